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
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numba as nb
import numpy as np

from pansplat.geometry.equirect import row_weights
from pansplat.sweep.surface import pad_sphere, ray_grid

_LUMA = np.array((0.299, 0.587, 0.114), np.float32)
_OPPOSED = (np.float32(0.2), np.float32(-0.5))  # cosines between rays at which the penalty starts and is full
_BLOCK = 8  # hypotheses that a thread processes together


@dataclass(frozen=True)
class MatchingConfig:
    """Weights of the matching cost, for image values in [0, 1]."""

    window: int = 2
    """Half size of the correlation window, pixels."""
    correlation_weight: float = 1.0
    color_weight: float = 0.5
    color_truncation: float = 0.15
    """Mean absolute colour difference at which the colour cost is truncated."""
    variance_epsilon: float = 4e-4
    """Added to the variances, so that noise in flat windows has no effect."""
    free_space_penalty: float = 0.5
    """For a hypothesis in front of the other view's surface."""
    consistency_bonus: float = 0.15
    """For a hypothesis on the other view's surface."""
    occluded_cost: float = 0.9
    """Cost of a hypothesis behind the other view's surface, where it cannot be matched."""
    back_facing_cost: float = 0.8
    """Cost of a plane between the two cameras: each would see a different side of it."""
    tolerance: float = 0.08
    """Relative difference of inverse depth within which two views are consistent."""
    outside_penalty: float = 0.3
    """For a hypothesis below the floor or above the ceiling."""
    textureless_weight: float = 0.3
    """Weight of the matching cost in a window without texture; it is one in a textured window."""
    textureless_cost: float = 0.4
    """Cost that replaces the rest of the matching cost in such a window."""
    texture_variance: float = 4e-4
    """Variance of a window that is half textured."""
    distance_ratio: float = 4.0
    """Ratio of a point's distances to the two cameras up to which there is no penalty."""
    distance_penalty: float = 0.5
    """Penalty for an infinite ratio: half the view shrinks to a few pixels, which match everything."""
    opposed_penalty: float = 0.5
    """For a sphere where the rays to a point meet at 120 degrees or more, falling to zero at 78: the cameras would see
    opposite sides of the surface."""


