"""`pansplat bench memory`: peak memory of training and inference over resolutions, as in the paper's memory figure.

Source: PanSplat, section 3.4 and its figure of GPU memory.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import safetensors.torch
from torch import Tensor

from pansplat.atomic import replacing
from pansplat.bench.memory_case import (
    MATCHED_HEIGHT,
    MemoryCase,
    MemorySetting,
    OverLimit,
    RowFailed,
    Taken,
    Work,
    take,
)
from pansplat.errors import InputError

Status = Literal["measured", "not tried", "over the limit", "died"]
Watch = Callable[[str, "list[MemoryRow]"], None]

_TILES = (1, 2, 4)
_GROWTH = 4.0  # of memory, at most, when the height doubles


@dataclass
class MemoryRow:
    """One way to work at one height, and what it took. None is what was not measured.

    Attributes:
        work, tiles, height: see `MemoryCase`.
        status: whether it was measured, and why not.
        note: what happened, in words.
        base_gib: held before: Python, libraries, weights, input. 2^30 bytes.
        peak_gib: the most that was held at once, the base included.
        wall_s, processor_s: seconds on the clock, and of all threads together.
        num_gaussians: that were predicted.
        deviation: |result - reference| / |reference|, Euclidean: of all gradients together, or the largest among the
            prediction's means, opacities and picture.
        reference: whether others of the same kind and height are compared with this row.
    """

    work: Work
    tiles: int
    height: int
    status: Status
    note: str = ""
    base_gib: float | None = None
    peak_gib: float | None = None
    wall_s: float | None = None
    processor_s: float | None = None
    num_gaussians: int | None = None
    deviation: float | None = None
    reference: bool = False

    @property
    def taken_gib(self) -> float | None:
        """What the work took beyond what was held before it, 2^30 bytes."""
        return None if self.peak_gib is None or self.base_gib is None else self.peak_gib - self.base_gib

    @property
    def case(self) -> MemoryCase:
        """What was done."""
        return MemoryCase(self.work, self.tiles, self.height)


def memory_cases(heights: Sequence[int], *, quick: bool) -> list[MemoryCase]:
    """By height, inference before training; of each kind the reference first, which keeps everything at once.

    Args:
        quick: leave out one-step, and all tiles but the fewest and the most.
    """
    tiles = (1, 4) if quick else _TILES
    kinds = [(work, number) for work in get_args(Work) for number in (tiles if work != "plain" else (1,))]
    kinds = [kind for kind in kinds if not (quick and kind[0] == "one-step")]
    return [MemoryCase(work, number, height) for height in sorted(heights) for work, number in kinds]


@dataclass(frozen=True)
class Measuring:
    """Where rows are measured and kept.

    Attributes:
        setting: of all rows.
        weights: file of the network's.
        folder: for the results that others are compared with, so that a run that was stopped goes on.
        watch: told what is being done.
    """

    setting: MemorySetting
    weights: Path
    folder: Path
    watch: Watch

    def run(self, cases: Sequence[MemoryCase], rows: list[MemoryRow]) -> None:
        """Measure the cases that `rows` has not measured, one after another.

        Args:
            rows: of earlier runs, too; grows, in the order of `memory_cases`. Those of other cases stay.
        """
        rows[:] = [row for row in rows if row.status == "measured" or row.case not in cases]
        self._forget_lost_references(cases, rows)
        for number, case in enumerate(cases, start=1):
            if case not in [row.case for row in rows]:
                self.watch(f"{number} of {len(cases)}: {describe(case)}", rows)
                known = [row for row in rows if row.status == "measured" or row.case in cases]
                rows.append(self._measured(case, known))  # what failed before may have had a lower limit
                rows.sort(key=lambda row: (row.height, get_args(Work).index(row.work), row.tiles))
            self.watch("", rows)

    def _forget_lost_references(self, cases: Sequence[MemoryCase], rows: list[MemoryRow]) -> None:
        """Measure anew what is to be compared with, but left no result, as after a run that came to its end."""
        done = {row.case for row in rows}
        to_compare = {(case.kind, case.height) for case in cases if case not in done}
        lost = [
            row
            for row in rows
            if row.reference and (row.case.kind, row.height) in to_compare and not self._result_of(row.case).is_file()
        ]
        rows[:] = [row for row in rows if row not in lost]

    def _result_of(self, case: MemoryCase) -> Path:
        return self.folder / f"{case.kind}_{case.height}.safetensors"

    def _measured(self, case: MemoryCase, rows: Sequence[MemoryRow]) -> MemoryRow:
        expected = expected_gib(case, rows)
        if expected > self.setting.limit_gib:
            note = f"{expected:.1f} GiB expected" if math.isfinite(expected) else "a lower panorama was too much"
            return MemoryRow(**dataclasses.asdict(case), status="not tried", note=note)
        try:
            taken = take(case, self.setting, self.weights)
        except OverLimit as error:
            return MemoryRow(**dataclasses.asdict(case), status="over the limit", note=str(error))
        except RowFailed as error:
            return MemoryRow(**dataclasses.asdict(case), status="died", note=str(error))
        return self._row(case, taken)

    def _row(self, case: MemoryCase, taken: Taken) -> MemoryRow:
        values = {f.name: getattr(taken, f.name) for f in dataclasses.fields(taken) if f.name != "result"}
        row = MemoryRow(**dataclasses.asdict(case), status="measured", **values)
        path = self._result_of(case)
        if path.is_file():
            row.deviation = deviation(taken.result, safetensors.torch.load_file(path), together=case.kind == "training")
        else:  # the first of its kind that came to an end
            row.reference = True
            with replacing(path) as partial:
                safetensors.torch.save_file(taken.result, partial)
        return row


def expected_gib(case: MemoryCase, rows: Sequence[MemoryRow]) -> float:
    """The memory a case may need, from the same work at the next lower height; 0 where nothing is known.

    Nothing is known of training above the height up to which all of the network learns.
    """
    lower = [r for r in rows if (r.work, r.tiles) == (case.work, case.tiles) and r.height < case.height]
    if case.kind == "training" and case.height > MATCHED_HEIGHT:
        lower = [row for row in lower if row.height > MATCHED_HEIGHT]
    if not lower:
        return 0.0
    row = max(lower, key=lambda r: r.height)
    if row.taken_gib is None or row.base_gib is None:
        return math.inf
    return row.base_gib + row.taken_gib * _GROWTH ** math.log2(case.height / row.height)


def deviation(result: dict[str, Tensor], reference: dict[str, Tensor], *, together: bool) -> float:
    """|result - reference| / |reference|, Euclidean.

    Args:
        together: of all tensors as one; else the largest of each by itself.

    Raises:
        ValueError: they do not hold the same.
    """
    if result.keys() != reference.keys():
        raise ValueError(f"needed {sorted(reference)}, got {sorted(result)}")
    apart = {name: float((result[name].double() - reference[name].double()).norm()) for name in reference}
    size = {name: float(reference[name].double().norm()) for name in reference}
    if together:
        return math.hypot(*apart.values()) / max(math.hypot(*size.values()), 1e-300)
    return max(apart[name] / max(size[name], 1e-300) for name in reference)


def describe(case: MemoryCase) -> str:
    """The case in words."""
    tiles = "untiled" if case.tiles == 1 else f"{case.tiles**2} tiles"
    work = case.work if case.work == "inference" else f"training, {case.work}"
    return f"{case.height}x{2 * case.height}, {work}, {tiles}"


def write_memory_rows(
    path: Path, machine: dict[str, object], setting: MemorySetting, rows: Sequence[MemoryRow]
) -> None:
    """Write {machine, setting, rows} as JSON; the file is whole at any moment.

    Raises:
        InputError: the file cannot be written.
    """
    content = {
        "machine": machine,
        "setting": dataclasses.asdict(setting),
        "rows": [{**dataclasses.asdict(row), "taken_gib": row.taken_gib} for row in rows],
    }
    with replacing(path) as partial:
        partial.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")


def kept_rows(path: Path, setting: MemorySetting) -> list[MemoryRow]:
    """The rows of an earlier run with the same settings, with those that could not be measured.

    Raises:
        InputError: the file is of other settings, or no such file at all.
    """
    if not path.is_file():
        return []
    names = {field.name for field in dataclasses.fields(MemoryRow)}
    try:
        content = json.loads(path.read_text())
        before = content["setting"]
        rows = [MemoryRow(**{name: row[name] for name in names}) for row in content["rows"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: needed rows of `pansplat bench memory`, got {error!r}; delete it.") from error
    now = dataclasses.asdict(setting)
    changed = [f"{name} was {before.get(name)}, now {now[name]}" for name in now if before.get(name) != now[name]]
    changed = [words for words in changed if not words.startswith("limit_gib")]
    if changed:
        raise InputError(f"{path}: measured otherwise ({'; '.join(changed)}); give another --out, or delete the file.")
    return rows
