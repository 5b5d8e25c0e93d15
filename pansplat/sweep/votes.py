"""Which planes a scene has, before any surface is known: every pixel votes for the planes that it matches best.

Most hypotheses of a single pixel are wrong, but wrong ones are wrong at all depths, while what lies on a floor or a
wall agrees on one number, the plane's offset. A pixel's vote is shared among all its hypotheses by how well they fit,
so one that fits everywhere (a bare wall) decides nothing.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import cv2
import numpy as np

from pansplat.geometry.equirect import row_weights
from pansplat.sweep.cost import Family, MatchingConfig, View, matching_cost
from pansplat.sweep.planes import PlaneSupport

_CANDIDATES = 192  # planes across an axis
_SOFTNESS = np.float32(0.1)  # difference of cost at which a hypothesis gets a share smaller by e
_POOR = np.float32(0.6)  # cost of a match that is worth nothing
_MAX_VARIANCE = 4e-3  # of grey values: more texture gives no more votes
_MIN_SLANT = 0.2  # rays flatter to a plane than this hardly tell its offset
_LITTLE = 0.1  # of the strongest plane's votes, from where a plane's votes count
_DISTINCT = 3  # times the middle of all votes: a floor or ceiling stands out by this


def vote_for_planes(
    views: Sequence[View],
    rays: Sequence[np.ndarray],
    cam2world: np.ndarray,
    support: PlaneSupport,
    limits: tuple[float, float],
    min_floor: float,
    config: MatchingConfig,
) -> PlaneSupport:
    """The support with what pixels vote for: shares of planes, and where the floor and the ceiling are.

    Args:
        rays: (3, h, w) for each view, components of its rays along the scene's axes.
        limits: inverse depths between which to search, 1/m.
        min_floor: floor and ceiling are at least so far from the cameras' mean, metres.
    """
    votes = np.zeros_like(support.histogram)
    for view in range(len(views)):
        for other in range(len(views)):
            if other != view:
                poses = (cam2world[view], cam2world[other])
                votes += _votes(views[view], views[other], rays[view], poses, support, limits, config)
    shares = np.log1p(votes / (_LITTLE * votes.max() + 1e-9)) / math.log1p(1 / _LITTLE)
    offsets = support.offsets
    reach = []
    for sign in (1, -1):
        side = np.where(sign * offsets > min_floor, votes[0], 0)
        distinct = side.max() > _DISTINCT * np.median(side[sign * offsets > min_floor])
        reach.append(float(offsets[side.argmax()]) if distinct else sign * math.inf)
    return dataclasses.replace(support, votes=shares, floor_ceiling=(reach[0], reach[1]))


def _votes(
    view: View,
    other: View,
    rays: np.ndarray,
    poses: tuple[np.ndarray, np.ndarray],
    support: PlaneSupport,
    limits: tuple[float, float],
    config: MatchingConfig,
) -> np.ndarray:
    """Votes (3, bins) of one view's pixels, matched against one other."""
    here, there = poses
    low, high = limits
    step = (high - low) / (_CANDIDATES - 1)
    inverse = low + step * np.arange(_CANDIDATES)
    nothing = np.zeros((2, _CANDIDATES), np.float32)
    families = [
        Family(
            (low * slope).astype(np.float32), (step * slope).astype(np.float32), nothing, side,
            support.backs(axis, here, there, inverse),
        )
        for axis, (slope, side) in enumerate(zip(np.abs(rays), (rays > 0).astype(np.uint8), strict=True))
    ]  # fmt: skip
    cost = matching_cost(view, other, np.linalg.inv(there) @ here, families, limits, (math.inf, -math.inf), config)
    fit = np.exp(-cost / _SOFTNESS)
    fit *= (_texture(view) / fit.sum(axis=-1))[..., None] * np.maximum(_POOR - cost, 0)
    votes = np.zeros_like(support.histogram)
    for axis in range(3):
        centre = support.axes[axis] @ (here[:3, 3] - support.origin)
        for sign in (-1, 1):
            facing = sign * rays[axis] > _MIN_SLANT
            found = fit[facing][:, axis * _CANDIDATES : (axis + 1) * _CANDIDATES].sum(axis=0)
            offset = centre + sign / inverse
            order = np.argsort(offset)
            votes[axis] += np.interp(support.offsets, offset[order], found[order], left=0, right=0)
    return votes


def _texture(view: View) -> np.ndarray:
    """Weight (h, w) of the pixels' votes by texture and solid angle; the weights sum to one, or are all zero."""
    gray = view.image.mean(axis=2)
    variance = cv2.boxFilter(gray * gray, -1, (5, 5)) - cv2.boxFilter(gray, -1, (5, 5)) ** 2
    area = row_weights(len(view.image)).numpy()[:, None]
    weight = np.clip(variance, 0, _MAX_VARIANCE) * view.usable * area
    return (weight / max(float(weight.sum()), 1e-9)).astype(np.float32)
