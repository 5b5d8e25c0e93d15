"""`pansplat bench raster`: time and memory of the rasterisers against their error.

The cases of a group are rendered in turns, round after round, so that other load on the machine affects all of them.
The rows are saved after every image, so that an interruption loses nothing.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from pansplat.bench.fidelity import measure_fidelity
from pansplat.bench.harness import Timing, measure_peak_memory, quartile_range, restore_threads, time_call
from pansplat.bench.raster_cases import BenchScene, Group, RasterCase
from pansplat.bench.renderers import (
    RenderedImage,
    device_of,
    release_workspace,
    render_case,
    render_with_graph,
    warm_up,
)
from pansplat.bench.report import Column, Report, Row, format_threads, result_column
from pansplat.gaussians.scene import Gaussians

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MIN_REPEATS, _MAX_REPEATS = 3, 15  # of fast cases
_MARKERS = {"numba": "o", "torch": "s", "triton": "D"}
_KERNEL_COLORS = {"ray": "#1764ab", "ewa": "#c8501e"}
_FRONT_COLOR = "#2a8c4a"
_MIN_ERROR = 1e-8  # smaller errors are plotted at this value


@dataclass
class RasterResult:
    """Time, memory and errors of one way to render an image.

    Errors are those of the colours against the exact image: kernel "ray", order "radial", filter "angular", one ray per
    pixel, float64. Errors with the prefix `own` are against the float64 image of the case's own kernel, order, filter,
    layout and faces: those of the backend alone.

    Attributes:
        num_gaussians: of the scene.
        forward_ms, forward_min_ms: median and minimum, without gradients.
        forward_spread_ms: range between the quartiles.
        backward_ms, backward_min_ms, backward_spread_ms: of the backward pass alone, to all fields of the Gaussians.
        forward_cpu_ms, backward_cpu_ms: minimum of the processor time, of all threads together.
        repeats: number of timed images.
        peak_mb: largest additional memory of the forward pass without gradients, 10^6 bytes.
        backward_peak_mb: likewise, of forward and backward together.
        psnr_db, max_error, seam_jump, energy_error: see `fidelity.Fidelity`.
        stages_ms: by the backend's own clock, of the fastest forward pass.
    """

    num_gaussians: int
    forward_ms: float | None = None
    forward_min_ms: float | None = None
    forward_spread_ms: float | None = None
    forward_cpu_ms: float | None = None
    backward_ms: float | None = None
    backward_min_ms: float | None = None
    backward_spread_ms: float | None = None
    backward_cpu_ms: float | None = None
    repeats: int = 0
    peak_mb: float | None = None
    backward_peak_mb: float | None = None
    psnr_db: float | None = None
    max_error: float | None = None
    seam_jump: float | None = None
    energy_error: float | None = None
    own_psnr_db: float | None = None
    own_max_error: float | None = None
    stages_ms: dict[str, float] = field(default_factory=dict)

    def set_times(self, name: str, timings: Sequence[Timing]) -> None:
        """Set the fields of the forward or backward pass from its timings."""
        walls = [1e3 * timing.wall for timing in timings]
        setattr(self, f"{name}_ms", statistics.median(walls))
        setattr(self, f"{name}_min_ms", min(walls))
        setattr(self, f"{name}_spread_ms", quartile_range(walls))
        setattr(self, f"{name}_cpu_ms", 1e3 * min(timing.cpu for timing in timings))

    def set_errors(self, case: RasterCase, color: Tensor, exact: Tensor | None, own: Tensor | None) -> None:
        """Set the errors against the exact image and against the float64 image of the case's own choices."""
        panorama = case.layout != "pinhole"
        if exact is not None:
            errors = measure_fidelity(color, exact, panorama=panorama)
            self.max_error, self.psnr_db = errors.max_error, errors.psnr_db
            self.seam_jump, self.energy_error = errors.seam_jump, errors.energy_error
        if own is not None:
            errors = measure_fidelity(color, own, panorama=panorama)
            self.own_max_error, self.own_psnr_db = errors.max_error, errors.psnr_db


RasterRow = Row[RasterCase, RasterResult]


