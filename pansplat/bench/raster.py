"""`pansplat bench raster`: time and memory of the rasterisers against their error.

A case is a way to render an image; a group of cases answers one question on one scene. The cases of a group are
rendered in turns, round after round, so that other load on the machine affects all of them.

Values of a row: `forward_ms` is the median without gradients, `backward_ms` that of the backward pass alone, to all
fields of the Gaussians; each with `_min_ms`, `_spread_ms` (range between the quartiles) and `_cpu_ms` (minimum of the
processor time of all threads). `peak_mb` is the largest additional memory of a forward pass, 10^6 bytes. `psnr_db` and
`max_error` are against the exact image: kernel "ray", order "radial", filter "angular", one ray per pixel, float64.
"""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.bench.harness import (
    Timing,
    compare_images,
    measure_peak_memory,
    quartile_range,
    restore_threads,
    time_call,
)
from pansplat.bench.report import Benchmark, Column, Header, Report, Row, format_threads, make_axes
from pansplat.bench.scenes import full_lattice_room, lattice_room_size
from pansplat.constants import NEAR
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.pose import rotations_from_quats
from pansplat.rendering import rasterize
from pansplat.rendering.cpu.runtime import release_idle_memory
from pansplat.rendering.image_planes import Layout, Stitching
from pansplat.rendering.official import OFFICIAL, official_face_size
from pansplat.rendering.rasterize import Kernel, Lowpass, Order

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Precision = Literal["float32", "float64"]

_FIELDS = ("means", "scales", "quats", "opacities", "harmonics")
_MIN_REPEATS, _MAX_REPEATS = 3, 15  # of fast cases
_MAX_TORCH_GAUSSIANS = 4_000_000  # the torch reference renders them in minutes
_MAX_CHOICE_HEIGHT = 512  # pixels: every choice needs a float64 reference of its own
_MARKERS = {"numba": "o", "torch": "s", "triton": "D"}
_HEADLINE = ("headline", "equirect", "float32")  # suite, layout and precision
_MAX_PSNR = 160.0  # dB, of a plotted point


@dataclass(frozen=True)
class RasterCase:
    """A way to render an image.

    Attributes:
        backend: "torch", "numba" or "triton".
        height: pixels; a panorama is twice as wide, a pinhole image square with a field of view of 90 degrees.
        kernel, order, filter, layout: as in `pansplat.rasterize` (`filter` is its `lowpass`).
        face_size: of the faces of a cubemap, pixels.
        stitching: of a cubemap.
        threads: the largest number to use.
        backward: whether the backward pass is timed as well.
    """

    backend: str
    height: int
    kernel: Kernel = "ray"
    order: Order = "radial"
    filter: Lowpass = "angular"
    layout: Layout = "equirect"
    face_size: int | None = None
    stitching: Stitching = "seamless"
    precision: Precision = "float32"
    threads: int = 1
    backward: bool = True

    @property
    def device(self) -> torch.device:
        """The device that the backend renders on."""
        return torch.device("cuda" if self.backend == "triton" else "cpu")

    @property
    def exact(self) -> RasterCase:
        """The exact image: one ray per pixel, exact kernel, float64."""
        layout = "pinhole" if self.layout == "pinhole" else "equirect"
        return RasterCase("torch", self.height, layout=layout, precision="float64", backward=False)

    @property
    def layout_name(self) -> str:
        """The layout with the size of its faces and its stitching."""
        faces = f" {self.face_size}" if self.face_size else ""
        return f"{self.layout}{faces}{' official' if self.stitching == 'official' else ''}"

    def __str__(self) -> str:
        """The case as it is shown while it is measured."""
        choice = f"{self.backend} {self.kernel} {self.order} {self.filter} {self.layout_name}"
        return f"{choice}, height {self.height}, {format_threads(self.threads)}"

    def render(self, gaussians: Gaussians, pose: Float[Tensor, "4 4"]) -> Float[Tensor, "channel height width"]:
        """Colours on black, differentiable in the Gaussians, which have the case's precision and device."""
        rendered = rasterize(
            gaussians,
            pose,
            size=(self.height, self.height if self.layout == "pinhole" else 2 * self.height),
            layout=self.layout,
            kernel=self.kernel,
            order=self.order,
            lowpass=self.filter,
            near=NEAR,
            face_size=self.face_size,
            stitching=self.stitching,
            backend=self.backend,  # type: ignore[arg-type]
        )
        return rendered.color

    def prepare_backward(self, gaussians: Gaussians, pose: Float[Tensor, "4 4"]) -> Callable[[], object]:
        """The backward pass of an image that has been rendered: from a random gradient to the Gaussians' fields."""
        leaves = {name: getattr(gaussians, name).detach().requires_grad_() for name in _FIELDS}
        color = self.render(replace(gaussians, **leaves), pose)
        gradient = torch.rand(color.shape, generator=torch.Generator().manual_seed(0)).to(color)
        return lambda: torch.autograd.grad(color, list(leaves.values()), gradient)


