"""Semi-global aggregation on the sphere, over hypotheses that are surfaces.

Along each of eight directions a path pays to change its hypothesis: little for the next one of the same family,
a crease's price to switch to a surface of another family that meets it at this pixel, and most, less at image
edges, to jump. Staying on a plane is free however slanted it is. Horizontal paths wrap, vertical ones continue
over the poles.

Source: Hirschmueller, doi:10.1109/TPAMI.2007.1166, generalised from fronto-parallel labels to families.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numba as nb
import numpy as np

from pansplat.geometry.equirect import row_weights

_DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))


@dataclass(frozen=True)
class AggregationConfig:
    """Prices of changing the hypothesis from a pixel to its neighbour, in the matching cost's unit."""

    step_price: float = 0.08
    crease_price: float = 0.15
    jump_price: float = 1.6
    edge_scale: float = 0.1
    """Sum of absolute colour differences over which a jump's price falls by e."""


@nb.njit(fastmath=True, inline="always")
def _advance(previous, cost, out, step_price, crease_price, jump_price, families, count, slots, slot_map, a, b):
    """One step of a path: `out` = cost + cheapest way here, less the cheapest so far (to stay bounded)."""
    lowest = previous[0]
    for n in range(1, families * count):
        lowest = min(lowest, previous[n])
    cap = lowest + jump_price
    for s in range(slots):
        a[s] = cap
    for f in range(families):
        slope, start = slot_map[f, 0], slot_map[f, 1]
        for k in range(count):
            s = int(slope * k + start)
            if 0 <= s < slots:
                a[s] = min(a[s], previous[f * count + k] + crease_price)
    b[0] = min(a[0], a[1])
    b[slots - 1] = min(a[slots - 1], a[slots - 2])
    for s in range(1, slots - 1):
        b[s] = min(min(a[s - 1], a[s]), a[s + 1])
    for f in range(families):
        slope, start = slot_map[f, 0], slot_map[f, 1]
        n0 = f * count
        for k in range(count):
            best = min(previous[n0 + k], cap)
            if k > 0:
                best = min(best, previous[n0 + k - 1] + step_price)
            if k < count - 1:
                best = min(best, previous[n0 + k + 1] + step_price)
            s = int(slope * k + start)
            if 0 <= s < slots:
                best = min(best, b[s])
            out[n0 + k] = cost[n0 + k] + best - lowest


@nb.njit(fastmath=True, inline="always")
def _jump_price(guide, i, j, ip, jp, price, floor, scale):
    d = abs(guide[i, j, 0] - guide[ip, jp, 0]) + abs(guide[i, j, 1] - guide[ip, jp, 1])
    d += abs(guide[i, j, 2] - guide[ip, jp, 2])
    return max(price * math.exp(-d / scale), floor)


@nb.njit(fastmath=True, nogil=True, cache=True)
def _sweep_rows(cost, total, guide, slot_map, families, count, slots, prices, stretch, dx):
    """Add the costs of paths along the rows; each starts a turn early to close the circle."""
    height, width, labels = cost.shape
    step_price, crease_price, jump_price, scale = prices
    previous, current = np.empty(labels, np.float32), np.empty(labels, np.float32)
    a, b = np.empty(slots, np.float32), np.empty(slots, np.float32)
    for i in range(height):
        t = stretch[i]  # neighbours in a row near the pole are close: changing there costs more
        previous[:] = cost[i, 0]
        for n in range(1, 2 * width):
            j, jp = (dx * n) % width, (dx * (n - 1)) % width
            jump = _jump_price(guide, i, j, i, jp, jump_price, crease_price * np.float32(1.2), scale)
            _advance(
                previous, cost[i, j], current, step_price * t, crease_price * t, jump * t,
                families, count, slots, slot_map[i, j], a, b,
            )  # fmt: skip
            if n >= width:
                for k in range(labels):
                    total[i, j, k] += current[k]
            previous, current = current, previous


@nb.njit(fastmath=True, nogil=True, cache=True)
def _sweep_columns(cost, total, guide, slot_map, families, count, slots, prices, dy, dx, run_up):
    """Add the costs of vertical or diagonal paths; each comes over the pole, `run_up` rows early."""
    height, width, labels = cost.shape
    step_price, crease_price, jump_price, scale = prices
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
            floor = crease_price * np.float32(1.2)
            jump = _jump_price(guide, row, js, row_before, (jp + shift_before) % width, jump_price, floor, scale)
            _advance(
                previous[jp], cost[row, js], current[j], step_price * length, crease_price * length, jump * length,
                families, count, slots, slot_map[row, js], a, b,
            )  # fmt: skip
            if n >= 0:
                for k in range(labels):
                    total[row, js, k] += current[j, k]
        row_before, shift_before = row, shift
        previous, current = current, previous


def aggregate(
    cost: np.ndarray,
    guide: np.ndarray,
    slot_map: np.ndarray,
    slots: int,
    config: AggregationConfig,
    threads: int = 2,
) -> np.ndarray:
    """Sum of the path costs of all eight directions, (h, w, families * count).

    Args:
        cost: (h, w, families * count) matching cost.
        guide: (h, w, 3) picture whose edges make jumps cheaper.
        slot_map: (h, w, families, 2) slope and start of each family's hypotheses in depth slots: two hypotheses
            whose slots differ by at most one meet at this pixel.
        slots: number of depth slots.
    """
    height, _, labels = cost.shape
    families = slot_map.shape[2]
    stretch = np.minimum(1 / row_weights(height).numpy(), 8).astype(np.float32)
    prices = tuple(
        np.float32(v) for v in (config.step_price, config.crease_price, config.jump_price, config.edge_scale)
    )

    def run(directions: tuple[tuple[int, int], ...]) -> np.ndarray:
        total = np.zeros_like(cost)
        for dy, dx in directions:
            shape = (families, labels // families, slots, prices)
            if dy == 0:
                _sweep_rows(cost, total, guide, slot_map, *shape, stretch, dx)
            else:
                _sweep_columns(cost, total, guide, slot_map, *shape, dy, dx, height // 4)
        return total

    # Fixed groups, summed in a fixed order: the same bits for any number of threads.
    groups = (_DIRECTIONS[::2], _DIRECTIONS[1::2])
    with ThreadPoolExecutor(max(1, min(threads, len(groups)))) as pool:
        first, second = pool.map(run, groups)
    first += second
    return first


@nb.njit(parallel=True, cache=True)
def best_labels(total: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Cheapest label (h, w) int32 and its offset in [-0.5, 0.5] labels by the parabola through its neighbours."""
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
