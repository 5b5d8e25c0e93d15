"""Rays through boxes, ellipsoids and cylinders, found by a tree of boxes; one processor core a picture.

A body is an affine map from the world to its own space, where it is the cube [-1, 1]^3, the unit sphere, or the
cylinder x^2 + z^2 <= 1, |y| <= 1. Distances along a ray are the same in both.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from numpy.typing import NDArray

from pansplat.data.generated.patterns import OPTIONS

BOX, ELLIPSOID, CYLINDER = 0, 1, 2
_LEAF = 2  # bodies


def build_tree(low: NDArray[np.float64], high: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Nested boxes over bodies with the given corners (body 3).

    Returns:
        Corners (node 6), and per node: first child (the second follows it) and 0, or first place in the order and
        the number of bodies; the order stands in the last column.
    """
    order = np.arange(len(low))
    bounds, links = [np.zeros(6)], [[0, 0]]
    pending = [(0, 0, len(low))]
    while pending:
        node, start, end = pending.pop()
        chosen = order[start:end]
        bounds[node] = np.concatenate((low[chosen].min(axis=0), high[chosen].max(axis=0)))
        if end - start <= _LEAF:
            links[node] = [start, end - start]
            continue
        centres = low[chosen] + high[chosen]
        axis = int(np.ptp(centres, axis=0).argmax())
        order[start:end] = chosen[np.argsort(centres[:, axis], kind="stable")]
        middle, child = (start + end) // 2, len(bounds)
        links[node] = [child, 0]
        bounds += [np.zeros(6), np.zeros(6)]
        links += [[0, 0], [0, 0]]
        pending += [(child, start, middle), (child + 1, middle, end)]
    rows = np.zeros((max(len(bounds), len(low)), 3), np.int64)
    rows[: len(links), :2] = links
    rows[: len(low), 2] = order
    return np.array(bounds), rows


@nb.njit(**OPTIONS)
def _box(ox, oy, oz, dx, dy, dz):
    ix, iy, iz = 1 / dx, 1 / dy, 1 / dz
    ax, bx = (-1 - ox) * ix, (1 - ox) * ix
    ay, by = (-1 - oy) * iy, (1 - oy) * iy
    az, bz = (-1 - oz) * iz, (1 - oz) * iz
    enter = max(max(min(ax, bx), min(ay, by)), min(az, bz))
    leave = min(min(max(ax, bx), max(ay, by)), max(az, bz))
    if enter > leave:
        return np.inf
    return enter


@nb.njit(**OPTIONS)
def _ellipsoid(ox, oy, oz, dx, dy, dz):
    a, b = dx * dx + dy * dy + dz * dz, ox * dx + oy * dy + oz * dz
    # The nearest point of the ray, then half a chord: no cancellation for small spheres far away.
    px, py, pz = ox - b / a * dx, oy - b / a * dy, oz - b / a * dz
    left = 1 - (px * px + py * py + pz * pz)
    if left < 0:
        return np.inf
    return -b / a - math.sqrt(left / a)


@nb.njit(**OPTIONS)
def _cylinder(ox, oy, oz, dx, dy, dz):
    a, b = dx * dx + dz * dz, ox * dx + oz * dz
    iy = 1 / dy
    enter, leave = min((-1 - oy) * iy, (1 - oy) * iy), max((-1 - oy) * iy, (1 - oy) * iy)
    if a > 0:
        px, pz = ox - b / a * dx, oz - b / a * dz
        left = 1 - (px * px + pz * pz)
        if left < 0:
            return np.inf
        half = math.sqrt(left / a)
        enter, leave = max(enter, -b / a - half), min(leave, -b / a + half)
    elif ox * ox + oz * oz > 1:
        return np.inf
    if enter > leave:
        return np.inf
    return enter


@nb.njit(**OPTIONS)
def meet(kind, m, x, y, z, dx, dy, dz):
    """Distance at which a ray enters a body; inf where it does not, negative behind or from within."""
    px, py, pz = x - m[3], y - m[7], z - m[11]
    ox, oy, oz = (
        m[0] * px + m[1] * py + m[2] * pz,
        m[4] * px + m[5] * py + m[6] * pz,
        m[8] * px + m[9] * py + m[10] * pz,
    )
    ux, uy, uz = (
        m[0] * dx + m[1] * dy + m[2] * dz,
        m[4] * dx + m[5] * dy + m[6] * dz,
        m[8] * dx + m[9] * dy + m[10] * dz,
    )
    if kind == 0:
        return _box(ox, oy, oz, ux, uy, uz)
    if kind == 1:
        return _ellipsoid(ox, oy, oz, ux, uy, uz)
    return _cylinder(ox, oy, oz, ux, uy, uz)


@nb.njit(**OPTIONS)
def first_hit(bodies, x, y, z, dx, dy, dz, most, any_will_do):
    """The distance to the first body nearer than `most` and its number (-1: none); or to any, for shadows.

    `bodies` are kinds, maps, the tree's corners and links, and room for 64 numbers to work in.
    """
    kinds, maps, bounds, links, stack = bodies
    ix, iy, iz = 1 / dx, 1 / dy, 1 / dz
    stack[0], depth = 0, 1
    best, body = most, -1
    while depth:
        depth -= 1
        node = stack[depth]
        box = bounds[node]
        ax, bx = (box[0] - x) * ix, (box[3] - x) * ix
        ay, by = (box[1] - y) * iy, (box[4] - y) * iy
        az, bz = (box[2] - z) * iz, (box[5] - z) * iz
        enter = max(max(min(ax, bx), min(ay, by)), min(az, bz))
        leave = min(min(max(ax, bx), max(ay, by)), max(az, bz))
        if enter > leave or leave < 0 or enter > best:
            continue
        first, count = links[node, 0], links[node, 1]
        if count == 0:
            # The child on the ray's side first.
            nearer = 0
            left, right = bounds[first], bounds[first + 1]
            along = (
                (right[0] + right[3] - left[0] - left[3]) * dx
                + (right[1] + right[4] - left[1] - left[4]) * dy
                + (right[2] + right[5] - left[2] - left[5]) * dz
            )
            if along < 0:
                nearer = 1
            stack[depth], stack[depth + 1] = first + 1 - nearer, first + nearer
            depth += 2
            continue
        for place in range(first, first + count):
            k = links[place, 2]
            t = meet(kinds[k], maps[k], x, y, z, dx, dy, dz)
            if 1e-6 < t < best:
                best, body = t, k
                if any_will_do:
                    return best, body
    return best, body
