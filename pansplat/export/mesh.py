"""The surfaces of a scene as triangles with the photographs as textures.

The depth of the Gaussians of each view, at its camera, gives a vertex for each pixel of a coarse panorama. Triangles
that the camera sees at a grazing angle span the step from one surface to another and are left out. Each place is kept
from the nearest camera that sees it, as in `pansplat.refinement.fusion`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor
from torch.nn import functional

from pansplat.errors import InputError
from pansplat.export.mesh_files import Mesh, MeshPart
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.geometry.equirect import pad_equirect, pixel_directions
from pansplat.refinement.fusion import BACKGROUND_LEVEL, OPAQUE, are_seen, measure_reach
from pansplat.rendering import rasterize

DEFAULT_TRIANGLES = 2_000_000  # of a mesh, at most

_MOST_ROWS, _FEWEST_ROWS = 512, 8  # of the grid of one panorama
_GRAZING = math.radians(83)  # largest angle between a ray and the normal of a surface that it meets
_TEXTURE_ROWS = 2048  # of a texture that is drawn; at most those of the photographs

Textures = Callable[[int], Float[Tensor, "3 height width"]]
"""The texture of a view, sRGB in [0, 1]."""

Inside = Callable[[Float[np.ndarray, "n 3"]], Bool[np.ndarray, "n"]]
"""Whether places, metres, are to be in a mesh."""


@torch.no_grad()
def make_mesh(
    scene: Scene,
    *,
    triangles: int = DEFAULT_TRIANGLES,
    textures: Textures | None = None,
    inside: Inside | None = None,
) -> Mesh:
    """The surfaces that the cameras of a scene see, with each place once.

    Args:
        scene: with input cameras; of a joint scene all Gaussians are drawn for each.
        triangles: largest number; bounds the rows of the panoramas, of which there are at most 512.
        textures: by default the images of the views' Gaussians at their cameras.
        inside: chooses the places of a triangle's corners (`pansplat.tours.doll_house.find_rooms`); by default all.
    """
    count = len(scene.cam2world)
    if not count:
        raise InputError("a mesh needs a scene with input cameras, got none; export the folder of the panoramas")
    rows = min(_MOST_ROWS, math.isqrt(triangles // (4 * count)))
    if rows < _FEWEST_ROWS:
        raise InputError(
            f"a mesh of {count} panoramas needs {4 * count * _FEWEST_ROWS**2:,} triangles or more, got a limit of "
            f"{triangles:,}; raise it"
        )
    size = rows, 2 * rows
    poses, own = scene.cam2world.double(), scene.gaussians.views
    seen = [scene.gaussians if scene.joint else scene.gaussians.select(own == view) for view in range(count)]
    depths, reaches = [], []
    for gaussians, pose in zip(seen, poses, strict=True):
        # Where a mask leaves out the surface, the background shows beside it.
        surface = gaussians.select(gaussians.levels < BACKGROUND_LEVEL)
        drawn = rasterize(surface, pose, size=size)
        depth = torch.where(drawn.alpha > OPAQUE, drawn.depth, 0)
        # At the edge of a hole the camera has no whole triangles: others fill it up to there.
        hole = functional.max_pool2d(pad_equirect((depth == 0).to(depth)[None], 1), 3, stride=1)[0] > 0
        reaches.append(torch.where(hole, 0, measure_reach(surface, pose, rows)).cpu())
        depths.append(depth.double().cpu())
    parts = []
    for view, (depth, pose) in enumerate(zip(depths, poses.cpu(), strict=True)):
        places = depth[..., None] * pixel_directions(*size, dtype=torch.float64)
        points = torch.cat((places.reshape(-1, 3), _join_at_pole(places, 0)[None], _join_at_pole(places, -1)[None]))
        corners = _connect(points.numpy(), rows)
        points = points @ pose[:3, :3].T + pose[:3, 3]
        is_free = ~_are_seen_nearer(points, view, poses.cpu(), reaches).numpy()
        numbers = _find_points(corners, rows)
        is_kept = is_free[numbers].any(axis=1)
        if inside is not None:
            is_kept &= inside(points.numpy())[numbers].all(axis=1)
        triangle = corners[is_kept]
        draw = partial(_draw, seen[view], pose, scene) if textures is None else partial(textures, view)
        name = scene.names[view] if view < len(scene.names) else f"panorama {view + 1}"
        parts.append(_make_part(name, points.numpy(), triangle, rows, partial(_balance, draw, scene, view)))
    return Mesh(tuple(part for part in parts if len(part.triangles)), scene.frame)


def _join_at_pole(places: Float[Tensor, "row column 3"], row: int) -> Float[Tensor, "3"]:
    """The place above or below the camera in the plane of the row next to it; 0 if one of its pixels has no surface."""
    ring = places[row]
    if not bool((ring.norm(dim=1) > 0).all()):
        return torch.zeros(3, dtype=places.dtype)
    height = ring[:, 1].mean()
    return torch.stack((torch.zeros_like(height), height, torch.zeros_like(height)))


def _find_points(corners: Int[np.ndarray, "*shape"], rows: int) -> Int[np.ndarray, "*shape"]:
    """Numbers of the places of vertices. Those on the seam, and at the poles, are several vertices at one place.

    The vertices are rows of 2 rows + 1, then 2 rows vertices of the upper pole, and as many of the lower one.
    """
    columns = 2 * rows
    row, column = np.divmod(corners, columns + 1)
    grid = row * columns + column % columns
    first_pole = rows * (columns + 1)
    return np.where(corners < first_pole, grid, rows * columns + (corners - first_pole) // columns)


def _connect(points: Float[np.ndarray, "n 3"], rows: int) -> Int[np.ndarray, "triangle 3"]:
    """The triangles of a panorama's surfaces: its vertices, seen from the camera; see `_find_points`."""
    columns = 2 * rows
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij")
    upper = row * (columns + 1) + column
    lower = upper + columns + 1
    quads = np.stack((upper, upper + 1, lower, lower + 1), axis=-1).reshape(-1, 4)
    # The shorter diagonal follows the edge of a surface.
    ends = points[_find_points(quads, rows)]
    is_falling = np.linalg.norm(ends[:, 0] - ends[:, 3], axis=1) <= np.linalg.norm(ends[:, 1] - ends[:, 2], axis=1)
    falling, rising = quads[is_falling], quads[~is_falling]
    column, first = np.arange(columns), rows * (columns + 1)
    last = (rows - 1) * (columns + 1) + column
    corners = np.concatenate(
        (
            falling[:, [0, 2, 3]],
            falling[:, [0, 3, 1]],
            rising[:, [0, 2, 1]],
            rising[:, [1, 2, 3]],
            np.stack((first + column, column, column + 1), axis=1),
            np.stack((first + columns + column, last + 1, last), axis=1),
        )
    )
    return corners[_are_surfaces(points[_find_points(corners, rows)])]


