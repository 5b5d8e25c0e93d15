"""Straight vertical edges of surfaces.

Frames, columns and the fronts of furniture end at vertical lines. A depth network and matches place the pixels of such
a line one by one, so that it becomes a wave when the camera moves. All points of a vertical line have one horizontal
distance from the camera, and an upright panorama shows them in one column. This distance is therefore smoothed along
columns, beside vertical edges of the photograph, where the surface is vertical.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from pansplat.sweep.bend import smooth_lines
from pansplat.sweep.surface import pad_sphere, rotate_image, upright_rotation


@dataclass(frozen=True)
class StraightenConfig:
    """What a vertical edge is, and how its surface is smoothed. Angles are in radians."""

    contrast: float = 0.1
    """Difference of grey values of the pixels left and right of an edge."""
    length: float = 0.25
    """Smallest length of an edge."""
    reach: int = 2
    """Pixels left and right of an edge that are smoothed."""
    max_latitude: float = 1.2
    """Above and below, columns are narrow."""
    span: float = 0.2
    """Angle over which the slope of the surface is measured."""
    slope: float = 0.73
    """Change of the logarithm of horizontal distance with the angle at which a surface is not vertical."""
    color: float = 0.15
    """Mean difference of colour of neighbouring pixels that divides their coupling by e."""
    smoothing: float = 0.38
    """Angle over which distances are averaged."""


def straighten(
    log_depth: Float[np.ndarray, "h w"],
    image: Float[np.ndarray, "h w 3"],
    down: Float[np.ndarray, "3"],
    config: StraightenConfig,
) -> Float[np.ndarray, "h w"]:
    """The logarithm of a panorama's depth with smooth vertical edges.

    Args:
        down: unit vector in the camera's axes.
    """
    turn = upright_rotation(np.eye(3), down)
    if turn is None:
        return (log_depth + _measure_change(log_depth, image, config)).astype(np.float32)
    turned = rotate_image(np.concatenate((log_depth[..., None], image), axis=-1), turn)
    change = _measure_change(turned[..., 0], turned[..., 1:], config)
    return (log_depth + rotate_image(change[..., None], turn.T)[..., 0]).astype(np.float32)


def _measure_change(log_depth: np.ndarray, image: np.ndarray, config: StraightenConfig) -> np.ndarray:
    """What straightens the log-depth (h, w) of an upright panorama."""
    height = len(log_depth)
    rows_per_radian = height / math.pi
    latitude = ((np.arange(height) + 0.5) / height - 0.5) * math.pi
    to_horizontal = np.log(np.cos(latitude))[:, None]
    distance = log_depth.astype(np.float64) + to_horizontal
    window = (1, 2 * round(0.5 * config.span * rows_per_radian) + 1)
    mean = cv2.blur(distance, window, borderType=cv2.BORDER_REPLICATE)
    slope = (np.roll(mean, -1, axis=0) - mean) * rows_per_radian
    color = np.abs(np.roll(image, -1, axis=0) - image).mean(axis=2)
    coupling = np.exp(-((slope / config.slope) ** 2) - color / config.color)
    beside = _find_vertical_edges(image, config) & (np.abs(latitude) < config.max_latitude)[:, None]
    coupling *= beside & np.roll(beside, -1, axis=0)
    coupling[-1] = 0  # the last row is no neighbour of the first one
    columns = np.stack((distance.T, np.ones_like(distance.T)))
    smooth_lines(columns, np.ascontiguousarray(coupling.T), (config.smoothing * rows_per_radian) ** 2)
    return (columns[0] / columns[1]).T - distance


def _find_vertical_edges(image: np.ndarray, config: StraightenConfig) -> np.ndarray:
    """Pixels (h, w) beside vertical edges."""
    margin = config.reach + 2
    gray = pad_sphere(image.mean(axis=2), margin)
    contrast = np.abs(np.roll(gray, -1, axis=1) - np.roll(gray, 1, axis=1))
    is_edge = (cv2.dilate(contrast, np.ones((1, 3))) > config.contrast).astype(np.uint8)
    length = max(round(config.length * len(image) / math.pi), 3)
    runs = cv2.morphologyEx(is_edge, cv2.MORPH_OPEN, np.ones((length, 1), np.uint8))
    near = cv2.dilate(runs, np.ones((1, 2 * config.reach + 1), np.uint8))
    return near[margin:-margin, margin:-margin] > 0
