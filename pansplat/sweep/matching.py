"""Stereo matching on the sphere: the matching cost of depth hypotheses, and semi-global cost aggregation.

A hypothesis set assigns the inverse depth `base + k * step` to a pixel, k = 0..count-1; base and step are maps. For
concentric spheres they are constant (PanSplat, section 3.2). For parallel planes they are proportional to the ray's
component along the normal, so that a matching window is warped as its plane requires. For a narrow search the base is
the coarser level's surface.

Aggregation runs along eight directions. A path adds a small penalty for the next hypothesis of the same set, a crease
penalty for a hypothesis of another set with the same depth at this pixel, and a jump penalty, lower at image edges, for
any other. A slanted plane is a single hypothesis and has no penalty. Horizontal paths wrap; vertical paths continue
over the poles.

Source: Hirschmueller, doi:10.1109/TPAMI.2007.1166, generalised from fronto-parallel labels to sets of hypotheses.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import cv2
import numba as nb
import numpy as np

from pansplat.geometry.equirect import row_weights
from pansplat.sweep.panoramas import pad_sphere, ray_grid
from pansplat.system.kernels import cached_njit, fast_atan2, parallel_for, thread_count

_LUMA = np.array((0.299, 0.587, 0.114), np.float32)
_WINDOW = 2  # half size of the correlation window, pixels
_BATCH = 8  # hypotheses that a thread processes together


class MatchingWeights(NamedTuple):
    """Weights of the matching cost, for image values in [0, 1]."""

    correlation_weight: float = 1.0
    color_weight: float = 0.5
    color_truncation: float = 0.15  # mean absolute colour difference at which the colour cost is truncated
    variance_epsilon: float = 4e-4  # added to the variances, so that noise in flat windows has no effect
    free_space_penalty: float = 0.5  # added to the cost of a hypothesis in front of the other view's surface
    consistency_bonus: float = 0.15  # subtracted from the cost of a hypothesis on the other view's surface
    occluded_cost: float = 0.9  # of a hypothesis behind the other view's surface, where it cannot be matched
    back_facing_cost: float = 0.8  # of a plane between the two cameras: each would see a different side of it
    tolerance: float = 0.08  # relative difference of inverse depth within which two views are consistent
    textureless_weight: float = 0.3  # of the matching cost in a window without texture; one in a textured window
    textureless_cost: float = 0.4  # replaces the rest of the matching cost in such a window
    texture_variance: float = 4e-4  # of a window that is half textured
    distance_ratio: float = 4.0  # of a point's distances to the two cameras up to which there is no penalty
    distance_penalty: float = 0.5  # for an infinite ratio: half the view shrinks to pixels that match everything
    opposed_penalty: float = 0.5  # for a sphere where the cameras would see opposite sides of the surface
    opposed_from: float = 0.2  # cosine between the rays to a point (78 degrees) at which this penalty starts
    opposed_to: float = -0.5  # cosine (120 degrees) at which it is full


_WEIGHTS = MatchingWeights()


@cached_njit(fastmath=True, nogil=True, error_model="numpy")
def _project_row(rays, rotation, translation, inverse, height, width, u, v, scale, cosine):
    """For one row: padded pixel coordinates in the other view, ratio of inverse depths, cosine between the two rays."""
    for j in range(rays.shape[0]):
        dx, dy, dz = rays[j, 0], rays[j, 1], rays[j, 2]
        rho = inverse[j]
        x = rotation[0, 0] * dx + rotation[0, 1] * dy + rotation[0, 2] * dz + rho * translation[0]
        y = rotation[1, 0] * dx + rotation[1, 1] * dy + rotation[1, 2] * dz + rho * translation[1]
        z = rotation[2, 0] * dx + rotation[2, 1] * dy + rotation[2, 2] * dz + rho * translation[2]
        flat = x * x + z * z
        u[j] = (fast_atan2(x, z) * np.float32(0.5 / math.pi) + np.float32(0.5)) * width + np.float32(0.5)
        v[j] = (fast_atan2(y, math.sqrt(flat)) * np.float32(1 / math.pi) + np.float32(0.5)) * height + np.float32(0.5)
        scale[j] = np.float32(1) / math.sqrt(max(flat + y * y, np.float32(1e-12)))
        along = rho * (x * translation[0] + y * translation[1] + z * translation[2])
        cosine[j] = (flat + y * y - along) * scale[j]


@cached_njit(fastmath=True, nogil=True)
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


@cached_njit(fastmath=True, nogil=True)
def _pad_in_place(padded, m):
    """Fill the margins of a padded panorama: columns wrap, rows continue over the poles."""
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


# Arguments of the kernels; numba compiles a named tuple's fields as separate variables.
class _Matched(NamedTuple):
    """The view that is matched: its image, rays and masks, and the grey values of its windows.

    `gray` (h + 2m, w + 2m) is padded by half a window; `mean` and `variance` (h, w) are those of the windows.
    """

    image: np.ndarray
    valid: np.ndarray
    rays: np.ndarray
    gray: np.ndarray
    mean: np.ndarray
    variance: np.ndarray


class _Other(NamedTuple):
    """The view that is warped. Its image is padded by one pixel; without a surface the inverse depth has no meaning."""

    image: np.ndarray
    valid: np.ndarray
    inverse_depth: np.ndarray
    has_surface: bool
    rotation: np.ndarray
    translation: np.ndarray


class _Set(NamedTuple):
    """The maps of a `HypothesisSet`."""

    base: np.ndarray
    step: np.ndarray
    penalty: np.ndarray
    side: np.ndarray
    back_facing: np.ndarray


class _Warped(NamedTuple):
    """The other view, warped by one hypothesis.

    `gray` is padded; `color_cost` is in [0, 1]; `ratio` is the inverse depth over that of the other view's surface;
    `penalty` grows with unequal distances and opposed rays.
    """

    gray: np.ndarray
    color_cost: np.ndarray
    state: np.ndarray
    ratio: np.ndarray
    penalty: np.ndarray


_MATCHED, _OUT_OF_RANGE, _MASKED = 0, 1, 2  # states of a warped pixel
_UNSEEN = np.float32(1e-3)  # weight of a view that cannot see a hypothesis; it counts only where no view can


@nb.njit(fastmath=True, forceinline=True, error_model="numpy")
def _warp(k, view, other, hypotheses, limits, weights, row, warped):
    """Warp the other view by hypothesis `k`; `row` (5, w) is scratch."""
    height, width = view.mean.shape
    image, rays, base, step = view.image, view.rays, hypotheses.base, hypotheses.step
    there, valid, inverse_there = other.image, other.valid, other.inverse_depth
    gray, color_cost, state, ratio, penalty = warped
    m = (gray.shape[0] - height) // 2
    inverse, u, v, scale, cosine = row[0], row[1], row[2], row[3], row[4]
    for i in range(height):
        for j in range(width):
            inverse[j] = base[i, j] + np.float32(k) * step[i, j]
        _project_row(rays[i], other.rotation, other.translation, inverse, height, width, u, v, scale, cosine)
        for j in range(width):
            iu = min(max(int(u[j]), 0), width)
            iv = min(max(int(v[j]), 0), height)
            fu, fv = u[j] - iu, v[j] - iv
            w00, w01 = (1 - fu) * (1 - fv), fu * (1 - fv)
            w10, w11 = (1 - fu) * fv, fu * fv
            r = w00 * there[iv, iu, 0] + w01 * there[iv, iu + 1, 0]
            r += w10 * there[iv + 1, iu, 0] + w11 * there[iv + 1, iu + 1, 0]
            g = w00 * there[iv, iu, 1] + w01 * there[iv, iu + 1, 1]
            g += w10 * there[iv + 1, iu, 1] + w11 * there[iv + 1, iu + 1, 1]
            b = w00 * there[iv, iu, 2] + w01 * there[iv, iu + 1, 2]
            b += w10 * there[iv + 1, iu, 2] + w11 * there[iv + 1, iu + 1, 2]
            gray[i + m, j + m] = np.float32(0.299) * r + np.float32(0.587) * g + np.float32(0.114) * b
            difference = abs(image[i, j, 0] - r) + abs(image[i, j, 1] - g) + abs(image[i, j, 2] - b)
            truncation = weights.color_truncation
            color_cost[i, j] = min(difference * np.float32(1 / 3), truncation) / truncation
            row_there = min(max(int(v[j] - np.float32(0.5)), 0), height - 1)
            column_there = int(u[j] - np.float32(0.5)) % width
            in_range = limits[0] <= inverse[j] <= limits[1]
            state[i, j] = (_MATCHED if valid[row_there, column_there] else _MASKED) if in_range else _OUT_OF_RANGE
            if other.has_surface:
                ratio[i, j] = inverse[j] * scale[j] / inverse_there[row_there, column_there]
            excess = max(1 - weights.distance_ratio * min(scale[j], 1 / scale[j]), np.float32(0))
            opposed = (weights.opposed_from - cosine[j]) / (weights.opposed_from - weights.opposed_to)
            penalty[i, j] = weights.distance_penalty * excess
            penalty[i, j] += weights.opposed_penalty * min(max(opposed, np.float32(0)), np.float32(1))


@nb.njit(fastmath=True, forceinline=True, error_model="numpy")
def _combine_costs(k, view, other, hypotheses, weights, warped, sums, m, result, share, slot):
    """Write the cost of hypothesis `k` to `result[..., slot]`, and its weight among the other views to `share`.

    `sums` are those of `_window_sums`.
    """
    height, width = view.mean.shape
    own_mean, own_variance, valid = view.mean, view.variance, view.valid
    set_penalty, side, back_facing = hypotheses.penalty, hypotheses.side, hypotheses.back_facing
    _, color_cost, state, ratio, penalty = warped
    sum_b, sum_bb, sum_ab = sums
    area = np.float32(1.0 / ((2 * m + 1) * (2 * m + 1)))
    epsilon = weights.variance_epsilon
    neutral = np.float32(0.5) * (weights.correlation_weight + weights.color_weight)
    impossible = np.float32(2) * (weights.correlation_weight + weights.color_weight)
    for i in range(height):
        for j in range(width):
            mean = sum_b[i, j] * area
            variance = max(sum_bb[i, j] * area - mean * mean, np.float32(0))
            covariance = sum_ab[i, j] * area - own_mean[i, j] * mean
            score = (covariance + epsilon) / math.sqrt((own_variance[i, j] + epsilon) * (variance + epsilon))
            cost = weights.correlation_weight * min(1 - score, np.float32(1))
            cost += weights.color_weight * color_cost[i, j]
            textured = own_variance[i, j] / (own_variance[i, j] + weights.texture_variance)
            textured = weights.textureless_weight + (1 - weights.textureless_weight) * textured
            cost = textured * cost + (1 - textured) * weights.textureless_cost
            extra = set_penalty[k] + penalty[i, j]
            seen = np.float32(1)
            if other.has_surface:
                if ratio[i, j] > 1 + weights.tolerance:
                    extra += weights.free_space_penalty
                elif ratio[i, j] > 1 - weights.tolerance:
                    extra -= weights.consistency_bonus
                else:
                    cost, seen = weights.occluded_cost, _UNSEEN
            if back_facing[side[i, j], k]:
                cost, seen = weights.back_facing_cost, _UNSEEN
            if state[i, j] == _MASKED or not valid[i, j]:
                cost, seen = neutral, _UNSEEN
            result[i, j, slot] = impossible if state[i, j] == _OUT_OF_RANGE else cost + extra
            share[i, j, slot] = seen


@cached_njit(fastmath=True, nogil=True)
def _compute_block_cost(view, other, hypotheses, limits, weights, cost, total, offset, block):
    """Add the weighted costs of a block of a set's hypotheses to `cost`, the weights to `total` (h, w, labels).

    Without `total`, there is one other view: its costs are written. The set starts at `offset`.
    """
    first = block * _BATCH
    last = min(first + _BATCH, len(hypotheses.penalty))
    height, width = view.mean.shape
    m = (view.gray.shape[0] - height) // 2
    maps, row = np.empty((6, height, width), np.float32), np.empty((5, width), np.float32)
    gray, state = np.empty((height + 2 * m, width + 2 * m), np.float32), np.empty((height, width), np.uint8)
    warped, sums = _Warped(gray, maps[0], state, maps[1], maps[2]), (maps[3], maps[4], maps[5])
    column = np.empty((3, width + 2 * m), np.float32)
    result, share = np.empty((height, width, _BATCH), np.float32), np.empty((height, width, _BATCH), np.float32)
    for k in range(first, last):
        _warp(k, view, other, hypotheses, limits, weights, row, warped)
        _pad_in_place(warped.gray, m)
        _window_sums(view.gray, warped.gray, m, column[0], column[1], column[2], sums[0], sums[1], sums[2])
        _combine_costs(k, view, other, hypotheses, weights, warped, sums, m, result, share, k - first)
    for i in range(height):
        for j in range(width):
            for k in range(first, last):
                if total.size:
                    weight = share[i, j, k - first]
                    cost[i, j, offset + k] += weight * result[i, j, k - first]
                    total[i, j, offset + k] += weight
                else:
                    cost[i, j, offset + k] = result[i, j, k - first]


class DepthRange(NamedTuple):
    """Inverse depths of the search, 1/m.

    Attributes:
        farthest: limit beyond the given range, for surfaces that are farther than `far`.
        low, high: the given range.
    """

    farthest: float
    low: float
    high: float

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest and largest inverse depth of the search."""
        return self.farthest, self.high

    def step(self, count: int) -> float:
        """Distance of `count` values over the given range."""
        return (self.high - self.low) / (count - 1)

    def sample(self, count: int) -> np.ndarray:
        """`count` values over the given range, continued with the same step beyond it."""
        step = self.step(count)
        return self.low + step * np.arange(-int((self.low - self.farthest) / step), count)


