"""Straight vertical edges of surfaces.

Frames, columns and the fronts of furniture end at vertical lines. A depth network and matches place the pixels of such
a line one by one, so that it becomes a wave when the camera moves. All points of a vertical line have one horizontal
distance from the camera, and an upright panorama shows them in one column. This distance is therefore smoothed along
columns, beside vertical edges of the photograph, where the surface is vertical.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import Float

from pansplat.sweep.bend import smooth_lines
from pansplat.sweep.surface import pad_sphere, rotate_image, upright_rotation

# What a vertical edge is, and how its surface is smoothed; angles are in radians.
_CONTRAST = 0.1  # difference of grey values of the pixels left and right of an edge
_LENGTH = 0.25  # smallest length of an edge
_REACH = 2  # pixels left and right of an edge that are smoothed
_MAX_LATITUDE = 1.2  # above and below, columns are narrow
_SPAN = 0.2  # angle over which the slope of the surface is measured
_SLOPE = 0.73  # change of the logarithm of horizontal distance with the angle at which a surface is not vertical
_COLOR = 0.15  # mean difference of colour of neighbouring pixels that divides their coupling by e
_SMOOTHING = 0.38  # angle over which distances are averaged


def straighten(
    log_depth: Float[np.ndarray, "h w"],
    image: Float[np.ndarray, "h w 3"],
    down: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "h w"]:
    """The logarithm of a panorama's depth with smooth vertical edges.

    Args:
        down: unit vector in the camera's axes.
    """
    turn = upright_rotation(np.eye(3), down)
    if turn is None:
        return (log_depth + _measure_change(log_depth, image)).astype(np.float32)
    turned = rotate_image(np.concatenate((log_depth[..., None], image), axis=-1), turn)
    change = _measure_change(turned[..., 0], turned[..., 1:])
    return (log_depth + rotate_image(change[..., None], turn.T)[..., 0]).astype(np.float32)


def _measure_change(log_depth: np.ndarray, image: np.ndarray) -> np.ndarray:
    """What straightens the log-depth (h, w) of an upright panorama."""
    height = len(log_depth)
    rows_per_radian = height / math.pi
    latitude = ((np.arange(height) + 0.5) / height - 0.5) * math.pi
    to_horizontal = np.log(np.cos(latitude))[:, None]
    distance = log_depth.astype(np.float64) + to_horizontal
    window = (1, 2 * round(0.5 * _SPAN * rows_per_radian) + 1)
    mean = cv2.blur(distance, window, borderType=cv2.BORDER_REPLICATE)
    slope = (np.roll(mean, -1, axis=0) - mean) * rows_per_radian
    color = np.abs(np.roll(image, -1, axis=0) - image).mean(axis=2)
    coupling = np.exp(-((slope / _SLOPE) ** 2) - color / _COLOR)
    beside = _find_vertical_edges(image) & (np.abs(latitude) < _MAX_LATITUDE)[:, None]
    coupling *= beside & np.roll(beside, -1, axis=0)
    coupling[-1] = 0  # the last row is no neighbour of the first one
    columns = np.stack((distance.T, np.ones_like(distance.T)))
    smooth_lines(columns, np.ascontiguousarray(coupling.T), (_SMOOTHING * rows_per_radian) ** 2)
    return (columns[0] / columns[1]).T - distance


def _find_vertical_edges(image: np.ndarray) -> np.ndarray:
    """Pixels (h, w) beside vertical edges."""
    margin = _REACH + 2
    gray = pad_sphere(image.mean(axis=2), margin)
    contrast = np.abs(np.roll(gray, -1, axis=1) - np.roll(gray, 1, axis=1))
    is_edge = (cv2.dilate(contrast, np.ones((1, 3))) > _CONTRAST).astype(np.uint8)
    length = max(round(_LENGTH * len(image) / math.pi), 3)
    runs = cv2.morphologyEx(is_edge, cv2.MORPH_OPEN, np.ones((length, 1), np.uint8))
    near = cv2.dilate(runs, np.ones((1, 2 * _REACH + 1), np.uint8))
    return near[margin:-margin, margin:-margin] > 0