@dataclass(eq=False)
class _Measurement:
    """A row and its timings."""

    row: RasterRow
    repeats: int = 1
    forward: list[Timing] = field(default_factory=list)
    backward: list[Timing] = field(default_factory=list)

    @property
    def case(self) -> RasterCase:
        return self.row.case

    @property
    def needs_forward(self) -> bool:
        return len(self.forward) < self.repeats

    @property
    def needs_backward(self) -> bool:
        return self.case.backward and len(self.backward) < self.repeats

    @property
    def is_done(self) -> bool:
        return not self.needs_forward and not self.needs_backward

    def update_row(self) -> None:
        self.row.result.repeats = len(self.forward)
        for name, timings in (("forward", self.forward), ("backward", self.backward)):
            if timings:
                self.row.result.set_times(name, timings)


class RasterBench:
    """Measures groups of cases and adds their rows to a report."""

    def __init__(self, report: Report[RasterRow], *, budget: float = 2.0, slow: float = 5.0) -> None:
        """Begin a run.

        Args:
            report: gets the rows.
            budget: seconds for the repeats of a case.
            slow: seconds; a case whose first image takes longer is not repeated.
        """
        self._report, self._budget, self._slow = report, budget, slow
        self._references: dict[tuple[str, RasterCase], Tensor] = {}  # by the name of the scene
        self._scene: BenchScene | None = None
        self._gaussians: Gaussians | None = None

    def run(self, groups: Iterable[Group]) -> None:
        """Measure all groups.

        Raises:
            InputError: the file of rows cannot be written, or a scene cannot be read.
        """
        for group in groups:
            self._load(group.scene)
            with restore_threads():
                self._measure(group)

    def _load(self, scene: BenchScene) -> None:
        if scene is self._scene:
            return
        self._report.update(f"{scene.name}: making the scene")
        if self._scene is None or scene.name != self._scene.name:
            self._gaussians = None  # two large scenes might not fit in memory
            self._gaussians = scene.load()
        self._scene = scene

    def _measure(self, group: Group) -> None:
        measurements = []
        for case in group.cases:
            references = self._reference_images(group, case)
            self._report.update(f"{case}: first image")
            measurement = _Measurement(self._new_row(group, case))
            measurement.row.result.set_errors(case, self._render_first(measurement).color, *references)
            self._report.add(measurement.row)
            measurements.append(measurement)
        while not all(measurement.is_done for measurement in measurements):
            for measurement in measurements:
                if not measurement.is_done:
                    step = f"{len(measurement.forward) + 1} of {measurement.repeats}"
                    self._report.update(f"{measurement.case}: {step}")
                    self._render_again(measurement)
        self._report.update()

    def _reference_images(self, group: Group, case: RasterCase) -> tuple[Tensor | None, Tensor | None]:
        """The exact image and the float64 image of the case's own choices, as far as the group needs them."""
        exact = None if group.references == "none" else self._reference_image(group, case.exact)
        own = self._reference_image(group, case.reference) if group.references == "own" else None
        return exact, own

    def _reference_image(self, group: Group, case: RasterCase) -> Tensor:
        """A float64 image; rendered once for each scene, which is a row as well."""
        key = group.scene.name, case
        if key not in self._references:
            self._report.update(f"{case}: float64 reference")
            measurement = _Measurement(self._new_row(group, case))
            color = self._references[key] = self._render_first(measurement).color
            exact = color if case == case.exact else self._reference_image(group, case.exact)
            measurement.row.result.set_errors(case, color, exact, None)
            self._report.add(measurement.row)
        return self._references[key]

    def _new_row(self, group: Group, case: RasterCase) -> RasterRow:
        assert self._gaussians is not None
        return Row(group.suite, group.scene.name, case, RasterResult(len(self._gaussians)))

    def _render_first(self, measurement: _Measurement) -> RenderedImage:
        """Render the first image: warm up, measure the memory, choose the number of repeats."""
        case, result = measurement.case, measurement.row.result
        release_workspace(case.backend)
        result.peak_mb, (image, timing) = measure_peak_memory(lambda: self._time_forward(case), device_of(case.backend))
        walls = [timing.wall]
        result.stages_ms = {name: 1e3 * value for name, value in image.stages.items()}
        if timing.wall > self._slow or case.precision == "float64":
            measurement.forward.append(timing)
        if case.backward:
            release_workspace(case.backend)
            device = device_of(case.backend)
            result.backward_peak_mb, timing = measure_peak_memory(lambda: self._time_backward(case), device)
            walls.append(timing.wall)
            if timing.wall > self._slow:
                measurement.backward.append(timing)
        if case.precision != "float64" and max(walls) <= self._slow:
            measurement.repeats = min(_MAX_REPEATS, max(_MIN_REPEATS, int(self._budget / sum(walls))))
        measurement.update_row()
        return image

    def _render_again(self, measurement: _Measurement) -> None:
        if measurement.needs_forward:
            image, timing = self._time_forward(measurement.case)
            if not measurement.forward or timing.wall < min(other.wall for other in measurement.forward):
                measurement.row.result.stages_ms = {name: 1e3 * value for name, value in image.stages.items()}
            measurement.forward.append(timing)
        if measurement.needs_backward:
            measurement.backward.append(self._time_backward(measurement.case))
        measurement.update_row()

    def _prepare(self, case: RasterCase) -> tuple[Gaussians, Tensor]:
        """Set the case's number of threads, warm up, and return the scene in its precision and the pose."""
        assert self._scene is not None and self._gaussians is not None
        torch.set_num_threads(case.threads)
        warm_up(case)
        dtype, device = getattr(torch, case.precision), device_of(case.backend)
        return self._gaussians.to(dtype=dtype, device=device), self._scene.pose

    @torch.no_grad()
    def _time_forward(self, case: RasterCase) -> tuple[RenderedImage, Timing]:
        gaussians, pose = self._prepare(case)
        timing, image = time_call(lambda: render_case(case, gaussians, pose), device_of(case.backend))
        return image, timing

    def _time_backward(self, case: RasterCase) -> Timing:
        gaussians, pose = self._prepare(case)
        image, leaves, grad_color = render_with_graph(case, gaussians, pose)
        device = device_of(case.backend)
        timing, _ = time_call(lambda: torch.autograd.grad(image.color, leaves, grad_color), device)
        return timing


