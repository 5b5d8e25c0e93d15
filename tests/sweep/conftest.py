"""Textured rooms with known depth; each is searched at most once for all tests."""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import pytest

from pansplat.sweep.panoramas import ray_grid, resize_sphere
from pansplat.sweep.search import SearchConfig, observe, search
from pansplat.sweep.surface import PosedImages, Surface


def _waves(points: np.ndarray) -> np.ndarray:
    """Smooth colours (n, 3) of many wavelengths, 0.5 to 3 m, that do not repeat within a room."""
    generator = np.random.default_rng(7)
    color = np.full(points.shape, 0.5)
    for _ in range(28):
        direction = generator.normal(size=3)
        wavelength = 0.5 * 6 ** generator.random()
        wave = points @ (direction / np.linalg.norm(direction)) * (2 * math.pi / wavelength)
        color += 0.07 * np.sin(wave[:, None] + generator.random(3) * 2 * math.pi)
    return color.clip(0, 1)


def _tiles(points: np.ndarray) -> np.ndarray:
    """Bricks (n, 3) of one colour each, with edges along the room's axes."""
    generator = np.random.default_rng(3)
    table = generator.random((64, 3))
    cell = np.floor(points / np.array((0.71, 0.53, 0.87)) + 0.37).astype(np.int64)
    return table[(cell @ np.array((7, 19, 37))) % 64]


def _blank(points: np.ndarray) -> np.ndarray:
    return np.ones(points.shape)


_PAINTS = {"waves": _waves, "tiles": _tiles, "blank": _blank}


