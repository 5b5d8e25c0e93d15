"""Scenes before they are shared: cropped to a box, and without floaters.

Each step states how many Gaussians it leaves out, and how much the pictures at the cameras change.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from pansplat.errors import InputError
from pansplat.gaussians.crop import Box, crop, keep_gaussians
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.geometry.equirect import pad_equirect, row_weights
from pansplat.pipeline import render
from pansplat.refinement.fusion import OPAQUE, look_up
from pansplat.rendering import rasterize
from pansplat.system.descriptions import describe_count
from pansplat.system.progress import report_progress, stage

_NEIGHBOURS = 16  # Gaussians beside a Gaussian, in the directions of its camera, that are compared with it
_CHUNK = 1 << 17  # Gaussians whose neighbours are searched at once
_SAME_DISTANCE = 0.15  # largest difference of the logarithms of two distances from a camera that count as the same
_MIN_COMPANIONS = 2  # least neighbours at the same distance of a Gaussian that is not isolated
_CONFIRMED = 0.03  # largest distance to a Gaussian of another camera that confirms one, over that to its own camera
_IN_FRONT = 0.85  # largest distance of a floater from its camera, over that of the surface behind it
_DEPTH_ROWS = 512  # most rows of the image of that surface
_PICTURE_ROWS = 256  # most rows of the pictures that are compared before and after
_MAX_PICTURES = 16  # cameras at which pictures are compared


@dataclass(frozen=True)
class Change:
    """What a step did.

    Attributes:
        step: its name.
        before, after: numbers of Gaussians.
        cameras: numbers of cameras, before and after.
        psnr: of the pictures at the remaining cameras against those before, dB; infinite if they are equal, None
            without cameras.
    """

    step: str
    before: int
    after: int
    cameras: tuple[int, int]
    psnr: float | None

    def __str__(self) -> str:
        text = f"{self.step}: {self.before - self.after:,} of {self.before:,} Gaussians left out"
        if self.cameras[0] > self.cameras[1]:
            text += f", and {self.cameras[0] - self.cameras[1]} of {describe_count(self.cameras[0], 'camera')}"
        if self.psnr is None:
            return text
        where = f"the picture{'s' if self.cameras[1] > 1 else ''} at the {describe_count(self.cameras[1], 'camera')}"
        if math.isinf(self.psnr):
            return f"{text}; {where} did not change"
        return f"{text}; {where} before and after agree to {self.psnr:.1f} dB"


@stage()
def clean_up(scene: Scene, box: Box | None = None, *, floaters: bool = True) -> tuple[Scene, list[Change]]:
    """The scene after the steps, and what each of them did.

    Args:
        scene: with each surface once, or not.
        box: that it is cropped to.
        floaters: whether they are kept.
    """
    steps: dict[str, Callable[[Scene], Scene]] = {}
    if box is not None:
        steps["crop"] = partial(crop, box=box)
    if not floaters:
        steps["floaters"] = remove_floaters
    changes = []
    for number, (name, step) in enumerate(steps.items()):
        report_progress(name, number / len(steps))
        cleaned = step(scene)
        counts = len(scene.gaussians), len(cleaned.gaussians)
        cameras = len(scene.cam2world), len(cleaned.cam2world)
        changes.append(Change(name, *counts, cameras, compare_pictures(scene, cleaned)))
        scene = cleaned
    return scene, changes


@torch.no_grad()
def compare_pictures(before: Scene, after: Scene) -> float | None:
    """PSNR of the panoramas at the cameras of one scene against those of another one, over all of at most 16 cameras.

    Returns:
        dB, weighted by solid angle; infinite if they are equal, None without cameras.
    """
    count = len(after.cam2world)
    if not count:
        return None
    if len(before.gaussians) == len(after.gaussians) and len(before.cam2world) == count:
        return math.inf
    rows = min(after.height, _PICTURE_ROWS)
    weights, errors = row_weights(rows), []
    for number in np.unique(np.linspace(0, count - 1, min(count, _MAX_PICTURES)).round().astype(int)).tolist():
        pose = after.cam2world[number]
        first, second = (
            render(scene, pose, size=(rows, 2 * rows)).color.clamp(0, 1).double() for scene in (before, after)
        )
        error = (first - second).square().mean(dim=(0, 2)).cpu()
        errors.append(float((error * weights).sum() / weights.sum()))
    mean = sum(errors) / len(errors)
    return -10 * math.log10(mean) if mean > 0 else math.inf


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