def make_raster_report(
    machine: Mapping[str, Any], *, json: Path | None = None, plot: Path | None = None, page: Path | None = None
) -> Report[RasterRow]:
    """The report of a run.

    Args:
        machine: from `describe_machine`.
        json: file of the rows.
        plot: time against error; the costs over counts and resolutions go to a second file, NAME_sweeps.
        page: tables in Markdown.
    """
    plots = {} if plot is None else {
        plot: plot_choices, plot.with_name(f"{plot.stem}_sweeps{plot.suffix}"): plot_sweeps
    }  # fmt: skip
    return Report(
        RASTER_COLUMNS,
        _section,
        machine,
        facts=("cpu", "threads", "gpu"),
        findings=list_findings,
        json_file=json,
        page=page,
        plots=plots,
        width=210,
    )


def _section(row: RasterRow) -> str:
    """The table of a row: one for each suite and scene; a sweep has one for all its scenes."""
    return row.suite if row.suite in ("count", "resolution") else f"{row.suite}: {row.scene}"


def _times(title: str, name: str, spread: str | None = None) -> Column[RasterRow]:
    return Column(title, lambda row: _time(getattr(row.result, name), getattr(row.result, spread) if spread else None))


def _time(middle: float | None, spread: float | None) -> str:
    """Milliseconds with three digits, and half the range between the quartiles."""
    if middle is None:
        return ""
    digits = 0 if middle >= 100 else 1 if middle >= 10 else 2
    return f"{middle:,.{digits}f}" + (f" ±{spread / 2:.{digits}f}" if spread else "")


def _renderer(row: RasterRow) -> str:
    return row.case.backend if row.case.precision == "float32" else f"{row.case.backend} {row.case.precision}"


RASTER_COLUMNS: tuple[Column[RasterRow], ...] = (
    Column("renderer", _renderer, "left"),
    Column("kernel", lambda row: row.case.kernel, "left"),
    Column("order", lambda row: row.case.order, "left"),
    Column("filter", lambda row: row.case.filter, "left"),
    Column("layout", lambda row: row.case.layout_name, "left"),
    Column("height", lambda row: str(row.case.height)),
    result_column("Gaussians", "{:,}", "num_gaussians"),
    Column("threads", lambda row: str(row.case.threads)),
    _times("forward ms", "forward_ms", "forward_spread_ms"),
    _times("CPU", "forward_cpu_ms"),
    _times("backward ms", "backward_ms", "backward_spread_ms"),
    _times("CPU", "backward_cpu_ms"),
    result_column("peak MB", "{:,.0f}", "peak_mb"),
    result_column("PSNR dB", "{:.1f}", "psnr_db"),
    result_column("max error", "{:.1e}", "max_error"),
    result_column("seam", "{:.1e}", "seam_jump"),
    result_column("energy", "{:+.2%}", "energy_error"),
    result_column("own error", "{:.1e}", "own_max_error"),
)


