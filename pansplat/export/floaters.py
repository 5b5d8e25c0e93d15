"""Floaters: isolated Gaussians in free space, which a scene may leave out before it is shared."""

from __future__ import annotations

import numpy as np
import scipy
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from pansplat.errors import InputError
from pansplat.gaussians.crop import keep_gaussians
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.geometry.equirect import pad_equirect
from pansplat.refinement.fusion import OPAQUE, look_up
from pansplat.rendering import rasterize

_NEIGHBOURS = 16  # Gaussians beside a Gaussian, in the directions of its camera, that are compared with it
_CHUNK = 1 << 17  # Gaussians whose neighbours are searched at once
_SAME_DISTANCE = 0.15  # largest difference of the logarithms of two distances from a camera that count as the same
_MIN_COMPANIONS = 2  # least neighbours at the same distance of a Gaussian that is not isolated
_CONFIRMED = 0.03  # largest distance to a Gaussian of another camera that confirms one, over that to its own camera
_IN_FRONT = 0.85  # largest distance of a floater from its camera, over that of the surface behind it
_DEPTH_ROWS = 512  # most rows of the image of that surface


def remove_floaters(scene: Scene) -> Scene:
    """The scene without isolated Gaussians in free space (`find_floaters`); all cameras are kept."""
    return keep_gaussians(scene, ~find_floaters(scene), range(len(scene.cam2world)))


@torch.no_grad()
def find_floaters(scene: Scene) -> Bool[Tensor, "n"]:
    """Which Gaussians float, alone or two together: isolated ones in front of the surfaces that their camera sees.

    A Gaussian is isolated if hardly any of those beside it, in the directions of its camera, is as far, and if no other
    camera has one at its place. A thin thing, such as a wire, has neighbours along itself. What has no surface behind
    it, such as a distant tree before the sky, is kept.

    Raises:
        InputError: the scene has no input cameras.
    """
    if not len(scene.cam2world):
        raise InputError("floaters are found with input cameras, got a scene without one; crop it to a box")
    gaussians = scene.gaussians
    means = gaussians.means.double().cpu().numpy()
    finite = np.flatnonzero(np.isfinite(means).all(axis=1))
    is_floater = np.zeros(len(means), bool)
    views = gaussians.views.long().cpu().numpy()
    for view, center in enumerate(scene.cam2world[:, :3, 3].numpy()):
        own = finite[views[finite] == view]
        is_floater[own] = _are_nearer(means[own] - center, means[finite if scene.joint else own] - center)
    suspects = np.flatnonzero(is_floater)
    rest = finite[~is_floater[finite]]
    if not len(suspects) or not len(rest):
        return torch.zeros(len(means), dtype=torch.bool, device=gaussians.means.device)
    tree = scipy.spatial.cKDTree(means[rest])
    for view in np.unique(views[suspects]).tolist():
        chosen = suspects[views[suspects] == view]
        radii = _CONFIRMED * np.linalg.norm(means[chosen] - scene.cam2world[view, :3, 3].numpy(), axis=1)
        near = tree.query_ball_point(means[chosen], radii)
        is_confirmed = np.array([bool((views[rest[found]] != view).any()) for found in near])
        shown = rest if scene.joint else rest[views[rest] == view]
        surface = gaussians.select(torch.from_numpy(shown).to(gaussians.means.device))
        points = gaussians.means[torch.from_numpy(chosen).to(gaussians.means.device)]
        in_front = _are_in_front(points, scene.cam2world[view], surface, scene.height).cpu().numpy()
        is_floater[chosen] = in_front & ~is_confirmed
    return torch.from_numpy(is_floater).to(gaussians.means.device)


def _are_nearer(offsets: Float[np.ndarray, "n 3"], others: Float[np.ndarray, "m 3"]) -> Bool[np.ndarray, "n"]:
    """Whether Gaussians at offsets from their camera are isolated among those beside them, and nearer than most.

    Args:
        offsets: from the camera, metres.
        others: that may be beside them, themselves among these.
    """
    is_nearer = np.zeros(len(offsets), bool)
    if len(others) <= _NEIGHBOURS:
        return is_nearer
    (distances, rays), (other_distances, other_rays) = _split(offsets), _split(others)
    logs, other_logs = np.log(distances), np.log(other_distances)
    tree = scipy.spatial.cKDTree(other_rays, balanced_tree=False, compact_nodes=False)
    for start in range(0, len(rays), _CHUNK):
        part = slice(start, start + _CHUNK)
        neighbours = tree.query(rays[part], _NEIGHBOURS + 1, workers=torch.get_num_threads())[1][:, 1:]
        behind = other_logs[neighbours] - logs[part, None]
        companions = (np.abs(behind) < _SAME_DISTANCE).sum(axis=1)
        is_nearer[part] = (companions < _MIN_COMPANIONS) & ((behind > _SAME_DISTANCE).sum(axis=1) > _NEIGHBOURS // 2)
    return is_nearer


def _split(offsets: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """Lengths and directions."""
    distances = np.maximum(np.linalg.norm(offsets, axis=1), 1e-9)
    return distances, offsets / distances[:, None]


def _are_in_front(
    points: Float[Tensor, "n 3"], pose: Float[Tensor, "4 4"], surface: Gaussians, height: int
) -> Bool[Tensor, "n"]:
    """Whether points are clearly nearer to a camera than all surfaces in and around their pixels, of which one is."""
    rows = min(height, _DEPTH_ROWS)
    drawn = rasterize(surface, pose, size=(rows, 2 * rows))
    depth = torch.where(drawn.alpha > OPAQUE, drawn.depth, torch.inf)[None]
    nearest = -functional.max_pool2d(pad_equirect(-depth, 1), 3, stride=1)[0]
    distances, found = look_up(nearest, points, pose)
    return (distances < _IN_FRONT * found) & torch.isfinite(found)
