"""Matching cost of depth hypotheses: how well one view, warped by a hypothesis, looks like the other.

A family of hypotheses assigns inverse depth `base + k * step` to a pixel, k = 0..count-1, with a base and a step
of each pixel's own. Concentric spheres have the same base and step everywhere (PanSplat, section 3.2); parallel
planes have both proportional to the ray's component along their normal, so a window is warped as the plane
demands; a narrow search has the coarser level's surface as its base.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numba as nb
import numpy as np

from pansplat.sweep.sphere import pad_sphere, ray_grid

_LUMA = np.array((0.299, 0.587, 0.114), np.float32)
_OPPOSED = (np.float32(0.2), np.float32(-0.5))  # cosine between rays from which it costs, and from which in full
_BLOCK = 8  # hypotheses that a thread holds at a time


@dataclass(frozen=True)
class MatchingConfig:
    """Weights of the matching cost; image values are in [0, 1]."""

    window: int = 2
    """Half size of the correlation window, pixels."""
    correlation_weight: float = 1.0
    color_weight: float = 0.5
    color_limit: float = 0.15
    """Mean absolute colour difference beyond which a mismatch costs no more."""
    variance_floor: float = 4e-4
    """Added to the variances, so that flat windows neither match nor mismatch by their noise."""
    visible_penalty: float = 0.5
    """For a hypothesis in front of what the other view sees through it."""
    agreement_bonus: float = 0.15
    occluded_cost: float = 0.6
    """For a hypothesis behind the other view's surface, where pictures cannot tell."""
    unseen_cost: float = 0.8
    """For a plane between the two cameras, of which each would see another face: pictures cannot tell."""
    tolerance: float = 0.08
    """Relative inverse depth within which two views agree."""
    outside_penalty: float = 1.0
    """For a hypothesis below the floor or above the ceiling."""
    flat_weight: float = 0.3
    """What pictures may say of a window without texture; a bare wall fits wherever it is not contradicted."""
    flat_cost: float = 0.4
    """What a hypothesis costs as far as pictures may not say."""
    texture_variance: float = 4e-4
    """Variance of a window that is half way from flat to textured."""
    distance_ratio: float = 4.0
    """A point this many times nearer to one camera than to the other is still compared like any other ..."""
    distance_penalty: float = 0.5
    """... and one infinitely nearer costs this: half the view shrinks to a few pixels, which fit anything."""
    opposed_penalty: float = 0.5
    """For a sphere where the rays to a point meet at 120 degrees or more, falling to none at 78: nobody sees a
    surface from both its sides, and few surfaces lie so flat to both."""


_WEIGHTS = (
    "correlation_weight", "color_weight", "color_limit", "variance_floor", "visible_penalty",
    "agreement_bonus", "occluded_cost", "tolerance", "outside_penalty",
    "flat_weight", "flat_cost", "texture_variance", "distance_ratio", "distance_penalty",
    "opposed_penalty", "unseen_cost",
)  # fmt: skip  # the order in which the kernel unpacks them


@nb.njit(fastmath=True, inline="always")
def _fast_atan2(y, x):
    """atan2 within 2e-6 radians, by a polynomial that vectorises."""
    ax, ay = abs(x), abs(y)
    small, large = min(ax, ay), max(ax, ay)
    a = small / max(large, np.float32(1e-30))
    s = a * a
    p = np.float32(-0.01172120) * s + np.float32(0.05265332)
    p = p * s - np.float32(0.11643287)
    p = p * s + np.float32(0.19354346)
    p = p * s - np.float32(0.33262347)
    r = (p * s + np.float32(0.99997726)) * a
    r = np.float32(math.pi / 2) - r if ay > ax else r
    r = np.float32(math.pi) - r if x < 0 else r
    return -r if y < 0 else r