@dataclass(frozen=True, eq=False)
class HypothesisSet:
    """Spheres, parallel planes, or a narrow range of depths; see the module's description.

    Attributes:
        base, step: (h, w) float32, 1/m.
        penalty: (count) added to the cost of a hypothesis.
        side: (h, w) 0 where a pixel sees the planes at negative distances along their normal, 1 at positive ones.
        back_facing: (2, count) by `side`, planes that the two views see from different sides; None for none.
        sphere: the hypotheses are spheres around the camera.
    """

    base: np.ndarray
    step: np.ndarray
    penalty: np.ndarray
    side: np.ndarray | None = None
    back_facing: np.ndarray | None = None
    sphere: bool = False


@dataclass(frozen=True, eq=False)
class View:
    """One view at one level of the search.

    Attributes:
        image: (h, w, 3) float32.
        valid: (h, w) False for masked pixels.
        inverse_depth: (h, w) of the surface found so far; None before the coarse level.
    """

    image: np.ndarray
    valid: np.ndarray
    inverse_depth: np.ndarray | None = None


class OtherView(NamedTuple):
    """A view that another one is matched against.

    Attributes:
        view: the other view.
        pose: (4, 4) from the matched view's camera to the other one's.
        sets: the hypotheses of the matched view; those of all others differ in `back_facing` only.
    """

    view: View
    pose: np.ndarray
    sets: list[HypothesisSet]


