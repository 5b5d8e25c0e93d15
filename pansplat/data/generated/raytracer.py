"""Ray tracing of generated scenes: radial depth along the ray of each pixel centre, and antialiased colours.

A body is a box, ellipsoid or cylinder with an affine map from the world to its own space, in which it is [-1, 1]^3, the
unit sphere, or x^2 + z^2 <= 1, |y| <= 1. Ray parameters are equal in both spaces. The bodies are in a bounding volume
hierarchy (BVH).

Lighting is diffuse, and therefore independent of the view: lamps and a sun with shadows, portals (windows and open
doors as luminous rectangles), and the ambient light of a room, which is weaker in corners. Rooms that share a light
group share their lamps and portals.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from numpy.typing import NDArray

from pansplat.data.generated.textures import COLOR_A, COLOR_B, COLOR_C, GLOW, OPTIONS, color, fractal

BOX, ELLIPSOID, CYLINDER = 0, 1, 2
_LEAF = 2  # bodies


def build_bvh(low: NDArray[np.float64], high: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """A bounding volume hierarchy of bodies with the given corners (body 3).

    Returns:
        Corners (node 6), and links (node 3). The first two columns hold the index of the first child (the second child
        follows it) and 0, or for leaves the first place in the order and the number of bodies. The third column holds
        the order of the bodies.
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


@nb.njit(**OPTIONS)
def intersect_body(kind, m, x, y, z, dx, dy, dz):
    """Distance at which a ray enters a body; inf if it misses, negative if the body is behind or around the origin."""
    px, py, pz = x - m[3], y - m[7], z - m[11]
    ox = m[0] * px + m[1] * py + m[2] * pz
    oy = m[4] * px + m[5] * py + m[6] * pz
    oz = m[8] * px + m[9] * py + m[10] * pz
    ux = m[0] * dx + m[1] * dy + m[2] * dz
    uy = m[4] * dx + m[5] * dy + m[6] * dz
    uz = m[8] * dx + m[9] * dy + m[10] * dz
    if kind == 0:
        return _box(ox, oy, oz, ux, uy, uz)
    if kind == 1:
        return _ellipsoid(ox, oy, oz, ux, uy, uz)
    return _cylinder(ox, oy, oz, ux, uy, uz)


@nb.njit(**OPTIONS)
def first_hit(bodies, x, y, z, dx, dy, dz, limit, any_hit):
    """Distance and index of the first body nearer than `limit`; `limit` and -1 if there is none.

    Args:
        bodies: kinds, maps, corners and links of the BVH, and a stack of 64 integers.
        any_hit: whether any body nearer than `limit` is sufficient, for shadow rays.
    """
    kinds, maps, bounds, links, stack = bodies
    ix, iy, iz = 1 / dx, 1 / dy, 1 / dz
    stack[0], depth = 0, 1
    best, body = limit, -1
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
            # Visit the child nearer to the origin first.
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
            t = intersect_body(kinds[k], maps[k], x, y, z, dx, dy, dz)
            if 1e-6 < t < best:
                best, body = t, k
                if any_hit:
                    return best, body
    return best, body


SKY = 40.0  # radius of the sphere of sky and horizon, metres
WALL, FLOOR, CEILING = -1, -2, -3  # materials that depend on the room
# Columns of a room after its corners x0 z0 x1 z1.
WALL_MATERIAL, FLOOR_MATERIAL, CEILING_MATERIAL, TRIM_MATERIAL, PANEL_MATERIAL = range(4, 9)
PANEL_HEIGHT, TRIM_HEIGHT, HEIGHT, AMBIENT, LIGHT_GROUP = 9, 10, 11, 12, 15
# Columns of a light: position (direction to a sun, centre of a portal), colour, size, kind, the light group that it
# reaches (-1 for all), and for portals: half width, half height, the axis of the normal, whether bodies cast shadows.
LIGHT_COLOR, LIGHT_SIZE, LIGHT_KIND, LIGHT_REACHES = 3, 6, 7, 8
PORTAL_WIDTH, PORTAL_HEIGHT, PORTAL_AXIS, PORTAL_SHADOWS, LIGHT_NUMBERS = 9, 10, 11, 12, 13
LAMP, SUN, PORTAL = 0, 1, 2


@nb.njit(**OPTIONS)
def _room_at(rooms, x, z):
    for k in range(len(rooms)):
        if rooms[k, 0] <= x <= rooms[k, 2] and rooms[k, 1] <= z <= rooms[k, 3]:
            return k
    return -1


