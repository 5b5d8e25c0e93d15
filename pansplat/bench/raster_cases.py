"""Cases of the raster benchmark: ways to render an image, in groups that answer one question on one scene.

The quick run compares all choices at a reduced height, and the main ones at the full height.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.bench.scenes import full_lattice_room, lattice_room_size
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.pose import rotations_from_quats
from pansplat.rendering.image_planes import Layout, Stitching
from pansplat.rendering.official import OFFICIAL, official_face_size
from pansplat.rendering.rasterize import Kernel, Lowpass, Order

Precision = Literal["float32", "float64"]
References = Literal["own", "exact", "none"]

_BYTES_PER_GAUSSIAN = 600  # upper bound: the scene, its gradients and the renderer's buffers
_MAX_TORCH_GAUSSIANS = 4_000_000  # the torch reference renders them in minutes
_MAX_CHOICE_HEIGHT = 512  # pixels: every choice needs a float64 reference of its own
_SWEEP_BACKENDS = ("triton", "numba")


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
    def size(self) -> tuple[int, int]:
        """Height and width of the image."""
        return self.height, self.height if self.layout == "pinhole" else 2 * self.height

    @property
    def reference(self) -> RasterCase:
        """The same image by the float64 torch backend."""
        return replace(self, backend="torch", precision="float64", threads=1, backward=False)

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
        return f"{choice}, height {self.height}, {self.threads} threads"


@dataclass(frozen=True, eq=False)
class BenchScene:
    """A scene, which `load` makes as float32 Gaussians when they are needed, and the pose that it is rendered from."""

    name: str
    load: Callable[[], Gaussians]
    pose: Float[Tensor, "4 4"]


@dataclass(frozen=True, eq=False)
class Group:
    """Cases that are rendered in turns, so that other load on the machine affects all of them.

    Attributes:
        suite: the question: "headline", "choices", "count", "resolution" or "scene".
        references: images to compare with: "own" is the exact image and the float64 image of the same choices, "exact"
            the exact one alone.
    """

    suite: str
    scene: BenchScene
    cases: Sequence[RasterCase]
    references: References


def default_face_size(height: int) -> int:
    """Size of cube faces whose centres resolve as much as the panorama's equator."""
    return max(1, round(2 * height / math.pi))


def list_choices(backend: str, height: int, face_sizes: tuple[int, ...], threads: int) -> list[RasterCase]:
    """Every kernel, order and filter on every layout that has them; an equirect has one kernel and one order."""
    filters: tuple[Lowpass, ...] = ("angular", "3dgs")
    orders: tuple[Order, ...] = ("radial", "z")
    kernels: tuple[Kernel, ...] = ("ray", "ewa")
    equirects = [RasterCase(backend, height, filter=lowpass, threads=threads) for lowpass in filters]
    cubemaps = [
        RasterCase(backend, height, kernel, order, lowpass, "cubemap", face_size, threads=threads)
        for face_size, kernel, order, lowpass in itertools.product(face_sizes, kernels, orders, filters)
    ]
    pinholes = [RasterCase(backend, height, kernel=kernel, layout="pinhole", threads=threads) for kernel in kernels]
    return equirects + cubemaps + pinholes


def make_official_case(backend: str, height: int, threads: int) -> RasterCase:
    """The options of the official code (`OFFICIAL`)."""
    o, face_size = OFFICIAL, official_face_size(height)
    stitching = "seamless" if height % 4 else o.stitching
    return RasterCase(backend, height, o.kernel, o.order, o.lowpass, "cubemap", face_size, stitching, threads=threads)