_WEIGHTS = (
    "correlation_weight", "color_weight", "color_truncation", "variance_epsilon", "free_space_penalty",
    "consistency_bonus", "occluded_cost", "tolerance", "outside_penalty",
    "textureless_weight", "textureless_cost", "texture_variance", "distance_ratio", "distance_penalty",
    "opposed_penalty", "back_facing_cost",
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
    """For one row: padded pixel coordinates in the other view, ratio of inverse depths, cosine between the two rays."""
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


@nb.njit(parallel=True, fastmath=True, cache=True)
def _compute_set_cost(
    image, gray, mean, variance, other, rays, rotation, translation, base, step, limits, penalty, back_facing, sphere,
    side, down, floor_ceiling, valid, other_valid, other_inverse, has_surface, weights, m,
    cost, offset, count,
):  # fmt: skip
    height, width = image.shape[:2]
    low, high = limits
    correlation_weight, color_weight, color_truncation, epsilon, free_space_penalty = weights[:5]
    consistency_bonus, occluded_cost, tolerance, outside_penalty = weights[5:9]
    textureless_weight, textureless_cost, texture_variance, distance_ratio, distance_penalty = weights[9:14]
    opposed_penalty, back_facing_cost = weights[14:]
    opposed_from, opposed_to = _OPPOSED
    if not sphere:
        opposed_penalty = np.float32(0)
    neutral = np.float32(0.5) * (correlation_weight + color_weight)
    impossible = np.float32(2) * (correlation_weight + color_weight)
    area = np.float32(1.0 / ((2 * m + 1) * (2 * m + 1)))
    for block in nb.prange((count + _BLOCK - 1) // _BLOCK):
        warped = np.empty((height + 2 * m, width + 2 * m), np.float32)
        difference = np.empty((height, width), np.float32)
        state = np.empty((height, width), np.uint8)  # 0 matched, 1 out of range, 2 masked in the other view
        ratio = np.empty((height, width), np.float32)
        geometry = np.empty((height, width), np.float32)
        sum_b, sum_bb = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
        sum_ab = np.empty((height, width), np.float32)
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
                    difference[i, j] = min(d * np.float32(1 / 3), color_truncation) / color_truncation
                    qi = min(max(int(v[j] - np.float32(0.5)), 0), height - 1)
                    qj = int(u[j] - np.float32(0.5)) % width
                    state[i, j] = 1 if inverse[j] < low or inverse[j] > high else (0 if other_valid[qi, qj] else 2)
                    if has_surface:
                        ratio[i, j] = inverse[j] * scale[j] / other_inverse[qi, qj]
                    geometry[i, j] = distance_penalty * max(
                        1 - distance_ratio * min(scale[j], 1 / scale[j]), np.float32(0)
                    )
                    opposed = (opposed_from - cosine[j]) / (opposed_from - opposed_to)
                    geometry[i, j] += opposed_penalty * min(max(opposed, np.float32(0)), np.float32(1))
            _pad_in_place(warped, m)
            _window_sums(gray, warped, m, column[0], column[1], column[2], sum_b, sum_bb, sum_ab)
            for i in range(height):
                for j in range(width):
                    mean_b = sum_b[i, j] * area
                    var_b = max(sum_bb[i, j] * area - mean_b * mean_b, np.float32(0))
                    covariance = sum_ab[i, j] * area - mean[i, j] * mean_b
                    score = (covariance + epsilon) / math.sqrt((variance[i, j] + epsilon) * (var_b + epsilon))
                    c = correlation_weight * min(1 - score, np.float32(1)) + color_weight * difference[i, j]
                    textured = variance[i, j] / (variance[i, j] + texture_variance)
                    textured = textureless_weight + (1 - textureless_weight) * textured
                    c = textured * c + (1 - textured) * textureless_cost
                    extra = penalty[side[i, j], k] + geometry[i, j]
                    if has_surface:
                        if ratio[i, j] > 1 + tolerance:
                            extra += free_space_penalty
                        elif ratio[i, j] > 1 - tolerance:
                            extra -= consistency_bonus
                        else:
                            c = occluded_cost
                    if back_facing[side[i, j], k]:
                        c = back_facing_cost
                    if state[i, j] == 2 or not valid[i, j]:
                        c = neutral
                    below = down[i, j] / max(base[i, j] + np.float32(k) * step[i, j], low)
                    if below > floor_ceiling[0] or below < floor_ceiling[1]:
                        extra += outside_penalty
                    result[i, j, k - first] = impossible if state[i, j] == 1 else c + extra
        for i in range(height):
            for j in range(width):
                for k in range(first, last):
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
        penalty: (2, count) added to the cost of a hypothesis, by `side`.
        side: (h, w) 0 where a pixel sees the planes at negative distances along their normal, 1 at positive ones.
        back_facing: (2, count) planes that the two views see from different sides; None for none.
        sphere: the hypotheses are spheres around the camera.
    """

    base: np.ndarray
    step: np.ndarray
    penalty: np.ndarray
    side: np.ndarray
    back_facing: np.ndarray | None = None
    sphere: bool = False


@dataclass(frozen=True, eq=False)
class View:
    """One view at one level of the search.

    Attributes:
        image: (h, w, 3) float32.
        valid: (h, w) False for masked pixels.
        down: (h, w) components of the rays along the scene's down axis.
        inverse_depth: (h, w) of the surface found so far; None before the first pass.
    """

    image: np.ndarray
    valid: np.ndarray
    down: np.ndarray
    inverse_depth: np.ndarray | None = None


def compute_matching_cost(
    view: View,
    other: View,
    pose: np.ndarray,
    sets: list[HypothesisSet],
    limits: tuple[float, float],
    floor_ceiling: tuple[float, float],
    config: MatchingConfig,
) -> np.ndarray:
    """Matching cost (h, w, sets * count) of every hypothesis, in the unit of the config's weights.

    Args:
        pose: (4, 4) from `view`'s camera to `other`'s.
        limits: smallest and largest inverse depth, 1/m.
        floor_ceiling: extent of the scene below and above (negative) `view`'s camera, metres.
    """
    height, width = view.image.shape[:2]
    m = config.window
    gray = pad_sphere(view.image @ _LUMA, m)
    window = (2 * m + 1, 2 * m + 1)
    inside = (slice(m, -m), slice(m, -m))
    mean = np.ascontiguousarray(cv2.boxFilter(gray, -1, window)[inside])
    variance = np.ascontiguousarray(cv2.boxFilter(gray * gray, -1, window)[inside])
    variance = np.maximum(variance - mean * mean, 0)
    has_surface = other.inverse_depth is not None
    other_inverse = other.inverse_depth if has_surface else np.ones((height, width), np.float32)
    weights = tuple(np.float32(getattr(config, name)) for name in _WEIGHTS)
    count = sets[0].penalty.shape[1]
    cost = np.empty((height, width, len(sets) * count), np.float32)
    other_image, rays = pad_sphere(other.image, 1), ray_grid(height)
    rotation = np.ascontiguousarray(pose[:3, :3], np.float32)
    translation = np.ascontiguousarray(pose[:3, 3], np.float32)
    for n, hypotheses in enumerate(sets):
        back_facing = np.zeros((2, count), bool) if hypotheses.back_facing is None else hypotheses.back_facing
        _compute_set_cost(
            view.image, gray, mean, variance, other_image, rays, rotation, translation, hypotheses.base,
            hypotheses.step, (np.float32(limits[0]), np.float32(limits[1])), hypotheses.penalty, back_facing,
            hypotheses.sphere, hypotheses.side, view.down,
            (np.float32(floor_ceiling[0]), np.float32(floor_ceiling[1])), view.valid, other.valid, other_inverse,
            has_surface, weights, m, cost, n * count, count,
        )  # fmt: skip
    return cost


_DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))


@dataclass(frozen=True)
class AggregationConfig:
    """Penalties for a change of hypothesis between neighbouring pixels, in the unit of the matching cost."""

    step_penalty: float = 0.08
    crease_penalty: float = 0.15
    jump_penalty: float = 1.6
    edge_scale: float = 0.1
    """Sum of absolute colour differences that divides the jump penalty by e."""


@nb.njit(fastmath=True, inline="always")
def _advance_path(previous, cost, out, step_penalty, crease_penalty, jump_penalty, sets, count, slots, slot_map, a, b):
    """One step of a path: `out` = cost + lowest path cost so far, less its minimum, so that it stays bounded."""
    lowest = previous[0]
    for n in range(1, sets * count):
        lowest = min(lowest, previous[n])
    cap = lowest + jump_penalty
    for s in range(slots):
        a[s] = cap
    for f in range(sets):
        slope, start = slot_map[f, 0], slot_map[f, 1]
        for k in range(count):
            s = int(slope * k + start)
            if 0 <= s < slots:
                a[s] = min(a[s], previous[f * count + k] + crease_penalty)
    b[0] = min(a[0], a[1])
    b[slots - 1] = min(a[slots - 1], a[slots - 2])
    for s in range(1, slots - 1):
        b[s] = min(min(a[s - 1], a[s]), a[s + 1])
    for f in range(sets):
        slope, start = slot_map[f, 0], slot_map[f, 1]
        n0 = f * count
        for k in range(count):
            best = min(previous[n0 + k], cap)
            if k > 0:
                best = min(best, previous[n0 + k - 1] + step_penalty)
            if k < count - 1:
                best = min(best, previous[n0 + k + 1] + step_penalty)
            s = int(slope * k + start)
            if 0 <= s < slots:
                best = min(best, b[s])
            out[n0 + k] = cost[n0 + k] + best - lowest


@nb.njit(fastmath=True, inline="always")
def _jump_penalty(guide, i, j, ip, jp, penalty, floor, scale):
    d = abs(guide[i, j, 0] - guide[ip, jp, 0]) + abs(guide[i, j, 1] - guide[ip, jp, 1])
    d += abs(guide[i, j, 2] - guide[ip, jp, 2])
    return max(penalty * math.exp(-d / scale), floor)


@nb.njit(fastmath=True, nogil=True, cache=True)
def _aggregate_rows(cost, total, guide, slot_map, sets, count, slots, penalties, stretch, dx):
    """Add the costs of horizontal paths; each starts a full turn early, so that it is closed."""
    height, width, labels = cost.shape
    step_penalty, crease_penalty, jump_penalty, scale = penalties
    previous, current = np.empty(labels, np.float32), np.empty(labels, np.float32)
    a, b = np.empty(slots, np.float32), np.empty(slots, np.float32)
    for i in range(height):
        t = stretch[i]  # neighbours near a pole are closer, so penalties are higher
        previous[:] = cost[i, 0]
        for n in range(1, 2 * width):
            j, jp = (dx * n) % width, (dx * (n - 1)) % width
            jump = _jump_penalty(guide, i, j, i, jp, jump_penalty, crease_penalty * np.float32(1.2), scale)
            _advance_path(
                previous, cost[i, j], current, step_penalty * t, crease_penalty * t, jump * t,
                sets, count, slots, slot_map[i, j], a, b,
            )  # fmt: skip
            if n >= width:
                for k in range(labels):
                    total[i, j, k] += current[k]
            previous, current = current, previous


@nb.njit(fastmath=True, nogil=True, cache=True)
def _aggregate_columns(cost, total, guide, slot_map, sets, count, slots, penalties, dy, dx, run_up):
    """Add the costs of vertical or diagonal paths; each starts `run_up` rows early, beyond the pole."""
    height, width, labels = cost.shape
    step_penalty, crease_penalty, jump_penalty, scale = penalties
    length = np.float32(1.0 if dx == 0 else 1 / math.sqrt(2))
    previous, current = np.empty((width, labels), np.float32), np.empty((width, labels), np.float32)
    a, b = np.empty(slots, np.float32), np.empty(slots, np.float32)
    row_before, shift_before = 0, 0
    for n in range(-run_up, height):
        row, shift = (n, 0) if n >= 0 else (-1 - n, width // 2)
        if dy < 0:
            row = height - 1 - row
        for j in range(width):
            js = (j + shift) % width
            if n == -run_up:
                current[j] = cost[row, js]
                continue
            jp = (j - dx) % width
            floor = crease_penalty * np.float32(1.2)
            jump = _jump_penalty(guide, row, js, row_before, (jp + shift_before) % width, jump_penalty, floor, scale)
            _advance_path(
                previous[jp], cost[row, js], current[j], step_penalty * length, crease_penalty * length, jump * length,
                sets, count, slots, slot_map[row, js], a, b,
            )  # fmt: skip
            if n >= 0:
                for k in range(labels):
                    total[row, js, k] += current[j, k]
        row_before, shift_before = row, shift
        previous, current = current, previous


def aggregate_costs(
    cost: np.ndarray, guide: np.ndarray, slot_map: np.ndarray, slots: int, config: AggregationConfig, threads: int = 2
) -> np.ndarray:
    """Sum of the path costs of all eight directions, (h, w, sets * count).

    Args:
        cost: (h, w, sets * count) matching cost.
        guide: (h, w, 3) image whose edges lower the jump penalty.
        slot_map: (h, w, sets, 2) slope and start of each set's hypotheses in depth slots: two hypotheses whose slots
            differ by at most one have the same depth at this pixel.
        slots: number of depth slots.
    """
    height, _, labels = cost.shape
    sets = slot_map.shape[2]
    stretch = np.minimum(1 / row_weights(height).numpy(), 8).astype(np.float32)
    penalties = tuple(
        np.float32(v) for v in (config.step_penalty, config.crease_penalty, config.jump_penalty, config.edge_scale)
    )

    def run(directions: tuple[tuple[int, int], ...]) -> np.ndarray:
        total = np.zeros_like(cost)
        for dy, dx in directions:
            shape = (sets, labels // sets, slots, penalties)
            if dy == 0:
                _aggregate_rows(cost, total, guide, slot_map, *shape, stretch, dx)
            else:
                _aggregate_columns(cost, total, guide, slot_map, *shape, dy, dx, height // 4)
        return total

    # Fixed groups, summed in a fixed order: the result does not depend on the number of threads.
    groups = (_DIRECTIONS[::2], _DIRECTIONS[1::2])
    with ThreadPoolExecutor(max(1, min(threads, len(groups)))) as pool:
        first, second = pool.map(run, groups)
    first += second
    return first


@nb.njit(parallel=True, cache=True)
def select_labels(total: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Label of lowest cost (h, w) int32, and its subpixel offset in [-0.5, 0.5] labels by a parabola fit."""
    height, width, labels = total.shape
    label = np.empty((height, width), np.int32)
    offset = np.zeros((height, width), np.float32)
    for i in nb.prange(height):
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
    return label, offset
