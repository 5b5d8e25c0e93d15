"""The surfaces that a panorama shows, by its Gaussians."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from pansplat.gaussians.harmonics import SH_0
from pansplat.gaussians.scene import Scene

RAYS = 360  # around a camera, of which walls are measured
OPAQUE = 0.5  # least opacity of the surfaces that hide and block
_ROWS, _COLUMNS = 180, 360  # of equal solid angles

Outline = Float[np.ndarray, "corner 2"]


def locate_surfaces(
    scene: Scene, view: int, level: Float[np.ndarray, "3 3"], *, min_opacity: float = 0.1
) -> Float[np.ndarray, "n 3"]:
    """Places (right, down, forward) relative to a view's camera of its Gaussians that show surfaces, metres.

    Args:
        scene: with all Gaussians of the view.
        view: number of the camera.
        level: axes of a level camera, as columns right, down and forward.
        min_opacity: Gaussians of lower opacity are left out.
    """
    means, center = scene.gaussians.means[_show(scene, view, min_opacity)], scene.cam2world[view, :3, 3]
    return (means.double().cpu().numpy() - center.double().cpu().numpy()).dot(level)


def find_colors(scene: Scene, view: int, *, min_opacity: float) -> Float[np.ndarray, "n 3"]:
    """The colours, without those of higher degrees of harmonics, of the Gaussians of `locate_surfaces`, in [0, 1]."""
    harmonics = scene.gaussians.harmonics[_show(scene, view, min_opacity), 0]
    return (0.5 + SH_0 * harmonics).clamp(0, 1).double().cpu().numpy()


def _show(scene: Scene, view: int, min_opacity: float) -> Bool[Tensor, "n"]:
    """Which Gaussians show the surfaces of a view. Coarse levels have Gaussians behind the surfaces."""
    gaussians = scene.gaussians
    shown = (gaussians.views == view) & (gaussians.opacities > min_opacity) & (gaussians.levels <= 1)
    return shown & gaussians.means.isfinite().all(dim=1)


def sample_surfaces(scene: Scene, view: int, level: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "n 3"]:
    """The places of `locate_surfaces`, of each of many equal solid angles the one of median distance.

    Pictures of much detail have more Gaussians: where they are and how many has no influence on what is measured here.
    """
    places = locate_surfaces(scene, view, level)
    distances = np.maximum(np.linalg.norm(places, axis=1), 1e-9)
    columns = (np.arctan2(places[:, 0], places[:, 2]) / (2 * math.pi) % 1.0 * _COLUMNS).astype(int) % _COLUMNS
    cells = columns * _ROWS + ((places[:, 1] / distances + 1) / 2 * _ROWS).astype(int).clip(0, _ROWS - 1)
    order = np.lexsort((distances, cells))
    borders = np.flatnonzero(np.diff(cells[order], prepend=-1, append=-1))
    return places[order[(borders[:-1] + borders[1:] - 1) // 2]]


def split_by_azimuth(
    flat: Float[np.ndarray, "n 2"], values: Float[np.ndarray, "n"], count: int
) -> list[Float[np.ndarray, "m"]]:
    """The values of the places in each of `count` equal sectors around a camera, from forward to the right.

    Args:
        flat: places (right, forward) relative to the camera.
        values: of the places.
    """
    sectors = ((np.arctan2(flat[:, 0], flat[:, 1]) / (2 * math.pi) % 1.0) * count).astype(int) % count
    order = np.argsort(sectors, kind="stable")
    return np.split(values[order], np.searchsorted(sectors[order], np.arange(1, count)))


def locate_ends(
    scene: Scene, panoramas: Sequence[int], edges: Iterable[tuple[int, int]]
) -> tuple[list[tuple[int, int]], dict[int, Float[np.ndarray, "n 3"]], dict[int, Float[np.ndarray, "3"]]]:
    """The edges between two of a scene's panoramas, and by panorama its surfaces and its camera.

    Surfaces are in the axes of the world, relative to their camera; cameras are places in the world, metres.

    Args:
        scene: of some panoramas, with all Gaussians of each.
        panoramas: the number in the tour of each of the scene's views.
        edges: pairs of panoramas; those with another panorama are left out.
    """
    view = {panorama: number for number, panorama in enumerate(panoramas)}
    inside = [(a, b) for a, b in edges if a != b and a in view and b in view]
    ends = {node for edge in inside for node in edge}
    positions = scene.cam2world[:, :3, 3].double().cpu().numpy()
    surfaces = {node: locate_surfaces(scene, view[node], np.eye(3), min_opacity=OPAQUE) for node in ends}
    return inside, surfaces, {node: positions[view[node]] for node in ends}


def ray_angles() -> Float[np.ndarray, "ray"]:
    """Azimuths from forward to the right, radians."""
    return (np.arange(RAYS) + 0.5) * 2 * math.pi / RAYS


def ray_directions() -> Float[np.ndarray, "ray 2"]:
    angles = ray_angles()
    return np.stack((np.sin(angles), np.cos(angles)), axis=1)


def meet_outline(center: Float[np.ndarray, "2"], outline: Outline) -> tuple[np.ndarray, np.ndarray]:
    """Distance at which each ray meets the outline, and the number of that wall; infinite and -1 if it does not."""
    rays, along = ray_directions(), np.roll(outline, -1, axis=0) - outline
    cross = rays[:, None, 0] * along[:, 1] - rays[:, None, 1] * along[:, 0]
    offset = outline - center
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (offset[:, 0] * along[:, 1] - offset[:, 1] * along[:, 0]) / cross
        position = (offset[:, 0] * rays[:, None, 1] - offset[:, 1] * rays[:, None, 0]) / cross
    distance = np.where((distance > 0) & (position >= 0) & (position <= 1), distance, np.inf)
    nearest = distance.argmin(axis=1)
    reached = distance[np.arange(RAYS), nearest]
    return reached, np.where(np.isfinite(reached), nearest, -1)
