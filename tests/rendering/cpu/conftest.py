"""Scenes as the numba stages take them, and what the float64 reference sees of them."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor

from pansplat.gaussians.scene import Gaussians
from pansplat.rendering import projection
from pansplat.rendering.cpu.projection import Camera, GaussianArrays, ProjectedGaussians, project_gaussians
from pansplat.rendering.cpu.rasterize import MIN_PLANAR_COSINE
from pansplat.rendering.cpu.records import (
    DIRECTION,
    DIRECTION_RESIDUAL,
    HALF_LOG2_E,
    L_ALONG_A,
    L_ALONG_B,
    LOG2_PEAK,
    PIXEL_CENTRES,
    RADIAL_VARIANCE,
    RECORD_SIZE,
    ROW_A,
    ROW_B,
    TILE_SIZE,
    PixelTables,
    tabulate_pixels,
)
from pansplat.rendering.cpu.runtime import Workspace
from pansplat.rendering.image_planes import ImagePlane

SPREAD = 0.1 * (math.pi / 64) ** 2


def _fields(scene: Gaussians, covariances: Tensor | None = None) -> GaussianArrays:
    scene, nothing = scene.to(dtype=torch.float32), np.empty
    if covariances is None:
        shape = scene.quats.numpy(), scene.scales.numpy(), nothing((0, 3, 3), np.float32)
    else:
        shape = nothing((0, 4), np.float32), nothing((0, 3), np.float32), covariances.float().numpy()
    return GaussianArrays(scene.means.numpy(), *shape, scene.opacities.numpy(), scene.harmonics.numpy())


@pytest.fixture
def fields() -> Callable[..., GaussianArrays]:
    """A scene as float32 arrays."""
    return _fields


@pytest.fixture
def workspace() -> Iterator[Workspace]:
    """Memory for one test."""
    workspace = Workspace()
    yield workspace
    del workspace


@pytest.fixture
def seen(workspace: Workspace, pose: Tensor) -> Callable[..., ProjectedGaussians]:
    """What the numba stage sees of a scene."""

    def see(
        scene: Gaussians, covariances: Tensor | None = None, *, threads: int = 1, near: float = 0.05
    ) -> ProjectedGaussians:
        return project_gaussians(
            _fields(scene, covariances), Camera(pose.numpy(), SPREAD, True, near), workspace, threads
        )

    return see


@pytest.fixture
def truth(pose: Tensor) -> Callable[..., projection.ProjectedGaussians]:
    """What the float64 reference sees of the same float32 numbers."""

    def see(scene: Gaussians, covariances: Tensor | None = None) -> projection.ProjectedGaussians:
        covariances = None if covariances is None else covariances.float().double()
        scene = scene.to(dtype=torch.float32).to(dtype=torch.float64)
        return projection.project_gaussians(
            scene, covariances, pose, filter_variance=SPREAD, compensate=True, exact=True
        )

    return see


def _decode(records: Tensor) -> dict[str, Tensor]:
    """The quantities of docs/rendering.md in records, those that do not depend on the choice of a and b."""
    direction = records[:, DIRECTION:DIRECTION_RESIDUAL] + records[:, DIRECTION_RESIDUAL:ROW_A]
    first, second = records[:, ROW_A:ROW_B], records[:, ROW_B:L_ALONG_A]
    front = direction + records[:, L_ALONG_A, None] * first + records[:, L_ALONG_B, None] * second
    across = first[:, :, None] * first[:, None, :] + second[:, :, None] * second[:, None, :]
    return {
        "direction": direction,
        "across": across / HALF_LOG2_E,
        "front": front,
        "along": records[:, RADIAL_VARIANCE] * HALF_LOG2_E,
        "peak": 2 ** records[:, LOG2_PEAK],
    }


@pytest.fixture
def decode() -> Callable[[Tensor], dict[str, Tensor]]:
    """What records hold, free of the choice of axes."""
    return _decode


@dataclass(frozen=True, eq=False)
class Case:
    """Records drawn at random, every one listed in every tile, and what float64 makes of them densely."""

    records: np.ndarray
    values: np.ndarray
    intersections: np.ndarray
    starts: np.ndarray
    slots: np.ndarray
    tables: PixelTables
    points: Tensor
    size: tuple[int, int]

    def dense(self, upstream: np.ndarray | None = None) -> tuple[Tensor, ...]:
        """The sums; with an upstream gradient also the gradients of records and values."""
        records = torch.from_numpy(self.records).double()
        records[:, :DIRECTION_RESIDUAL] += records[:, DIRECTION_RESIDUAL:ROW_A]
        records.requires_grad_()
        values = torch.from_numpy(self.values).double().requires_grad_()
        through, weights = torch.ones(self.size, dtype=torch.float64), []
        for n, _, a, b, (front_a, front_b, along, level) in (row.split((3, 3, 3, 3, 4)) for row in records):
            ahead = n + front_a * a + front_b * b
            offset = self.points - n
            if self.tables.kind != PIXEL_CENTRES:
                # A ray's length is free, and with it the gradients of what would turn a and b out of their plane.
                # The kernel's are those at L = 1.
                length = (1 + offset @ ahead).detach()
                offset = self.points / torch.where(length > 0, length, 1)[..., None] - n
            front = 1 + offset @ ahead
            if self.tables.kind == PIXEL_CENTRES:
                front, along = torch.ones_like(front), 0.0
            q = (offset @ a).square() + (offset @ b).square()
            alpha = torch.exp2(level - q / (front.square() + along * q)).clamp_max(0.99)
            alpha = torch.where((front > 0) & (alpha >= 1 / 255), alpha, 0)
            weights.append(alpha * through)
            through = through * (1 - alpha)
        stacked = torch.stack(weights)
        ones = torch.cat((values, torch.ones_like(values[:, :1])), dim=1)
        sums = torch.einsum("nyx,nv->vyx", stacked, ones)
        if upstream is None:
            return (sums.detach(),)
        return sums.detach(), *torch.autograd.grad(sums, (records, values), torch.from_numpy(upstream).double())

    def reduce(self, slots: np.ndarray) -> np.ndarray:
        """Each Gaussian's slots summed."""
        return slots.astype(np.float64).reshape(len(self.records), -1, slots.shape[1]).sum(axis=1)