@dataclass(frozen=True, eq=False)
class BenchScene:
    """A scene, which `load` makes as float32 Gaussians when they are needed, and the pose that it is rendered from."""

    name: str
    load: Callable[[], Gaussians]
    pose: Float[Tensor, "4 4"]


@dataclass(frozen=True, eq=False)
class Group:
    """Cases that are rendered in turns; the suite is their question: "headline", "choices" or "scene"."""

    suite: str
    scene: BenchScene
    cases: Sequence[RasterCase]


def make_room_scene(height: int) -> BenchScene:
    """The synthetic room, rendered from a pose between its cameras and slightly off the line through them.

    The camera is rotated so that no wall is parallel to a cube face: all points of such a wall have one depth, and
    order "z" would depend on rounding.
    """
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotations_from_quats(torch.tensor((0.97, 0.06, 0.21, 0.04), dtype=torch.float64))
    pose[:3, 3] = torch.tensor((0.1, 0.05, 0.15))
    return BenchScene(f"room {height}", partial(full_lattice_room, _multiple_of_8(height)), pose)


def choice_height(height: int, *, quick: bool) -> int:
    """Height of the images that compare every choice; smaller in a quick run."""
    return min(_multiple_of_8(0.375 * height) if quick else height, _MAX_CHOICE_HEIGHT)


def list_raster_groups(
    scene_of: Callable[[int], BenchScene], height: int, backends: Sequence[str], threads: int, *, quick: bool
) -> list[Group]:
    """The main choices on the scene of this height, and all choices on the one of `choice_height`.

    Args:
        scene_of: the scene for a height.
        height: of the largest images, pixels.
        backends: available ones besides torch.
        threads: the largest number to use.
        quick: minutes instead of an hour.
    """
    small = choice_height(height, quick=quick)
    headline = [case for name in backends for case in list_main_choices(name, height, threads)]
    headline += [RasterCase(name, height) for name in backends if threads > 1]
    headline += [RasterCase("torch", height)] if lattice_room_size(height) <= _MAX_TORCH_GAUSSIANS else []
    choices = [case for name in backends for case in list_choices(name, small, threads)]
    choices += list_main_choices("torch", small, 1) + ([] if quick else list_choices("torch", small, 1))
    choices = list(dict.fromkeys(choices))
    return [Group("headline", scene_of(height), headline), Group("choices", scene_of(small), choices)]


def make_sample_group(scene: BenchScene, height: int, backends: Sequence[str], threads: int) -> Group:
    """The main choices on a real scene, to check the results of the room."""
    cases = [case for name in backends for case in list_main_choices(name, height, threads)]
    return Group("scene", scene, cases + list_main_choices("torch", height, 1))