def _are_surfaces(corners: Float[np.ndarray, "triangle 3 3"]) -> Bool[np.ndarray, "triangle"]:
    """Whether triangles have a surface at each corner, and the camera, at the origin, sees them at no grazing angle."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    middles = corners.mean(axis=1)
    cosine = -(normals * middles).sum(axis=1)
    limit = math.cos(_GRAZING) * np.linalg.norm(normals, axis=1) * np.linalg.norm(middles, axis=1)
    return (np.linalg.norm(corners, axis=2) > 0).all(axis=1) & (cosine > limit)


def _are_seen_nearer(
    points: Float[Tensor, "n 3"],
    view: int,
    poses: Float[Tensor, "view 4 4"],
    reaches: list[Float[Tensor, "height width"]],
) -> Bool[Tensor, "n"]:
    """Whether a camera sees each point that is nearer to it than its own; of two as near, the first one."""
    distance = (points - poses[view, :3, 3]).norm(dim=1)
    seen = torch.zeros(len(points), dtype=torch.bool)
    for other, (pose, reach) in enumerate(zip(poses, reaches, strict=True)):
        if other == view:
            continue
        there = (points - pose[:3, 3]).norm(dim=1)
        asked = (((there < distance) | ((there == distance) & (other < view))) & ~seen).nonzero()[:, 0]
        seen[asked] = are_seen(points[asked], pose, reach)
    return seen


def _draw(gaussians: Gaussians, pose: Float[Tensor, "4 4"], scene: Scene) -> Float[Tensor, "3 height width"]:
    """The image of a view's Gaussians at its camera."""
    rows = min(scene.height, _TEXTURE_ROWS)
    drawn = rasterize(gaussians, pose, size=(rows, 2 * rows))
    return drawn.color / drawn.alpha.clamp_min(OPAQUE)


@torch.no_grad()
def _balance(
    draw: Callable[[], Float[Tensor, "3 height width"]], scene: Scene, view: int
) -> UInt8[np.ndarray, "height width 3"]:
    """The pixels of a texture, with the mean exposure and white balance of all views if those of each are known."""
    texture = draw()
    if scene.gains and not scene.joint:
        texture = texture / torch.tensor(scene.gains[view]).to(texture)[:, None, None]
    return (texture.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).cpu().numpy()


def _make_part(
    name: str,
    points: Float[np.ndarray, "n 3"],
    corners: Int[np.ndarray, "triangle 3"],
    rows: int,
    texture: Callable[[], UInt8[np.ndarray, "height width 3"]],
) -> MeshPart:
    """The part of some triangles, with the vertices that they need."""
    used, triangles = np.unique(corners, return_inverse=True)
    columns, first = 2 * rows, rows * (2 * rows + 1)
    row, column = np.divmod(used, columns + 1)
    around = (used - first) % columns
    in_grid = used < first
    u = np.where(in_grid, column + 0.5, around + 1.0) / columns
    v = np.where(in_grid, (row + 0.5) / rows, (used - first) // columns)
    positions = points[_find_points(used, rows)]
    return MeshPart(name, positions, np.stack((u, v), axis=1), triangles.reshape(-1, 3), texture)