def _random_records(
    kind: str, picture: ImagePlane, count: int, opacity: tuple[float, float], rng: np.random.Generator
) -> Tensor:
    """Gaussians of 0.4 to 6 pixels that point into the picture, float64."""
    height, width = picture.size
    deviations = np.exp(rng.uniform(math.log(0.4), math.log(6), (count, 2)))
    turn = rng.uniform(0, math.pi, count)
    first = np.stack((np.cos(turn), np.sin(turn)), axis=1) / deviations[:, :1]
    second = np.stack((-np.sin(turn), np.cos(turn)), axis=1) / deviations[:, 1:]
    records = torch.zeros(count, RECORD_SIZE, dtype=torch.float64)
    records[:, LOG2_PEAK] = torch.from_numpy(np.log2(rng.uniform(*opacity, count)))
    pixels = rng.uniform(-1, 1, (count, 2)) * (width / 2 + 1, height / 2 + 1)
    if kind == "ewa":
        records[:, DIRECTION:2] = torch.from_numpy(pixels + np.array((width, height)) / 2)
        records[:, ROW_A : ROW_A + 2], records[:, ROW_B : ROW_B + 2] = map(torch.from_numpy, (first, second))
        return records
    if kind == "pinhole":
        ahead = np.concatenate((pixels / picture.focal, np.ones((count, 1))), axis=1)
        direction = torch.from_numpy(ahead) @ picture.rotation.T
    else:
        direction = torch.from_numpy(rng.standard_normal((count, 3)))
    direction = direction / direction.norm(dim=1, keepdim=True)
    right, down = projection.tangent_frame(direction)
    records[:, DIRECTION:DIRECTION_RESIDUAL] = direction
    for columns, axis in ((ROW_A, first), (ROW_B, second)):
        across = torch.from_numpy(axis) / picture.pixel_angle
        records[:, columns : columns + 3] = across[:, :1] * right + across[:, 1:] * down
    records[:, L_ALONG_A : L_ALONG_B + 1] = torch.from_numpy(0.05 * rng.standard_normal((count, 2)))
    records[:, RADIAL_VARIANCE] = torch.from_numpy(rng.uniform(0, 0.05, count))
    return records


