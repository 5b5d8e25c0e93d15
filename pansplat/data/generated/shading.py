"""A panorama of a generated scene: exact depth along each pixel's ray, colour averaged over a pixel.

Light is diffuse: lamps and a sun with shadows, and light from all around that corners get less of. It does not depend
on where one looks from, so the same point has the same colour in all views.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from pansplat.data.generated.patterns import COLOR_A, COLOR_B, COLOR_C, GLOW, OPTIONS, color, fractal
from pansplat.data.generated.raycast import first_hit, meet

SKY = 40.0  # metres to the sphere that sky and horizon are painted on
WALL, FLOOR, CEILING = -1, -2, -3  # materials that the room decides
# Places in a room's row of numbers, after its corners x z x z.
WALL_LOOK, FLOOR_LOOK, CEILING_LOOK, TRIM_LOOK, PANEL_LOOK, PANEL_HEIGHT, TRIM_HEIGHT, TALL, ROOM_NUMBERS = range(4, 13)
# Places in a light's row of numbers: position (or direction to a sun), colour, size, 1 for a sun.
LIGHT_COLOR, LIGHT_SIZE, LIGHT_SUN, LIGHT_NUMBERS = 3, 6, 7, 8


@nb.njit(**OPTIONS)
def _room_at(rooms, x, z):
    for k in range(len(rooms)):
        if rooms[k, 0] <= x <= rooms[k, 2] and rooms[k, 1] <= z <= rooms[k, 3]:
            return k
    return -1


@nb.njit(**OPTIONS)
def _surface(kind, m, half, x, y, z):
    """Unit normal, face (two an axis; the side of round bodies is 0), place and half size on the surface, metres."""
    px, py, pz = x - m[3], y - m[7], z - m[11]
    qx, qy, qz = (
        m[0] * px + m[1] * py + m[2] * pz,
        m[4] * px + m[5] * py + m[6] * pz,
        m[8] * px + m[9] * py + m[10] * pz,
    )
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
    wx, wy, wz = (
        m[0] * nx + m[4] * ny + m[8] * nz,
        m[1] * nx + m[5] * ny + m[9] * nz,
        m[2] * nx + m[6] * ny + m[10] * nz,
    )
    size = math.sqrt(wx * wx + wy * wy + wz * wz)
    return wx / size, wy / size, wz / size, face, u, v, half_u, half_v


@nb.njit(**OPTIONS)
def _room_look(rooms, room, wanted, y, outside):
    """The material of a wall, floor or ceiling of a room; walls have a trim at the floor and maybe a panel above."""
    if room < 0:
        return outside
    place = WALL_LOOK
    if wanted == FLOOR:
        place = FLOOR_LOOK
    elif wanted == CEILING:
        place = CEILING_LOOK
    elif -y < rooms[room, TRIM_HEIGHT]:
        place = TRIM_LOOK
    elif -y < rooms[room, PANEL_HEIGHT]:
        place = PANEL_LOOK
    return int(rooms[room, place])


@nb.njit(**OPTIONS)
def _openness(rooms, room, x, y, z, nx, ny, nz):
    """Share of the surrounding light that reaches a point near the room's corners and edges."""
    if room < 0:
        return 1.0
    r = rooms[room]
    share = 1.0
    for away, towards in (
        (x - r[0], nx),
        (r[2] - x, -nx),
        (z - r[1], nz),
        (r[3] - z, -nz),
        (-y, -ny),
        (y + r[TALL], ny),
    ):
        if towards < 0.5:  # not the plane it lies on itself
            share *= 1 - 0.3 * math.exp(-max(away, 0.0) / 0.3)
    return share


@nb.njit(**OPTIONS)
def _sky(looks, sky, dx, dy, dz, w):
    """Sky, clouds and a skyline in a direction from the world's origin; `sky` is a material."""
    up = -dy
    around = math.atan2(dx, dz) * 4
    m = looks[sky]
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
def _lit(bodies, lights, last, x, y, z, nx, ny, nz, jitter):
    """Light (red, green, blue) from lamps and sun at a point, with shadows.

    `jitter` chooses a place on a lamp. `last` is the body that stood before each light at the point before: most
    often it still does.
    """
    kinds, maps = bodies[0], bodies[1]
    r, g, b = 0.0, 0.0, 0.0
    x, y, z = x + 1e-4 * nx, y + 1e-4 * ny, z + 1e-4 * nz
    for k in range(len(lights)):
        light = lights[k]
        size = light[LIGHT_SIZE]
        jx, jy, jz = size * (2 * (jitter & 1) - 1), 0.3 * size * ((jitter % 3) - 1), size * ((jitter & 2) - 1)
        if light[LIGHT_SUN] > 0:
            lx, ly, lz, most, fall = light[0] + jx, light[1] + jy, light[2] + jz, 2 * SKY, 1.0
            away = math.sqrt(lx * lx + ly * ly + lz * lz)
        else:
            lx, ly, lz = light[0] + jx - x, light[1] + jy - y, light[2] + jz - z
            away = math.sqrt(lx * lx + ly * ly + lz * lz)
            most, fall = away, 1 / (0.6 + away * away)
        facing = (nx * lx + ny * ly + nz * lz) / away
        power = facing * fall
        if power < 0.01:
            continue
        lx, ly, lz = lx / away, ly / away, lz / away
        if last[k] >= 0 and 1e-6 < meet(kinds[last[k]], maps[last[k]], x, y, z, lx, ly, lz) < most:
            continue
        _, last[k] = first_hit(bodies, x, y, z, lx, ly, lz, most, True)
        if last[k] < 0:
            r, g, b = (
                r + power * light[LIGHT_COLOR],
                g + power * light[LIGHT_COLOR + 1],
                b + power * light[LIGHT_COLOR + 2],
            )
    return r, g, b


