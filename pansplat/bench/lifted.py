"""A real place to measure on: a pair's known depth, with a Gaussian at every point of every level's lattice."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.bench.scenes import NUM_LEVELS, disc_sizes, flat_discs
from pansplat.data.views import Views
from pansplat.errors import InputError
from pansplat.gaussians.harmonics import harmonics_basis
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.geometry.equirect import (
    pad_equirect,
    pixel_directions,
    resize_equirect,
    sample_equirect,
    uv_from_directions,
)
from pansplat.geometry.fibonacci import fibonacci_directions, lattice_size


def lift_depth(views: Views, *, seed: int = 0) -> Scene:
    """A scene of discs on the surfaces that the views' depth maps show, as many as the lattices have points.

    Sizes and opacities are as in `full_lattice_room`; colours are the pictures'. Where depth is unknown it is taken to
    be the view's median. The order is level, view, lattice point.

    Args:
        views: with depths; a height that halves three times.
        seed: of sizes and opacities.

    Returns:
        A scene of float32 Gaussians, 886,580 of two views at a height of 512.

    Raises:
        InputError: the views have no depth.
    """
    if views.depths is None:
        raise InputError(
            "a scene made of depth needs a depth map beside each panorama; got none; take --scene-from prediction"
        )
    height = views.images.shape[-2]
    generator = torch.Generator().manual_seed(seed)
    depths = [torch.where(known > 0, known, known[known > 0].median()) for known in views.depths.double()]
    parts = [
        _lift_level(views.images[view], depth, views.cam2world[view], level, view, generator)
        for level in range(NUM_LEVELS)
        for view, depth in enumerate(depths)
    ]
    return Scene(Gaussians.cat(parts), views.cam2world, views.near, views.far, views.names, "depth", height)


def _lift_level(
    image: Float[Tensor, "3 height width"],
    depth: Float[Tensor, "height width"],
    pose: Float[Tensor, "4 4"],
    level: int,
    view: int,
    generator: torch.Generator,
) -> Gaussians:
    height = image.shape[-2] >> level
    maps = torch.cat((image.double(), 1 / depth[None]))
    maps = resize_equirect(maps[None], (height, 2 * height))[0]
    maps = torch.cat((maps, _normals(1 / maps[3])))
    rays = fibonacci_directions(lattice_size(2 * height))
    picked = sample_equirect(maps, uv_from_directions(rays)).T
    distance = 1 / picked[:, 3]
    normals = torch.nn.functional.normalize(picked[:, 4:], dim=1)
    turn = pose[:3, :3]
    return flat_discs(
        rays @ turn.T,
        (distance[:, None] * rays) @ turn.T + pose[:3, 3],
        normals @ turn.T,
        disc_sizes(len(rays), generator),
        distance * math.pi / height,
        ((picked[:, :3] - 0.5) / harmonics_basis(rays, 0))[:, None, :],
        level,
        view,
    )


def _normals(depth: Float[Tensor, "height width"]) -> Float[Tensor, "3 height width"]:
    """Unit normals of the surface, from its points in the neighbouring pixels."""
    points = (pixel_directions(*depth.shape, dtype=torch.float64) * depth[..., None]).permute(2, 0, 1)
    around = pad_equirect(points, 1, "sphere")
    east = around[:, 1:-1, 2:] - around[:, 1:-1, :-2]
    south = around[:, 2:, 1:-1] - around[:, :-2, 1:-1]
    return torch.nn.functional.normalize(torch.linalg.cross(east, south, dim=0), dim=0)