def compute_matching_cost(
    view: View,
    others: Sequence[OtherView],
    limits: tuple[float, float],
    weights: MatchingWeights = _WEIGHTS,
) -> np.ndarray:
    """Matching cost (h, w, sets * count) of every hypothesis, in the unit of the weights.

    It is the mean over the other views that can see the hypothesis; over all of them where none can.

    Args:
        limits: smallest and largest inverse depth, 1/m.
    """
    height, width = view.image.shape[:2]
    m = _WINDOW
    gray = pad_sphere(view.image @ _LUMA, m)
    window = (2 * m + 1, 2 * m + 1)
    inside = (slice(m, -m), slice(m, -m))
    mean = np.ascontiguousarray(cv2.boxFilter(gray, -1, window)[inside])
    variance = np.ascontiguousarray(cv2.boxFilter(gray * gray, -1, window)[inside])
    variance = np.maximum(variance - mean * mean, 0)
    matched = _Matched(view.image, view.valid, ray_grid(height), gray, mean, variance)
    low, high = np.float32(limits)
    weights = MatchingWeights(*map(np.float32, weights))
    count = len(others[0].sets[0].penalty)
    shape = height, width, len(others[0].sets) * count
    several = len(others) > 1
    cost = np.zeros(shape, np.float32) if several else np.empty(shape, np.float32)
    total = np.zeros(shape if several else (0, 0, 0), np.float32)
    unknown = np.ones((height, width), np.float32)
    for other, pose, sets in others:
        warped = _Other(
            pad_sphere(other.image, 1),
            other.valid,
            unknown if other.inverse_depth is None else other.inverse_depth,
            other.inverse_depth is not None,
            np.ascontiguousarray(pose[:3, :3], np.float32),
            np.ascontiguousarray(pose[:3, 3], np.float32),
        )
        for n, own in enumerate(sets):
            back_facing = np.zeros((2, count), bool) if own.back_facing is None else own.back_facing
            # One type for all sets: the kernel is compiled once.
            maps = (np.ascontiguousarray(each, np.float32) for each in (own.base, own.step, own.penalty))
            side = np.zeros((height, width), np.uint8) if own.side is None else np.ascontiguousarray(own.side)
            hypotheses = _Set(*maps, side, back_facing)
            own_weights = weights if own.sphere else weights._replace(opposed_penalty=np.float32(0))
            arguments = matched, warped, hypotheses, (low, high), own_weights, cost, total, n * count
            parallel_for(partial(_compute_block_cost, *arguments), -(-count // _BATCH), thread_count())
    if several:
        cost /= total
    return cost


_DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))