def list_choices(backend: str, height: int, threads: int) -> list[RasterCase]:
    """Every kernel, order and filter on every layout that has them; an equirect has one kernel and one order."""
    direct, kernels = RasterCase(backend, height, threads=threads), _kernels(backend)
    orders: tuple[Order, ...] = ("radial", "z")
    filters: tuple[Lowpass, ...] = ("angular", "3dgs")
    stitched = replace(direct, layout="cubemap", face_size=default_face_size(height))
    return [
        *(replace(direct, filter=lowpass) for lowpass in filters),
        *(
            replace(stitched, kernel=kernel, order=order, filter=lowpass)
            for kernel, order, lowpass in itertools.product(kernels, orders, filters)
        ),
        *(replace(direct, kernel=kernel, layout="pinhole") for kernel in kernels),
    ]


def list_main_choices(backend: str, height: int, threads: int) -> list[RasterCase]:
    """The direct panorama, the stitched ones, and the options of the official code (`OFFICIAL`)."""
    direct = RasterCase(backend, height, threads=threads)
    stitched = replace(direct, layout="cubemap", face_size=default_face_size(height))
    official = replace(
        direct,
        kernel=OFFICIAL.kernel,
        order=OFFICIAL.order,
        filter=OFFICIAL.lowpass,
        layout="cubemap",
        face_size=official_face_size(height),
        stitching="seamless" if height % 4 else OFFICIAL.stitching,
    )
    cases = [direct, stitched, replace(stitched, kernel="ewa"), official]
    return [case for case in cases if case.kernel in _kernels(backend)]


def _kernels(backend: str) -> tuple[Kernel, ...]:
    return ("ray",) if backend == "numba" else ("ray", "ewa")


def default_face_size(height: int) -> int:
    """Size of cube faces whose centres resolve as much as the panorama's equator."""
    return max(1, round(2 * height / math.pi))


def _multiple_of_8(height: float) -> int:
    """The nearest height that the room's four levels can have."""
    return max(8, 8 * round(height / 8))


@dataclass(eq=False)
class _Measurement:
    """A row and its timings by pass, "forward" and "backward"."""

    row: Row
    repeats: int = 1
    timings: dict[str, list[Timing]] = field(default_factory=dict)

    @property
    def unfinished(self) -> list[str]:
        """The passes that still have to be timed."""
        return [name for name, timings in self.timings.items() if len(timings) < self.repeats]

    def add(self, name: str, timing: Timing) -> None:
        """Add the timing of a pass and update the row."""
        self.timings[name].append(timing)
        walls = [1e3 * each.wall for each in self.timings[name]]
        self.row.result |= {
            f"{name}_ms": statistics.median(walls),
            f"{name}_min_ms": min(walls),
            f"{name}_spread_ms": quartile_range(walls),
            f"{name}_cpu_ms": 1e3 * min(each.cpu for each in self.timings[name]),
            "repeats": len(walls),
        }


