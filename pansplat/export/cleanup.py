"""Scenes before they are shared: cropped to a box or to rooms, without floaters and without faint Gaussians.

Each step states how many Gaussians it leaves out, and how much the pictures at the cameras change.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
import torch
from jaxtyping import Bool, Float
from shapely import contains_xy
from shapely.geometry import Polygon
from torch import Tensor
from torch.nn import functional

from pansplat.errors import InputError
from pansplat.gaussians.crop import Box, crop, keep_gaussians
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.geometry.equirect import pad_equirect, row_weights, uv_from_directions
from pansplat.pipeline import render
from pansplat.rendering import rasterize
from pansplat.system.descriptions import describe_count
from pansplat.system.progress import report_progress, stage
from pansplat.tours.facts import TourFacts
from pansplat.tours.floor import assign_storeys
from pansplat.tours.graph import make_graph

_NEIGHBOURS = 16  # of a Gaussian
_CHUNK = 1 << 17  # Gaussians whose neighbours are looked for at once
_ALIKE = 0.15  # largest difference of the logarithms of two distances from a camera that are alike
_FEW = 2  # neighbours of an isolated Gaussian that are as far are fewer
_CONFIRMED = 0.03  # distance from a Gaussian of another camera, relative to that from the own camera
_LONELY = 3.0  # distance of the neighbours, relative to that of their own ones and to the largest standard deviation
_IN_FRONT = 0.85  # largest distance from a camera, relative to that of the surface behind
_OPAQUE = 0.5  # least alpha of that surface
_DEPTH_ROWS, _PICTURE_ROWS = 512, 256  # of the images that are compared
_MAX_PICTURES = 16  # cameras at which pictures are compared


@dataclass(frozen=True)
class Cleaning:
    """What is done, in this order.

    Attributes:
        rooms: names of rooms of the plan, or of panoramas in them, that the scene is cropped to.
        box: that the scene is cropped to.
        floaters: whether floaters are kept.
        min_opacity: of the Gaussians that are kept.
    """

    rooms: tuple[str, ...] = ()
    box: Box | None = None
    floaters: bool = True
    min_opacity: float = 0.0


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
def clean_up(
    scene: Scene,
    cleaning: Cleaning,
    layers: Scene | None = None,
) -> tuple[Scene, list[Change]]:
    """The scene after the steps, and what each of them did.

    Args:
        scene: with each surface once, or not.
        cleaning: the steps.
        layers: the scene of the same cameras with all that each panorama shows, to find the rooms of a joint one.
    """
    steps: dict[str, Callable[[Scene], Scene]] = {}
    box, least = cleaning.box, cleaning.min_opacity
    if cleaning.rooms:
        names = cleaning.rooms  # first, because the layers are those of all cameras
        steps["rooms"] = lambda scene: crop_to_rooms(scene, names, layers)
    if box is not None:
        steps["crop"] = lambda scene: crop(scene, box)
    if not cleaning.floaters:
        steps["floaters"] = remove_floaters
    if least > 0:
        steps["opacity"] = lambda scene: keep_gaussians(
            scene, scene.gaussians.opacities >= least, range(len(scene.cam2world))
        )
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


def crop_to_rooms(scene: Scene, names: Sequence[str], layers: Scene | None = None) -> Scene:
    """The part of a scene that is in some rooms.

    The layers of the rooms' cameras are kept: what these see through doors, too. A joint scene also keeps what other
    cameras have seen within the rooms' outlines.

    Args:
        scene: with input cameras.
        names: of rooms of the floor plan, or of panoramas in them; upper and lower case are equal.
        layers: see `clean_up`.
    """
    if not len(scene.cam2world):
        raise InputError("rooms need a scene with input cameras, got one without; crop it to a box")
    tour = make_graph(scene)
    shown = scene if layers is None else layers
    rooms = () if shown.joint else TourFacts(shown).plan.rooms
    labels = [panorama.label.casefold() for panorama in tour.panoramas]
    views: set[int] = set()
    for name in names:
        wanted = name.casefold()
        found = {view for view, label in enumerate(labels) if label == wanted}
        found |= {view for room in rooms for view in room.panoramas if room.name.casefold() == wanted}
        if not found:
            known = dict.fromkeys([*(room.name for room in rooms), *(panorama.label for panorama in tour.panoramas)])
            raise InputError(f"needed the name of a room or panorama, got {name!r}; choose from {', '.join(known)}")
        views |= found
    inside = [room for room in rooms if views & {*room.panoramas}]
    views |= {view for room in inside for view in room.panoramas}
    own = scene.gaussians.views.long().cpu()
    kept = torch.isin(own, torch.tensor(sorted(views)))
    if scene.joint and inside:
        storeys = torch.tensor(assign_storeys(tour))[own]
        places = scene.gaussians.means.double().cpu().numpy() @ tour.level_axes[:, (0, 2)]
        for room in inside:
            is_within = torch.from_numpy(contains_xy(Polygon(room.outline), places[:, 0], places[:, 1]))
            kept |= is_within & (storeys == room.storey)
    return keep_gaussians(scene, kept.to(scene.gaussians.means.device), sorted(views))


def remove_floaters(scene: Scene) -> Scene:
    """The scene without isolated Gaussians in free space (`find_floaters`); all cameras are kept."""
    return keep_gaussians(scene, ~find_floaters(scene), range(len(scene.cam2world)))


@torch.no_grad()
def find_floaters(scene: Scene) -> Bool[Tensor, "n"]:
    """Which Gaussians float, alone or two together: isolated ones in front of the surfaces that their camera sees.

    A Gaussian is isolated if hardly any of those beside it, in the directions of its camera, is as far, and if no other
    camera has one at its place. A thin thing, such as a wire, has neighbours along itself. What has no surface behind
    it, such as a distant tree before the sky, is kept. In a scene without input cameras, Gaussians float whose
    neighbours are far, relative to the neighbours' own ones and to their size.
    """
    gaussians = scene.gaussians
    means = gaussians.means.double().cpu().numpy()
    finite = np.flatnonzero(np.isfinite(means).all(axis=1))
    is_floater = np.zeros(len(means), bool)
    if not len(scene.cam2world):
        is_floater[finite] = _are_lonely(means[finite], gaussians.scales.amax(dim=1).double().cpu().numpy()[finite])
        return torch.from_numpy(is_floater).to(gaussians.means.device)
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
        alike = (np.abs(behind) < _ALIKE).sum(axis=1)
        is_nearer[part] = (alike < _FEW) & ((behind > _ALIKE).sum(axis=1) > _NEIGHBOURS // 2)
    return is_nearer


def _split(offsets: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """Lengths and directions."""
    distances = np.maximum(np.linalg.norm(offsets, axis=1), 1e-9)
    return distances, offsets / distances[:, None]


def _are_lonely(means: Float[np.ndarray, "n 3"], sizes: Float[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """Whether the neighbours of each Gaussian are far."""
    is_lonely = np.zeros(len(means), bool)
    if len(means) <= _NEIGHBOURS:
        return is_lonely
    tree, workers = scipy.spatial.cKDTree(means), torch.get_num_threads()
    parts = [slice(start, start + _CHUNK) for start in range(0, len(means), _CHUNK)]
    reach = np.concatenate([tree.query(means[part], [_NEIGHBOURS + 1], workers=workers)[0][:, 0] for part in parts])
    suspects = np.flatnonzero(reach > _LONELY * sizes)
    neighbours = tree.query(means[suspects], _NEIGHBOURS + 1, workers=workers)[1][:, 1:]
    is_lonely[suspects] = reach[suspects] > _LONELY * np.median(reach[neighbours], axis=1)
    return is_lonely


def _are_in_front(
    points: Float[Tensor, "n 3"], pose: Float[Tensor, "4 4"], surface: Gaussians, height: int
) -> Bool[Tensor, "n"]:
    """Whether points are clearly nearer to a camera than all surfaces in and around their pixels, of which one is."""
    rows = min(height, _DEPTH_ROWS)
    drawn = rasterize(surface, pose, size=(rows, 2 * rows))
    depth = torch.where(drawn.alpha > _OPAQUE, drawn.depth, torch.inf)[None]
    nearest = -functional.max_pool2d(pad_equirect(-depth, 1), 3, stride=1)[0]
    offsets = (points.double() - pose[:3, 3].to(points.device)) @ pose[:3, :3].to(points.device)
    uv = uv_from_directions(offsets)
    row, column = (uv[:, 1] * rows).long().clamp(0, rows - 1), (uv[:, 0] * 2 * rows).long() % (2 * rows)
    found = nearest[row, column]
    return (offsets.norm(dim=1) < _IN_FRONT * found) & torch.isfinite(found)