@nb.njit(**OPTIONS)
def _seen(scene, bodies, last, x, y, z, dx, dy, dz, pixel, jitter):
    """Colour and distance of what a ray meets; `pixel` is the angle of a pixel."""
    kinds, maps, halves, faces, _, _, looks, rooms, lights, ambient, outside, sky = scene
    t, body = first_hit(bodies, x, y, z, dx, dy, dz, math.inf, False)
    if body < 0:
        t = _to_sky(x, y, z, dx, dy, dz)
        px, py, pz = (x + t * dx) / SKY, (y + t * dy) / SKY, (z + t * dz) / SKY
        r, g, b = _sky(looks, sky, px, py, pz, pixel)
        return r, g, b, t
    px, py, pz = x + t * dx, y + t * dy, z + t * dz
    nx, ny, nz, face, u, v, half_u, half_v = _surface(kinds[body], maps[body], halves[body], px, py, pz)
    facing = abs(nx * dx + ny * dy + nz * dz)
    width = pixel * t / max(0.7 * math.sqrt(facing), 0.15)  # between the pixel's short and its long side
    look = faces[body, face]
    room = _room_at(rooms, px + 0.02 * nx, pz + 0.02 * nz)
    if look < 0:
        if ny > 0.5 or ny < -0.5:
            u, v = px, pz
        elif abs(nx) > abs(nz):
            u, v = pz, py
        else:
            u, v = px, py
        look = _room_look(rooms, room, look, py, outside)
    r, g, b = color(looks[look], u, v, width, half_u, half_v)
    around = _openness(rooms, room, px, py, pz, nx, ny, nz) * (0.85 - 0.15 * ny)
    lr, lg, lb = _lit(bodies, lights, last, px, py, pz, nx, ny, nz, jitter)
    glow = looks[look, GLOW]
    return (
        r * (ambient[0] * around + lr + glow),
        g * (ambient[1] * around + lg + glow),
        b * (ambient[2] * around + lb + glow),
        t,
    )


@nb.njit(**OPTIONS)
def _to_sky(x, y, z, dx, dy, dz):
    b = x * dx + y * dy + z * dz
    return -b + math.sqrt(b * b + SKY * SKY - (x * x + y * y + z * z))


@nb.njit(**OPTIONS)
def draw_panorama(scene, pose, samples, image, depth):
    """Fill `image` (H W 3), linear light, with the mean of samples x samples rays a pixel; `depth` (H W) in metres."""
    height, width = depth.shape
    bodies = (scene[0], scene[1], scene[4], scene[5], np.empty(64, np.int64))
    last = np.full(len(scene[8]), -1)
    x, y, z = pose[0, 3], pose[1, 3], pose[2, 3]
    pixel = math.pi / height
    for i in range(height):
        for j in range(width):
            for k in range(samples * samples + 1):  # the last one through the pixel's centre
                centre = k == samples * samples
                du, dv = ((k % samples) + 0.5) / samples, ((k // samples) + 0.5) / samples
                if centre:
                    du, dv = 0.5, 0.5
                longitude, latitude = (
                    2 * math.pi * (j + du) / width - math.pi,
                    math.pi * (i + dv) / height - 0.5 * math.pi,
                )
                cx, cy, cz = (
                    math.cos(latitude) * math.sin(longitude),
                    math.sin(latitude),
                    math.cos(latitude) * math.cos(longitude),
                )
                dx = pose[0, 0] * cx + pose[0, 1] * cy + pose[0, 2] * cz
                dy = pose[1, 0] * cx + pose[1, 1] * cy + pose[1, 2] * cz
                dz = pose[2, 0] * cx + pose[2, 1] * cy + pose[2, 2] * cz
                if centre:
                    t, body = first_hit(bodies, x, y, z, dx, dy, dz, math.inf, False)
                    depth[i, j] = t if body >= 0 else _to_sky(x, y, z, dx, dy, dz)
                else:
                    r, g, b, _ = _seen(scene, bodies, last, x, y, z, dx, dy, dz, pixel, k)
                    share = 1 / (samples * samples)
                    image[i, j, 0] += share * r
                    image[i, j, 1] += share * g
                    image[i, j, 2] += share * b