@pytest.fixture
def make_case(pose: Tensor) -> Callable[..., Case]:
    """Makes cases: "equirect" or "pinhole" by the exact kernel, "ewa" by the classic one."""

    def make(
        kind: str,
        size: tuple[int, int],
        count: int,
        *,
        num_values: int = 4,
        opacity: tuple[float, float] = (0.05, 0.95),
    ) -> Case:
        rng = np.random.default_rng(3)
        picture = ImagePlane(size, pose[:3, :3], 0.0 if kind == "equirect" else 0.6 * max(size))
        precise = _random_records(kind, picture, count, opacity, rng)
        records = precise.float()
        records[:, DIRECTION_RESIDUAL:ROW_A] = (
            precise[:, :DIRECTION_RESIDUAL] - records[:, :DIRECTION_RESIDUAL].double()
        ).float()
        tables = tabulate_pixels(picture, exact=kind != "ewa")
        tiles = tables.tiles[0] * tables.tiles[1]
        whole = (TILE_SIZE - 1) << 8 | (TILE_SIZE - 1) << 24
        intersections = np.empty((tiles * count, 2), np.int32)
        intersections[:, 0], intersections[:, 1] = np.tile(np.arange(count), tiles), whole
        slots = (np.tile(np.arange(count) * tiles, tiles) + np.repeat(np.arange(tiles), count)).astype(np.int32)
        points = picture.coordinates() if kind == "ewa" else picture.directions()
        return Case(
            records.numpy(),
            rng.uniform(-0.5, 1.5, (count, num_values)).astype(np.float32),
            intersections,
            np.arange(0, tiles * count + 1, count) if count else np.zeros(tiles + 1, np.int64),
            slots,
            tables,
            torch.nn.functional.pad(points, (0, 3 - points.shape[-1])),
            size,
        )

    return make


@pytest.fixture(params=["behind", "around the eye"])
def one_too_wide(request: pytest.FixtureRequest, make_case: Callable[..., Case]) -> Case:
    """A tile of two chunks, narrow but for the last Gaussian: 100 degrees away, or about the eye, and seen."""
    case = make_case("pinhole", (TILE_SIZE, TILE_SIZE), 300, opacity=(0.02, 0.1))
    middle = case.points[TILE_SIZE // 2, TILE_SIZE // 2]
    assert (case.records[:, :DIRECTION_RESIDUAL] @ middle.numpy()).min() > MIN_PLANAR_COSINE
    behind = request.param == "behind"
    angle = math.radians(100 if behind else 0)
    right, down = (axis[0] for axis in projection.tangent_frame(middle[None]))
    mean = math.cos(angle) * middle + math.sin(angle) * right
    towards = math.sin(angle) * middle - math.cos(angle) * right
    # Seen in part of the tile: what makes L positive there, or negative elsewhere, is that the ellipsoid is oblique.
    size, front, along, level = (0.5, 1.5, 0.0, -1.0) if behind else (3.0, 0.7, 1e3, -3.0)
    numbers = (mean, torch.zeros(3), size * towards, size * down, torch.tensor((front, 0, along, level)))
    case.records[-1] = torch.cat(numbers).numpy()
    return case
