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

from pansplat_homes.bvh import CYLINDER, ELLIPSOID, GLASS, Bodies, first_hit, intersect_body, to_local
from pansplat_homes.textures import (
    COLOR_A,
    COLOR_B,
    COLOR_C,
    GLOSS,
    GLOW,
    IMAGE,
    KIND,
    MIRROR,
    SEED,
    SIZE_U,
    color,
    fractal,
    hash_unit,
    image_color,
)
from pansplat_homes.vectors import (
    INLINE,
    OPTIONS,
    advance,
    cross,
    dot,
    mix,
    multiply,
    scale,
    subtract,
    take,
    unit,
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
def _surface_point(kind, m, half, point):
    """Unit normal, face (two per axis; 0 for round sides), texture coordinates and half size of the face, metres."""
    q = to_local(m, point)
    a, b, c = abs(q[0]), abs(q[1]), abs(q[2])
    normal, face = (0.0, 0.0, 0.0), 0
    u, v, half_u, half_v = q[0] * half[0], q[1] * half[1], half[0], half[1]
    if kind == ELLIPSOID:
        normal = q
        u, v = math.atan2(q[0], q[2]) * half[0], math.asin(min(1.0, max(-1.0, q[1]))) * half[1]
    elif kind == CYLINDER and a * a + c * c > b * b:
        normal = (q[0], 0.0, q[2])
        u, half_u = math.atan2(q[0], q[2]) * half[0], math.pi * half[0]
    elif kind == CYLINDER or (b >= a and b >= c):
        normal, face = (0.0, math.copysign(1.0, q[1]), 0.0), 3 if q[1] > 0 else 2
        v, half_v = q[2] * half[2], half[2]
    elif a >= c:
        normal, face = (math.copysign(1.0, q[0]), 0.0, 0.0), 1 if q[0] > 0 else 0
        u, half_u = q[2] * half[2], half[2]
    else:
        normal, face = (0.0, 0.0, math.copysign(1.0, q[2])), 5 if q[2] > 0 else 4
    return _world_normal(m, normal), face, u, v, half_u, half_v


@nb.njit(**INLINE)
def _mesh_point(scene, body, triangle, point, direction):
    """The surface at a point of a triangle.

    Returns:
        Unit normal towards the origin of the ray, place in `mesh_materials`, image coordinates, their change per metre,
        and texture coordinates in metres.
    """
    m, t, c = scene.bodies.maps[body], scene.bodies.triangles[triangle], scene.normals[triangle]
    half, q = take(scene.halves[body], 0), to_local(m, point)
    # Barycentric coordinates, in metres.
    a, b, r = multiply(take(t, 3), half), multiply(take(t, 6), half), multiply(subtract(q, take(t, 0)), half)
    aa, ab, bb, ra, rb = dot(a, a), dot(a, b), dot(b, b), dot(r, a), dot(r, b)
    square = max(aa * bb - ab * ab, 1e-30)
    u, v = (ra * bb - rb * ab) / square, (rb * aa - ra * ab) / square
    # Normals of the plane and of the interpolated corners, in the space of the mesh.
    across, corner = cross(take(t, 3), take(t, 6)), take(c, 0)
    smooth = advance(corner, u, subtract(take(c, 3), corner))
    smooth = advance(smooth, v, subtract(take(c, 6), corner))
    plane, normal = _world_normal(m, across), _world_normal(m, smooth)
    if dot(plane, direction) > 0:
        plane = scale(plane, -1.0)
    along = dot(plane, normal)
    if along < 0:
        normal = scale(normal, -1.0)
    if abs(along) < 0.3 or dot(normal, direction) > 0:
        normal = plane
    w = scene.bodies.texcoords[triangle]
    au, av, bu, bv = w[2] - w[0], w[3] - w[1], w[4] - w[0], w[5] - w[1]
    density = math.sqrt(abs(au * bv - av * bu) / math.sqrt(square))
    # Texture coordinates in metres are those of the box around the mesh.
    mu, mv = q[0] * half[0], q[1] * half[1]
    if abs(normal[1]) > 0.7:
        mv = q[2] * half[2]
    elif abs(across[0]) * half[1] * half[2] > abs(across[2]) * half[0] * half[1]:
        mu = q[2] * half[2]
    place = scene.faces[body, 0] + scene.triangle_materials[triangle]
    return normal, place, w[0] + u * au + v * bu, w[1] + u * av + v * bv, density, mu, mv


@nb.njit(**OPTIONS)
def _world_normal(m, n):
    """Unit normal in the world of a normal in the space of a body."""
    x = m[0] * n[0] + m[4] * n[1] + m[8] * n[2]
    y = m[1] * n[0] + m[5] * n[1] + m[9] * n[2]
    z = m[2] * n[0] + m[6] * n[1] + m[10] * n[2]
    size = math.sqrt(x * x + y * y + z * z) + 1e-30
    return x / size, y / size, z / size


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
def _ambient_visibility(rooms, room, point, normal):
    """Fraction of the ambient light at a point; below 1 near the edges and corners of its room."""
    if room < 0:
        return 1.0
    r, (x, y, z), (nx, ny, nz) = rooms[room], point, normal
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
def _sky_color(materials, sky, direction, w):
    """Light of sky, clouds and skyline in a direction from the world origin; `sky` is the index of a material."""
    up = -direction[1]
    around = math.atan2(direction[0], direction[2]) * 4
    m, seed = materials[sky], int(materials[sky, SEED])
    cloud = unit(0.5 + 2.5 * fractal(around + 3 * up, 9 * up, 1.5, 5, w * 4, seed)) * 0.6
    light = mix(mix(take(m, COLOR_B), take(m, COLOR_A), unit(up) ** 0.5), (1.0, 1.0, 1.0), cloud)
    ridge = 0.08 + 0.25 * fractal(around, 0.3, 0.8, 6, w * 4, seed + 5)
    land = unit(0.5 + (ridge - up) / max(w, 1e-3))
    shade = max(0.1, 0.6 + 1.2 * fractal(around, 8 * up, 0.5, 5, w * 4, seed + 9))
    return scale(mix(light, scale(take(m, COLOR_C), shade), land), m[GLOW])


@nb.njit(**INLINE)
def _towards(corner):
    return scale(corner, 1 / (math.sqrt(dot(corner, corner)) + 1e-9))


@nb.njit(**OPTIONS)
def portal_form_factor(light, point, normal):
    """Fraction of a surface element's light that comes from an upright rectangle.

    The vector form factor of the rectangle is exact (Lambert's formula). A sphere of equal vector form factor then
    gives the part above the plane of the surface, which is smooth where that plane cuts the rectangle.
    """
    side = (0.0, 0.0, light[PORTAL_WIDTH])
    if light[PORTAL_AXIS] > 0:
        side = (light[PORTAL_WIDTH], 0.0, 0.0)
    centre, high = subtract(take(light, 0), point), (0.0, light[PORTAL_HEIGHT], 0.0)
    form = (0.0, 0.0, 0.0)
    p = _towards(advance(advance(centre, 1.0, high), -1.0, side))
    for k in range(4):
        along, up = (1.0 if k < 2 else -1.0), (1.0 if k == 0 or k == 3 else -1.0)
        q = _towards(advance(advance(centre, up, high), along, side))
        cosine = min(0.9999, max(-0.9999, dot(p, q)))
        # A rational fit of arccos(cosine) / sin(arccos(cosine)) / 2 pi. Source: Hill and Heitz, Real-time area
        # lighting: a journey from research to production, SIGGRAPH 2016 course.
        c = abs(cosine)
        weight = (0.8543985 + (0.4965155 + 0.0145206 * c) * c) / (3.4175940 + (4.1616724 + c) * c)
        if cosine < 0:
            weight = 0.5 / math.sqrt(1 - cosine * cosine) - weight
        form = advance(form, weight, cross(p, q))
        p = q
    size, along = math.sqrt(dot(form, form)), dot(form, normal)
    if dot(form, centre) < 0:
        along = -along
    return max(0.0, (size * size + along) / (size + 1))


@nb.njit(**OPTIONS)
def _brightness(light):
    """Of the strongest colour; portals to a darker room have negative colours."""
    return max(abs(light[LIGHT_COLOR]), abs(light[LIGHT_COLOR + 1]), abs(light[LIGHT_COLOR + 2]))


_WINDOW_DEPTH = 0.4  # metres in front of a portal without shadows
_SHADE_RADIUS = 0.25  # metres around a lamp without shadows, for its shade


@nb.njit(**INLINE)
def _irradiance(light, group, point, normal, a, b):
    """Unshadowed irradiance of a light of unit colour, direction to a point on it, and the distance of that point.

    Args:
        group: light group of the surface.
        a, b: select the point on the light, in [-1, 1].
    """
    kind, size, position = light[LIGHT_KIND], light[LIGHT_SIZE], take(light, 0)
    unlit = 0.0, (0.0, 1.0, 0.0), 0.0
    if light[LIGHT_REACHES] >= 0 and light[LIGHT_REACHES] != group:
        return unlit
    way = subtract(position, point)
    square = dot(way, way)
    if kind == PORTAL:
        wide, high = light[PORTAL_WIDTH], light[PORTAL_HEIGHT]
        if square > 4 * (wide * wide + high * high) and 4 * wide * high * _brightness(light) < _LEAST_LIGHT * square:
            return unlit
        power = portal_form_factor(light, point, normal)
        along, up = _SHARPNESS * a * wide, _SHARPNESS * b * high
        shift = (along, up, 0.0) if light[PORTAL_AXIS] > 0 else (0.0, up, along)
        margin = _WINDOW_DEPTH  # the bars of its window would shadow a part of the rays to it in the whole room
    else:
        shift, margin = (size * a, 0.3 * size * b, size * b), _SHADE_RADIUS
        if kind == SUN:
            power, way = dot(normal, position), position
        else:
            power = dot(normal, way) / (math.sqrt(square) * (0.6 + square))
    way = advance(way, 1.0, shift)
    away = math.sqrt(dot(way, way))
    limit = 2 * SKY if kind == SUN else max(away - margin, 0.0)
    return power, (way[0] / away, way[1] / away, way[2] / away), limit


@nb.njit(**INLINE)
def _direct_light(bodies, lights, last, group, point, normal, a, b, few):
    """Light (red, green, blue) of lamps, portals and sun at a point of a light group, with shadows.

    Args:
        last: per light, the body that blocked it at the previous point, which is tested first; updated.
        a, b: select a point on each light, in [-1, 1].
        few: whether only strong lights cast shadows.
    """
    total, point = (0.0, 0.0, 0.0), advance(point, 1e-4, normal)
    for k in range(len(lights)):
        light = lights[k]
        power, way, limit = _irradiance(light, group, point, normal, a, b)
        strength = power * _brightness(light)
        if strength < _LEAST_LIGHT:
            continue
        if few and strength < _STRONG_LIGHT:
            power *= 0.7
        elif light[LIGHT_KIND] != PORTAL or (light[PORTAL_SHADOWS] > 0 and dot(normal, way) > 0):
            other = last[k]
            if other >= 0 and 1e-6 < intersect_body(bodies.kinds[other], bodies.maps[other], point, way) < limit:
                continue
            _, blocker, triangle = first_hit(bodies, point, way, limit, True, False)
            last[k] = blocker if triangle < 0 else -1
            if blocker >= 0:
                continue
        total = advance(total, power, take(light, LIGHT_COLOR))
    return total


@nb.njit(**INLINE)
def _shade(scene, last, body, triangle, origin, direction, t, width, a, b, few):
    """Diffuse light (red, green, blue), unit normal and material at the hit of a ray; material -1 is the sky.

    Args:
        t: distance of the hit, metres.
        width: angle of a pixel times the length of the whole path to the hit, metres.
    """
    point = advance(origin, t, direction)
    if body < 0:
        on_sphere = (point[0] / SKY, point[1] / SKY, point[2] / SKY)
        return _sky_color(scene.materials, scene.sky, on_sphere, width / SKY), (0.0, 0.0, 0.0), -1
    density, image_u, image_v = 0.0, 0.0, 0.0
    if triangle >= 0:
        normal, place, image_u, image_v, density, u, v = _mesh_point(scene, body, triangle, point, direction)
        half_u, half_v, material = scene.halves[body, 0], scene.halves[body, 1], scene.mesh_materials[place]
    else:
        normal, face, u, v, half_u, half_v = _surface_point(
            scene.bodies.kinds[body], scene.bodies.maps[body], scene.halves[body], point
        )
        material = scene.faces[body, face]
    # Between the sides of the pixel's footprint.
    width /= max(0.7 * math.sqrt(abs(dot(normal, direction))), 0.15)
    room = _room_at(scene.rooms, point[0] + 0.02 * normal[0], point[2] + 0.02 * normal[2])
    if material < 0:
        u, v = point[0], point[1]
        if abs(normal[1]) > 0.5:
            v = point[2]
        elif abs(normal[0]) > abs(normal[2]):
            u = point[2]
        material = _room_material(scene.rooms, room, material, point[1], scene.outside)
    surface = scene.materials[material]
    if surface[KIND] == IMAGE:
        image = scene.bodies.images[int(surface[SIZE_U])]
        shown = image_color(scene.bodies.texels, image, image_u, image_v, width * density)
        reflectance = multiply(shown, take(surface, COLOR_A))
    else:
        reflectance = color(surface, u, v, width, half_u, half_v)
    ambient, group = take(scene.ambient, 0), -1
    if room >= 0:
        ambient, group = take(scene.rooms[room], AMBIENT), int(scene.rooms[room, LIGHT_GROUP])
    around = _ambient_visibility(scene.rooms, room, point, normal) * (0.85 - 0.15 * normal[1])
    if normal[1] < -0.5 and -0.03 < point[1] < 0.03:
        around *= _floor_visibility(scene.floor_light, scene.floor_start, point[0], point[2])
    direct = _direct_light(scene.bodies, scene.lights, last, group, point, normal, a, b, few)
    # Portals to darker rooms take light away, in dark corners possibly more than there is.
    light = (
        max(ambient[0] * around + direct[0], 0.1 * ambient[0] * around) + surface[GLOW],
        max(ambient[1] * around + direct[1], 0.1 * ambient[1] * around) + surface[GLOW],
        max(ambient[2] * around + direct[2], 0.1 * ambient[2] * around) + surface[GLOW],
    )
    return multiply(reflectance, light), normal, material


@nb.njit(**OPTIONS)
def _fresnel(facing):
    """Reflectance of glass or varnish. Source: Schlick 1994, refractive index 1.5."""
    return 0.04 + 0.96 * (1 - facing) ** 5


@nb.njit(**INLINE)
def _trace_ray(scene, last, queue, origin, direction, pixel, a, b):
    """Light (red, green, blue), distance, unit normal and material of the first hit of a ray behind any glass.

    Args:
        queue: workspace for rays (4 9): origin, direction, weight, length of the path to the origin, and kind.
        pixel: angle of a pixel, radians.
        a, b: select a point on each light, in [-1, 1].
    """
    total, seen, seen_normal, seen_material = (0.0, 0.0, 0.0), 0.0, (0.0, 0.0, 0.0), -1
    _enqueue(queue[0], origin, direction, 1.0, 0.0, _FIRST)
    waiting = 1
    while waiting:
        waiting -= 1
        ray = queue[waiting]
        origin, direction, weight, length, kind = take(ray, 0), take(ray, 3), ray[6], ray[7], ray[8]
        t, body, triangle = first_hit(scene.bodies, origin, direction, math.inf, False, kind == _FIRST)
        share, reflected = 0.0, _WEAK
        if body >= 0 and scene.bodies.kinds[body] == GLASS:
            point = advance(origin, t, direction)
            normal, _, _, _, _, _ = _surface_point(GLASS, scene.bodies.maps[body], scene.halves[body], point)
            once = _fresnel(abs(dot(normal, direction)))
            share = 2 * once / (1 + once)  # both faces of the pane
            ray[6], ray[8] = weight * (1 - share), _BEHIND
            waiting += 1
        else:
            if body < 0:
                t = _distance_to_sky(origin, direction)
            width = pixel * (length + t) if body >= 0 else pixel * SKY
            light, normal, material = _shade(
                scene, last, body, triangle, origin, direction, t, width, a, b, kind == _WEAK
            )
            if kind <= _BEHIND:
                seen, seen_normal, seen_material = t, normal, material
                if material >= 0 and scene.materials[material, MIRROR] > 0:
                    share, reflected = scene.materials[material, MIRROR], _MIRRORED
                elif material >= 0 and scene.materials[material, GLOSS] > 0:
                    share = scene.materials[material, GLOSS] * _fresnel(abs(dot(normal, direction)))
                    share = max(share - _LEAST_REFLECTION, 0.0)
            total = advance(total, weight * (1 - share), light)
        if share > 0:
            facing = dot(normal, direction)
            start = advance(advance(origin, t, direction), -1e-4 * facing, normal)
            turned = advance(direction, -2 * facing, normal)
            _enqueue(queue[waiting], start, turned, weight * share, length + t, reflected)
            waiting += 1
    return total, seen, seen_normal, seen_material


@nb.njit(**INLINE)
def _enqueue(ray, origin, direction, weight, length, kind):
    ray[0], ray[1], ray[2] = origin
    ray[3], ray[4], ray[5] = direction
    ray[6], ray[7], ray[8] = weight, length, kind


@nb.njit(**OPTIONS)
def _distance_to_sky(origin, direction):
    b = dot(origin, direction)
    return -b + math.sqrt(b * b + SKY * SKY - dot(origin, origin))


@nb.njit(**OPTIONS)
def _direction(pose, height, i, j):
    """World direction through a point (row i, column j; pixel centres at half-integers) of a panorama."""
    longitude, latitude = math.pi * j / height - math.pi, math.pi * i / height - 0.5 * math.pi
    d = math.cos(latitude) * math.sin(longitude), math.sin(latitude), math.cos(latitude) * math.cos(longitude)
    return dot(take(pose[0], 0), d), dot(take(pose[1], 0), d), dot(take(pose[2], 0), d)


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
    step = subtract(take(points[k, m], 0), take(points[i, j], 0))
    here, there = take(normals[i, j], 0), take(normals[k, m], 0)
    off = abs(dot(step, here)) + abs(dot(step, there))
    if dot(here, there) < 0.9 or off > 4 * pixel * min(depth[i, j], depth[k, m]):
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
    origin = pose[0, 3], pose[1, 3], pose[2, 3]
    for step in range(2 if samples > 1 else 1):
        rays = 1 if step == 0 else samples * samples - 1
        if step == 1:
            chosen = _find_edges(image, depth, points, normals, shown)
        for i in range(height):
            for j in range(width):
                if not chosen[i, j]:
                    continue
                total = take(image[i, j], 0) if step == 1 else (0.0, 0.0, 0.0)
                for k in range(step, step + rays):
                    row, column = i + 0.5, j + 0.5
                    if step == 1:  # on one or two rings around the centre
                        radius, angle = 0.36 if rays < 4 else 0.25 + 0.2 * (k % 2), 2 * math.pi * (k + 0.25) / rays
                        row, column = row + radius * math.sin(angle), column + radius * math.cos(angle)
                    direction = _direction(pose, height, row, column)
                    # Points on lights follow the R2 sequence from a random start.
                    a, b = 0.7548776662466927 * k + hash_unit(i, j, 1), 0.5698402909980532 * k + hash_unit(i, j, 2)
                    a, b = 2 * (a - math.floor(a)) - 1, 2 * (b - math.floor(b)) - 1
                    light, t, normal, material = _trace_ray(
                        scene, last, queue, origin, direction, math.pi / height, a, b
                    )
                    total = advance(total, 1.0, light)
                    if step == 0:
                        points[i, j, 0], points[i, j, 1], points[i, j, 2] = scale(direction, t)
                        normals[i, j, 0], normals[i, j, 1], normals[i, j, 2] = normal
                        depth[i, j], shown[i, j] = t, material
                for c in range(3):
                    image[i, j, c] = total[c] / (step + rays)
    for i in range(height):
        for j in range(width):
            if shown[i, j] >= 0 and scene.materials[shown[i, j], MIRROR] > 0:
                depth[i, j] = 0
