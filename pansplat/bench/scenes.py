"""The synthetic furnished room of the benchmarks, of any size: one Gaussian at every point of every level's lattice.

Source: PanSplat, section 3.3 (lattices and levels). The counts are the paper's: 886,580 Gaussians at a height of
512, of two views and four levels.
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.fibonacci import fibonacci_directions, lattice_size
from pansplat.geometry.pose import quats_from_rotations

NUM_LEVELS = 4  # levels of lattices, as the paper has
_BASELINE = 1.0  # metres between the two cameras
_CHUNK = 1 << 17  # rays that are cast at once

# Corners of the room, then of its furniture, metres; the cameras are 1.2 m above the floor (y points down).
_ROOM = ((-3.4, -1.5, -2.6), (3.0, 1.2, 3.9))
_FURNITURE = (
    ((-0.9, 0.45, 1.3), (0.9, 0.5, 2.3)),  # table top
    ((-0.1, 0.5, 1.7), (0.1, 1.2, 1.9)),  # table leg
    ((-3.4, 0.35, -0.6), (-2.5, 1.2, 1.6)),  # sofa
    ((2.4, -0.9, -1.9), (3.0, 1.2, -0.4)),  # cupboard
    ((-1.2, -1.5, -2.6), (-0.8, 1.2, -2.2)),  # pillar
    ((1.6, 0.7, 3.0), (2.6, 1.2, 3.6)),  # chest
    ((-0.3, -1.1, 2.0), (0.3, -0.8, 2.6)),  # lamp
)
NUM_SURFACES = 6 * (1 + len(_FURNITURE))
_FOOTPRINT = (0.5, 1.0)  # standard deviations of discs across the line of sight, in pixels of their level
_MAX_STRETCH = 4.0  # largest ratio of the axes of a disc seen at a slant
_THICKNESS = 0.1  # thickness of a disc relative to its width
_OPACITY = (0.3, 0.95)  # opacities of the discs: smallest and largest


def make_room_cameras(views: int = 2) -> Float[Tensor, "view 4 4"]:
    """Poses of the input cameras of `full_lattice_room`: upright, on a line a metre long."""
    poses = torch.eye(4, dtype=torch.float64).repeat(views, 1, 1)
    if views > 1:
        poses[:, 0, 3] = torch.linspace(-0.5 * _BASELINE, 0.5 * _BASELINE, views, dtype=torch.float64)
    return poses


def lattice_room_size(height: int) -> int:
    """Number of Gaussians of `full_lattice_room` with two views."""
    return 2 * sum(lattice_size(2 * height >> level) for level in range(NUM_LEVELS))


def full_lattice_room(height: int, *, views: int = 2) -> Gaussians:
    """A furnished room as panoramas of that height see it: every point of every level's lattice is a Gaussian.

    The Gaussians are discs on the surfaces, 0.5 to 1 pixel of their level wide, of opacity 0.3 to 0.95, which are the
    sizes and overlaps of a predicted scene. The order is level, view, lattice point. Deterministic.

    Args:
        height: rows of the panoramas; a multiple of 8.
        views: number of input cameras.

    Returns:
        float32 Gaussians, 886,580 at a height of 512.

    Raises:
        ValueError: the height is not a multiple of 8.
    """
    if height < 8 or height % 8:
        raise ValueError(f"`height` must be a positive multiple of 8, got {height}")
    generator = torch.Generator().manual_seed(0)
    parts = []
    for level in range(NUM_LEVELS):
        rays = fibonacci_directions(lattice_size(2 * height >> level))
        pixel_angle = math.pi / (height >> level)
        for view, pose in enumerate(make_room_cameras(views)):
            for chunk in rays.split(_CHUNK):
                parts.append(_make_discs(chunk, pose[:3, 3], pixel_angle, generator, level, view))
    return Gaussians.cat(parts)


def _make_discs(
    rays: Float[Tensor, "n 3"],
    position: Float[Tensor, "3"],
    pixel_angle: float,
    generator: torch.Generator,
    level: int,
    view: int,
) -> Gaussians:
    """A disc where each ray from a camera meets the room; it looks round along the ray."""
    distance, axis, surface = trace_room(rays, position)
    points = position + distance[:, None] * rays
    normals = torch.nn.functional.one_hot(axis, 3).double()
    facing = (rays * normals).sum(dim=1)
    low, high = torch.tensor((_FOOTPRINT, _OPACITY), dtype=torch.float64).T
    size, opacity = (low + (high - low) * torch.rand(2, len(rays), generator=generator, dtype=torch.float64).T).T
    across = torch.linalg.cross(normals, rays + 1e-9 * rays.roll(1, dims=1))
    across = torch.nn.functional.normalize(across, dim=1)
    axes = torch.stack((torch.linalg.cross(across, normals), across, normals), dim=2)
    width = size * distance * pixel_angle
    stretch = (1 / facing.abs()).clamp_max(_MAX_STRETCH)
    return Gaussians(
        means=points.float(),
        scales=torch.stack((width * stretch, width, width * _THICKNESS), dim=1).float(),
        quats=quats_from_rotations(axes).float(),
        opacities=opacity.float(),
        harmonics=_paint(points, surface, generator),
        levels=torch.full((len(rays),), level, dtype=torch.uint8),
        views=torch.full((len(rays),), view, dtype=torch.uint8),
    )


def trace_room(
    rays: Float[Tensor, "n 3"], position: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "n"], Int[Tensor, "n"], Int[Tensor, "n"]]:
    """The first surface of the room or its furniture along rays from a position in the room.

    Args:
        rays: directions, float64; of any length.
        position: metres, float64; outside of the furniture.

    Returns:
        Distance in lengths of the ray, the axis of the surface's normal, and the surface's number below
        `NUM_SURFACES`: one for each side of each box.
    """
    inverse = 1 / torch.where(rays.abs() < 1e-12, torch.full_like(rays, 1e-12), rays)
    bounds = torch.tensor(_ROOM, dtype=torch.float64) - position
    distance, axis = torch.maximum(bounds[0] * inverse, bounds[1] * inverse).min(dim=1)
    body = torch.zeros_like(axis)
    for number, corners in enumerate(_FURNITURE, 1):
        bounds = torch.tensor(corners, dtype=torch.float64) - position
        first, second = bounds[0] * inverse, bounds[1] * inverse
        enters, side = torch.minimum(first, second).max(dim=1)
        leaves = torch.maximum(first, second).amin(dim=1)
        hit = (enters > 0) & (enters < leaves) & (enters < distance)
        distance, axis = torch.where(hit, enters, distance), torch.where(hit, side, axis)
        body = torch.where(hit, number, body)
    side = rays.gather(1, axis[:, None])[:, 0] > 0
    return distance, axis, 6 * body + 2 * axis + side


def _paint(
    points: Float[Tensor, "n 3"], surface: Int[Tensor, "n"], generator: torch.Generator
) -> Float[Tensor, "n 1 3"]:
    """Harmonics of degree 0: one colour per surface with stripes and noise."""
    palette = torch.rand(int(surface.max()) + 1, 3, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    stripes = torch.sin(9 * points).prod(dim=1) + 0.5 * torch.sin(70 * points).prod(dim=1)
    grain = 0.05 * torch.randn(len(points), 3, generator=generator, dtype=torch.float64)
    torch.randn(len(points), 3, generator=generator)  # unused; the room stays that of earlier figures
    return (2.4 * (palette[surface] - 0.5) + 0.5 * stripes[:, None] + grain).float()[:, None]