class _Penalties(NamedTuple):
    """Penalties for a change of hypothesis between neighbouring pixels, in the unit of the matching cost.

    `edge_scale` is the sum of absolute colour differences that divides the jump penalty by e.
    """

    step: np.float32
    crease: np.float32
    jump: np.float32
    edge_scale: np.float32


_PENALTIES = _Penalties(*np.float32((0.08, 0.15, 1.6, 0.1)))


@nb.njit(fastmath=True, inline="always")
def _advance_path(previous, cost, slot_map, step, crease, jump, in_slot, near_slot, current):
    """One step of a path: `current` = cost + lowest path cost so far, less its minimum, so that it stays bounded.

    Args:
        previous, current: (labels) path costs of the pixel before and of this pixel.
        cost: (labels) matching costs.
        slot_map: (sets, 2) see `aggregate_costs`.
        step, crease, jump: penalties.
        in_slot, near_slot: (slots) scratch: the lowest path cost, with a crease, in a depth slot; in it or next to it.
    """
    sets, slots = len(slot_map), len(in_slot)
    count = len(cost) // sets
    lowest = previous[0]
    for label in range(1, len(cost)):
        lowest = min(lowest, previous[label])
    after_jump = lowest + jump
    for slot in range(slots):
        in_slot[slot] = after_jump
    for n in range(sets):
        slope, start, first = slot_map[n, 0], slot_map[n, 1], n * count
        for k in range(count):
            slot = int(slope * k + start)
            if 0 <= slot < slots:
                in_slot[slot] = min(in_slot[slot], previous[first + k] + crease)
    near_slot[0] = min(in_slot[0], in_slot[1])
    near_slot[slots - 1] = min(in_slot[slots - 1], in_slot[slots - 2])
    for slot in range(1, slots - 1):
        near_slot[slot] = min(min(in_slot[slot - 1], in_slot[slot]), in_slot[slot + 1])
    for n in range(sets):
        slope, start, first = slot_map[n, 0], slot_map[n, 1], n * count
        for k in range(count):
            best = min(previous[first + k], after_jump)
            if k > 0:
                best = min(best, previous[first + k - 1] + step)
            if k < count - 1:
                best = min(best, previous[first + k + 1] + step)
            slot = int(slope * k + start)
            if 0 <= slot < slots:
                best = min(best, near_slot[slot])
            current[first + k] = cost[first + k] + best - lowest