@nb.njit(**OPTIONS)
def _surface_point(kind, m, half, x, y, z):
    """Unit normal, face (two per axis; 0 for round sides), texture coordinates and half size of the face, metres."""
    px, py, pz = x - m[3], y - m[7], z - m[11]
    qx = m[0] * px + m[1] * py + m[2] * pz
    qy = m[4] * px + m[5] * py + m[6] * pz
    qz = m[8] * px + m[9] * py + m[10] * pz
    a, b, c = abs(qx), abs(qy), abs(qz)
    nx, ny, nz, face = 0.0, 0.0, 0.0, 0
    u, v, half_u, half_v = qx * half[0], qy * half[1], half[0], half[1]
    if kind == 1:
        nx, ny, nz = qx, qy, qz
        u, v = math.atan2(qx, qz) * half[0], math.asin(min(1.0, max(-1.0, qy))) * half[1]
    elif kind == 2 and a * a + c * c > b * b:
        nx, nz = qx, qz
        u, v = math.atan2(qx, qz) * half[0], qy * half[1]
        half_u = math.pi * half[0]
    elif kind == 2 or (b >= a and b >= c):
        ny, face = math.copysign(1.0, qy), 3 if qy > 0 else 2
        v, half_v = qz * half[2], half[2]
    elif a >= c:
        nx, face = math.copysign(1.0, qx), 1 if qx > 0 else 0
        u, half_u = qz * half[2], half[2]
    else:
        nz, face = math.copysign(1.0, qz), 5 if qz > 0 else 4
    wx = m[0] * nx + m[4] * ny + m[8] * nz
    wy = m[1] * nx + m[5] * ny + m[9] * nz
    wz = m[2] * nx + m[6] * ny + m[10] * nz
    size = math.sqrt(wx * wx + wy * wy + wz * wz)
    return wx / size, wy / size, wz / size, face, u, v, half_u, half_v


@nb.njit(**OPTIONS)
def _room_material(rooms, room, kind, y, outside):
    """The material of a room's wall, floor or ceiling at height -y; walls may have a trim and a panel above it."""
    if room < 0:
        return outside
    place = WALL_MATERIAL
    if kind == FLOOR:
        place = FLOOR_MATERIAL
    elif kind == CEILING:
        place = CEILING_MATERIAL
    elif -y < rooms[room, TRIM_HEIGHT]:
        place = TRIM_MATERIAL
    elif -y < rooms[room, PANEL_HEIGHT]:
        place = PANEL_MATERIAL
    return int(rooms[room, place])


@nb.njit(**OPTIONS)
def _ambient_visibility(rooms, room, x, y, z, nx, ny, nz):
    """Fraction of the ambient light at a point; below 1 near the edges and corners of its room."""
    if room < 0:
        return 1.0
    r = rooms[room]
    visibility = 1.0
    for away, towards in (
        (x - r[0], nx),
        (r[2] - x, -nx),
        (z - r[1], nz),
        (r[3] - z, -nz),
        (-y, -ny),
        (y + r[HEIGHT], ny),
    ):
        if towards < 0.5:  # excludes the plane of the point itself
            visibility *= 1 - 0.3 * math.exp(-max(away, 0.0) / 0.3)
    return visibility


@nb.njit(**OPTIONS)
def _sky_color(materials, sky, dx, dy, dz, w):
    """Light of sky, clouds and skyline in a direction from the world origin; `sky` is the index of a material."""
    up = -dy
    around = math.atan2(dx, dz) * 4
    m = materials[sky]
    t = min(1.0, max(0.0, up)) ** 0.5
    cloud = min(1.0, max(0.0, 0.5 + 2.5 * fractal(around + 3 * up, 9 * up, 1.5, 5, w * 4, int(m[14])))) * 0.6
    r = (m[COLOR_A] * t + m[COLOR_B] * (1 - t)) * (1 - cloud) + cloud
    g = (m[COLOR_A + 1] * t + m[COLOR_B + 1] * (1 - t)) * (1 - cloud) + cloud
    b = (m[COLOR_A + 2] * t + m[COLOR_B + 2] * (1 - t)) * (1 - cloud) + cloud
    ridge = 0.08 + 0.25 * fractal(around, 0.3, 0.8, 6, w * 4, int(m[14]) + 5)
    land = min(1.0, max(0.0, 0.5 + (ridge - up) / max(w, 1e-3)))
    shade = max(0.1, 0.6 + 1.2 * fractal(around, 8 * up, 0.5, 5, w * 4, int(m[14]) + 9))
    r = r * (1 - land) + land * shade * m[COLOR_C]
    g = g * (1 - land) + land * shade * m[COLOR_C + 1]
    b = b * (1 - land) + land * shade * m[COLOR_C + 2]
    return r * m[GLOW], g * m[GLOW], b * m[GLOW]


