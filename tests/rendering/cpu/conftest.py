"""Projected scenes, and random records with their dense rasterisation in float64."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from pansplat.gaussians.scene import Gaussians
from pansplat.rendering import projection as reference
from pansplat.rendering.cpu.projection import Camera, GaussianArrays, ProjectedGaussians, project_gaussians
from pansplat.rendering.cpu.projection_backward import GaussianGradients, backpropagate_projection
from pansplat.rendering.cpu.rasterize import MIN_PLANAR_COSINE
from pansplat.rendering.cpu.records import (
    DIRECTION,
    DIRECTION_RESIDUAL,
    HALF_LOG2_E,
    L_ALONG_A,
    L_ALONG_B,
    LOG2_PEAK,
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

FILTER_VARIANCE = 0.1 * (math.pi / 64) ** 2


class View(NamedTuple):
    """Gaussians, a camera, and their projection: the first arguments of most stages."""

    gaussians: GaussianArrays
    camera: Camera
    projected: ProjectedGaussians


@pytest.fixture
def workspace() -> Iterator[Workspace]:
    """Memory for one test."""
    workspace = Workspace()
    yield workspace
    del workspace


@pytest.fixture
def project(workspace: Workspace, pose: Tensor) -> Callable[..., View]:
    """Projects a scene in float32."""

    def run(
        scene: Gaussians, covariances: Tensor | None = None, *, camera: Camera | None = None, threads: int = 1
    ) -> View:
        camera = camera or Camera(pose.numpy(), FILTER_VARIANCE, True, 0.05)
        scene = scene.to(dtype=torch.float32)
        shape = (scene.quats, scene.scales, None) if covariances is None else (None, None, covariances.float())
        gaussians = GaussianArrays.from_tensors((scene.means, *shape, scene.opacities, scene.harmonics))
        return View(gaussians, camera, project_gaussians(gaussians, camera, workspace, threads))

    return run


@pytest.fixture
def project_reference(pose: Tensor) -> Callable[..., reference.ProjectedGaussians]:
    """Projects the same float32 numbers by the float64 reference."""

    def run(scene: Gaussians, covariances: Tensor | None = None) -> reference.ProjectedGaussians:
        covariances = None if covariances is None else covariances.float().double()
        scene = scene.to(dtype=torch.float32).to(dtype=torch.float64)
        return reference.project_gaussians(
            scene, covariances, pose, filter_variance=FILTER_VARIANCE, compensate=True, exact=True
        )

    return run


def _decode_records(records: Tensor) -> tuple[Tensor, ...]:
    """Direction, the rows a, b and l, S' and the peak, all as in docs/rendering.md."""
    direction = records[:, DIRECTION:DIRECTION_RESIDUAL] + records[:, DIRECTION_RESIDUAL:ROW_A]
    a, b = records[:, ROW_A:ROW_B], records[:, ROW_B:L_ALONG_A]
    l = direction + records[:, L_ALONG_A, None] * a + records[:, L_ALONG_B, None] * b  # noqa: E741
    unit = math.sqrt(HALF_LOG2_E)
    return direction, a / unit, b / unit, l, records[:, RADIAL_VARIANCE] * HALF_LOG2_E, 2 ** records[:, LOG2_PEAK]


@pytest.fixture
def decode_records() -> Callable[[Tensor], tuple[Tensor, ...]]:
    return _decode_records


@pytest.fixture
def rigid_part() -> Callable[[Tensor, Tensor], Tensor]:
    """The part of a pose's gradient along rigid motions."""

    def select(pose: Tensor, gradient: Tensor) -> Tensor:
        turn = pose.detach()[:3, :3].T @ gradient[:3, :3]
        return torch.cat((turn - turn.T, gradient[:3, 3:]), dim=1)

    return select