@nb.njit(fastmath=True, nogil=True, cache=True)
def _project_row(rays, rotation, translation, inverse, height, width, u, v, scale, cosine):
    """Of one row's hypotheses: padded pixel coordinates in the other view, their inverse depth's ratio there, and the
    cosine between the two views' rays."""
    for j in range(rays.shape[0]):
        dx, dy, dz = rays[j, 0], rays[j, 1], rays[j, 2]
        rho = inverse[j]
        x = rotation[0, 0] * dx + rotation[0, 1] * dy + rotation[0, 2] * dz + rho * translation[0]
        y = rotation[1, 0] * dx + rotation[1, 1] * dy + rotation[1, 2] * dz + rho * translation[1]
        z = rotation[2, 0] * dx + rotation[2, 1] * dy + rotation[2, 2] * dz + rho * translation[2]
        flat = x * x + z * z
        u[j] = (_fast_atan2(x, z) * np.float32(0.5 / math.pi) + np.float32(0.5)) * width + np.float32(0.5)
        v[j] = (_fast_atan2(y, math.sqrt(flat)) * np.float32(1 / math.pi) + np.float32(0.5)) * height + np.float32(0.5)
        scale[j] = np.float32(1) / math.sqrt(max(flat + y * y, np.float32(1e-12)))
        along = rho * (x * translation[0] + y * translation[1] + z * translation[2])
        cosine[j] = (flat + y * y - along) * scale[j]


@nb.njit(fastmath=True, nogil=True, cache=True)
def _window_sums(gray, warped, m, column_b, column_bb, column_ab, row_b, row_bb, row_ab):
    """Sums over (2m+1)^2 windows of the warped grey values, their squares and products; inputs padded by m."""
    rows, columns = gray.shape
    height, width = rows - 2 * m, columns - 2 * m
    column_b[:] = 0
    column_bb[:] = 0
    column_ab[:] = 0
    for i in range(2 * m):
        for j in range(columns):
            b = warped[i, j]
            column_b[j] += b
            column_bb[j] += b * b
            column_ab[j] += gray[i, j] * b
    for i in range(height):
        for j in range(columns):
            b = warped[i + 2 * m, j]
            column_b[j] += b
            column_bb[j] += b * b
            column_ab[j] += gray[i + 2 * m, j] * b
        for j in range(width):
            s = column_b[j]
            t = column_bb[j]
            q = column_ab[j]
            for d in range(1, 2 * m + 1):
                s += column_b[j + d]
                t += column_bb[j + d]
                q += column_ab[j + d]
            row_b[i, j] = s
            row_bb[i, j] = t
            row_ab[i, j] = q
        for j in range(columns):
            b = warped[i, j]
            column_b[j] -= b
            column_bb[j] -= b * b
            column_ab[j] -= gray[i, j] * b


@nb.njit(fastmath=True, nogil=True, cache=True)
def _pad_in_place(padded, m):
    """Fill the margins of a padded panorama from its inside: wrap in longitude, continue over the poles."""
    rows, columns = padded.shape
    height, width = rows - 2 * m, columns - 2 * m
    for i in range(rows):
        source, shift = i, 0
        if i < m:
            source, shift = 2 * m - 1 - i, width // 2
        elif i >= m + height:
            source, shift = 2 * (m + height) - 1 - i, width // 2
        for j in range(columns):
            if shift or j < m or j >= m + width:
                padded[i, j] = padded[source, m + (j - m + shift) % width]


