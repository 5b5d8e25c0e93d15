"""Bodies and triangles in bounding volume hierarchies (BVH), and the first one that a ray meets.

A body is a box, ellipsoid or cylinder with an affine map from the world to its own space, in which it is [-1, 1]^3, the
unit sphere, or x^2 + z^2 <= 1, |y| <= 1. Ray parameters are equal in both spaces.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from pansplat_homes.textures import is_opaque
from pansplat_homes.vectors import INLINE, OPTIONS, advance, cross, dot, subtract, take

BOX, ELLIPSOID, CYLINDER, GLASS, MESH = range(5)
"""Kinds of bodies. A pane of glass is a box that transmits all rays and reflects some of the light. A mesh fills a box
with triangles."""
STACK_SIZE = 128
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
    pending = [(0, 0, count)]
    centres = low + high
    boxes, counts, costs = np.empty((_BINS, 6)), np.empty(_BINS, np.int64), np.empty(_BINS)
    running = np.empty(6)
    while pending:
        node, start, end = pending.pop()
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
        pending.append((used, start, middle))
        pending.append((used + 1, middle, end))
        used += 2
    return bounds[:used].copy(), links[:used].copy(), order


@nb.njit(**INLINE)
def to_local(m, p):
    """A point in the space of a body."""
    p = subtract(p, (m[3], m[7], m[11]))
    return dot(take(m, 0), p), dot(take(m, 4), p), dot(take(m, 8), p)


@nb.njit(**INLINE)
def _turn_to_local(m, d):
    """A direction in the space of a body."""
    return dot(take(m, 0), d), dot(take(m, 4), d), dot(take(m, 8), d)


@nb.njit(**INLINE)
def _cross_slabs(low, high, origin, direction):
    """Distances at which a ray enters and leaves a box; enters after it leaves if it misses.

    Args:
        direction: the reciprocals of its components.
    """
    ax, bx = (low[0] - origin[0]) * direction[0], (high[0] - origin[0]) * direction[0]
    ay, by = (low[1] - origin[1]) * direction[1], (high[1] - origin[1]) * direction[1]
    az, bz = (low[2] - origin[2]) * direction[2], (high[2] - origin[2]) * direction[2]
    enter = max(max(min(ax, bx), min(ay, by)), min(az, bz))
    leave = min(min(max(ax, bx), max(ay, by)), max(az, bz))
    return enter, leave


@nb.njit(**INLINE)
def _reciprocal(d):
    return 1 / d[0], 1 / d[1], 1 / d[2]


@nb.njit(**OPTIONS)
def _ellipsoid(o, d):
    a, b = dot(d, d), dot(o, d)
    # Half a chord from the point of the ray nearest to the centre: avoids cancellation for small, distant spheres.
    p = advance(o, -b / a, d)
    left = 1 - dot(p, p)
    if left < 0:
        return np.inf
    return -b / a - math.sqrt(left / a)


@nb.njit(**OPTIONS)
def _cylinder(o, d):
    a, b = d[0] * d[0] + d[2] * d[2], o[0] * d[0] + o[2] * d[2]
    inverse = 1 / d[1]
    bottom, top = (-1 - o[1]) * inverse, (1 - o[1]) * inverse
    enter, leave = min(bottom, top), max(bottom, top)
    if a > 0:
        px, pz = o[0] - b / a * d[0], o[2] - b / a * d[2]
        left = 1 - (px * px + pz * pz)
        if left < 0:
            return np.inf
        half = math.sqrt(left / a)
        enter, leave = max(enter, -b / a - half), min(leave, -b / a + half)
    elif o[0] * o[0] + o[2] * o[2] > 1:
        return np.inf
    return enter if enter <= leave else np.inf


@nb.njit(**INLINE)
def intersect_body(kind, m, origin, direction):
    """Distance at which a ray enters a body; inf if it misses, negative if the body is behind or around the origin."""
    o, d = to_local(m, origin), _turn_to_local(m, direction)
    if kind == BOX or kind == GLASS:  # noqa: SIM109
        enter, leave = _cross_slabs((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), o, _reciprocal(d))
        return enter if enter <= leave else np.inf
    return _ellipsoid(o, d) if kind == ELLIPSOID else _cylinder(o, d)


@nb.njit(**INLINE)
def _enter(box, origin, inverse):
    """Distance at which a ray enters an axis-aligned box; 0 from inside, inf if it misses."""
    enter, leave = _cross_slabs(take(box, 0), take(box, 3), origin, inverse)
    return np.inf if enter > leave or leave < 0 else max(enter, 0.0)


@nb.njit(**INLINE)
def _push_children(bounds, first, stack, depth, limit, origin, inverse):
    """Push the children of a node that a ray enters before `limit`, the nearer one last; the new depth of the stack."""
    near, far = first, first + 1
    at_near, at_far = _enter(bounds[near], origin, inverse), _enter(bounds[far], origin, inverse)
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
def _intersect_triangle(t, o, d):
    """Distance and barycentric coordinates of a hit; the distance is inf if the ray misses.

    Source: Moeller and Trumbore 1997.
    """
    first, second = take(t, 3), take(t, 6)
    p = cross(d, second)
    determinant = dot(first, p)
    if determinant == 0:
        return np.inf, 0.0, 0.0
    inverse, from_corner = 1 / determinant, subtract(o, take(t, 0))
    q = cross(from_corner, first)
    u, v = dot(from_corner, p) * inverse, dot(d, q) * inverse
    if u < 0 or u > 1 or v < 0 or u + v > 1:
        return np.inf, u, v
    return dot(second, q) * inverse, u, v


@nb.njit(**INLINE)
def _is_hole(bodies, triangle, u, v):
    """Whether the image of a triangle is transparent at barycentric coordinates."""
    if bodies.cutouts[triangle] < 0:
        return False
    c, image = bodies.texcoords[triangle], bodies.images[bodies.cutouts[triangle]]
    x, y = c[0] + u * (c[2] - c[0]) + v * (c[4] - c[0]), c[1] + u * (c[3] - c[1]) + v * (c[5] - c[1])
    return not is_opaque(bodies.texels, image, x, y)


@nb.njit(**INLINE)
def _hit_mesh(bodies, root, depth, o, d, limit, any_hit):
    """Distance and index of the first triangle nearer than `limit` of the mesh at node `root`, or `limit` and -1.

    Args:
        depth: number of entries of the stack that are in use.
        o, d: ray in the space of the mesh.
    """
    stack, inverse = bodies.stack, _reciprocal(d)
    base, best, hit = depth, limit, -1
    stack[depth] = root
    depth += 1
    while depth > base:
        depth -= 1
        node = stack[depth]
        first, count = bodies.mesh_links[node, 0], bodies.mesh_links[node, 1]
        if count == 0:
            depth = _push_children(bodies.mesh_bounds, first, stack, depth, best, o, inverse)
            continue
        for k in range(first, first + count):
            away, u, v = _intersect_triangle(bodies.triangles[k], o, d)
            if 1e-6 < away < best and not _is_hole(bodies, k, u, v):
                best, hit = away, k
                if any_hit:
                    return best, hit
    return best, hit


@nb.njit(**INLINE)
def first_hit(bodies, origin, direction, limit, any_hit, glass):
    """Distance, body and triangle (-1 except in meshes) of the first hit nearer than `limit`; body -1 if there is none.

    Args:
        bodies: a `Bodies`.
        any_hit: whether any hit nearer than `limit` is sufficient, for shadow rays.
        glass: whether panes of glass count.
    """
    kinds, maps, stack, inverse = bodies.kinds, bodies.maps, bodies.stack, _reciprocal(direction)
    stack[0], depth = 0, 1
    best, body, triangle = limit, -1, -1
    while depth:
        depth -= 1
        node = stack[depth]
        first, count = bodies.links[node, 0], bodies.links[node, 1]
        if count == 0:
            depth = _push_children(bodies.bounds, first, stack, depth, best, origin, inverse)
            continue
        for k in range(first, first + count):
            if kinds[k] == MESH:
                o, d = to_local(maps[k], origin), _turn_to_local(maps[k], direction)
                t, found = _hit_mesh(bodies, bodies.roots[k], depth, o, d, best, any_hit)
                if found >= 0:
                    best, body, triangle = t, k, found
            elif glass or kinds[k] != GLASS:
                t = intersect_body(kinds[k], maps[k], origin, direction)
                if 1e-6 < t < best:
                    best, body, triangle = t, k, -1
            if any_hit and body >= 0:
                return best, body, triangle
    return best, body, triangle
