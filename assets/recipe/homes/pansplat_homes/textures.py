"""Procedural textures, averaged over the footprint of a pixel.

Every pattern gets the width `w` of a pixel on the surface, metres. Steps are integrated exactly, and octaves of noise
finer than `w` are omitted. Nearby views therefore agree, as photographs do.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numba as nb
import numpy as np
from numpy.typing import NDArray

from pansplat_homes.vectors import OPTIONS, advance, mix, scale, subtract, take, unit


class Pattern(IntEnum):
    """Kinds of patterns; the numbers select them in `color`."""

    PLAIN = 0
    PLANKS = 1
    TILES = 2
    STRIPES = 3
    STONE = 4
    PICTURE = 5
    TEXT = 6
    BOOKS = 7
    RUG = 8
    TERRAZZO = 9


# Columns of a material.
KIND, COLOR_A, COLOR_B, COLOR_C = 0, 1, 4, 7
SIZE_U, SIZE_V, FRACTION, MOTTLE, SEED, GLOW, GLOSS, MIRROR, NUMBERS = range(10, 19)

IMAGE = 100
"""Kind of a material with an image in place of a pattern: `SIZE_U` is its index, the first colour multiplies it."""
_BYTES = np.arange(256) / 255
_LINEAR = np.where(_BYTES <= 0.04045, _BYTES / 12.92, ((_BYTES + 0.055) / 1.055) ** 2.4)


@nb.njit(**OPTIONS)
def hash_unit(i, j, seed):
    """A pseudo-random number in [0, 1) from two integers and a seed."""
    h = (int(i) * 374761393 + int(j) * 668265263 + int(seed) * 974634721) & 0xFFFFFFFF
    h = ((h ^ (h >> 15)) * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1103515245) & 0xFFFFFFFF
    return (h ^ (h >> 16)) / 4294967296.0


@nb.njit(**OPTIONS)
def noise(x, y, seed):
    """Smooth value noise in [0, 1] with a wavelength of about 2."""
    i, j = math.floor(x), math.floor(y)
    fx, fy = x - i, y - j
    fx, fy = fx * fx * (3 - 2 * fx), fy * fy * (3 - 2 * fy)
    low = hash_unit(i, j, seed) * (1 - fx) + hash_unit(i + 1, j, seed) * fx
    high = hash_unit(i, j + 1, seed) * (1 - fx) + hash_unit(i + 1, j + 1, seed) * fx
    return low * (1 - fy) + high * fy


@nb.njit(**OPTIONS)
def fractal(u, v, size, octaves, w, seed):
    """Fractal noise with mean 0; the first octave is `size` metres wide, octaves finer than `w` fade out."""
    total, gain = 0.0, 1.0
    for octave in range(octaves):
        shown = unit(1.5 - w / size)
        if shown <= 0:
            break
        total += gain * shown * (noise(u / size + 7.3 * octave, v / size - 3.1 * octave, seed + octave) - 0.5)
        gain *= 0.55
        size *= 0.5
    return total


@nb.njit(**OPTIONS)
def pulse(x, share, w):
    """A pulse wave of period 1 that is 1 in the first `share` of a period, averaged over a window of width `w`."""
    if w >= 1:
        return share
    a, b = x - 0.5 * w, x + 0.5 * w
    if w < 1e-6:
        return 1.0 if x - math.floor(x) < share else 0.0
    fa, fb = math.floor(a), math.floor(b)
    return ((fb - fa) * share + min(b - fb, share) - min(a - fa, share)) / w


@nb.njit(**OPTIONS)
def _mix(material, first, second, t):
    return mix(take(material, first), take(material, second), unit(t))


@nb.njit(**OPTIONS)
def _per_cell(cell, size, w):
    """A random tone `cell` in [0, 1), centred at 0; it fades out where pattern cells are as small as pixels."""
    return (cell - 0.5) * unit(1.5 - w / size)


@nb.njit(**OPTIONS)
def _planks(material, u, v, w, seed):
    wide, long = material[SIZE_U], material[SIZE_V]
    if wide > long:  # upright boards
        wide, long, u, v = long, wide, v, u
    row = math.floor(v / wide)
    along = u / long + hash_unit(row, 3, seed)
    tone = 0.5 + 0.8 * _per_cell(hash_unit(row, math.floor(along), seed), wide, w)
    tone += 1.2 * fractal(u * 0.12, v + 0.3 * tone, 0.05, 4, w, seed) * 0.8
    joint = max(pulse(v / wide, material[FRACTION], w / wide), pulse(along, material[FRACTION] * wide / long, w / long))
    return scale(_mix(material, COLOR_A, COLOR_B, tone), 1 - 0.7 * joint)


@nb.njit(**OPTIONS)
def _tiles(material, u, v, w, seed):
    size_u, size_v, share = material[SIZE_U], material[SIZE_V], material[FRACTION]
    row = math.floor(v / size_v)
    shifted = u / size_u + (0.5 * (row % 2) if size_u > 1.5 * size_v else 0.0)  # long tiles are laid as bricks
    column = math.floor(shifted)
    joint = 1 - (1 - pulse(shifted, share * size_v / size_u, w / size_u)) * (1 - pulse(v / size_v, share, w / size_v))
    small = min(size_u, size_v)
    tone = 0.3 + 0.6 * _per_cell(hash_unit(row, column, seed), small, w)
    if material[MOTTLE] > 0.5 and hash_unit(seed, 5, 5) < 0.5:  # a chequered floor
        tone += 0.7 * ((row + column) % 2) * unit(1.5 - w / small)
    tone += 0.5 * fractal(u, v, 0.5 * small, 3, w, seed + 9)
    return mix(_mix(material, COLOR_A, COLOR_B, tone), take(material, COLOR_C), joint)


@nb.njit(**OPTIONS)
def _stripes(material, u, v, w, seed):
    size = material[SIZE_U]
    wide = pulse(u / size, material[FRACTION], w / size)
    narrow = pulse(u / size + 0.3, 0.12, w / size)
    return mix(_mix(material, COLOR_A, COLOR_B, wide), take(material, COLOR_C), narrow)


@nb.njit(**OPTIONS)
def _stone(material, u, v, w, seed):
    size = material[SIZE_U]
    turbulent = fractal(u, v, size, 6, w, seed)
    if material[FRACTION] > 0.5:  # veins
        vein = 1 - abs(math.sin((u + 0.7 * v) / size * 3 + 6 * turbulent))
        return _mix(material, COLOR_A, COLOR_B, vein * vein * vein * unit(1.5 - 2 * w / size))
    return _mix(material, COLOR_A, COLOR_B, 0.5 + 1.3 * turbulent)


@nb.njit(**OPTIONS)
def _picture(material, u, v, w, seed, half_u, half_v):
    """A noisy background with twelve discs and bars of random colours."""
    x, y = u / half_u, v / half_v
    w /= min(half_u, half_v)
    painted = _mix(material, COLOR_A, COLOR_B, 0.5 + 0.5 * y + 1.5 * fractal(x, y, 0.8, 5, w, seed))
    for k in range(12):
        cx, cy = 2.2 * hash_unit(k, 0, seed) - 1.1, 2.2 * hash_unit(k, 1, seed) - 1.1
        size = 0.06 + 0.4 * hash_unit(k, 2, seed) ** 2
        if hash_unit(k, 3, seed) < 0.5:
            inside = size - math.hypot(x - cx, y - cy)
        else:
            inside = min(size - abs(x - cx), size * (0.2 + hash_unit(k, 4, seed)) - abs(y - cy))
        cover = unit(0.5 + inside / max(w, 1e-4))
        if cover > 0:
            shade = 1 + fractal(x, y, 0.3, 3, w, seed + k)
            grey = 0.5 * hash_unit(k, 8, seed) ** 2
            red, green, blue = hash_unit(k, 5, seed), hash_unit(k, 6, seed), hash_unit(k, 7, seed)
            disc = grey + 0.5 * red**2, grey + 0.5 * green**2, grey + 0.5 * blue**2
            painted = mix(painted, scale(disc, shade), cover)
    return max(painted[0], 0.0), max(painted[1], 0.0), max(painted[2], 0.0)


@nb.njit(**OPTIONS)
def _text(material, u, v, w, seed, half_u, half_v):
    """Lines of words of random letters on a plain background, with a margin; some lines are short."""
    tall = material[SIZE_U]
    line = math.floor(v / (1.6 * tall))
    y = v / tall - 1.6 * line
    letter = math.floor(u / (0.62 * tall))
    end = half_u * (0.85 if hash_unit(line, 8, seed) < 0.8 else 0.85 * (2 * hash_unit(line, 9, seed) - 1))
    ink = 0.0
    if abs(v) < 0.88 * half_v and -0.88 * half_u < u < end and y < 1 and hash_unit(letter, line, seed) > 0.17:
        if w > 0.35 * tall:
            ink = 0.45
        else:
            column, row = math.floor((u / (0.62 * tall) - letter) * 6), math.floor(y * 7)
            if column < 5:
                ink = 1.0 if hash_unit(column + 8 * row, letter + 131 * line, seed + 1) < 0.5 else 0.0
                ink += (0.5 - ink) * unit(w / (0.2 * tall) - 0.3)
    ink *= unit(2.0 - 1.2 * w / tall) if w > tall else 1.0
    return _mix(material, COLOR_A, COLOR_B, ink)


@nb.njit(**OPTIONS)
def _books(material, u, v, w, seed):
    """Spines of books of several widths, most with a title band."""
    size = material[SIZE_U]
    x = u / size + 0.6 * noise(1.3 * u / size, 0.5, seed)
    book = math.floor(x)
    shown = unit(1.6 - w / size)
    hue, light = hash_unit(book, 0, seed), 0.35 + shown * (0.6 * hash_unit(book, 1, seed) ** 2 - 0.2)
    gap = 1.0 - 0.6 * shown * pulse(x, 0.12, w / size)
    band = pulse(v / 0.11 + hash_unit(book, 2, seed), 0.25, w / 0.11) if hash_unit(book, 3, seed) < 0.7 else 0.0
    band = 0.18 + shown * (band - 0.18)
    r = light * (1 + 0.6 * shown * math.sin(6.28 * hue)) * (1 - 0.4 * band) + 0.25 * band
    g = light * (1 + 0.6 * shown * math.sin(6.28 * hue + 2.1)) * (1 - 0.4 * band) + 0.25 * band
    b = light * (1 + 0.6 * shown * math.sin(6.28 * hue + 4.2)) * (1 - 0.4 * band) + 0.2 * band
    return r * gap, g * gap, b * gap


@nb.njit(**OPTIONS)
def _rug(material, u, v, w, seed, half_u, half_v):
    """Nested borders around a field of diamonds."""
    edge = min(half_u - abs(u), half_v - abs(v))
    size = material[SIZE_U]
    if edge < 3 * size:
        t = pulse(edge / size, 0.45, w / size)
    else:
        t = pulse((abs(u) + abs(v)) / (2 * size), 0.35, w / size)
        t = 0.6 * t + 0.4 * pulse((abs(u) - abs(v)) / (2 * size) + 100, 0.5, w / size)
    t += 0.6 * fractal(u, v, 0.06, 3, w, seed)
    spot = 0.5 * pulse(edge / (4 * size), 0.2, w / (4 * size))
    return mix(_mix(material, COLOR_A, COLOR_B, t), take(material, COLOR_C), spot)


@nb.njit(**OPTIONS)
def _terrazzo(material, u, v, w, seed):
    """Chips of two colours in a third colour."""
    size = material[SIZE_U]
    x, y = u / size, v / size
    i, j = math.floor(x), math.floor(y)
    best, chip = 9.0, 0.0
    for di in range(-1, 2):
        for dj in range(-1, 2):
            px = i + di + hash_unit(i + di, j + dj, seed)
            py = j + dj + hash_unit(i + di, j + dj, seed + 1)
            away = math.hypot(x - px, y - py) / (0.3 + 0.7 * hash_unit(i + di, j + dj, seed + 2))
            if away < best:
                best, chip = away, hash_unit(i + di, j + dj, seed + 3)
    cover = unit(0.5 + (0.55 - best) / max(w / size, 1e-3))
    cover = cover + (0.4 - cover) * unit(w / size - 0.5)
    return mix(take(material, COLOR_A), _mix(material, COLOR_B, COLOR_C, chip), cover)


@nb.njit(**OPTIONS)
def color(material, u, v, w, half_u, half_v):
    """Reflectance (red, green, blue) of a surface.

    Args:
        material: a row of numbers, see the columns above.
        u, v: texture coordinates, metres; v points down on upright surfaces.
        w: width of a pixel on the surface, metres.
        half_u, half_v: half the size of the surface, metres, for patterns that fill it.
    """
    kind, seed = int(material[KIND]), int(material[SEED])
    reflectance = take(material, COLOR_A)
    if kind == 1:
        reflectance = _planks(material, u, v, w, seed)
    elif kind == 2:
        reflectance = _tiles(material, u, v, w, seed)
    elif kind == 3:
        reflectance = _stripes(material, u, v, w, seed)
    elif kind == 4:
        reflectance = _stone(material, u, v, w, seed)
    elif kind == 5:
        reflectance = _picture(material, u, v, w, seed, half_u, half_v)
    elif kind == 6:
        reflectance = _text(material, u, v, w, seed, half_u, half_v)
    elif kind == 7:
        reflectance = _books(material, u, v, w, seed)
    elif kind == 8:
        reflectance = _rug(material, u, v, w, seed, half_u, half_v)
    elif kind == 9:
        reflectance = _terrazzo(material, u, v, w, seed)
    return scale(reflectance, 1 + material[MOTTLE] * fractal(u, v, 0.9, 7, w, seed + 77))


def mip_levels(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Texels (n 4) of an image (H W 4), sRGB with opacity, at all its levels of half the size, the finest first.

    Each texel is the mean, in linear light, of 2 x 2 texels of the finer level; the last row or column of an odd size
    is omitted.
    """
    level = np.concatenate((_LINEAR[image[..., :3]], image[..., 3:] / 255), axis=-1)
    levels = [image.reshape(-1, 4)]
    while max(level.shape[:2]) > 1:
        height, width = max(level.shape[0] // 2, 1), max(level.shape[1] // 2, 1)
        rows, columns = min(level.shape[0], 2), min(level.shape[1], 2)
        level = level[: rows * height, : columns * width].reshape(height, rows, width, columns, 4).mean(axis=(1, 3))
        encoded = level.copy()
        encoded[..., :3] = np.where(level <= 0.0031308, 12.92 * level, 1.055 * level ** (1 / 2.4) - 0.055)[..., :3]
        levels.append(np.rint(255 * encoded).astype(np.uint8).reshape(-1, 4))
    return np.concatenate(levels)


@nb.njit(**OPTIONS)
def _bilinear(texels, start, width, height, u, v):
    """Linear light at image coordinates in a level that starts at texel `start`; the image repeats."""
    x, y = (u - math.floor(u)) * width - 0.5, (math.floor(v) + 1 - v) * height - 0.5
    left, top = math.floor(x), math.floor(y)
    fx, fy = x - left, y - top
    left, top = int(left), int(top)
    total = (0.0, 0.0, 0.0)
    for corner in range(4):
        column, row = left + (corner & 1), top + (corner >> 1)
        weight = (fx if corner & 1 else 1 - fx) * (fy if corner >> 1 else 1 - fy)
        texel = texels[start + (row + height) % height * width + (column + width) % width]
        total = advance(total, weight, (_LINEAR[texel[0]], _LINEAR[texel[1]], _LINEAR[texel[2]]))
    return total


@nb.njit(**OPTIONS)
def image_color(texels, image, u, v, w):
    """Linear light (red, green, blue) of an image.

    Args:
        texels: `mip_levels` of all images.
        image: first texel, width and height.
        u, v: image coordinates, in [0, 1] and repeated; v points up.
        w: width of a pixel in these coordinates.
    """
    start, width, height = image[0], image[1], image[2]
    level = max(0.0, math.log2(max(w * math.sqrt(width * height), 1e-9)))
    while level >= 1 and (width > 1 or height > 1):
        start += width * height
        width, height = max(width // 2, 1), max(height // 2, 1)
        level -= 1
    light = _bilinear(texels, start, width, height, u, v)
    if level > 0 and (width > 1 or height > 1):
        coarse = _bilinear(texels, start + width * height, max(width // 2, 1), max(height // 2, 1), u, v)
        light = advance(light, min(level, 1.0), subtract(coarse, light))
    return light


@nb.njit(**OPTIONS)
def is_opaque(texels, image, u, v):
    """Whether the texel of the finest level at image coordinates is more than half opaque."""
    width, height = image[1], image[2]
    column, row = int((u - math.floor(u)) * width), int((math.floor(v) + 1 - v) * height)
    return texels[image[0] + min(row, height - 1) * width + min(column, width - 1), 3] > 127