@nb.njit(parallel=True, fastmath=True, cache=True)
def _family_cost(
    image, gray, mean, variance, other, rays, rotation, translation, base, step, limits, penalty, unseen, sphere, side,
    down, floor_ceiling, usable, other_usable, other_inverse, other_confidence, informed, weights, m,
    cost, offset, count,
):  # fmt: skip
    height, width = image.shape[:2]
    low, high = limits
    correlation_weight, color_weight, color_limit, epsilon, visible, bonus, occluded, tolerance, outside = weights[:9]
    flat_weight, flat_cost, texture_variance, distance_ratio, distance_penalty = weights[9:14]
    opposed_penalty, unseen_cost = weights[14:]
    opposed_from, opposed_to = _OPPOSED
    if not sphere:
        opposed_penalty = np.float32(0)
    neutral = np.float32(0.5) * (correlation_weight + color_weight)
    impossible = np.float32(2) * (correlation_weight + color_weight)
    area = np.float32(1.0 / ((2 * m + 1) * (2 * m + 1)))
    for block in nb.prange((count + _BLOCK - 1) // _BLOCK):
        warped = np.empty((height + 2 * m, width + 2 * m), np.float32)
        difference = np.empty((height, width), np.float32)
        state = np.empty((height, width), np.uint8)  # 0 matched, 1 out of range, 2 unseen or masked
        ratio = np.empty((height, width), np.float32)
        trust = np.empty((height, width), np.float32)
        unlike = np.empty((height, width), np.float32)
        sum_b, sum_bb, sum_ab = (
            np.empty((height, width), np.float32),
            np.empty((height, width), np.float32),
            np.empty((height, width), np.float32),
        )
        column = np.empty((3, width + 2 * m), np.float32)
        u, v, scale = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32)
        inverse, cosine = np.empty(width, np.float32), np.empty(width, np.float32)
        result = np.empty((height, width, _BLOCK), np.float32)
        first = block * _BLOCK
        last = min(first + _BLOCK, count)
        for k in range(first, last):
            for i in range(height):
                for j in range(width):
                    inverse[j] = base[i, j] + np.float32(k) * step[i, j]
                _project_row(rays[i], rotation, translation, inverse, height, width, u, v, scale, cosine)
                for j in range(width):
                    iu = min(max(int(u[j]), 0), width)
                    iv = min(max(int(v[j]), 0), height)
                    fu, fv = u[j] - iu, v[j] - iv
                    w00, w01 = (1 - fu) * (1 - fv), fu * (1 - fv)
                    w10, w11 = (1 - fu) * fv, fu * fv
                    r = w00 * other[iv, iu, 0] + w01 * other[iv, iu + 1, 0]
                    r += w10 * other[iv + 1, iu, 0] + w11 * other[iv + 1, iu + 1, 0]
                    g = w00 * other[iv, iu, 1] + w01 * other[iv, iu + 1, 1]
                    g += w10 * other[iv + 1, iu, 1] + w11 * other[iv + 1, iu + 1, 1]
                    b = w00 * other[iv, iu, 2] + w01 * other[iv, iu + 1, 2]
                    b += w10 * other[iv + 1, iu, 2] + w11 * other[iv + 1, iu + 1, 2]
                    warped[i + m, j + m] = np.float32(0.299) * r + np.float32(0.587) * g + np.float32(0.114) * b
                    d = abs(image[i, j, 0] - r) + abs(image[i, j, 1] - g) + abs(image[i, j, 2] - b)
                    difference[i, j] = min(d * np.float32(1 / 3), color_limit) / color_limit
                    qi = min(max(int(v[j] - np.float32(0.5)), 0), height - 1)
                    qj = int(u[j] - np.float32(0.5)) % width
                    state[i, j] = 1 if inverse[j] < low or inverse[j] > high else (0 if other_usable[qi, qj] else 2)
                    ratio[i, j] = inverse[j] * scale[j] / other_inverse[qi, qj] if informed else np.float32(1)
                    unlike[i, j] = distance_penalty * max(
                        1 - distance_ratio * min(scale[j], 1 / scale[j]), np.float32(0)
                    )
                    opposed = (opposed_from - cosine[j]) / (opposed_from - opposed_to)
                    unlike[i, j] += opposed_penalty * min(max(opposed, np.float32(0)), np.float32(1))
                    trust[i, j] = other_confidence[qi, qj] if informed else np.float32(0)
            _pad_in_place(warped, m)
            _window_sums(gray, warped, m, column[0], column[1], column[2], sum_b, sum_bb, sum_ab)
            for i in range(height):
                for j in range(width):
                    mean_b = sum_b[i, j] * area
                    var_b = max(sum_bb[i, j] * area - mean_b * mean_b, np.float32(0))
                    covariance = sum_ab[i, j] * area - mean[i, j] * mean_b
                    score = (covariance + epsilon) / math.sqrt((variance[i, j] + epsilon) * (var_b + epsilon))
                    c = correlation_weight * min(1 - score, np.float32(1)) + color_weight * difference[i, j]
                    said = variance[i, j] / (variance[i, j] + texture_variance)
                    said = flat_weight + (1 - flat_weight) * said
                    c = said * c + (1 - said) * flat_cost
                    extra = penalty[side[i, j], k] + unlike[i, j]
                    t = trust[i, j]
                    if ratio[i, j] > 1 + tolerance:
                        extra += visible * t
                    elif ratio[i, j] > 1 - tolerance:
                        extra -= bonus * t
                    else:
                        c = (1 - t) * c + t * occluded
                    if unseen[side[i, j], k]:
                        c = unseen_cost
                    if state[i, j] == 2 or not usable[i, j]:
                        c = neutral
                    below = down[i, j] / max(base[i, j] + np.float32(k) * step[i, j], low)
                    if below > floor_ceiling[0] or below < floor_ceiling[1]:
                        extra += outside
                    result[i, j, k - first] = impossible if state[i, j] == 1 else c + extra
        for i in range(height):
            for j in range(width):
                for k in range(first, last):
                    cost[i, j, offset + k] = result[i, j, k - first]