def _direct_rows(rows: Sequence[RasterRow], suite: str, backend: str) -> list[RasterRow]:
    """Timed float32 rows of the exact direct panorama, by number of threads."""
    chosen = [
        row
        for row in rows
        if (row.suite, row.case.backend, row.case.layout, row.case.filter) == (suite, backend, "equirect", "angular")
        and row.case.precision == "float32"
        and row.result.forward_ms is not None
    ]
    return sorted(chosen, key=lambda row: row.case.threads)


def list_findings(rows: Sequence[RasterRow]) -> list[str]:
    """Speed against torch, as sentences."""
    return [
        f"{row.case.backend} on {format_threads(row.case.threads)} is {_speedup(torch_row, row)} as fast as the tiled "
        f"torch reference on one, {_size(row)}."
        for torch_row in _direct_rows(rows, "headline", "torch")[:1]
        for row in (*_direct_rows(rows, "headline", "numba"), *_direct_rows(rows, "headline", "triton"))
    ]


def _speedup(slow: RasterRow, fast: RasterRow) -> str:
    """How many times faster, by elapsed and by processor time."""
    a, b = slow.result, fast.result
    text = [f"{_quotient(a.forward_ms, b.forward_ms)} times"]
    if a.backward_ms and b.backward_ms:
        text.append(f"(backward {_quotient(a.backward_ms, b.backward_ms)} times)")
    if a.forward_cpu_ms and b.forward_cpu_ms and slow.case.threads == fast.case.threads:
        cpu = _quotient(a.forward_cpu_ms, b.forward_cpu_ms)
        if a.backward_cpu_ms and b.backward_cpu_ms:
            cpu += f" and {_quotient(a.backward_cpu_ms, b.backward_cpu_ms)}"
        text.append(f"[by processor time {cpu}]")
    return " ".join(text)


def _quotient(slow: float | None, fast: float | None) -> str:
    assert slow is not None and fast
    return f"{slow / fast:,.0f}"


def _size(row: RasterRow) -> str:
    return f"{row.case.height}x{2 * row.case.height}, {row.result.num_gaussians:,} Gaussians"