@nb.njit(**OPTIONS)
def portal_form_factor(light, x, y, z, nx, ny, nz):
    """Fraction of a surface element's light that comes from an upright rectangle.

    The vector form factor of the rectangle is exact (Lambert's formula). A sphere of equal vector form factor then
    gives the part above the plane of the surface, which is smooth where that plane cuts the rectangle.
    """
    ax, az = 0.0, light[PORTAL_WIDTH]
    if light[PORTAL_AXIS] > 0:
        ax, az = az, ax
    cx, cy, cz, high = light[0] - x, light[1] - y, light[2] - z, light[PORTAL_HEIGHT]
    fx, fy, fz = 0.0, 0.0, 0.0
    px, py, pz = cx - ax, cy + high, cz - az
    size = math.sqrt(px * px + py * py + pz * pz) + 1e-9
    px, py, pz = px / size, py / size, pz / size
    for k in range(4):
        along, up = (1.0 if k < 2 else -1.0), (1.0 if k == 0 or k == 3 else -1.0)
        qx, qy, qz = cx + along * ax, cy + up * high, cz + along * az
        size = math.sqrt(qx * qx + qy * qy + qz * qz) + 1e-9
        qx, qy, qz = qx / size, qy / size, qz / size
        cosine = min(0.9999, max(-0.9999, px * qx + py * qy + pz * qz))
        weight = math.acos(cosine) / math.sqrt(1 - cosine * cosine) * (0.5 / math.pi)
        fx += weight * (py * qz - pz * qy)
        fy += weight * (pz * qx - px * qz)
        fz += weight * (px * qy - py * qx)
        px, py, pz = qx, qy, qz
    size = math.sqrt(fx * fx + fy * fy + fz * fz)
    towards = fx * nx + fy * ny + fz * nz
    if fx * cx + fy * cy + fz * cz < 0:
        towards = -towards
    return max(0.0, (size * size + towards) / (size + 1))


@nb.njit(**OPTIONS)
def _direct_light(bodies, lights, last, group, x, y, z, nx, ny, nz, jitter):
    """Light (red, green, blue) of lamps, portals and sun at a point of a light group, with shadows.

    Args:
        last: per light, the body that blocked it at the previous point, which is tested first; updated.
        jitter: selects a point on each lamp.
    """
    kinds, maps = bodies[0], bodies[1]
    r, g, b = 0.0, 0.0, 0.0
    x, y, z = x + 1e-4 * nx, y + 1e-4 * ny, z + 1e-4 * nz
    for k in range(len(lights)):
        light = lights[k]
        if light[LIGHT_REACHES] >= 0 and light[LIGHT_REACHES] != group:
            continue
        size = light[LIGHT_SIZE]
        jx, jy, jz = size * (2 * (jitter & 1) - 1), 0.3 * size * ((jitter % 3) - 1), size * ((jitter & 2) - 1)
        if light[LIGHT_KIND] == PORTAL:
            power = portal_form_factor(light, x, y, z, nx, ny, nz)
            along = 0.5 * light[PORTAL_WIDTH] * (2 * (jitter & 1) - 1)
            lx, ly, lz = light[0] - x, light[1] - y + 0.5 * light[PORTAL_HEIGHT] * ((jitter & 2) - 1), light[2] - z
            if light[PORTAL_AXIS] > 0:
                lx += along
            else:
                lz += along
            away = math.sqrt(lx * lx + ly * ly + lz * lz)
            if light[PORTAL_SHADOWS] == 0 or nx * lx + ny * ly + nz * lz < 0:
                r += power * light[LIGHT_COLOR]
                g += power * light[LIGHT_COLOR + 1]
                b += power * light[LIGHT_COLOR + 2]
                continue
            limit = away
        else:
            if light[LIGHT_KIND] == SUN:
                lx, ly, lz, limit, fall = light[0] + jx, light[1] + jy, light[2] + jz, 2 * SKY, 1.0
                away = math.sqrt(lx * lx + ly * ly + lz * lz)
            else:
                lx, ly, lz = light[0] + jx - x, light[1] + jy - y, light[2] + jz - z
                away = math.sqrt(lx * lx + ly * ly + lz * lz)
                limit, fall = away, 1 / (0.6 + away * away)
            power = (nx * lx + ny * ly + nz * lz) / away * fall
            if power < 0.01:
                continue
        lx, ly, lz = lx / away, ly / away, lz / away
        if last[k] >= 0 and 1e-6 < intersect_body(kinds[last[k]], maps[last[k]], x, y, z, lx, ly, lz) < limit:
            continue
        _, last[k] = first_hit(bodies, x, y, z, lx, ly, lz, limit, True)
        if last[k] < 0:
            r += power * light[LIGHT_COLOR]
            g += power * light[LIGHT_COLOR + 1]
            b += power * light[LIGHT_COLOR + 2]
    return r, g, b


