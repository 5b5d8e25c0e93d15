"""Where there is something to see at a panorama: a flight does not end with the face to a wall."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from pansplat.gaussians.scene import Scene
from pansplat.tours.surfaces import locate_surfaces

BINS = 24  # of the horizon; the first one begins at the yaw -pi
_ELEVATION = math.sin(math.radians(20))  # of the surfaces that count, above and below the horizon
_OPAQUE = 0.5  # least opacity of a surface
_BLANK = 0.45  # of the median distance of surfaces, below which a view is blank
_WINDOW = 3  # bins of a view, 45 degrees


def measure_outlook(scene: Scene, view: int, level: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "bin"]:
    """Median distances of what a view's camera sees around the horizon; 0 where it sees nothing.

    Args:
        scene: with all Gaussians of the view.
        view: number of the camera.
        level: axes of a level camera, as columns right, down and forward.
    """
    offsets = locate_surfaces(scene, view, level, min_opacity=_OPAQUE)
    distances = np.linalg.norm(offsets, axis=1)
    is_ahead = np.abs(offsets[:, 1]) < _ELEVATION * distances
    bins = ((np.arctan2(offsets[:, 0], offsets[:, 2]) / (2 * math.pi) + 0.5) * BINS).astype(int) % BINS
    found = [distances[is_ahead & (bins == number)] for number in range(BINS)]
    return np.array([np.median(own) if len(own) else 0.0 for own in found])


def choose_heading(outlook: Float[np.ndarray, "bin"], yaw: float) -> float:
    """The yaw at which a flight ends: the given one, or that of the widest view if it faces a wall.

    Args:
        outlook: of `measure_outlook`.
        yaw: in which the camera arrives, radians.
    """
    around = np.stack([np.roll(outlook, shift) for shift in range(-(_WINDOW // 2), _WINDOW // 2 + 1)])
    views = around.mean(axis=0)
    here = int((yaw / (2 * math.pi) + 0.5) * BINS) % BINS
    if not outlook.any() or views[here] >= _BLANK * np.median(outlook):
        return yaw
    return ((int(views.argmax()) + 0.5) / BINS - 0.5) * 2 * math.pi