class RasterBench:
    """Measures groups of cases and adds their rows to a report."""

    def __init__(self, report: Report, *, budget: float = 2.0, slow: float = 5.0) -> None:
        """Begin a run.

        Args:
            report: gets the rows.
            budget: seconds for the repeats of a case.
            slow: seconds; a case whose first image takes longer is not repeated.
        """
        self._report, self._budget, self._slow = report, budget, slow
        self._exact: dict[tuple[str, RasterCase], Tensor] = {}  # by the name of the scene
        self._scene: BenchScene | None = None
        self._gaussians: Gaussians | None = None

    def run(self, groups: Iterable[Group]) -> None:
        """Measure all groups; the rows are saved after every image, so that an interruption loses nothing.

        Raises:
            InputError: the file of rows cannot be written, or a scene cannot be read.
        """
        for group in groups:
            if self._scene is None or group.scene.name != self._scene.name:
                self._report.step(f"{group.scene.name}: making the scene")
                self._gaussians = None  # two large scenes might not fit in memory
                self._gaussians = group.scene.load()
            self._scene = group.scene
            with restore_threads():
                self._measure(group)

    def _measure(self, group: Group) -> None:
        assert self._gaussians is not None
        has_reference = len(self._gaussians) <= _MAX_TORCH_GAUSSIANS
        measurements = []
        for case in group.cases:
            exact = self._exact_image(group, case.exact) if has_reference else None
            self._report.step(str(case))
            measurement, color = self._render_first(group, case)
            if exact is not None:
                measurement.row.result |= compare_images(color, exact)
            self._report.add(measurement.row)
            measurements.append(measurement)
        while unfinished := [measurement for measurement in measurements if measurement.unfinished]:
            for measurement in unfinished:
                for name in measurement.unfinished:
                    measurement.add(name, self._time(measurement.row.case, name)[0])
                self._report.save()

    def _exact_image(self, group: Group, case: RasterCase) -> Tensor:
        """The float64 image; rendered once for each scene, which is a row as well."""
        key = group.scene.name, case
        if key not in self._exact:
            self._report.step(f"{case}, float64")
            measurement, color = self._render_first(group, case)
            measurement.row.result |= compare_images(color, color)
            measurement.row.is_reference = True
            self._report.add(measurement.row)
            self._exact[key] = color
        return self._exact[key]

    def _render_first(self, group: Group, case: RasterCase) -> tuple[_Measurement, Tensor]:
        """Render the first image: measure the memory, choose the number of repeats."""
        assert self._gaussians is not None
        row = Row(group.suite, group.scene.name, case, {"num_gaussians": len(self._gaussians)})
        measurement = _Measurement(row, timings={"forward": [], "backward": []} if case.backward else {"forward": []})
        render = self._prepare(case, "forward")
        release_idle_memory()  # buffers that numba keeps for the next image
        with torch.no_grad():
            peak_mb, (forward, color) = measure_peak_memory(lambda: time_call(render, case.device), case.device)
        if peak_mb is not None:
            row.result["peak_mb"] = peak_mb
        first = {"forward": forward} | ({"backward": self._time(case, "backward")[0]} if case.backward else {})
        if case.precision != "float64" and max(timing.wall for timing in first.values()) <= self._slow:
            seconds = sum(timing.wall for timing in first.values())
            measurement.repeats = min(_MAX_REPEATS, max(_MIN_REPEATS, int(self._budget / seconds)))
        else:
            for name, timing in first.items():
                measurement.add(name, timing)
        return measurement, color

    def _time(self, case: RasterCase, name: str) -> tuple[Timing, Any]:
        """Time the "forward" or "backward" pass."""
        with torch.set_grad_enabled(name == "backward"):
            return time_call(self._prepare(case, name), case.device)

    def _prepare(self, case: RasterCase, name: str) -> Callable[[], Any]:
        """Set the number of threads, warm up, and return the pass to time, which renders the loaded scene."""
        assert self._scene is not None and self._gaussians is not None
        torch.set_num_threads(case.threads)
        gaussians = self._gaussians.to(dtype=getattr(torch, case.precision), device=case.device)
        return _make_pass(case, name, gaussians, self._scene.pose)


def _make_pass(case: RasterCase, name: str, gaussians: Gaussians, pose: Tensor) -> Callable[[], Any]:
    """The pass to time, warmed up by one Gaussian: kernels are compiled, tables of the image size computed."""
    single = gaussians.select(torch.zeros(1, dtype=torch.int64, device=gaussians.means.device))
    if name == "backward":
        case.prepare_backward(single, pose)()
        return case.prepare_backward(gaussians, pose)
    with torch.no_grad():
        case.render(single, pose)
    return lambda: case.render(gaussians, pose)


def _format_time(name: str) -> Callable[[Row], str]:
    """Milliseconds with three digits, and half the range between the quartiles if it is known."""

    def format_row(row: Row) -> str:
        middle, spread = row.get(name), row.get(name.replace("_ms", "_spread_ms"))
        if middle is None:
            return ""
        digits = 0 if middle >= 100 else 1 if middle >= 10 else 2
        return f"{middle:,.{digits}f}" + (f" ±{spread / 2:.{digits}f}" if spread else "")

    return format_row


