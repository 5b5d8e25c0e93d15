"""Panoramas as numpy arrays: pixels of directions, padding, resizing, rotation."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from functools import partial

import cv2
import numba as nb
import numpy as np
import torch

from pansplat.geometry.equirect import pixel_directions, rotate_equirect
from pansplat.system.kernels import cached_njit, parallel_for, thread_count

_RANGE = 1 << 14  # points that a thread processes together
_MIN_TILT = math.radians(0.5)  # a camera with less tilt is not turned upright


@functools.lru_cache(maxsize=4)
def ray_grid(height: int) -> np.ndarray:
    """Unit rays (height, 2 height, 3), float32, of a panorama's pixels; read-only."""
    rays = pixel_directions(height, 2 * height).numpy()
    rays.flags.writeable = False
    return rays


@nb.njit(inline="always")
def locate_pixel(x, y, z, height):
    """Row and column of the pixel that holds a direction."""
    column = (math.atan2(x, z) / (2 * math.pi) + 0.5) * 2 * height
    row = (math.atan2(y, math.sqrt(x * x + z * z)) / math.pi + 0.5) * height
    return min(int(row), height - 1), int(column) % (2 * height)


def nearest_pixel(directions: np.ndarray, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of the pixel that holds each direction (..., 3)."""
    flat = np.ascontiguousarray(directions, np.float64).reshape(-1, 3)
    pixels = np.empty((2, len(flat)), np.int32)
    for_point_ranges(partial(_locate_pixels, flat, height, pixels), len(flat))
    row, column = pixels.reshape(2, *directions.shape[:-1])
    return row, column


@cached_njit(nogil=True)
def _locate_pixels(directions, height, pixels, first, end):
    for n in range(first, end):
        pixels[0, n], pixels[1, n] = locate_pixel(directions[n, 0], directions[n, 1], directions[n, 2], height)


def for_point_ranges(work: Callable[[int, int], object], count: int) -> None:
    """Call `work` on all threads with the ends of ranges of points, 0 to `count`."""
    parallel_for(lambda item: work(item * _RANGE, min((item + 1) * _RANGE, count)), -(-count // _RANGE), thread_count())


def pad_sphere(image: np.ndarray, margin: int) -> np.ndarray:
    """A panorama (h, w) or (h, w, c) padded by its neighbours on the sphere."""
    over = np.roll(image, image.shape[1] // 2, axis=1)
    rows = np.concatenate((over[:margin][::-1], image, over[-margin:][::-1]))
    return np.ascontiguousarray(np.concatenate((rows[:, -margin:], rows, rows[:, :margin]), axis=1))


def resize_sphere(image: np.ndarray, height: int) -> np.ndarray:
    """A panorama (h, w) or (h, w, c) at another height: area average when smaller, bilinear when larger."""
    if image.shape[0] == height:
        return np.ascontiguousarray(image)
    if image.shape[0] > height:
        return cv2.resize(image, (2 * height, height), interpolation=cv2.INTER_AREA)
    # The smallest margin that has whole pixels at both sizes: values continue over the seam and the poles.
    common = math.gcd(image.shape[0], height)
    margin, scaled = image.shape[0] // common, height // common
    size = 2 * (height + scaled), height + 2 * scaled
    large = cv2.resize(pad_sphere(image, margin), size, interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(large[scaled:-scaled, scaled:-scaled])


def resize_sharp(values: np.ndarray, height: int) -> np.ndarray:
    """A panorama (h, w) at another height: the nearest pixel when smaller, so that edges stay, bilinear when larger."""
    if height >= len(values):
        return resize_sphere(values, height)
    return cv2.resize(values, (2 * height, height), interpolation=cv2.INTER_NEAREST_EXACT)


def resize_mask(mask: np.ndarray, height: int) -> np.ndarray:
    """A panorama (h, w) of bool at another height, by the nearest pixel."""
    return cv2.resize(mask.astype(np.uint8), (2 * height, height), interpolation=cv2.INTER_NEAREST) > 0


def upright_rotation(rotation: np.ndarray, down: np.ndarray) -> np.ndarray | None:
    """The smallest rotation (3, 3) after which a camera's y axis is `down`, as new axes in the old ones.

    None for a camera that is upright already.
    """
    target = rotation.T @ down
    axis = np.cross((0.0, 1.0, 0.0), target)
    sine, cosine = float(np.linalg.norm(axis)), float(target[1])
    angle = math.atan2(sine, cosine)
    if angle < _MIN_TILT:
        return None
    if sine < 1e-9:  # the camera is upside down
        return np.diag((1.0, -1.0, -1.0))
    return cv2.Rodrigues(axis / sine * angle)[0]


def rotate_image(image: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """A panorama (h, w, c) of the camera rotated by `rotation` (3, 3), its new axes in the old ones."""
    maps = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)
    return np.ascontiguousarray(rotate_equirect(maps, torch.from_numpy(rotation)).permute(1, 2, 0).numpy())
