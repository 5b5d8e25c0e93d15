"""The world of estimated poses: up by gravity, and metres by the height of the cameras over the floor.

The floor is found by its appearance. For each candidate height, the rays below the horizon are extended to a
horizontal plane and projected into another panorama; where the plane is the floor, both images agree.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray as Array

from pansplat.geometry.equirect import pixel_directions
from pansplat.geometry.level import level_pose
from pansplat.system.threads import worker_threads
from pansplat.tours.floor import find_storeys

FLOOR_HEIGHT = 256  # rows of the panoramas in which the floor is searched
_STEPS = 0.03  # relative difference of neighbouring heights
_RANGE = 0.12, 12.0  # heights of the camera that are searched, over the distance of two cameras
_STEEPEST, _FLATTEST = math.radians(85), math.radians(12)  # rays that are used are between, below the horizon
_WINDOW = 9  # pixels; side of the windows that are compared
_MIN_DEVIATION = 0.012  # least deviation of grey values in a window, which are 0 to 1
_MIN_CORRELATION = 0.6
_MIN_EVIDENCE, _MIN_CONTRAST = 0.02, 1.25  # mean correlation that a floor needs; its ratio to any other height
# A plane below the best one is the floor, or may be it: its share of the evidence, and contrast to its ring.
_LOWER_SHARE, _LOWER_CONTRAST = 0.5, 2.0
_DOUBTFUL_SHARE, _DOUBTFUL_CONTRAST = 0.25, 1.45
_RING = 0.12, 0.36  # a plane is compared with those whose height differs by so much, relative
_LOWER = 1.2, 2.6  # lower planes are so much deeper than the best one
_SAME_HEIGHT = 0.1  # largest logarithm of the ratio of the heights over the floors of two storeys
_FLOOR_PAIRS = 8  # the floor of a storey is found by so many nearest pairs
_NEAR_QUANTILE, _FAR_QUANTILE = 0.02, 0.98  # quantiles of the points' distances that give near and far
_NEAR_FACTOR, _FAR_FACTOR = 0.7, 1.4


def level_poses(poses: Float[Array, "view 4 4"], downs: Float[Array, "view 3"]) -> Float[Array, "view 4 4"]:
    """The poses in a world whose y axis points down, and whose origin and forward axis are the first camera's.

    Args:
        downs: gravity in each camera's frame; NaN where unknown. Without any, the cameras' y axes are used.
    """
    world = np.einsum("nij,nj->ni", poses[:, :3, :3], downs)
    world = world[np.isfinite(world).all(axis=1)]
    if not len(world):
        world = poses[:, :3, 1]
    down = np.median(world, axis=0)
    axes = level_pose(torch.from_numpy(poses[0]), torch.from_numpy(-down))[:3, :3].numpy().T
    levelled = poses.copy()
    levelled[:, :3, :3] = axes @ poses[:, :3, :3]
    levelled[:, :3, 3] = (poses[:, :3, 3] - poses[0, :3, 3]) @ axes.T
    return levelled


@dataclass(frozen=True)
class Floor:
    """The horizontal plane below the cameras on which panoramas agree best.

    Attributes:
        height: mean height of the cameras over it, in the poses' unit.
        evidence: mean correlation of the panoramas on it.
        contrast: ratio of the evidence to that of the best other height.
        lower: how much lower another plane is that may be the floor, as a ratio of the heights; None without one.
    """

    height: float
    evidence: float
    contrast: float
    lower: float | None = None

    def is_found(self) -> bool:
        """Whether the plane is a floor, and not the best of many wrong ones."""
        return self.evidence >= _MIN_EVIDENCE and self.contrast >= _MIN_CONTRAST


def find_floors(
    images: Sequence[Float[Array, "height width"]], poses: Float[Array, "view 4 4"], unit: float
) -> list[Floor]:
    """The floor of each storey that two panoramas or more show, by the nearest pairs within the storey.

    A panorama on the stairs is in no storey: its height over a floor is not that of a tripod. If each panorama has a
    level of its own, the floor is that below the lowest one, on which the others may look down.

    Args:
        images: grey panoramas in [0, 1], of `FLOOR_HEIGHT`.
        poses: levelled, y down.
        unit: about the metres that are one unit of the poses.
    """
    places = poses[:, :3, 3]

    def compare(views: Sequence[int], pairs: Sequence[tuple[int, int]]) -> Floor:
        nearest = sorted(pairs, key=lambda p: float(np.linalg.norm(places[views[p[0]]] - places[views[p[1]]])))
        return find_floor([images[view] for view in views], poses[list(views)], nearest[:_FLOOR_PAIRS])

    storeys = [views for views in find_storeys(-unit * places[:, 1]) if len(views) > 1]
    if storeys:
        return [compare(views, list(itertools.combinations(range(len(views)), 2))) for views in storeys]
    lowest = int(places[:, 1].argmax())
    floor = compare(range(len(poses)), [(lowest, view) for view in range(len(poses)) if view != lowest])
    return [replace(floor, height=floor.height - float(places[lowest, 1] - places[:, 1].mean()))]


def find_common_height(floors: Sequence[Floor]) -> tuple[float, str | None] | None:
    """The height of the cameras over the floors on which most evidence agrees, and why it is uncertain.

    The same tripod is used in all storeys. None if no floor is found.
    """
    found = [floor for floor in floors if floor.is_found() and floor.height > 0]
    if not found:
        return None
    agreeing = [
        [other for other in found if abs(math.log(other.height / floor.height)) < _SAME_HEIGHT] for floor in found
    ]
    best = max(agreeing, key=lambda group: sum(floor.evidence for floor in group))
    doubt = None
    if len(best) < len(found):
        doubt = "the floors of the storeys differ"
    elif len(best) == 1 and best[0].lower is not None:
        doubt = f"a plane {best[0].lower:.1f} times as deep may be the floor"
    return float(np.mean([floor.height for floor in best])), doubt


def find_floor(
    images: Sequence[Float[Array, "height width"]], poses: Float[Array, "view 4 4"], pairs: Sequence[tuple[int, int]]
) -> Floor:
    """The floor, by the correlation of the panoramas on horizontal planes of many heights.

    Args:
        images: grey panoramas in [0, 1], of `FLOOR_HEIGHT`.
        poses: levelled, y down.
        pairs: panoramas that are compared.
    """
    reference = float(np.median([np.linalg.norm(poses[i, :3, 3] - poses[j, :3, 3]) for i, j in pairs]))
    low, high = (math.log(reference * bound) for bound in _RANGE)
    heights = np.exp(np.arange(low, high, _STEPS))
    middle = float(poses[:, 1, 3].mean())
    evidence = np.zeros(len(heights))
    ordered = [*pairs, *((j, i) for i, j in pairs)]
    with worker_threads() as pool:
        for found in pool.map(
            lambda p: _floor_evidence(images[p[0]], images[p[1]], poses[p[0]], poses[p[1]], heights, middle), ordered
        ):
            evidence += found
    evidence /= 2 * len(pairs)
    smooth = np.convolve(np.pad(evidence, 1, mode="edge"), (0.25, 0.5, 0.25), "valid")
    best, lower = _choose_lowest(smooth)
    others = np.ones(len(heights), bool)
    for plane in (best, int(smooth.argmax())):
        others &= np.abs(np.arange(len(heights)) - plane) > round(0.15 / _STEPS)
    if not 0 < best < len(smooth) - 1:
        return Floor(float(heights[best]), 0.0, 0.0)
    left, centre, right = smooth[best - 1 : best + 2]
    shift = 0.5 * (left - right) / min(left - 2 * centre + right, -1e-12)
    height = float(heights[best] * math.exp(_STEPS * float(np.clip(shift, -1, 1))))
    return Floor(
        height,
        float(centre),
        float(centre / max(smooth[others].max(), 1e-9)),
        None if lower is None else math.exp(_STEPS * (lower - best)),
    )


def _choose_lowest(evidence: Float[Array, "n"]) -> tuple[int, int | None]:
    """Index of the floor among planes of increasing height of the camera, and that of a lower plane that may be it.

    Tables, beds and counters hide the floor, so that the best plane may be one of theirs. No plane is below the floor.
    """
    strongest = best = int(evidence.argmax())
    lower = None
    inner, outer = (round(bound / _STEPS) for bound in _RING)
    first, last = (best + round(math.log(bound) / _STEPS) for bound in _LOWER)
    for n in range(first, min(last, len(evidence) - 1)):
        if not evidence[n - 1] <= evidence[n] > evidence[n + 1]:
            continue
        distance = np.abs(np.arange(len(evidence)) - n)
        ring = float(np.median(evidence[(distance > inner) & (distance <= outer)]))
        share, contrast = evidence[n] / evidence[strongest], evidence[n] / max(ring, 1e-9)
        if share > _LOWER_SHARE and contrast > _LOWER_CONTRAST:
            best, lower = n, None
        elif share > _DOUBTFUL_SHARE and contrast > _DOUBTFUL_CONTRAST and lower is None:
            lower = n
    return best, lower


def _floor_evidence(
    image: Array, other: Array, pose: Array, other_pose: Array, heights: Float[Array, "n"], middle: float
) -> Float[Array, "n"]:
    """Mean over the sphere of the correlation of both images on a horizontal plane, for each height below `middle`."""
    rows = len(image)
    rays = pixel_directions(rows, 2 * rows, dtype=torch.float64).numpy()[rows // 2 :] @ pose[:3, :3].T
    down = rays[..., 1]
    seen = (down > math.sin(_FLATTEST)) & (down < math.sin(_STEEPEST))
    here = image[rows // 2 :].astype(np.float32)
    mean = cv2.blur(here, (_WINDOW, _WINDOW))
    deviation = np.sqrt(np.maximum(cv2.blur(here * here, (_WINDOW, _WINDOW)) - mean**2, 0))
    seen &= deviation > _MIN_DEVIATION
    area = np.sqrt(np.maximum(1 - down**2, 0)) * seen
    padded = cv2.copyMakeBorder(other.astype(np.float32), 0, 0, 2, 2, cv2.BORDER_WRAP)
    # Rays that end on a floor one unit below the camera, in the axes of the other one.
    toward_floor = rays / np.maximum(down, 1e-3)[..., None] @ other_pose[:3, :3]
    x, y, z = np.moveaxis(toward_floor.astype(np.float32), -1, 0)
    offset = ((pose[:3, 3] - other_pose[:3, 3]) @ other_pose[:3, :3]).astype(np.float32)
    turn = np.float32(rows / math.pi)
    found = np.zeros(len(heights))
    for n, height in enumerate(heights):
        depth = np.float32(middle + height - pose[1, 3])
        if depth <= 0.2 * height:
            continue
        px, py, pz = x * depth + offset[0], y * depth + offset[1], z * depth + offset[2]
        u = np.arctan2(px, pz) * turn + np.float32(rows - 0.5 + 2)
        v = np.arctan2(py, np.sqrt(px * px + pz * pz)) * turn + np.float32(rows / 2 - 0.5)
        warped = cv2.remap(padded, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        warped_mean = cv2.blur(warped, (_WINDOW, _WINDOW))
        variance = cv2.blur(warped * warped, (_WINDOW, _WINDOW)) - warped_mean**2
        both = cv2.blur(here * warped, (_WINDOW, _WINDOW)) - mean * warped_mean
        correlation = both / (deviation * np.sqrt(np.maximum(variance, np.float32(_MIN_DEVIATION**2))) + 1e-9)
        found[n] = float((area * np.maximum(correlation - _MIN_CORRELATION, 0)).sum())
    return found / (1 - _MIN_CORRELATION) / float(np.cos(np.linspace(0, math.pi / 2, rows // 2)).sum() * 2 * rows)


def depth_range(depths: Float[Array, "n"]) -> tuple[float, float] | None:
    """Near and far in the unit of the depths: the range of the points with a margin; None for too few points."""
    finite = depths[np.isfinite(depths)]
    if len(finite) < 20:
        return None
    near, far = np.quantile(finite, (_NEAR_QUANTILE, _FAR_QUANTILE))
    return float(_NEAR_FACTOR * near), float(_FAR_FACTOR * far)