@dataclass(frozen=True)
class Room:
    """A textured room, with or without a box on its floor. Metres, room axes, y down."""

    paint: str = "waves"
    low: tuple[float, float, float] = (-2.4, -1.3, -1.9)
    high: tuple[float, float, float] = (2.1, 1.2, 2.6)
    box: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    room2world: np.ndarray = field(default_factory=lambda: np.eye(4))
    """Similarity (4, 4) from the room's axes to the world's."""
    supersample: int = 2
    """Rays along each side of a pixel. Hard edges need more than smooth colours."""

    def cast(self, cam2world: np.ndarray, height: int) -> tuple[np.ndarray, np.ndarray]:
        """The panorama (h, 2h, 3), averaged over each pixel, and the radial depth (h, 2h) at pixel centres."""
        fine = ray_grid(height * self.supersample).astype(np.float64)
        image = _PAINTS[self.paint](self._intersect(fine, cam2world)[0].reshape(-1, 3)).reshape(fine.shape)
        depth = self._intersect(ray_grid(height).astype(np.float64), cam2world)[1]
        return resize_sphere(image.astype(np.float32), height), depth

    def pose(self, position: tuple[float, float, float], rotation: np.ndarray | None = None) -> np.ndarray:
        """cam2world (4, 4) of a camera at a position in the room, with its rotation in the room's axes."""
        scale = np.cbrt(np.linalg.det(self.room2world[:3, :3]))
        local = np.eye(4)
        local[:3, :3] = np.eye(3) if rotation is None else rotation
        local[:3, 3] = position
        pose = self.room2world @ local
        pose[:3, :3] /= scale
        return pose

    def two_poses(self) -> list[np.ndarray]:
        """Two cameras 0.86 m apart, the second turned by 20 degrees."""
        return [self.pose((-0.4, 0.0, -0.2)), self.pose((0.4, 0.05, 0.1), _turn("y", 20))]

    def observe(self, height: int, poses: Sequence[np.ndarray] | None = None) -> "Observed":
        """The panoramas at the poses, by default `two_poses`."""
        poses = self.two_poses() if poses is None else poses
        images, depths = zip(*(self.cast(pose, height) for pose in poses), strict=True)
        masks = np.ones((len(poses), height, 2 * height), bool)
        return Observed(self, PosedImages(np.stack(images), np.stack(poses), masks, 0.5, 8.0), np.stack(depths))

    def wall_distances(self, points: np.ndarray) -> np.ndarray:
        """Distances (..., 6) of points in room axes from the planes of the walls, the ceiling and the floor."""
        return np.concatenate((np.abs(points - self.low), np.abs(points - self.high)), axis=-1)

    def _intersect(self, rays: np.ndarray, cam2world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First intersections of a camera's rays (h, w, 3): points in room axes, and world distances."""
        to_room = np.linalg.inv(self.room2world)
        start = to_room[:3, :3] @ cam2world[:3, 3] + to_room[:3, 3]
        along = rays @ (to_room[:3, :3] @ cam2world[:3, :3]).T
        with np.errstate(divide="ignore"):
            inverse = 1 / along
        walls = np.maximum((np.array(self.low) - start) * inverse, (np.array(self.high) - start) * inverse)
        distance = walls.min(axis=-1)
        if self.box is not None:
            first, second = ((np.array(corner) - start) * inverse for corner in self.box)
            enter, leave = np.minimum(first, second).max(axis=-1), np.maximum(first, second).min(axis=-1)
            distance = np.where((enter > 0) & (enter < leave), enter, distance)
        return start + distance[..., None] * along, distance


def _turn(axis: str, degrees: float) -> np.ndarray:
    """Rotation (3, 3) about a camera axis; positive about y turns the view to the right."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return {
        "x": np.array(((1, 0, 0), (0, c, -s), (0, s, c))),
        "y": np.array(((c, 0, s), (0, 1, 0), (-s, 0, c))),
        "z": np.array(((c, -s, 0), (s, c, 0), (0, 0, 1))),
    }[axis]


@dataclass(frozen=True)
class Observed:
    """A room's panoramas and their true depth."""

    room: Room
    posed: PosedImages
    depths: np.ndarray
    """True radial depth (v, h, 2h)."""

    @functools.cached_property
    def surfaces(self) -> list[Surface]:
        """The sweep's surfaces."""
        return search(observe(self.posed, SearchConfig()))

    @property
    def inverse_depths(self) -> np.ndarray:
        """Inverse depth (v, h, 2h) of the sweep's surfaces."""
        return np.stack([surface.inverse_depth for surface in self.surfaces])

    def make_exact_surfaces(self) -> list[Surface]:
        """Surfaces with the true depth."""
        return [Surface((1 / d).astype(np.float32)) for d in self.depths]


_FURNISHED = Room(box=((-0.3, -0.1, 1.0), (0.4, 1.2, 1.7)))


@pytest.fixture(scope="session")
def make_room() -> type[Room]:
    """The class of rooms."""
    return Room


@pytest.fixture(scope="session")
def turn() -> Callable[[str, float], np.ndarray]:
    """Rotation (3, 3) about "x", "y" or "z" by degrees."""
    return _turn


@pytest.fixture(params=(0, 1), ids=("view 0", "view 1"))
def view(request: pytest.FixtureRequest) -> int:
    """Each of two views."""
    return request.param


@pytest.fixture(scope="session")
def empty_room() -> Observed:
    """Two views of the textured room, 96 pixels high."""
    return Room().observe(96)


@pytest.fixture(scope="session")
def small_room() -> Observed:
    """Two views of the textured room, 64 pixels high."""
    return Room().observe(64)


@pytest.fixture(scope="session")
def furnished_room() -> Observed:
    """Two views of the room with a box on the floor, which occludes a part of the room in each view."""
    return _FURNISHED.observe(96)


@pytest.fixture(scope="session")
def small_furnished_room() -> Observed:
    """The room with the box, 64 pixels high."""
    return _FURNISHED.observe(64)


@pytest.fixture(scope="session")
def three_views() -> Observed:
    """Three views of the room with the box, 64 pixels high."""
    third = _FURNISHED.pose((0.1, -0.1, -0.7), _turn("y", -60))
    return _FURNISHED.observe(64, [*_FURNISHED.two_poses(), third])