@nb.njit(fastmath=True, inline="always")
def _jump_penalty(pixel, before, penalties):
    """Penalty of a jump between two neighbouring pixels of the guide, lower at an edge."""
    difference = abs(pixel[0] - before[0]) + abs(pixel[1] - before[1])
    difference += abs(pixel[2] - before[2])
    floor = penalties.crease * np.float32(1.2)
    return max(penalties.jump * math.exp(-difference / penalties.edge_scale), floor)


@cached_njit(fastmath=True, nogil=True)
def _aggregate_rows(cost, total, guide, slot_map, slots, penalties, stretch, dx, run_up):
    """Add the costs of horizontal paths; each starts `run_up` columns early, so that it has no visible start."""
    height, width, labels = cost.shape
    previous, current = np.empty(labels, np.float32), np.empty(labels, np.float32)
    in_slot, near_slot = np.empty(slots, np.float32), np.empty(slots, np.float32)
    for i in range(height):
        t = stretch[i]  # neighbours near a pole are closer, so penalties are higher
        for label in range(labels):  # a copy of a slice takes two seconds to compile
            previous[label] = cost[i, -dx * run_up % width, label]
        for n in range(1 - run_up, width):
            j, j_before = (dx * n) % width, (dx * (n - 1)) % width
            jump = _jump_penalty(guide[i, j], guide[i, j_before], penalties)
            _advance_path(
                previous, cost[i, j], slot_map[i, j], penalties.step * t, penalties.crease * t, jump * t,
                in_slot, near_slot, current,
            )  # fmt: skip
            if n >= 0:
                for label in range(labels):
                    total[i, j, label] += current[label]
            previous, current = current, previous


