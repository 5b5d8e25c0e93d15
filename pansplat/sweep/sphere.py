"""Panoramas as numpy arrays: rays, padding over the poles, resizing. The kernels below work on these."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from pansplat.geometry.equirect import pixel_directions, uv_from_directions


def ray_grid(height: int) -> np.ndarray:
    """Unit rays (height, 2 height, 3), float32, of a panorama's pixels."""
    return pixel_directions(height, 2 * height).numpy()


def pixel_coordinates(directions: np.ndarray, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Continuous x and y of directions (..., 3) of any length in a panorama; pixel centres at half-integers."""
    uv = uv_from_directions(torch.from_numpy(np.ascontiguousarray(directions))).numpy()
    return uv[..., 0] * 2 * height, uv[..., 1] * height


def nearest_pixel(directions: np.ndarray, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of the pixel that each direction (..., 3) falls into."""
    x, y = pixel_coordinates(directions, height)
    return np.clip(y.astype(np.int64), 0, height - 1), x.astype(np.int64) % (2 * height)


def pad_sphere(image: np.ndarray, margin: int) -> np.ndarray:
    """Pad rows and columns by the true neighbours on the sphere; (h, w) or (h, w, c)."""
    over = np.roll(image, image.shape[1] // 2, axis=1)
    rows = np.concatenate((over[:margin][::-1], image, over[-margin:][::-1]))
    return np.ascontiguousarray(np.concatenate((rows[:, -margin:], rows, rows[:, :margin]), axis=1))


def resize_sphere(image: np.ndarray, height: int) -> np.ndarray:
    """A panorama (h, w) or (h, w, c) at another height: area average down, bilinear with true neighbours up."""
    if image.shape[0] == height:
        return np.ascontiguousarray(image)
    if image.shape[0] > height:
        return cv2.resize(image, (2 * height, height), interpolation=cv2.INTER_AREA)
    factor = height // image.shape[0]
    if height % image.shape[0] == 0:
        large = cv2.resize(pad_sphere(image, 2), None, fx=factor, fy=factor, interpolation=cv2.INTER_LINEAR)
        return np.ascontiguousarray(large[2 * factor : -2 * factor, 2 * factor : -2 * factor])
    return cv2.resize(image, (2 * height, height), interpolation=cv2.INTER_LINEAR)
