"""`pansplat bench raster`: time and memory of the rasterisers against their error.

A case is a way to render an image; a group of cases answers one question on one scene. The cases of a group are
rendered in turns, round after round, so that other load on the machine affects all of them.

Values of a row: `forward_ms` is the median without gradients, `backward_ms` that of the backward pass alone, to all
fields of the Gaussians; each with `_min_ms`, `_spread_ms` (range between the quartiles) and `_cpu_ms` (minimum of the
processor time of all threads). `peak_mb` is the largest additional memory of a forward pass, 10^6 bytes. `psnr_db` and
`max_error` are against the exact image: kernel "ray", one ray per pixel, float64.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.bench.harness import (
    Header,
    Suite,
    Timing,
    announce,
    compare_images,
    format_threads,
    make_axes,
    measure_peak_memory,
    quartile_range,
    restore_threads,
    time_call,
)
from pansplat.bench.scenes import full_lattice_room, lattice_room_size
from pansplat.constants import NEAR
from pansplat.evaluation.results import Column, Row
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.pose import rotations_from_quats
from pansplat.rendering import rasterize
from pansplat.rendering.image_planes import Layout
from pansplat.rendering.official import official_face_size
from pansplat.rendering.rasterize import Kernel
from pansplat.system.kernels import release_idle_memory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Precision = Literal["float32", "float64"]

_FIELDS = ("means", "scales", "quats", "opacities", "harmonics")
_MIN_REPEATS, _MAX_REPEATS = 3, 15  # images that are timed, at least, and of fast cases at most
_MAX_TORCH_GAUSSIANS = 4_000_000  # the torch reference renders them in minutes
_MAX_CHOICE_HEIGHT = 512  # rows; each layout needs a float64 reference
_MARKERS = {"numba": "o", "torch": "s", "triton": "D"}
_MAX_PSNR = 160.0  # dB; better ones are plotted here


@dataclass(frozen=True)
class RasterCase:
    """A way to render an image.

    Attributes:
        backend: "torch", "numba" or "triton".
        height: pixels; a panorama is twice as wide, a pinhole image square with a field of view of 90 degrees.
        kernel, layout: as in `pansplat.rasterize`.
        face_size: along the faces of a cubemap, pixels.
        threads: the largest number to use.
        backward: whether the backward pass is timed as well.
    """

    backend: str
    height: int
    kernel: Kernel = "ray"
    layout: Layout = "equirect"
    face_size: int | None = None
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
        """The layout with the size of its faces."""
        return f"{self.layout} {self.face_size}" if self.face_size else self.layout

    def __str__(self) -> str:
        """The case as it is shown while it is measured."""
        choice = f"{self.backend} {self.kernel} {self.layout_name}"
        return f"{choice}, height {self.height}, {format_threads(self.threads)}"

    def render(self, gaussians: Gaussians, pose: Float[Tensor, "4 4"]) -> Float[Tensor, "channel height width"]:
        """Colours on black, differentiable in the Gaussians, which have the case's precision and device."""
        rendered = rasterize(
            gaussians,
            pose,
            size=(self.height, self.height if self.layout == "pinhole" else 2 * self.height),
            layout=self.layout,
            kernel=self.kernel,
            near=NEAR,
            face_size=self.face_size,
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
    the order of kernel "ewa" would depend on rounding.
    """
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotations_from_quats(torch.tensor((0.97, 0.06, 0.21, 0.04), dtype=torch.float64))
    pose[:3, 3] = torch.tensor((0.1, 0.05, 0.15))
    return BenchScene(f"room {height}", partial(full_lattice_room, _multiple_of_8(height)), pose)


def choice_height(height: int) -> int:
    """Height of the images that compare every choice."""
    return min(_multiple_of_8(0.375 * height), _MAX_CHOICE_HEIGHT)


def list_raster_groups(height: int, backends: Sequence[str], threads: int) -> list[Group]:
    """The main choices on the room of this height, and also pinhole images on the one of `choice_height`.

    Args:
        height: rows of the largest images.
        backends: available ones besides torch.
        threads: the largest number to use.
    """
    small = choice_height(height)
    headline = [case for name in backends for case in list_choices(name, height, threads)]
    headline += [RasterCase(name, height) for name in backends if threads > 1]
    headline += [RasterCase("torch", height)] if lattice_room_size(height) <= _MAX_TORCH_GAUSSIANS else []
    choices = [case for name in backends for case in list_choices(name, small, threads)]
    choices += [RasterCase(name, small, layout="pinhole", threads=threads) for name in backends]
    choices += list_choices("torch", small, 1)
    return [Group("headline", make_room_scene(height), headline), Group("choices", make_room_scene(small), choices)]


def make_sample_group(scene: BenchScene, height: int, backends: Sequence[str], threads: int) -> Group:
    """All choices on a real scene, to check the results of the room."""
    cases = [case for name in backends for case in list_choices(name, height, threads)]
    return Group("scene", scene, cases + list_choices("torch", height, 1))


def list_choices(backend: str, height: int, threads: int) -> list[RasterCase]:
    """The direct panorama, the stitched one and, where the backend has it, the official drawing."""
    direct = RasterCase(backend, height, threads=threads)
    stitched = replace(direct, layout="cubemap", face_size=default_face_size(height))
    official = replace(stitched, kernel="ewa", face_size=official_face_size(height))
    return [direct, stitched, *([] if backend == "numba" or height % 4 else [official])]


def default_face_size(height: int) -> int:
    """Size of cube faces whose centres resolve as much as the panorama's equator."""
    return max(1, round(2 * height / math.pi))


def _multiple_of_8(height: float) -> int:
    """The nearest height that the room's four levels can have."""
    return max(8, 8 * round(height / 8))


def measure_raster(groups: Iterable[Group], *, budget: float = 2.0, slow: float = 3.0) -> Iterator[Row]:
    """Yield the row of each case, and yield it again after each repeat.

    Args:
        groups: cases, each group with its scene.
        budget: seconds for the repeats of a case.
        slow: seconds; a case whose first image takes longer is not repeated.
    """
    exact: dict[tuple[str, RasterCase], Tensor] = {}
    for group in groups:
        with restore_threads():
            yield from _measure_group(group, exact, budget, slow)


def _measure_group(
    group: Group, exact: dict[tuple[str, RasterCase], Tensor], budget: float, slow: float
) -> Iterator[Row]:
    """Add the exact images of the cases, render each case once, and then all in turns."""
    announce(f"{group.scene.name}: making the scene")
    scene, gaussians, cases = group.scene, group.scene.load(), list(group.cases)
    if len(gaussians) <= _MAX_TORCH_GAUSSIANS:
        references = dict.fromkeys(case.exact for case in cases)
        cases = [case for case in references if (scene.name, case) not in exact] + cases
    repeats: list[tuple[Row, RasterCase, int, dict[str, list[Timing]]]] = []
    for case in cases:
        announce(case)
        entries = {"suite": group.suite, "scene": scene.name, **asdict(case), "layout_name": case.layout_name}
        row = Row({**entries, "is_reference": case.precision == "float64"}, {"num_gaussians": len(gaussians)})
        render = _prepare(case, "forward", gaussians, scene.pose)
        release_idle_memory()  # numba keeps buffers for the next image
        with torch.no_grad():
            peak, (forward, color) = measure_peak_memory(lambda r=render, d=case.device: time_call(r, d), case.device)
        first = {"forward": forward} | (
            {"backward": _time(case, "backward", gaussians, scene)} if case.backward else {}
        )
        if case.precision == "float64":
            exact[scene.name, case] = color
        if (scene.name, case.exact) in exact:
            row.values |= compare_images(color, exact[scene.name, case.exact])
        seconds = [timing.wall for timing in first.values()]
        count, timings = 1, {name: [timing] for name, timing in first.items()}
        if case.precision != "float64" and max(seconds) <= slow:
            count = min(_MAX_REPEATS, max(_MIN_REPEATS, int(budget / sum(seconds))))
            timings = {name: [] for name in first}  # the first image may have waited for memory
        row.values |= peak | _summarise(timings)
        repeats.append((row, case, count, timings))
        yield row
    for _ in range(_MAX_REPEATS):
        for row, case, count, timings in repeats:
            for name, measured in timings.items():
                if len(measured) < count:
                    measured.append(_time(case, name, gaussians, scene))
                    row.values |= _summarise(timings)
                    yield row


def _summarise(timings: Mapping[str, Sequence[Timing]]) -> dict[str, float]:
    """The values of a row, by pass."""
    values: dict[str, float] = {}
    for name, measured in timings.items():
        walls = [1e3 * timing.wall for timing in measured]
        if walls:
            values |= {
                f"{name}_ms": statistics.median(walls),
                f"{name}_min_ms": min(walls),
                f"{name}_spread_ms": quartile_range(walls),
                f"{name}_cpu_ms": 1e3 * min(timing.cpu for timing in measured),
                "repeats": len(walls),
            }
    return values


def _time(case: RasterCase, name: str, gaussians: Gaussians, scene: BenchScene) -> Timing:
    """Time the "forward" or "backward" pass."""
    with torch.set_grad_enabled(name == "backward"):
        return time_call(_prepare(case, name, gaussians, scene.pose), case.device)[0]


def _prepare(case: RasterCase, name: str, gaussians: Gaussians, pose: Tensor) -> Callable[[], Any]:
    """Set the number of threads, and return the pass to time.

    It is warmed up by one Gaussian: kernels are compiled, tables of the image size computed.
    """
    torch.set_num_threads(case.threads)
    gaussians = gaussians.to(dtype=getattr(torch, case.precision), device=case.device)
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


def _describe_size(row: Row) -> str:
    return f"{row.get('height')}x{2 * row.get('height')}, {row.get('num_gaussians'):,} Gaussians"


def plot_choices(rows: Sequence[Row], header: Header) -> Figure | None:
    """Plot PSNR over time; None if there is nothing to plot."""
    shown = [row for row in rows if row.get("suite") == "choices" and row.get("layout") != "pinhole"]
    shown = [row for row in shown if row.get("precision") == "float32" and row.get("psnr_db") is not None]
    if not shown:
        return None
    figure, (axes,) = make_axes(1, (10, 6))
    for backend, layout in dict.fromkeys((row.get("backend"), row.get("layout_name")) for row in shown):
        group = [row for row in shown if (row.get("backend"), row.get("layout_name")) == (backend, layout)]
        x, y = [row.get("forward_ms") for row in group], [min(_MAX_PSNR, row.get("psnr_db")) for row in group]
        axes.plot(x, y, _MARKERS[backend], label=f"{backend}, {layout}")
        for row, *point in zip(group, x, y, strict=True):
            above = len(axes.texts) % 2  # labels are above and below in turns
            axes.annotate(
                row.get("kernel"), point, xytext=(6, 5 if above else -11), textcoords="offset points", fontsize=7
            )
    axes.set(xscale="log", xlabel="forward, milliseconds", ylabel=f"PSNR, dB (at most {_MAX_PSNR:g})")
    axes.set_title(
        f"{shown[0].get('scene')}: {_describe_size(shown[0])}; {header['machine']['cpu']}", loc="left", fontsize=9
    )
    axes.margins(x=0.15)
    axes.legend(fontsize=8, loc="center")
    return figure


def _describe_renderer(row: Row) -> str:
    return row.get("backend") + (" float64" if row.get("is_reference") else "")


RASTER = Suite(
    "raster",
    (
        Column("renderer", _describe_renderer),
        Column("kernel", "kernel"),
        Column("layout", "layout_name"),
        Column("height", "height", "d"),
        Column("Gaussians", "num_gaussians", ","),
        Column("threads", "threads", "d"),
        Column("forward ms", _format_time("forward_ms"), ">"),
        Column("CPU", _format_time("forward_cpu_ms"), ">"),
        Column("backward ms", _format_time("backward_ms"), ">"),
        Column("CPU", _format_time("backward_cpu_ms"), ">"),
        Column("peak MB", "peak_mb", ",.0f"),
        Column("PSNR dB", "psnr_db", ".1f"),
        Column("max error", "max_error", ".1e"),
    ),
    lambda row: f"{row.get('suite')}: {row.get('scene')}",
    plot_choices,
)
