"""Depth of panoramas in which windows and mirrors are part of the wall around them.

A single photograph does not show what is behind glass from elsewhere. With the depth of the wall the picture in a
window stays whole when the camera moves; with its true depth it bends and tears. A region that jumps in depth encloses
is a pane if the surface just outside of it is a vertical plane. A doorway is none: the floor leads through it without a
jump.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float
from scipy import ndimage

from pansplat.geometry.equirect import pixel_directions

_JUMP = 1.25  # ratio of depths of neighbouring pixels
_MIN_RATIO = 1.4  # depth of a region relative to that of the wall
_MIN_NEARER = 1.2  # median depth of a region relative to the surface around it
_MIN_PIXELS = 40
_BAND = 4  # pixels around a region, in which its wall is looked for
_DRAWS = 24  # planes that are tried
_MAX_TILT = 0.3  # vertical component of a wall's normal
_TOLERANCE = 0.02, 0.015  # distance from a plane: relative to its offset, and in camera heights
_MIN_INLIERS, _MIN_COVERED = 0.55, 0.95
_UNKNOWN = 1e3
_NEIGHBOURS = np.ones((3, 3), np.uint8)


def close_panes(depth: Float[np.ndarray, "h w"], rng: np.random.Generator) -> Float[np.ndarray, "h w"]:
    """The depth with that of the wall in windows and mirrors.

    Args:
        depth: radial, in camera heights, of an upright panorama; 0 where it is unknown.
        rng: draws the planes that are tried.
    """
    height, width = depth.shape
    margin = width // 4  # so that regions at the seam are whole
    wrapped = np.pad(depth, ((0, 0), (margin, margin)), mode="wrap")
    rays = np.pad(pixel_directions(height, width).numpy(), ((0, 0), (margin, margin), (0, 0)), mode="wrap")
    filled = np.where(wrapped > 0, wrapped, np.float32(_UNKNOWN)).astype(np.float32)
    is_far_side = filled > _JUMP * cv2.erode(filled, _NEIGHBOURS)
    labels, count = ndimage.label(~is_far_side)
    closed = filled.copy()
    if count > 1:
        largest = int(np.bincount(labels.ravel())[1:].argmax()) + 1
        for label, (rows, columns) in enumerate(ndimage.find_objects(labels), start=1):
            if label == largest or columns.stop - columns.start > width // 2:
                continue
            window = (
                slice(max(rows.start - _BAND - 2, 0), rows.stop + _BAND + 2),
                slice(max(columns.start - _BAND - 2, 0), columns.stop + _BAND + 2),
            )
            _close(closed[window], filled[window], rays[window], labels[window] == label, rng)
    closed[closed >= _UNKNOWN] = 0
    inner = closed[:, margin:-margin].copy()
    for part, copy in ((inner[:, -margin:], closed[:, :margin]), (inner[:, :margin], closed[:, -margin:])):
        nearer = (copy > 0) & ((copy < part) | (part == 0))
        part[nearer] = copy[nearer]
    return inner


def _close(
    closed: Float[np.ndarray, "h w"],
    filled: Float[np.ndarray, "h w"],
    rays: Float[np.ndarray, "h w 3"],
    region: np.ndarray,
    rng: np.random.Generator,
) -> None:
    """Write the wall's depth into `closed`, if the region is a pane in a wall."""
    if region.sum() < _MIN_PIXELS:
        return
    grown = cv2.dilate(region.astype(np.uint8), _NEIGHBOURS)
    region = grown > 0
    around = cv2.dilate(grown, np.ones((2 * _BAND + 1,) * 2, np.uint8)) > 0
    own = filled[region]
    frame = around & ~region & (filled * _MIN_NEARER < np.median(own))
    if frame.sum() < 20:
        return
    plane = _fit_wall((rays * filled[..., None])[frame].astype(np.float64), rng)
    if plane is None:
        return
    normal, offset = plane
    along = rays @ normal
    wall = np.where(along * offset > 0, offset / np.where(along == 0, 1, along), 0)
    if (wall[region] > 0).mean() < _MIN_COVERED or np.median(own / np.maximum(wall[region], 1e-6)) < _MIN_RATIO:
        return
    chosen = (cv2.dilate(grown, _NEIGHBOURS) > 0) & (wall > 0) & (filled > 1.03 * wall)
    closed[chosen] = wall[chosen]


def _fit_wall(
    points: Float[np.ndarray, "n 3"], rng: np.random.Generator
) -> tuple[Float[np.ndarray, "3"], float] | None:
    """Normal and offset of the vertical plane through most of the points; None without one through enough of them."""
    best, most = None, _MIN_INLIERS * len(points)
    for _ in range(_DRAWS):
        first, second, third = points[rng.integers(len(points), size=3)]
        normal = np.cross(second - first, third - first)
        length = np.linalg.norm(normal)
        if length < 1e-9 or abs(normal[1]) > _MAX_TILT * length:
            continue
        normal /= length
        offset = float(normal @ first)
        inliers = (np.abs(points @ normal - offset) < _TOLERANCE[0] * abs(offset) + _TOLERANCE[1]).sum()
        if inliers >= most:
            best, most = (normal, offset), inliers
    return best
