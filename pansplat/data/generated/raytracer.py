"""Ray tracing of generated scenes: radial depth along the ray of each pixel centre, and antialiased colours.

Light comes from lamps and a sun with shadows, from portals (windows and open doors as luminous rectangles), and from
the ambient light of a room, which is weaker in corners. Rooms of a light group share their lamps and portals. Most
surfaces are diffuse. Mirrors, polished surfaces and glass reflect the first thing that the reflected ray meets.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from pansplat.data.generated.bvh import GLASS, INLINE, Bodies, first_hit, intersect_body
from pansplat.data.generated.textures import (
    COLOR_A,
    COLOR_B,
    COLOR_C,
    GLOSS,
    GLOW,
    IMAGE,
    KIND,
    MIRROR,
    OPTIONS,
    SIZE_U,
    color,
    fractal,
    hash_unit,
    image_color,
)

_FIRST, _BEHIND, _MIRRORED, _WEAK = range(4)  # rays of the camera, behind glass, from mirrors and from polish or glass
FLOOR_CELL = 0.05  # metres
SKY = 40.0  # radius of the sphere of sky and horizon, metres
WALL, FLOOR, CEILING = -1, -2, -3  # materials that depend on the room
# Columns of a room after its corners x0 z0 x1 z1.
WALL_MATERIAL, FLOOR_MATERIAL, CEILING_MATERIAL, TRIM_MATERIAL, PANEL_MATERIAL = range(4, 9)
PANEL_HEIGHT, TRIM_HEIGHT, HEIGHT, AMBIENT, LIGHT_GROUP = 9, 10, 11, 12, 15
# Columns of a light: position (direction to a sun, centre of a portal), colour, size, kind, the light group that it
# reaches (-1 for all), and for portals: half width, half height, the axis of the normal, whether bodies cast shadows.
LIGHT_COLOR, LIGHT_SIZE, LIGHT_KIND, LIGHT_REACHES = 3, 6, 7, 8
PORTAL_WIDTH, PORTAL_HEIGHT, PORTAL_AXIS, PORTAL_SHADOWS, LIGHT_NUMBERS = 9, 10, 11, 12, 13
LAMP, SUN, PORTAL = range(3)
_SHARPNESS = 0.2  # size of the part of a portal that shadows are cast from; a larger part needs more rays
_LEAST_LIGHT = 0.005  # lights that give less to a surface are omitted
_STRONG_LIGHT = 0.4  # lights that give less cast no shadows in weak reflections
_LEAST_REFLECTION = 0.03  # of the light; weaker reflections are omitted


class SceneArrays(NamedTuple):
    """A scene for `trace_panorama`; rows are bodies, triangles, materials, rooms or lights.

    Attributes:
        halves: half sizes of the bodies, metres.
        faces: materials of a body's six faces: left right (x), up down (y), back front (z); or of a mesh, the place of
            its first material in `mesh_materials`.
        normals: normals of a triangle's corners.
        triangle_materials: place of a triangle's material relative to the first one of the mesh.
        floor_light: fraction of the ambient light on the floor (z x), in cells of `FLOOR_CELL` from the world x and z
            `floor_start`.
        ambient: ambient light (red, green, blue) outside the rooms.
        outside, sky: indices of materials.
    """

    bodies: Bodies
    halves: NDArray[np.float64]
    faces: NDArray[np.int64]
    normals: NDArray[np.float32]
    triangle_materials: NDArray[np.int32]
    mesh_materials: NDArray[np.int64]
    materials: NDArray[np.float64]
    rooms: NDArray[np.float64]
    floor_light: NDArray[np.float64]
    floor_start: NDArray[np.float64]
    lights: NDArray[np.float64]
    ambient: NDArray[np.float64]
    outside: int
    sky: int


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
    nx, ny, nz = _world_normal(m, nx, ny, nz)
    return nx, ny, nz, face, u, v, half_u, half_v


@nb.njit(**INLINE)
def _mesh_point(scene, body, triangle, x, y, z, dx, dy, dz):
    """The surface at a point of a triangle.

    Returns:
        Unit normal towards the origin of the ray, place in `mesh_materials`, image coordinates, their change per metre,
        and texture coordinates in metres.
    """
    m, half, t, c = (
        scene.bodies.maps[body],
        scene.halves[body],
        scene.bodies.triangles[triangle],
        scene.normals[triangle],
    )
    px, py, pz = x - m[3], y - m[7], z - m[11]
    qx = m[0] * px + m[1] * py + m[2] * pz
    qy = m[4] * px + m[5] * py + m[6] * pz
    qz = m[8] * px + m[9] * py + m[10] * pz
    # Barycentric coordinates, in metres.
    ax, ay, az = t[3] * half[0], t[4] * half[1], t[5] * half[2]
    bx, by, bz = t[6] * half[0], t[7] * half[1], t[8] * half[2]
    rx, ry, rz = (qx - t[0]) * half[0], (qy - t[1]) * half[1], (qz - t[2]) * half[2]
    aa, ab, bb = ax * ax + ay * ay + az * az, ax * bx + ay * by + az * bz, bx * bx + by * by + bz * bz
    ra, rb = rx * ax + ry * ay + rz * az, rx * bx + ry * by + rz * bz
    square = max(aa * bb - ab * ab, 1e-30)
    u, v = (ra * bb - rb * ab) / square, (rb * aa - ra * ab) / square
    # Normals of the plane and of the interpolated corners, in the space of the mesh.
    gx, gy, gz = t[4] * t[8] - t[5] * t[7], t[5] * t[6] - t[3] * t[8], t[3] * t[7] - t[4] * t[6]
    sx = c[0] + u * (c[3] - c[0]) + v * (c[6] - c[0])
    sy = c[1] + u * (c[4] - c[1]) + v * (c[7] - c[1])
    sz = c[2] + u * (c[5] - c[2]) + v * (c[8] - c[2])
    plane_x, plane_y, plane_z = _world_normal(m, gx, gy, gz)
    nx, ny, nz = _world_normal(m, sx, sy, sz)
    if plane_x * dx + plane_y * dy + plane_z * dz > 0:
        plane_x, plane_y, plane_z = -plane_x, -plane_y, -plane_z
    along = plane_x * nx + plane_y * ny + plane_z * nz
    if along < 0:
        nx, ny, nz = -nx, -ny, -nz
    if abs(along) < 0.3 or nx * dx + ny * dy + nz * dz > 0:
        nx, ny, nz = plane_x, plane_y, plane_z
    w = scene.bodies.texcoords[triangle]
    au, av, bu, bv = w[2] - w[0], w[3] - w[1], w[4] - w[0], w[5] - w[1]
    density = math.sqrt(abs(au * bv - av * bu) / math.sqrt(square))
    # Texture coordinates in metres are those of the box around the mesh.
    mu, mv = qx * half[0], qy * half[1]
    if abs(ny) > 0.7:
        mv = qz * half[2]
    elif abs(gx) * half[1] * half[2] > abs(gz) * half[0] * half[1]:
        mu = qz * half[2]
    place = scene.faces[body, 0] + scene.triangle_materials[triangle]
    return nx, ny, nz, place, w[0] + u * au + v * bu, w[1] + u * av + v * bv, density, mu, mv


@nb.njit(**OPTIONS)
def _world_normal(m, x, y, z):
    nx = m[0] * x + m[4] * y + m[8] * z
    ny = m[1] * x + m[5] * y + m[9] * z
    nz = m[2] * x + m[6] * y + m[10] * z
    size = math.sqrt(nx * nx + ny * ny + nz * nz) + 1e-30
    return nx / size, ny / size, nz / size


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
        if towards < 0.5 and away < 1.5:  # excludes the plane of the point itself
            visibility *= 1 - 0.3 * math.exp(-max(away, 0.0) / 0.3)
    return visibility


@nb.njit(**OPTIONS)
def _floor_visibility(cells, start, x, z):
    """Bilinear interpolation of the fraction of ambient light on the floor, 1 outside of the cells."""
    u, v = (x - start[0]) / FLOOR_CELL - 0.5, (z - start[1]) / FLOOR_CELL - 0.5
    j, i = int(math.floor(u)), int(math.floor(v))
    if i < 0 or j < 0 or i + 1 >= cells.shape[0] or j + 1 >= cells.shape[1]:
        return 1.0
    u, v = u - j, v - i
    upper = cells[i, j] * (1 - u) + cells[i, j + 1] * u
    return upper * (1 - v) + v * (cells[i + 1, j] * (1 - u) + cells[i + 1, j + 1] * u)


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
        # A rational fit of arccos(cosine) / sin(arccos(cosine)) / 2 pi. Source: Hill and Heitz, Real-time area
        # lighting: a journey from research to production, SIGGRAPH 2016 course.
        c = abs(cosine)
        weight = (0.8543985 + (0.4965155 + 0.0145206 * c) * c) / (3.4175940 + (4.1616724 + c) * c)
        if cosine < 0:
            weight = 0.5 / math.sqrt(1 - cosine * cosine) - weight
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
def _brightness(light):
    """Of the strongest colour; portals to a darker room have negative colours."""
    return max(abs(light[LIGHT_COLOR]), abs(light[LIGHT_COLOR + 1]), abs(light[LIGHT_COLOR + 2]))


_WINDOW_DEPTH = 0.4  # metres in front of a portal without shadows
_SHADE_RADIUS = 0.25  # metres around a lamp without shadows, for its shade


@nb.njit(**INLINE)
def _irradiance(light, group, x, y, z, nx, ny, nz, a, b):
    """Unshadowed irradiance of a light of unit colour, direction to a point on it, and the distance of that point.

    Args:
        group: light group of the surface.
        a, b: select the point on the light, in [-1, 1].
    """
    kind, size = light[LIGHT_KIND], light[LIGHT_SIZE]
    lx, ly, lz = light[0], light[1], light[2]
    if light[LIGHT_REACHES] >= 0 and light[LIGHT_REACHES] != group:
        return 0.0, 0.0, 1.0, 0.0, 0.0
    if kind == PORTAL:
        wide, high = light[PORTAL_WIDTH], light[PORTAL_HEIGHT]
        square = (lx - x) ** 2 + (ly - y) ** 2 + (lz - z) ** 2
        if square > 4 * (wide * wide + high * high) and 4 * wide * high * _brightness(light) < _LEAST_LIGHT * square:
            return 0.0, 0.0, 1.0, 0.0, 0.0
        power = portal_form_factor(light, x, y, z, nx, ny, nz)
        lx, ly, lz = lx - x, ly - y + _SHARPNESS * b * light[PORTAL_HEIGHT], lz - z
        if light[PORTAL_AXIS] > 0:
            lx += _SHARPNESS * a * light[PORTAL_WIDTH]
        else:
            lz += _SHARPNESS * a * light[PORTAL_WIDTH]
    elif kind == SUN:
        power = nx * lx + ny * ly + nz * lz
        lx, ly, lz = lx + size * a, ly + 0.3 * size * b, lz + size * b
    else:
        lx, ly, lz = lx - x, ly - y, lz - z
        square = lx * lx + ly * ly + lz * lz
        power = (nx * lx + ny * ly + nz * lz) / (math.sqrt(square) * (0.6 + square))
        lx, ly, lz = lx + size * a, ly + 0.3 * size * b, lz + size * b
    away = math.sqrt(lx * lx + ly * ly + lz * lz)
    limit = away
    if kind == SUN:
        limit = 2 * SKY
    elif kind == PORTAL:  # the bars of its window would shadow a part of the rays to it in the whole room
        limit = max(away - _WINDOW_DEPTH, 0.0)
    else:
        limit = max(away - _SHADE_RADIUS, 0.0)
    return power, lx / away, ly / away, lz / away, limit


@nb.njit(**INLINE)
def _direct_light(bodies, lights, last, group, x, y, z, nx, ny, nz, a, b, few):
    """Light (red, green, blue) of lamps, portals and sun at a point of a light group, with shadows.

    Args:
        last: per light, the body that blocked it at the previous point, which is tested first; updated.
        a, b: select a point on each light, in [-1, 1].
        few: whether only strong lights cast shadows.
    """
    kinds, maps = bodies.kinds, bodies.maps
    red, green, blue = 0.0, 0.0, 0.0
    x, y, z = x + 1e-4 * nx, y + 1e-4 * ny, z + 1e-4 * nz
    for k in range(len(lights)):
        light = lights[k]
        power, lx, ly, lz, limit = _irradiance(light, group, x, y, z, nx, ny, nz, a, b)
        strength = power * _brightness(light)
        if strength < _LEAST_LIGHT:
            continue
        if few and strength < _STRONG_LIGHT:
            power *= 0.7
        elif light[LIGHT_KIND] != PORTAL or (light[PORTAL_SHADOWS] > 0 and nx * lx + ny * ly + nz * lz > 0):
            if last[k] >= 0 and 1e-6 < intersect_body(kinds[last[k]], maps[last[k]], x, y, z, lx, ly, lz) < limit:
                continue
            _, blocker, triangle = first_hit(bodies, x, y, z, lx, ly, lz, limit, True, False)
            last[k] = blocker if triangle < 0 else -1
            if blocker >= 0:
                continue
        red += power * light[LIGHT_COLOR]
        green += power * light[LIGHT_COLOR + 1]
        blue += power * light[LIGHT_COLOR + 2]
    return red, green, blue


@nb.njit(**INLINE)
def _shade(scene, last, body, triangle, x, y, z, dx, dy, dz, t, width, a, b, few):
    """Diffuse light (red, green, blue), unit normal and material at the hit of a ray; material -1 is the sky.

    Args:
        t: distance of the hit, metres; any number if `body` is negative.
        width: angle of a pixel times the length of the whole path to the hit, metres.
    """
    if body < 0:
        t = _distance_to_sky(x, y, z, dx, dy, dz)
        red, green, blue = _sky_color(
            scene.materials, scene.sky, (x + t * dx) / SKY, (y + t * dy) / SKY, (z + t * dz) / SKY, width / SKY
        )
        return red, green, blue, 0.0, 0.0, 0.0, -1
    px, py, pz = x + t * dx, y + t * dy, z + t * dz
    density, image_u, image_v = 0.0, 0.0, 0.0
    if triangle >= 0:
        nx, ny, nz, place, image_u, image_v, density, u, v = _mesh_point(scene, body, triangle, px, py, pz, dx, dy, dz)
        half_u, half_v, material = scene.halves[body, 0], scene.halves[body, 1], scene.mesh_materials[place]
    else:
        nx, ny, nz, face, u, v, half_u, half_v = _surface_point(
            scene.bodies.kinds[body], scene.bodies.maps[body], scene.halves[body], px, py, pz
        )
        material = scene.faces[body, face]
    facing = abs(nx * dx + ny * dy + nz * dz)
    width /= max(0.7 * math.sqrt(facing), 0.15)  # between the sides of the pixel's footprint
    room = _room_at(scene.rooms, px + 0.02 * nx, pz + 0.02 * nz)
    if material < 0:
        if ny > 0.5 or ny < -0.5:
            u, v = px, pz
        elif abs(nx) > abs(nz):
            u, v = pz, py
        else:
            u, v = px, py
        material = _room_material(scene.rooms, room, material, py, scene.outside)
    surface = scene.materials[material]
    if surface[KIND] == IMAGE:
        image = scene.bodies.images[int(surface[SIZE_U])]
        red, green, blue = image_color(scene.bodies.texels, image, image_u, image_v, width * density)
        red, green, blue = red * surface[COLOR_A], green * surface[COLOR_A + 1], blue * surface[COLOR_A + 2]
    else:
        red, green, blue = color(surface, u, v, width, half_u, half_v)
    ambient, group = scene.ambient, -1
    if room >= 0:
        ambient, group = scene.rooms[room, AMBIENT:LIGHT_GROUP], int(scene.rooms[room, LIGHT_GROUP])
    around = _ambient_visibility(scene.rooms, room, px, py, pz, nx, ny, nz) * (0.85 - 0.15 * ny)
    if ny < -0.5 and -0.03 < py < 0.03:
        around *= _floor_visibility(scene.floor_light, scene.floor_start, px, pz)
    lr, lg, lb = _direct_light(scene.bodies, scene.lights, last, group, px, py, pz, nx, ny, nz, a, b, few)
    glow = surface[GLOW]
    # Portals to darker rooms take light away, in dark corners possibly more than there is.
    return (
        red * (max(ambient[0] * around + lr, 0.1 * ambient[0] * around) + glow),
        green * (max(ambient[1] * around + lg, 0.1 * ambient[1] * around) + glow),
        blue * (max(ambient[2] * around + lb, 0.1 * ambient[2] * around) + glow),
        nx,
        ny,
        nz,
        material,
    )


@nb.njit(**OPTIONS)
def _fresnel(facing):
    """Reflectance of glass or varnish. Source: Schlick 1994, refractive index 1.5."""
    return 0.04 + 0.96 * (1 - facing) ** 5


@nb.njit(**INLINE)
def _trace_ray(scene, last, queue, x, y, z, dx, dy, dz, pixel, a, b):
    """Light (red, green, blue), distance, unit normal and material of the first hit of a ray behind any glass.

    Args:
        queue: workspace for rays (4 9): origin, direction, weight, length of the path to the origin, and kind.
        pixel: angle of a pixel, radians.
        a, b: select a point on each light, in [-1, 1].
    """
    red, green, blue = 0.0, 0.0, 0.0
    seen, seen_x, seen_y, seen_z, seen_material = 0.0, 0.0, 0.0, 0.0, -1
    queue[0, 0], queue[0, 1], queue[0, 2], queue[0, 3], queue[0, 4], queue[0, 5] = x, y, z, dx, dy, dz
    queue[0, 6], queue[0, 7], queue[0, 8] = 1, 0, _FIRST
    waiting = 1
    while waiting:
        waiting -= 1
        ray = queue[waiting]
        x, y, z, dx, dy, dz, weight, length, kind = ray
        t, body, triangle = first_hit(scene.bodies, x, y, z, dx, dy, dz, math.inf, False, kind == _FIRST)
        share, reflected = 0.0, _WEAK
        if body >= 0 and scene.bodies.kinds[body] == GLASS:
            nx, ny, nz, _, _, _, _, _ = _surface_point(
                GLASS, scene.bodies.maps[body], scene.halves[body], x + t * dx, y + t * dy, z + t * dz
            )
            once = _fresnel(abs(nx * dx + ny * dy + nz * dz))
            share = 2 * once / (1 + once)  # both faces of the pane
            ray[6], ray[8] = weight * (1 - share), _BEHIND
            waiting += 1
        else:
            if body < 0:
                t = _distance_to_sky(x, y, z, dx, dy, dz)
            width = pixel * (length + t) if body >= 0 else pixel * SKY
            r, g, b_, nx, ny, nz, material = _shade(
                scene, last, body, triangle, x, y, z, dx, dy, dz, t, width, a, b, kind == _WEAK
            )
            if kind <= _BEHIND:
                seen, seen_x, seen_y, seen_z, seen_material = t, nx, ny, nz, material
                if material >= 0 and scene.materials[material, MIRROR] > 0:
                    share, reflected = scene.materials[material, MIRROR], _MIRRORED
                elif material >= 0 and scene.materials[material, GLOSS] > 0:
                    share = scene.materials[material, GLOSS] * _fresnel(abs(nx * dx + ny * dy + nz * dz))
                    share = max(share - _LEAST_REFLECTION, 0.0)
            red, green, blue = (
                red + weight * (1 - share) * r,
                green + weight * (1 - share) * g,
                blue + weight * (1 - share) * b_,
            )
        if share > 0:
            facing = nx * dx + ny * dy + nz * dz
            ray = queue[waiting]
            ray[0] = x + t * dx - 1e-4 * facing * nx
            ray[1] = y + t * dy - 1e-4 * facing * ny
            ray[2] = z + t * dz - 1e-4 * facing * nz
            ray[3], ray[4], ray[5] = dx - 2 * facing * nx, dy - 2 * facing * ny, dz - 2 * facing * nz
            ray[6], ray[7], ray[8] = weight * share, length + t, reflected
            waiting += 1
    return red, green, blue, seen, seen_x, seen_y, seen_z, seen_material


@nb.njit(**OPTIONS)
def _distance_to_sky(x, y, z, dx, dy, dz):
    b = x * dx + y * dy + z * dz
    return -b + math.sqrt(b * b + SKY * SKY - (x * x + y * y + z * z))


@nb.njit(**OPTIONS)
def _direction(pose, height, i, j):
    """World direction through a point (row i, column j; pixel centres at half-integers) of a panorama."""
    longitude, latitude = math.pi * j / height - math.pi, math.pi * i / height - 0.5 * math.pi
    x, y, z = math.cos(latitude) * math.sin(longitude), math.sin(latitude), math.cos(latitude) * math.cos(longitude)
    return (
        pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z,
        pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z,
        pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z,
    )


@nb.njit(**OPTIONS)
def _find_edges(image, depth, points, normals, shown):
    """Pixels that differ from a neighbour."""
    height, width = depth.shape
    edges, pixel = np.zeros((height, width), np.bool_), math.pi / height
    for i in range(height):
        for j in range(width):
            for k, m in ((i, (j + 1) % width), (min(i + 1, height - 1), j)):
                if _is_edge(image, depth, points, normals, shown, i, j, k, m, pixel):
                    edges[i, j] = edges[k, m] = True
    return edges


@nb.njit(**OPTIONS)
def _is_edge(image, depth, points, normals, shown, i, j, k, m, pixel):
    """Whether pixels (i, j) and (k, m) show different surfaces, or colours that differ by more than 10 percent."""
    if shown[i, j] != shown[k, m]:
        return True
    if shown[i, j] < 0:
        return False
    along, off, other = 0.0, 0.0, 0.0
    for c in range(3):
        step = points[k, m, c] - points[i, j, c]
        along += normals[i, j, c] * normals[k, m, c]
        off += step * normals[i, j, c]
        other += step * normals[k, m, c]
    if along < 0.9 or abs(off) + abs(other) > 4 * pixel * min(depth[i, j], depth[k, m]):
        return True
    contrast = 0.0
    for c in range(3):
        contrast = max(contrast, abs(image[i, j, c] - image[k, m, c]) / (image[i, j, c] + image[k, m, c] + 0.05))
    return contrast > 0.05


@nb.njit(**OPTIONS)
def trace_panorama(scene, pose, samples, image, depth):
    """Fill `image` (H W 3) with linear light and `depth` (H W) with metres, 0 where a mirror is seen.

    One ray passes through each pixel centre. Pixels that differ from a neighbour then get the mean of samples x samples
    rays.
    """
    height, width = depth.shape
    last, queue = np.full(len(scene.lights), -1), np.empty((4, 9))
    points, normals = np.empty((height, width, 3)), np.empty((height, width, 3))
    shown = np.empty((height, width), np.int64)
    chosen = np.ones((height, width), np.bool_)
    x, y, z = pose[0, 3], pose[1, 3], pose[2, 3]
    for step in range(2 if samples > 1 else 1):
        rays = 1 if step == 0 else samples * samples - 1
        if step == 1:
            chosen = _find_edges(image, depth, points, normals, shown)
        for i in range(height):
            for j in range(width):
                if not chosen[i, j]:
                    continue
                total_red, total_green, total_blue = 0.0, 0.0, 0.0
                if step == 1:
                    total_red, total_green, total_blue = image[i, j, 0], image[i, j, 1], image[i, j, 2]
                for k in range(step, step + rays):
                    row, column = i + 0.5, j + 0.5
                    if step == 1:  # on one or two rings around the centre
                        radius, angle = 0.36 if rays < 4 else 0.25 + 0.2 * (k % 2), 2 * math.pi * (k + 0.25) / rays
                        row, column = row + radius * math.sin(angle), column + radius * math.cos(angle)
                    dx, dy, dz = _direction(pose, height, row, column)
                    # Points on lights follow the R2 sequence from a random start.
                    a, b = 0.7548776662466927 * k + hash_unit(i, j, 1), 0.5698402909980532 * k + hash_unit(i, j, 2)
                    a, b = 2 * (a - math.floor(a)) - 1, 2 * (b - math.floor(b)) - 1
                    red, green, blue, t, nx, ny, nz, material = _trace_ray(
                        scene, last, queue, x, y, z, dx, dy, dz, math.pi / height, a, b
                    )
                    total_red, total_green, total_blue = total_red + red, total_green + green, total_blue + blue
                    if step == 0:
                        points[i, j, 0], points[i, j, 1], points[i, j, 2] = t * dx, t * dy, t * dz
                        normals[i, j, 0], normals[i, j, 1], normals[i, j, 2] = nx, ny, nz
                        depth[i, j], shown[i, j] = t, material
                image[i, j, 0] = total_red / (step + rays)
                image[i, j, 1] = total_green / (step + rays)
                image[i, j, 2] = total_blue / (step + rays)
    for i in range(height):
        for j in range(width):
            if shown[i, j] >= 0 and scene.materials[shown[i, j], MIRROR] > 0:
                depth[i, j] = 0