def list_findings(rows: Sequence[Row]) -> list[str]:
    """Speed against torch, as sentences."""
    direct = [row for row in rows if (row.suite, row.case.layout, row.case.precision) == _HEADLINE]
    slow = next((row for row in direct if row.case.backend == "torch" and row.get("forward_ms")), None)
    if slow is None:
        return []
    return [
        f"{row.case.backend} on {format_threads(row.case.threads)} is {_quotient('forward_ms', slow, row)} times as "
        f"fast forward and {_quotient('backward_ms', slow, row)} times backward as torch on one (processor time: "
        f"{_quotient('forward_cpu_ms', slow, row)} and {_quotient('backward_cpu_ms', slow, row)} times less), "
        f"{_describe_size(row)}."
        for row in sorted(direct, key=lambda row: (row.case.backend, row.case.threads))
        if row is not slow and row.get("forward_ms")
    ]


def _quotient(name: str, slow: Row, fast: Row) -> str:
    return f"{slow.get(name) / fast.get(name):,.0f}" if slow.get(name) and fast.get(name) else "?"


def _describe_size(row: Row) -> str:
    return f"{row.case.height}x{2 * row.case.height}, {row.get('num_gaussians'):,} Gaussians"


def plot_choices(rows: Sequence[Row], header: Header) -> Figure | None:
    """Plot PSNR over time; None if there is nothing to plot."""
    shown = [row for row in rows if row.suite == "choices" and row.case.layout != "pinhole"]
    shown = [row for row in shown if row.case.precision == "float32" and row.get("psnr_db") is not None]
    if not shown:
        return None
    figure, (axes,) = make_axes(1, (10, 6))
    for backend, layout in dict.fromkeys((row.case.backend, row.case.layout_name) for row in shown):
        group = [row for row in shown if (row.case.backend, row.case.layout_name) == (backend, layout)]
        x, y = [row.get("forward_ms") for row in group], [min(_MAX_PSNR, row.get("psnr_db")) for row in group]
        axes.plot(x, y, _MARKERS[backend], label=f"{backend}, {layout}")
        for row, *point in zip(group, x, y, strict=True):
            choice, above = f"{row.case.kernel} {row.case.order} {row.case.filter}", len(axes.texts) % 2  # in turns
            axes.annotate(choice, point, xytext=(6, 5 if above else -11), textcoords="offset points", fontsize=7)
    axes.set(xscale="log", xlabel="forward, milliseconds", ylabel=f"PSNR, dB (at most {_MAX_PSNR:g})")
    axes.set_title(f"{shown[0].scene}: {_describe_size(shown[0])}; {header['machine']['cpu']}", loc="left", fontsize=9)
    axes.margins(x=0.15)
    axes.legend(fontsize=8, loc="center")
    return figure


def _describe_renderer(row: Row) -> str:
    return row.case.backend if row.case.precision == "float32" else f"{row.case.backend} {row.case.precision}"


RASTER = Benchmark(
    "raster",
    (
        Column("renderer", _describe_renderer),
        Column("kernel", "kernel"),
        Column("order", "order"),
        Column("filter", "filter"),
        Column("layout", "layout_name"),
        Column("height", "height", "{:d}"),
        Column("Gaussians", "num_gaussians", "{:,}"),
        Column("threads", "threads", "{:d}"),
        Column("forward ms", _format_time("forward_ms"), "{:s}"),
        Column("CPU", _format_time("forward_cpu_ms"), "{:s}"),
        Column("backward ms", _format_time("backward_ms"), "{:s}"),
        Column("CPU", _format_time("backward_cpu_ms"), "{:s}"),
        Column("peak MB", "peak_mb", "{:,.0f}"),
        Column("PSNR dB", "psnr_db", "{:.1f}"),
        Column("max error", "max_error", "{:.1e}"),
    ),
    lambda row: f"{row.suite}: {row.scene}",
    plot_choices,
    list_findings,
    width=210,
)