@pytest.fixture
def backpropagate() -> Callable[..., GaussianGradients]:
    """Propagates the gradients of records and values, one slot per Gaussian by default, to Gaussians and pose."""

    def run(
        view: View,
        grad_records: np.ndarray,
        grad_values: np.ndarray,
        *,
        offsets: np.ndarray | None = None,
        threads: int = 1,
    ) -> GaussianGradients:
        gradients = GaussianGradients(*(np.full_like(field, np.nan) for field in view.gaussians), pose=np.zeros((3, 4)))
        offsets = np.arange(len(grad_values) + 1) if offsets is None else offsets
        return backpropagate_projection(*view, grad_records, grad_values, offsets, gradients, threads)

    return run


@dataclass(frozen=True, eq=False)
class Case:
    """Random records, each intersecting every tile, and their dense rasterisation."""

    records: np.ndarray
    values: np.ndarray
    intersections: np.ndarray
    starts: np.ndarray
    slots: np.ndarray
    tables: PixelTables
    points: Tensor
    size: tuple[int, int]

    def dense(self, upstream: np.ndarray | None = None) -> tuple[Tensor, ...]:
        """The sums in float64; with an upstream gradient also the gradients of records and values."""
        records = torch.from_numpy(self.records).double()
        records[:, :DIRECTION_RESIDUAL] += records[:, DIRECTION_RESIDUAL:ROW_A]
        records.requires_grad_()
        values = torch.from_numpy(self.values).double().requires_grad_()
        transmittance, weights = torch.ones(self.size, dtype=torch.float64), []
        for n, _, a, b, (l_along_a, l_along_b, radial_variance, log2_peak) in (
            row.split((3, 3, 3, 3, 4)) for row in records
        ):
            l = n + l_along_a * a + l_along_b * b  # noqa: E741
            # The length of a ray is arbitrary, and so are the gradients that rotate a and b out of their plane.
            # The kernel computes those at L = 1.
            length = (1 + (self.points - n) @ l).detach()
            offset = self.points / torch.where(length > 0, length, 1)[..., None] - n
            front = 1 + offset @ l
            q = (offset @ a).square() + (offset @ b).square()
            alpha = torch.exp2(log2_peak - q / (front.square() + radial_variance * q)).clamp_max(0.99)
            alpha = torch.where((front > 0) & (alpha >= 1 / 255), alpha, 0)
            weights.append(alpha * transmittance)
            transmittance = transmittance * (1 - alpha)
        with_ones = torch.cat((values, torch.ones_like(values[:, :1])), dim=1)
        sums = torch.einsum("nyx,nv->vyx", torch.stack(weights), with_ones)
        if upstream is None:
            return (sums.detach(),)
        return sums.detach(), *torch.autograd.grad(sums, (records, values), torch.from_numpy(upstream).double())

    def flatten(self) -> "Case":
        """Make every footprint wider than its tiles, with a nearly constant alpha."""
        self.records[:, ROW_A:L_ALONG_A] *= 1e-3
        self.records[:, L_ALONG_A:LOG2_PEAK] = 0
        return self

    def reduce(self, slots: np.ndarray) -> np.ndarray:
        """The sum of each Gaussian's slots."""
        return slots.astype(np.float64).reshape(len(self.records), -1, slots.shape[1]).sum(axis=1)