@cached_njit(fastmath=True, nogil=True)
def _aggregate_columns(cost, total, guide, slot_map, slots, penalties, dy, dx, run_up):
    """Add the costs of vertical or diagonal paths; each starts `run_up` rows early, beyond the pole."""
    height, width, labels = cost.shape
    length = np.float32(1.0 if dx == 0 else 1 / math.sqrt(2))
    previous, current = np.empty((width, labels), np.float32), np.empty((width, labels), np.float32)
    in_slot, near_slot = np.empty(slots, np.float32), np.empty(slots, np.float32)
    i_before, shift_before = 0, 0
    for n in range(-run_up, height):
        i, shift = (n, 0) if n >= 0 else (-1 - n, width // 2)
        if dy < 0:
            i = height - 1 - i
        for path in range(width):
            j = (path + shift) % width
            if n == -run_up:
                for label in range(labels):
                    current[path, label] = cost[i, j, label]
                continue
            path_before = (path - dx) % width
            jump = _jump_penalty(guide[i, j], guide[i_before, (path_before + shift_before) % width], penalties)
            _advance_path(
                previous[path_before], cost[i, j], slot_map[i, j],
                penalties.step * length, penalties.crease * length, jump * length,
                in_slot, near_slot, current[path],
            )  # fmt: skip
            if n >= 0:
                for label in range(labels):
                    total[i, j, label] += current[path, label]
        i_before, shift_before = i, shift
        previous, current = current, previous


def aggregate_costs(cost: np.ndarray, guide: np.ndarray, slot_map: np.ndarray, slots: int) -> np.ndarray:
    """Sum of the path costs of all eight directions, (h, w, sets * count).

    Args:
        cost: (h, w, sets * count) matching cost.
        guide: (h, w, 3) image whose edges lower the jump penalty.
        slot_map: (h, w, sets, 2) slope and start of each set's hypotheses in depth slots: two hypotheses whose slots
            differ by at most one have the same depth at this pixel.
        slots: number of depth slots.
    """
    height = len(cost)
    stretch = np.minimum(1 / row_weights(height).numpy(), 8).astype(np.float32)

    def run(directions: tuple[tuple[int, int], ...]) -> np.ndarray:
        total = np.zeros_like(cost)
        for dy, dx in directions:
            if dy == 0:
                _aggregate_rows(cost, total, guide, slot_map, slots, _PENALTIES, stretch, dx, height)  # half a turn
            else:
                _aggregate_columns(cost, total, guide, slot_map, slots, _PENALTIES, dy, dx, height // 4)
        return total

    groups = (_DIRECTIONS[::2], _DIRECTIONS[1::2])  # the two groups cost the same; each has a thread
    with ThreadPoolExecutor(len(groups)) as pool:
        first, second = pool.map(run, groups)
    first += second
    return first


def select_labels(total: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Label of lowest cost (h, w) int32, and its subpixel offset in [-0.5, 0.5] labels by a parabola fit."""
    label, offset = np.empty(total.shape[:2], np.int32), np.zeros(total.shape[:2], np.float32)
    parallel_for(partial(_select_labels, total, count, label, offset), len(total), thread_count())
    return label, offset


@cached_njit(nogil=True)
def _select_labels(total, count, label, offset, i):
    width, labels = total.shape[1:]
    for j in range(width):
        best = 0
        for n in range(1, labels):
            if total[i, j, n] < total[i, j, best]:
                best = n
        label[i, j] = best
        k = best % count
        if 0 < k < count - 1:
            left, right = total[i, j, best - 1], total[i, j, best + 1]
            curvature = left + right - 2 * total[i, j, best]
            if curvature > 1e-6:
                offset[i, j] = min(max(0.5 * (left - right) / curvature, -0.5), 0.5)