@nb.njit(**OPTIONS)
def _trace_ray(scene, bodies, last, x, y, z, dx, dy, dz, pixel, jitter):
    """Light (red, green, blue) and distance of the first hit of a ray; `pixel` is the angle of a pixel, radians."""
    kinds, maps, halves, faces, _, _, materials, rooms, lights, ambient, outside, sky = scene
    t, body = first_hit(bodies, x, y, z, dx, dy, dz, math.inf, False)
    if body < 0:
        t = _distance_to_sky(x, y, z, dx, dy, dz)
        px, py, pz = (x + t * dx) / SKY, (y + t * dy) / SKY, (z + t * dz) / SKY
        r, g, b = _sky_color(materials, sky, px, py, pz, pixel)
        return r, g, b, t
    px, py, pz = x + t * dx, y + t * dy, z + t * dz
    nx, ny, nz, face, u, v, half_u, half_v = _surface_point(kinds[body], maps[body], halves[body], px, py, pz)
    facing = abs(nx * dx + ny * dy + nz * dz)
    width = pixel * t / max(0.7 * math.sqrt(facing), 0.15)  # between the sides of the pixel's footprint
    material = faces[body, face]
    room = _room_at(rooms, px + 0.02 * nx, pz + 0.02 * nz)
    if material < 0:
        if ny > 0.5 or ny < -0.5:
            u, v = px, pz
        elif abs(nx) > abs(nz):
            u, v = pz, py
        else:
            u, v = px, py
        material = _room_material(rooms, room, material, py, outside)
    r, g, b = color(materials[material], u, v, width, half_u, half_v)
    around = _ambient_visibility(rooms, room, px, py, pz, nx, ny, nz) * (0.85 - 0.15 * ny)
    group = -1
    if room >= 0:
        ambient, group = rooms[room, AMBIENT:LIGHT_GROUP], int(rooms[room, LIGHT_GROUP])
    lr, lg, lb = _direct_light(bodies, lights, last, group, px, py, pz, nx, ny, nz, jitter)
    glow = materials[material, GLOW]
    return (
        r * (ambient[0] * around + lr + glow),
        g * (ambient[1] * around + lg + glow),
        b * (ambient[2] * around + lb + glow),
        t,
    )


@nb.njit(**OPTIONS)
def _distance_to_sky(x, y, z, dx, dy, dz):
    b = x * dx + y * dy + z * dz
    return -b + math.sqrt(b * b + SKY * SKY - (x * x + y * y + z * z))


@nb.njit(**OPTIONS)
def trace_panorama(scene, pose, samples, image, depth):
    """Fill `image` (H W 3) with linear light, the mean of samples x samples rays, and `depth` (H W) with metres."""
    height, width = depth.shape
    bodies = (scene[0], scene[1], scene[4], scene[5], np.empty(64, np.int64))
    last = np.full(len(scene[8]), -1)
    x, y, z = pose[0, 3], pose[1, 3], pose[2, 3]
    pixel = math.pi / height
    for i in range(height):
        for j in range(width):
            for k in range(samples * samples + 1):  # the last ray, for depth, passes through the pixel centre
                centre = k == samples * samples
                du, dv = ((k % samples) + 0.5) / samples, ((k // samples) + 0.5) / samples
                if centre:
                    du, dv = 0.5, 0.5
                longitude = 2 * math.pi * (j + du) / width - math.pi
                latitude = math.pi * (i + dv) / height - 0.5 * math.pi
                cx = math.cos(latitude) * math.sin(longitude)
                cy = math.sin(latitude)
                cz = math.cos(latitude) * math.cos(longitude)
                dx = pose[0, 0] * cx + pose[0, 1] * cy + pose[0, 2] * cz
                dy = pose[1, 0] * cx + pose[1, 1] * cy + pose[1, 2] * cz
                dz = pose[2, 0] * cx + pose[2, 1] * cy + pose[2, 2] * cz
                if centre:
                    t, body = first_hit(bodies, x, y, z, dx, dy, dz, math.inf, False)
                    depth[i, j] = t if body >= 0 else _distance_to_sky(x, y, z, dx, dy, dz)
                else:
                    r, g, b, _ = _trace_ray(scene, bodies, last, x, y, z, dx, dy, dz, pixel, k)
                    weight = 1 / (samples * samples)
                    image[i, j, 0] += weight * r
                    image[i, j, 1] += weight * g
                    image[i, j, 2] += weight * b
