"""`pansplat bench model`: seconds, memory and error of each way to run the network."""

from __future__ import annotations

import dataclasses
import json
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import safetensors.torch
import torch
from torch import Tensor

from pansplat.atomic import replacing
from pansplat.bench.model_case import Measured, ModelCase, measure_case
from pansplat.data.views import Views

Watch = Callable[[str, "list[ModelRow]"], None]


@dataclass
class ModelRow:
    """One way to run the network, what it took, and how far it is from the first row of the same `compat`.

    That row is in float32 and untiled. None is what was not measured.

    Attributes:
        compat, precision, attention, threads, tiles: see `ModelCase`.
        height: of the panoramas, pixels.
        stages_s: seconds of each part.
        total_s: their sum.
        processor_s: of all threads together: what to look at where others use the machine too.
        peak_gib: the process's largest resident memory, 2^30 bytes.
        num_gaussians: that were predicted.
        depth_median_error, depth_max_error: |depth - reference| / reference of the finest sweep.
        psnr_db: between the pictures at the middle pose, drawn by numba; infinite where they are the same.
        is_reference: whether others are compared with this row.
    """

    compat: str
    precision: str
    attention: str
    threads: int
    tiles: int
    height: int
    stages_s: dict[str, float] = field(default_factory=dict)
    total_s: float | None = None
    processor_s: float | None = None
    peak_gib: float | None = None
    num_gaussians: int | None = None
    depth_median_error: float | None = None
    depth_max_error: float | None = None
    psnr_db: float | None = None
    is_reference: bool = False


def model_cases(threads: int, *, bfloat16: bool, quick: bool) -> list[ModelCase]:
    """Ways to run the network; the first of each `compat` is what the others are compared with."""
    plain = ModelCase("fixed", "float32", "float32", threads, tiles=1)
    cases = [plain]
    if bfloat16:
        cases.append(dataclasses.replace(plain, precision="bfloat16"))
        cases.append(dataclasses.replace(plain, precision="bfloat16", attention="bfloat16"))
    if quick:
        return cases
    cases.insert(1, dataclasses.replace(plain, attention="bfloat16"))
    cases += [dataclasses.replace(plain, tiles=tiles) for tiles in (2, 4)]
    if bfloat16:
        cases.append(dataclasses.replace(plain, precision="bfloat16", tiles=2))
    if threads > 1:
        cases.append(dataclasses.replace(plain, threads=1))
    official = dataclasses.replace(plain, compat="official")
    cases.append(official)
    if bfloat16:
        cases.append(dataclasses.replace(official, precision="bfloat16"))
    return cases


def measure_model(
    cases: Sequence[ModelCase],
    views: Views,
    weights: Path,
    *,
    watch: Watch,
    rows: list[ModelRow],
) -> None:
    """Run the cases one after another, each in a process of its own; `rows` grows as they end.

    Raises:
        InputError: a case fails, as for want of memory.
    """
    references: dict[str, Measured] = {}
    with _kept(views) as kept:
        for number, case in enumerate(cases, start=1):
            watch(f"{number} of {len(cases)}: {describe_case(case)}", rows)
            measured = measure_case(case, weights, kept, near=views.near, far=views.far)
            reference = references.setdefault(case.compat, measured)
            rows.append(_row(case, measured, reference))
            watch("", rows)


def describe_case(case: ModelCase) -> str:
    """The case in words."""
    threads = "one thread" if case.threads == 1 else f"{case.threads} threads"
    return f"{case.compat}, {case.precision}, attention {case.attention}, {case.tiles}x{case.tiles} tiles, {threads}"


def relative_errors(depth: Tensor, reference: Tensor) -> tuple[float, float]:
    """Median and largest of |depth - reference| / reference."""
    relative = (depth.double() - reference.double()).abs() / reference.double()
    return float(relative.median()), float(relative.max())


def psnr(picture: Tensor, reference: Tensor) -> float:
    """Of colours in [0, 1], decibels; infinite where the pictures are the same."""
    error = (picture.double().clamp(0, 1) - reference.double().clamp(0, 1)).pow(2).mean()
    return float(-10 * torch.log10(error))


def _row(case: ModelCase, measured: Measured, reference: Measured) -> ModelRow:
    row = ModelRow(
        **dataclasses.asdict(case),
        height=measured.picture.shape[-2],
        stages_s=measured.stages_s,
        total_s=sum(measured.stages_s.values()),
        processor_s=measured.processor_s,
        peak_gib=measured.peak_gib,
        num_gaussians=measured.num_gaussians,
        is_reference=measured is reference,
    )
    if not row.is_reference:
        row.depth_median_error, row.depth_max_error = relative_errors(measured.depth, reference.depth)
        row.psnr_db = psnr(measured.picture, reference.picture)
    return row


@contextmanager
def _kept(views: Views) -> Iterator[Path]:
    """A file of the panoramas for the children."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "views.safetensors")
        tensors = {"images": views.images.contiguous(), "cam2world": views.cam2world.contiguous()}
        safetensors.torch.save_file(tensors, path)
        yield path


def write_model_rows(path: Path, machine: dict[str, object], network: str, rows: Sequence[ModelRow]) -> None:
    """Write {machine, network, rows} as JSON; the file is whole at any moment.

    Raises:
        InputError: the file cannot be written.
    """
    content = {"machine": machine, "network": network, "rows": [_as_json(row) for row in rows]}
    with replacing(path) as partial:
        partial.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")


def _as_json(row: ModelRow) -> dict[str, object]:
    """The fields; an infinite PSNR becomes null, its largest error being 0."""
    values = dataclasses.asdict(row)
    if row.psnr_db == float("inf"):
        values["psnr_db"] = None
    return values