@dataclass(frozen=True, eq=False)
class Family:
    """Hypotheses that belong together; see the module's description. Maps are (h, w) float32.

    `penalty` (2, count) is added to a hypothesis' cost by the side of its planes that a pixel looks at (`side`), and
    `unseen` (2, count), none unless given, are those that the other view sees from behind. `sphere` tells that the
    hypotheses are spheres around the camera.
    """

    base: np.ndarray
    step: np.ndarray
    penalty: np.ndarray
    side: np.ndarray
    unseen: np.ndarray | None = None
    sphere: bool = False


@dataclass(frozen=True, eq=False)
class View:
    """What the kernels need of one view at one level; `inverse_depth` and `confidence` are None at first."""

    image: np.ndarray
    usable: np.ndarray
    down: np.ndarray
    inverse_depth: np.ndarray | None = None
    confidence: np.ndarray | None = None


def matching_cost(
    view: View,
    other: View,
    pose: np.ndarray,
    families: list[Family],
    limits: tuple[float, float],
    floor_ceiling: tuple[float, float],
    config: MatchingConfig,
) -> np.ndarray:
    """Cost (h, w, families * count) of every hypothesis; low is good, the scale is that of the config's weights.

    Args:
        pose: (4, 4) from `view`'s camera to `other`'s.
        limits: inverse depths outside are impossible, 1/m.
        floor_ceiling: how far the scene reaches down and up (negative) from `view`'s camera, metres.
    """
    height, width = view.image.shape[:2]
    m = config.window
    gray = pad_sphere(view.image @ _LUMA, m)
    window = (2 * m + 1, 2 * m + 1)
    inside = (slice(m, -m), slice(m, -m))
    mean = np.ascontiguousarray(cv2.boxFilter(gray, -1, window)[inside])
    variance = np.ascontiguousarray(cv2.boxFilter(gray * gray, -1, window)[inside])
    variance = np.maximum(variance - mean * mean, 0)
    informed = other.inverse_depth is not None and other.confidence is not None
    other_inverse = other.inverse_depth if informed else np.ones((height, width), np.float32)
    other_confidence = other.confidence if informed else np.zeros((height, width), np.float32)
    weights = tuple(np.float32(getattr(config, name)) for name in _WEIGHTS)
    count = families[0].penalty.shape[1]
    cost = np.empty((height, width, len(families) * count), np.float32)
    other_image, rays = pad_sphere(other.image, 1), ray_grid(height)
    rotation = np.ascontiguousarray(pose[:3, :3], np.float32)
    translation = np.ascontiguousarray(pose[:3, 3], np.float32)
    for n, family in enumerate(families):
        unseen = np.zeros((2, count), bool) if family.unseen is None else family.unseen
        _family_cost(
            view.image, gray, mean, variance, other_image, rays, rotation, translation, family.base, family.step,
            (np.float32(limits[0]), np.float32(limits[1])), family.penalty, unseen, family.sphere, family.side,
            view.down, (np.float32(floor_ceiling[0]), np.float32(floor_ceiling[1])), view.usable, other.usable,
            other_inverse, other_confidence, informed, weights, m, cost, n * count, count,
        )  # fmt: skip
    return cost