def find_pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of the points that no other point beats in both numbers, by increasing first number.

    Of equal points all or none are on the front.
    """
    front = []
    for index in sorted(range(len(points)), key=lambda i: points[i]):
        if not front or points[index][1] < points[front[-1]][1] or points[index] == points[front[-1]]:
            front.append(index)
    return front


def plot_choices(rows: Sequence[RasterRow]) -> Figure | None:
    """Plot the root mean square error over the time, both logarithmic; None if there is nothing to plot."""
    from matplotlib.figure import Figure

    shown, points = [], []
    for row in rows:
        result = row.result
        if row.suite == "choices" and row.case.layout != "pinhole" and result.forward_ms and result.psnr_db is not None:
            shown.append(row)
            points.append((result.forward_ms, max(_MIN_ERROR, 10 ** (-result.psnr_db / 20))))
    if not shown:
        return None
    figure = Figure(figsize=(10, 6.5), layout="constrained")
    axes = figure.subplots()
    for row, (x, y) in zip(shown, points, strict=True):
        color = _KERNEL_COLORS[row.case.kernel]
        fill = color if row.case.filter == "angular" else "none"
        edge = color if row.case.precision == "float32" else "#444444"
        marker = _MARKERS.get(row.case.backend, "*")
        axes.scatter(x, y, s=55, marker=marker, facecolors=fill, edgecolors=edge, zorder=3)
    front = find_pareto_front(points)
    axes.plot(*zip(*(points[i] for i in front), strict=True), color=_FRONT_COLOR, linewidth=1.5, zorder=2)
    axes.set(xscale="log", yscale="log", xlabel="forward, milliseconds")
    axes.set_ylim(bottom=min(axes.get_ylim()[0], 0.03 * min(y for _, y in points)))
    _annotate(axes, [(points[i], _describe_choice(shown[i])) for i in front])
    axes.set_ylabel(f"root mean square error of the colours (the exact image is plotted at {_MIN_ERROR:.0e})")
    axes.set_title(f"{shown[0].scene}: {_size(shown[0])}", loc="left")
    decibels = axes.secondary_yaxis("right", functions=(lambda y: y, lambda y: y))
    decibels.set_yticks([10.0**-k for k in range(9)], [f"{20 * k} dB" for k in range(9)])
    _add_choice_legend(axes, shown)
    axes.grid(alpha=0.25)
    return figure


def _describe_choice(row: RasterRow) -> str:
    case = row.case
    layout = "direct" if case.layout == "equirect" else f"faces of {case.face_size}"
    order = "" if case.layout == "equirect" else f" {case.order}"
    return f"{case.backend} {case.kernel}{order} {case.filter}, {layout}" + (" float64" * (case.precision == "float64"))


def _annotate(axes: Axes, labels: list[tuple[tuple[float, float], str]]) -> None:
    """Label points: above them in the left half, below them in the right half, at three distances in turn."""
    low, high = (math.log(edge) for edge in axes.get_xlim())
    for index, (point, name) in enumerate(labels):
        above = math.log(point[0]) < 0.5 * (low + high)
        axes.annotate(
            name,
            point,
            xytext=(14, 12 + 13 * (index % 3)) if above else (-14, -12 - 13 * (index % 3)),
            textcoords="offset points",
            ha="left" if above else "right",
            fontsize=8,
            arrowprops={"arrowstyle": "-", "color": "#999999", "linewidth": 0.6},
        )


def _add_choice_legend(axes: Axes, rows: Sequence[RasterRow]) -> None:
    for backend in dict.fromkeys(row.case.backend for row in rows):
        axes.scatter([], [], marker=_MARKERS.get(backend, "*"), color="#888888", label=backend)
    for kernel in dict.fromkeys(row.case.kernel for row in rows):
        axes.plot([], [], linewidth=4, color=_KERNEL_COLORS[kernel], label=f"kernel {kernel}")
    axes.scatter([], [], marker="o", facecolors="none", edgecolors="#888888", label="hollow: filter 3dgs")
    axes.scatter([], [], marker="s", facecolors="#cccccc", edgecolors="#444444", label="dark edge: float64")
    axes.plot([], [], color=_FRONT_COLOR, label="Pareto front")
    axes.legend(fontsize=8, loc="best")


def plot_sweeps(rows: Sequence[RasterRow]) -> Figure | None:
    """Plot the minimum times over the number of Gaussians and of pixels; None if there is nothing to plot."""
    from matplotlib.figure import Figure

    timed = [row for row in rows if row.result.forward_ms]
    sweeps = {suite: [row for row in timed if row.suite == suite] for suite in ("count", "resolution")}
    if not any(sweeps.values()):
        return None
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    heights = {row.case.height for row in sweeps["count"]}
    size = f" at {max(heights)}x{2 * max(heights)}" if heights else ""
    _plot_curves(left, sweeps["count"], lambda row: row.result.num_gaussians)
    left.set(xlabel="Gaussians" + size, title="number of Gaussians, same image size")
    _plot_curves(right, sweeps["resolution"], lambda row: row.case.height)
    right.set(xlabel="height of the panorama, pixels", title="image size, scene of the same size")
    for axes in (left, right):
        axes.set_ylabel("milliseconds, minimum of the repeats")
    return figure


def _plot_curves(axes: Axes, rows: Sequence[RasterRow], x: Callable[[RasterRow], int]) -> None:
    for backend in dict.fromkeys(row.case.backend for row in rows):
        curve = sorted((row for row in rows if row.case.backend == backend), key=x)
        threads = f", {curve[0].case.threads} threads" if curve[0].case.threads > 1 else ""
        for name, style in (("forward", "-"), ("backward", "--")):
            points = [(x(row), getattr(row.result, f"{name}_min_ms")) for row in curve]
            points = [point for point in points if point[1]]
            if points:
                label = f"{backend} {name}{threads}"
                axes.plot(*zip(*points, strict=True), style, marker=_MARKERS.get(backend, "*"), label=label)
    axes.set(xscale="log", yscale="log")
    axes.grid(alpha=0.25, which="both")
    low, high = axes.get_ylim()
    if high < 10 * low:  # a smaller range would exaggerate noise
        middle = math.sqrt(low * high)
        axes.set_ylim(middle / math.sqrt(10), middle * math.sqrt(10))
    if rows:
        axes.legend(fontsize=8)