def _random_records(
    kind: str, plane: ImagePlane, count: int, opacity: tuple[float, float], rng: np.random.Generator
) -> Tensor:
    """Records of 0.4 to 6 pixels inside the image plane, float64."""
    height, width = plane.size
    deviations = np.exp(rng.uniform(math.log(0.4), math.log(6), (count, 2)))
    turn = rng.uniform(0, math.pi, count)
    a = np.stack((np.cos(turn), np.sin(turn)), axis=1) / deviations[:, :1]
    b = np.stack((-np.sin(turn), np.cos(turn)), axis=1) / deviations[:, 1:]
    records = torch.zeros(count, RECORD_SIZE, dtype=torch.float64)
    records[:, LOG2_PEAK] = torch.from_numpy(np.log2(rng.uniform(*opacity, count)))
    pixels = rng.uniform(-1, 1, (count, 2)) * (width / 2 + 1, height / 2 + 1)
    if kind == "pinhole":
        rays = np.concatenate((pixels / plane.focal, np.ones((count, 1))), axis=1)
        direction = torch.from_numpy(rays) @ plane.rotation.T
    else:
        direction = torch.from_numpy(rng.standard_normal((count, 3)))
    direction = direction / direction.norm(dim=1, keepdim=True)
    right, down = reference.tangent_frame(direction)
    records[:, DIRECTION:DIRECTION_RESIDUAL] = direction
    for field, row in ((ROW_A, a), (ROW_B, b)):
        across = torch.from_numpy(row) / plane.pixel_angle
        records[:, field : field + 3] = across[:, :1] * right + across[:, 1:] * down
    records[:, L_ALONG_A : L_ALONG_B + 1] = torch.from_numpy(0.05 * rng.standard_normal((count, 2)))
    records[:, RADIAL_VARIANCE] = torch.from_numpy(rng.uniform(0, 0.05, count))
    return records


@pytest.fixture
def make_case(pose: Tensor) -> Callable[..., Case]:
    """Makes cases of a kind: "equirect" or "pinhole"."""

    def make(
        kind: str,
        size: tuple[int, int],
        count: int,
        *,
        num_values: int = 4,
        opacity: tuple[float, float] = (0.05, 0.95),
    ) -> Case:
        rng = np.random.default_rng(3)
        plane = ImagePlane(size, pose[:3, :3], 0.0 if kind == "equirect" else 0.6 * max(size))
        precise = _random_records(kind, plane, count, opacity, rng)
        records, heads = precise.float(), slice(DIRECTION_RESIDUAL)
        records[:, DIRECTION_RESIDUAL:ROW_A] = (precise[:, heads] - records[:, heads].double()).float()
        tables = tabulate_pixels(plane)
        tiles = tables.tiles[0] * tables.tiles[1]
        whole_tile = (TILE_SIZE - 1) << 8 | (TILE_SIZE - 1) << 24
        intersections = np.empty((tiles * count, 2), np.int32)
        intersections[:, 0], intersections[:, 1] = np.tile(np.arange(count), tiles), whole_tile
        slots = (np.tile(np.arange(count) * tiles, tiles) + np.repeat(np.arange(tiles), count)).astype(np.int32)
        return Case(
            records.numpy(),
            rng.uniform(-0.5, 1.5, (count, num_values)).astype(np.float32),
            intersections,
            np.arange(0, tiles * count + 1, count) if count else np.zeros(tiles + 1, np.int64),
            slots,
            tables,
            plane.directions(),
            size,
        )

    return make


@pytest.fixture(params=["behind", "around the camera"])
def one_too_wide(request: pytest.FixtureRequest, make_case: Callable[..., Case]) -> Case:
    """A tile of two chunks whose last Gaussian, 100 degrees away or around the camera, needs three components."""
    case = make_case("pinhole", (TILE_SIZE, TILE_SIZE), 300, opacity=(0.02, 0.1))
    centre = case.points[TILE_SIZE // 2, TILE_SIZE // 2]
    assert (case.records[:, :DIRECTION_RESIDUAL] @ centre.numpy()).min() > MIN_PLANAR_COSINE
    behind = request.param == "behind"
    angle = math.radians(100 if behind else 0)
    right, down = (axis[0] for axis in reference.tangent_frame(centre[None]))
    direction = math.cos(angle) * centre + math.sin(angle) * right
    towards = math.sin(angle) * centre - math.cos(angle) * right
    # It is visible in a part of the tile: the ellipsoid is oblique, so L is positive there or negative elsewhere.
    size, *rest = (0.5, 1.5, 0, 0.0, -1.0) if behind else (3.0, 0.7, 0, 1e3, -3.0)
    case.records[-1] = torch.cat((direction, torch.zeros(3), size * towards, size * down, torch.tensor(rest))).numpy()
    return case
