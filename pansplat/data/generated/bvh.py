"""Bodies and triangles in bounding volume hierarchies (BVH), and the first one that a ray meets.

A body is a box, ellipsoid or cylinder with an affine map from the world to its own space, in which it is [-1, 1]^3, the
unit sphere, or x^2 + z^2 <= 1, |y| <= 1. Ray parameters are equal in both spaces.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from pansplat.data.generated.textures import OPTIONS, is_opaque

BOX, ELLIPSOID, CYLINDER, GLASS, MESH = range(5)
"""Kinds of bodies. A pane of glass is a box that transmits all rays and reflects some of the light. A mesh fills a box
with triangles."""
STACK_SIZE = 128
INLINE: dict[str, Any] = OPTIONS | {"forceinline": True}  # calls would copy the arrays of a scene, more than a kilobyte
_BINS = 12  # candidates for the split of a BVH node


class Bodies(NamedTuple):
    """Bodies in the leaves of a BVH, and triangles in the leaves of one BVH for each mesh.

    Attributes:
        roots: node of `mesh_bounds` and `mesh_links` with the root of a body's mesh.
        triangles: first corner and the two edges from it, in the space of the mesh, [-1, 1]^3.
        texcoords: image coordinates of the corners, in [0, 1]; v points up.
        cutouts: image whose opacity cuts holes into a triangle, or -1.
        texels, images: see `textures.image_color`.
        stack: `STACK_SIZE` integers of workspace.
    """

    kinds: NDArray[np.int64]
    maps: NDArray[np.float64]
    roots: NDArray[np.int64]
    bounds: NDArray[np.float64]
    links: NDArray[np.int64]
    mesh_bounds: NDArray[np.float32]
    mesh_links: NDArray[np.int32]
    triangles: NDArray[np.float32]
    texcoords: NDArray[np.float32]
    cutouts: NDArray[np.int32]
    texels: NDArray[np.uint8]
    images: NDArray[np.int64]
    stack: NDArray[np.int64]


@nb.njit(**OPTIONS)
def _half_area(box):
    x, y, z = box[3] - box[0], box[4] - box[1], box[5] - box[2]
    return x * y + y * z + z * x


@nb.njit(**OPTIONS)
def _extend(box, low, high):
    for k in range(3):
        box[k], box[k + 3] = min(box[k], low[k]), max(box[k + 3], high[k])


@nb.njit(**OPTIONS)
def build_bvh(low, high, leaf):
    """A bounding volume hierarchy of items with the given corners (item 3), by the surface area heuristic.

    Args:
        leaf: the largest number of items in a leaf.

    Returns:
        Corners (node 6), links (node 2), and the order in which the items must be stored. Links are the index of the
        first child (the second child follows it) and 0, or for leaves the first item and the number of items.
    """
    count, used = len(low), 1
    order = np.arange(count)
    bounds, links = np.empty((max(2 * count, 1), 6)), np.zeros((max(2 * count, 1), 2), np.int64)
    pending = np.empty((64 + count, 3), np.int64)
    pending[0, 0], pending[0, 1], pending[0, 2] = 0, 0, count
    waiting = 1
    centres = low + high
    boxes, counts, costs = np.empty((_BINS, 6)), np.empty(_BINS, np.int64), np.empty(_BINS)
    running = np.empty(6)
    while waiting:
        waiting -= 1
        node, start, end = pending[waiting]
        bounds[node, :3], bounds[node, 3:] = np.inf, -np.inf
        running[:3], running[3:] = np.inf, -np.inf
        for k in order[start:end]:
            _extend(bounds[node], low[k], high[k])
            _extend(running, centres[k], centres[k])
        if end - start <= leaf:
            links[node, 0], links[node, 1] = start, end - start
            continue
        axis = int(np.argmax(running[3:] - running[:3]))
        first, size = running[axis], running[axis + 3] - running[axis]
        middle = (start + end) // 2
        if size > 0:
            boxes[:, :3], boxes[:, 3:] = np.inf, -np.inf
            counts[:] = 0
            for k in order[start:end]:
                place = min(_BINS - 1, int((centres[k, axis] - first) / size * _BINS))
                counts[place] += 1
                _extend(boxes[place], low[k], high[k])
            for sweep in range(2):  # areas of the bins on one side, then of those on the other side
                running[:3], running[3:] = np.inf, -np.inf
                total = 0
                for step in range(_BINS - 1):
                    place = step if sweep == 0 else _BINS - 1 - step
                    total += counts[place]
                    _extend(running, boxes[place, :3], boxes[place, 3:])
                    cost = total * _half_area(running) if total else 0.0
                    if sweep == 0:
                        costs[place] = cost
                    else:
                        costs[place - 1] += cost
            split = int(np.argmin(costs[: _BINS - 1]))
            middle = start
            for place in range(start, end):
                k = order[place]
                if min(_BINS - 1, int((centres[k, axis] - first) / size * _BINS)) <= split:
                    order[place] = order[middle]
                    order[middle] = k
                    middle += 1
        if middle in (start, end):
            middle = (start + end) // 2
        links[node, 0] = used
        for child in range(2):
            pending[waiting, 0] = used + child
            pending[waiting, 1] = start if child == 0 else middle
            pending[waiting, 2] = middle if child == 0 else end
            waiting += 1
        used += 2
    return bounds[:used].copy(), links[:used].copy(), order


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
    # Half a chord from the point of the ray nearest to the centre: avoids cancellation for small, distant spheres.
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


@nb.njit(**INLINE)
def intersect_body(kind, m, x, y, z, dx, dy, dz):
    """Distance at which a ray enters a body; inf if it misses, negative if the body is behind or around the origin."""
    px, py, pz = x - m[3], y - m[7], z - m[11]
    ox = m[0] * px + m[1] * py + m[2] * pz
    oy = m[4] * px + m[5] * py + m[6] * pz
    oz = m[8] * px + m[9] * py + m[10] * pz
    ux = m[0] * dx + m[1] * dy + m[2] * dz
    uy = m[4] * dx + m[5] * dy + m[6] * dz
    uz = m[8] * dx + m[9] * dy + m[10] * dz
    if kind == BOX or kind == GLASS:  # noqa: SIM109
        return _box(ox, oy, oz, ux, uy, uz)
    if kind == ELLIPSOID:
        return _ellipsoid(ox, oy, oz, ux, uy, uz)
    return _cylinder(ox, oy, oz, ux, uy, uz)


@nb.njit(**INLINE)
def _enter(box, x, y, z, ix, iy, iz):
    """Distance at which a ray enters an axis-aligned box; 0 from inside, inf if it misses."""
    ax, bx = (box[0] - x) * ix, (box[3] - x) * ix
    ay, by = (box[1] - y) * iy, (box[4] - y) * iy
    az, bz = (box[2] - z) * iz, (box[5] - z) * iz
    enter = max(max(min(ax, bx), min(ay, by)), min(az, bz))
    leave = min(min(max(ax, bx), max(ay, by)), max(az, bz))
    if enter > leave or leave < 0:
        return np.inf
    return max(enter, 0.0)


@nb.njit(**INLINE)
def _push_children(bounds, first, stack, depth, limit, x, y, z, ix, iy, iz):
    """Push the children of a node that a ray enters before `limit`, the nearer one last; the new depth of the stack."""
    near, far = first, first + 1
    at_near, at_far = _enter(bounds[near], x, y, z, ix, iy, iz), _enter(bounds[far], x, y, z, ix, iy, iz)
    if at_far < at_near:
        near, far, at_near, at_far = far, near, at_far, at_near
    if at_far < limit:
        stack[depth] = far
        depth += 1
    if at_near < limit:
        stack[depth] = near
        depth += 1
    return depth


@nb.njit(**INLINE)
def _hit_mesh(bodies, root, depth, x, y, z, dx, dy, dz, limit, any_hit):
    """Distance and index of the first triangle nearer than `limit` of the mesh at node `root`, or `limit` and -1.

    Args:
        depth: number of entries of the stack that are in use.
        x, y, z, dx, dy, dz: ray in the space of the mesh.
    """
    bounds, links, triangles, stack = bodies.mesh_bounds, bodies.mesh_links, bodies.triangles, bodies.stack
    ix, iy, iz = 1 / dx, 1 / dy, 1 / dz
    base, best, hit = depth, limit, -1
    stack[depth] = root
    depth += 1
    while depth > base:
        depth -= 1
        node = stack[depth]
        first, count = links[node, 0], links[node, 1]
        if count == 0:
            depth = _push_children(bounds, first, stack, depth, best, x, y, z, ix, iy, iz)
            continue
        for k in range(first, first + count):  # Source: Moeller and Trumbore 1997
            t = triangles[k]
            px, py, pz = dy * t[8] - dz * t[7], dz * t[6] - dx * t[8], dx * t[7] - dy * t[6]
            scale = t[3] * px + t[4] * py + t[5] * pz
            if scale == 0:
                continue
            scale = 1 / scale
            ox, oy, oz = x - t[0], y - t[1], z - t[2]
            u = (ox * px + oy * py + oz * pz) * scale
            if u < 0 or u > 1:
                continue
            qx, qy, qz = oy * t[5] - oz * t[4], oz * t[3] - ox * t[5], ox * t[4] - oy * t[3]
            v = (dx * qx + dy * qy + dz * qz) * scale
            if v < 0 or u + v > 1:
                continue
            away = (t[6] * qx + t[7] * qy + t[8] * qz) * scale
            if 1e-6 < away < best:
                if bodies.cutouts[k] >= 0:
                    c = bodies.texcoords[k]
                    cu, cv = c[0] + u * (c[2] - c[0]) + v * (c[4] - c[0]), c[1] + u * (c[3] - c[1]) + v * (c[5] - c[1])
                    if not is_opaque(bodies.texels, bodies.images[bodies.cutouts[k]], cu, cv):
                        continue
                best, hit = away, k
                if any_hit:
                    return best, hit
    return best, hit


@nb.njit(**INLINE)
def first_hit(bodies, x, y, z, dx, dy, dz, limit, any_hit, glass):
    """Distance, body and triangle (-1 except in meshes) of the first hit nearer than `limit`; body -1 if there is none.

    Args:
        bodies: a `Bodies`.
        any_hit: whether any hit nearer than `limit` is sufficient, for shadow rays.
        glass: whether panes of glass count.
    """
    kinds, maps, bounds, links, stack = bodies.kinds, bodies.maps, bodies.bounds, bodies.links, bodies.stack
    ix, iy, iz = 1 / dx, 1 / dy, 1 / dz
    stack[0], depth = 0, 1
    best, body, triangle = limit, -1, -1
    while depth:
        depth -= 1
        node = stack[depth]
        first, count = links[node, 0], links[node, 1]
        if count == 0:
            depth = _push_children(bounds, first, stack, depth, best, x, y, z, ix, iy, iz)
            continue
        for k in range(first, first + count):
            if kinds[k] == MESH:
                m = maps[k]
                px, py, pz = x - m[3], y - m[7], z - m[11]
                t, found = _hit_mesh(
                    bodies,
                    bodies.roots[k],
                    depth,
                    m[0] * px + m[1] * py + m[2] * pz,
                    m[4] * px + m[5] * py + m[6] * pz,
                    m[8] * px + m[9] * py + m[10] * pz,
                    m[0] * dx + m[1] * dy + m[2] * dz,
                    m[4] * dx + m[5] * dy + m[6] * dz,
                    m[8] * dx + m[9] * dy + m[10] * dz,
                    best,
                    any_hit,
                )
                if found >= 0:
                    best, body, triangle = t, k, found
            elif glass or kinds[k] != GLASS:
                t = intersect_body(kinds[k], maps[k], x, y, z, dx, dy, dz)
                if 1e-6 < t < best:
                    best, body, triangle = t, k, -1
            if any_hit and body >= 0:
                return best, body, triangle
    return best, body, triangle