@dataclass(frozen=True)
class Settings:
    """Extent of a run.

    Attributes:
        height: of the largest images of the comparison, pixels.
        quick: minutes instead of an hour.
        threads: the largest number to use.
        backends: available ones besides torch.
        memory: bytes that may be used; larger scenes are left out.
    """

    height: int
    quick: bool
    threads: int
    backends: tuple[str, ...]
    memory: float

    @property
    def choice_height(self) -> int:
        """Height of the images that compare every choice."""
        return min(_multiple_of_8(0.375 * self.height) if self.quick else self.height, _MAX_CHOICE_HEIGHT)

    @property
    def face_sizes(self) -> tuple[int, ...]:
        """Sizes of cube faces: the default; in the full run also the official one and one that resolves more."""
        height = self.choice_height
        default = default_face_size(height)
        return (default,) if self.quick else (height // 2, default, height)

    @property
    def sweep_backends(self) -> list[str]:
        """The available backends of the sweeps, fastest first."""
        return [name for name in _SWEEP_BACKENDS if name in self.backends]

    @property
    def with_torch(self) -> bool:
        """Whether the torch reference can render the full height."""
        return lattice_room_size(self.height) <= _MAX_TORCH_GAUSSIANS


def make_room_scene(height: int) -> BenchScene:
    """The synthetic room, rendered from a pose between its cameras and slightly off the line through them.

    The camera is rotated so that no wall is parallel to a cube face: all points of such a wall have one depth, and
    order "z" would depend on rounding.
    """
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotations_from_quats(torch.tensor((0.97, 0.06, 0.21, 0.04), dtype=torch.float64))
    pose[:3, 3] = torch.tensor((0.1, 0.05, 0.15))
    return BenchScene(f"room {height}", partial(full_lattice_room, _multiple_of_8(height)), pose)


def list_raster_groups(settings: Settings, scene_of: Callable[[int], BenchScene], *, synthetic: bool) -> list[Group]:
    """All groups of a scene, the most important first.

    Args:
        scene_of: the scene for a height.
        synthetic: the room, which exists in every size; other scenes are thinned out for the sweep over counts.
    """
    height, small = settings.height, settings.choice_height
    references = ("exact" if settings.quick else "own") if settings.with_torch else "none"
    groups = [
        Group("headline", scene_of(height), _list_headline_cases(settings), references),
        Group("choices", scene_of(small), _list_choice_cases(settings), "own"),
    ]
    for index, scene in enumerate(_list_count_scenes(settings, scene_of, synthetic)):
        cases = _list_sweep_cases(settings, height, with_torch=index == 0 and not settings.quick)
        groups.append(Group("count", scene, cases, "none"))
    for index, scene_height in enumerate(_list_sweep_heights(settings)):
        if not synthetic or lattice_room_size(scene_height) * _BYTES_PER_GAUSSIAN < settings.memory:
            cases = _list_sweep_cases(settings, scene_height, with_torch=index < 2)
            groups.append(Group("resolution", scene_of(scene_height), cases, "none"))
    return [group for group in groups if group.cases]


def make_sample_group(settings: Settings, scene: BenchScene) -> Group:
    """The main choices on a real scene, to check the results of the room."""
    small = replace(settings, height=settings.choice_height)
    cases = [case for name in settings.sweep_backends for case in _list_main_choices(small, name)]
    cases += [RasterCase("torch", small.height)] if cases else _list_main_choices(small, "torch")
    return Group("scene", scene, cases, "own")


def _list_main_choices(settings: Settings, backend: str) -> list[RasterCase]:
    """The direct panorama, the stitched ones, and the official choices."""
    height, threads = settings.height, 1 if backend == "torch" else settings.threads
    face_size = default_face_size(height)
    stitched = RasterCase(backend, height, layout="cubemap", face_size=face_size, threads=threads)
    return [
        RasterCase(backend, height, threads=threads),
        stitched,
        replace(stitched, kernel="ewa"),
        make_official_case(backend, height, threads),
    ]


def _list_headline_cases(settings: Settings) -> list[RasterCase]:
    cases = []
    for backend in settings.backends:
        cases += _list_main_choices(settings, backend)
        if settings.threads > 1:
            cases.append(RasterCase(backend, settings.height))
    return [*cases, RasterCase("torch", settings.height)] if settings.with_torch else cases


def _list_choice_cases(settings: Settings) -> list[RasterCase]:
    height, cases = settings.choice_height, []
    for backend in settings.backends:
        cases += list_choices(backend, height, settings.face_sizes, settings.threads)
    if settings.quick:
        return cases + _list_main_choices(replace(settings, height=height), "torch")
    return cases + [replace(case, backward=False) for case in list_choices("torch", height, settings.face_sizes, 1)]


def _list_sweep_cases(settings: Settings, height: int, *, with_torch: bool) -> list[RasterCase]:
    """The direct panorama by the fast backends, and by torch if that does not take long."""
    fast = [RasterCase(name, height, threads=settings.threads) for name in settings.sweep_backends]
    return fast + ([RasterCase("torch", height)] if (with_torch and settings.with_torch) or not fast else [])


def _list_count_scenes(settings: Settings, scene_of: Callable[[int], BenchScene], synthetic: bool) -> list[BenchScene]:
    """Scenes of about a sixteenth, an eighth, a quarter, half and all Gaussians."""
    if synthetic:
        return [make_room_scene(_multiple_of_8(settings.height * factor)) for factor in (0.25, 0.354, 0.5, 0.707, 1.0)]
    whole = scene_of(settings.height)
    return [
        BenchScene(f"{whole.name} 1/{step}", partial(_every_nth, whole.load, step), whole.pose)
        for step in (16, 8, 4, 2, 1)
    ]


def _every_nth(load: Callable[[], Gaussians], step: int) -> Gaussians:
    gaussians = load()
    return gaussians.select(torch.arange(0, len(gaussians), step))


def _list_sweep_heights(settings: Settings) -> list[int]:
    factors = (0.25, 0.5, 1, 2) if settings.quick else (0.25, 0.5, 1, 2, 4)
    return [_multiple_of_8(settings.height * factor) for factor in factors]


def _multiple_of_8(height: float) -> int:
    """The nearest height that the room's four levels can have."""
    return max(8, 8 * round(height / 8))
