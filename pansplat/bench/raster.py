"""`pansplat bench raster`: draws the groups of a plan, and keeps what each way of drawing took and how wrong it is.

Cases of a group are drawn in turn, again and again, so that what else the machine does meets them all alike. The
file of results is written after every picture: an interruption loses nothing that was measured.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pansplat.bench.cases import Case, Group, Subject
from pansplat.bench.drawing import NEAR, Picture, device_of, draw, draw_and_differentiate, forget, wake
from pansplat.bench.fidelity import fidelity
from pansplat.bench.measure import Took, median, peak_memory, seconds, spread
from pansplat.bench.rows import Row, write_rows
from pansplat.bench.work import BACKWARD_OPERATIONS, FORWARD_OPERATIONS, Work, panorama_work
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering.rasterize import RasterOptions

Watch = Callable[[str, "list[Row]"], None]

_LEAST, _MOST = 3, 15  # repeats of what is not slow


@dataclass(eq=False)
class _Lane:
    """A case, its row, and the times taken so far."""

    case: Case
    row: Row
    wanted: int = 1
    forward: list[Took] = field(default_factory=list)
    backward: list[Took] = field(default_factory=list)

    @property
    def needs_forward(self) -> bool:
        return len(self.forward) < self.wanted

    @property
    def needs_backward(self) -> bool:
        return self.case.backward and len(self.backward) < self.wanted

    @property
    def done(self) -> bool:
        return not self.needs_forward and not self.needs_backward

    def write_times(self) -> None:
        """Bring the row up to date."""
        self.row.repeats = len(self.forward)
        for name, times in (("forward", self.forward), ("backward", self.backward)):
            if times:
                walls = [1e3 * one.wall for one in times]
                setattr(self.row, f"{name}_ms", median(walls))
                setattr(self.row, f"{name}_min_ms", min(walls))
                setattr(self.row, f"{name}_spread_ms", spread(walls))
                setattr(self.row, f"{name}_cpu_ms", 1e3 * min(one.cpu for one in times))


class Bench:
    """One run: measures groups, and holds the rows.

    Attributes:
        machine: what `machine.describe_machine` tells.
        rows: what is measured so far.
    """

    def __init__(
        self,
        machine: dict[str, Any],
        *,
        file: Path | None = None,
        budget: float = 2.0,
        slow: float = 5.0,
        watch: Watch | None = None,
    ) -> None:
        """Begin a run.

        Args:
            machine: written with the rows; its peaks are what they are compared with.
            file: JSON that is written after every picture.
            budget: seconds a case may take for its repeats.
            slow: seconds; a first drawing that takes longer counts as the measurement.
            watch: told what is being done, and the rows.
        """
        self.machine = machine
        self.rows: list[Row] = []
        self._file, self._budget, self._slow, self._watch = file, budget, slow, watch
        self._truths: dict[tuple[str, Case], Tensor] = {}  # by the scene's name
        self._work: dict[tuple[str, Case], Work] = {}
        self._scene: Subject | None = None
        self._gaussians: Gaussians | None = None

    def run(self, groups: Iterable[Group]) -> list[Row]:
        """Measure all groups.

        Raises:
            InputError: the file cannot be written, or a scene cannot be read.
        """
        for group in groups:
            self._load(group.subject)
            with _threads_restored():
                self._measure(group)
        return self.rows

    def add(self, rows: Iterable[Row]) -> None:
        """Take in rows that were measured elsewhere."""
        self.rows += rows
        self._save("")

    def truths(self, group: Group, case: Case) -> tuple[Tensor | None, Tensor | None]:
        """The exact picture, and the float64 picture of a case's own choices, as far as the group asks for them."""
        self._load(group.subject)
        with _threads_restored():
            exact = None if group.truths == "none" else self._truth(group, case.exact)
            own = self._truth(group, case.truth) if group.truths == "own" else None
        return exact, own

    def _load(self, subject: Subject) -> None:
        if subject is self._scene:
            return
        self._save(f"{subject.name}: making the scene")
        if self._scene is None or subject.name != self._scene.name:
            self._gaussians = None  # two large scenes at once might not fit
            self._gaussians = subject.load()
        self._scene = subject

    def _measure(self, group: Group) -> None:
        lanes = []
        for case in group.cases:
            truths = self.truths(group, case)
            self._save(_told(case, "first drawing"))
            lane = _Lane(case, self._row(group.suite, case))
            judge(lane.row, case, self._first(lane).color, *truths)
            self.rows.append(lane.row)
            lanes.append(lane)
        while not all(lane.done for lane in lanes):
            for lane in lanes:
                if not lane.done:
                    self._save(_told(lane.case, f"{len(lane.forward) + 1} of {lane.wanted}"))
                    self._again(lane)
        for lane in lanes:
            self._relate_to_peaks(lane)
        self._save("")

    def _truth(self, group: Group, case: Case) -> Tensor:
        """A float64 picture of the scene; drawn once, and that drawing is a row as well."""
        key = group.subject.name, case
        if key not in self._truths:
            self._save(_told(case, "the float64 reference"))
            lane = _Lane(case, self._row(group.suite, case))
            self._truths[key] = self._first(lane).color
            exact = self._truths[key] if case == case.exact else self._truth(group, case.exact)
            judge(lane.row, case, self._truths[key], exact, None)
            self.rows.append(lane.row)
        return self._truths[key]

    def _row(self, suite: str, case: Case) -> Row:
        assert self._scene is not None and self._gaussians is not None
        values = dataclasses.asdict(case)
        del values["backward"]
        return Row(suite=suite, scene=self._scene.name, num_gaussians=len(self._gaussians), **values)

    def _first(self, lane: _Lane) -> Picture:
        """Draw for the first time: warms up, measures memory, decides how often to draw again."""
        case, row = lane.case, lane.row
        forget(case.backend)
        row.peak_mb, (picture, took) = peak_memory(lambda: self._forward(case), device_of(case.backend))
        walls = [took.wall]
        row.stages_ms = {name: 1e3 * value for name, value in picture.stages.items()}
        if took.wall > self._slow or case.precision == "float64":
            lane.forward.append(took)
        if case.backward:
            forget(case.backend)
            row.backward_peak_mb, took = peak_memory(lambda: self._backward(case), device_of(case.backend))
            walls.append(took.wall)
            if took.wall > self._slow:
                lane.backward.append(took)
        slow = case.precision == "float64" or max(walls) > self._slow
        lane.wanted = 1 if slow else min(_MOST, max(_LEAST, int(self._budget / sum(walls))))
        lane.write_times()
        return picture

    def _again(self, lane: _Lane) -> None:
        if lane.needs_forward:
            picture, took = self._forward(lane.case)
            if not lane.forward or took.wall < min(one.wall for one in lane.forward):
                lane.row.stages_ms = {name: 1e3 * value for name, value in picture.stages.items()}
            lane.forward.append(took)
        if lane.needs_backward:
            lane.backward.append(self._backward(lane.case))
        lane.write_times()

    def _prepared(self, case: Case) -> tuple[Gaussians, Tensor]:
        """The scene as the case needs it, and the pose; torch may use as many threads as the case."""
        assert self._scene is not None and self._gaussians is not None
        torch.set_num_threads(case.threads)
        wake(case)
        return self._gaussians.to(
            dtype=getattr(torch, case.precision), device=device_of(case.backend)
        ), self._scene.pose

    @torch.no_grad()
    def _forward(self, case: Case) -> tuple[Picture, Took]:
        gaussians, pose = self._prepared(case)
        took, picture = seconds(lambda: draw(case, gaussians, pose), device_of(case.backend))
        return picture, took

    def _backward(self, case: Case) -> Took:
        """Seconds of the backward pass alone."""
        gaussians, pose = self._prepared(case)
        picture, leaves, upstream = draw_and_differentiate(case, gaussians, pose)
        took, _ = seconds(lambda: torch.autograd.grad(picture.color, leaves, upstream), device_of(case.backend))
        return took

    def _relate_to_peaks(self, lane: _Lane) -> None:
        """How much of the machine's arithmetic and bandwidth a direct panorama reached."""
        case, row = lane.case, lane.row
        if case.layout != "equirect" or case.backend not in ("torch", "numba"):
            return
        if not row.forward_cpu_ms or not row.forward_min_ms:  # a clock may be too coarse for the smallest pictures
            return
        assert self._scene is not None and self._gaussians is not None
        key = row.scene, case.truth
        if key not in self._work:
            self._save(_told(case, "counting its work"))
            options = RasterOptions(case.kernel, case.order, case.filter, NEAR, strict=False)
            self._work[key] = panorama_work(self._gaussians, self._scene.pose, case.height, options)
        work, threads = self._work[key], str(case.threads)
        row.pairs = work.pairs
        flops = 1e6 * self.machine["fma_gflops"]["1"]  # of a thread, a millisecond
        row.fma_fraction = FORWARD_OPERATIONS * work.pairs / flops / row.forward_cpu_ms
        row.bandwidth_fraction = work.bytes / (1e6 * self.machine["bandwidth_gb_s"][threads]) / row.forward_min_ms
        if row.backward_cpu_ms:
            row.backward_fma_fraction = BACKWARD_OPERATIONS * work.pairs / flops / row.backward_cpu_ms

    def _save(self, doing: str) -> None:
        """Write what there is, and tell what comes next."""
        if self._file is not None:
            write_rows(self._file, self.machine, self.rows)
        if self._watch is not None:
            self._watch(doing, self.rows)


def judge(row: Row, case: Case, color: Tensor, exact: Tensor | None, own: Tensor | None) -> None:
    """Write a picture's errors into its row: against the exact picture, and against that of its own choices."""
    panorama = case.layout != "pinhole"
    if exact is not None:
        found = fidelity(color, exact, panorama=panorama)
        row.max_error, row.psnr_db = found.max_error, found.psnr_db
        row.seam_jump, row.energy_error = found.seam_jump, found.energy_error
    if own is not None:
        found = fidelity(color, own, panorama=panorama)
        row.own_max_error, row.own_psnr_db = found.max_error, found.psnr_db


def _told(case: Case, doing: str) -> str:
    faces = f" {case.face_size}" if case.face_size else ""
    choice = f"{case.backend} {case.kernel} {case.order} {case.filter} {case.layout}{faces}"
    return f"{choice}, height {case.height}, {case.threads} threads: {doing}"


@contextlib.contextmanager
def _threads_restored() -> Iterator[None]:
    threads = torch.get_num_threads()
    try:
        yield
    finally:
        torch.set_num_threads(threads)
