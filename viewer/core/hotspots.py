"""The hotspots of a tour: where other panoramas stand in the image, and which one a click means."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from pansplat.geometry.level import wrap_angle
from pansplat.tours.graph import TourGraph
from pansplat.tours.links import RING_DISTANCE, RING_RADIUS, choose_rings
from pansplat_viewer.core.camera import Camera
from pansplat_viewer.core.picking import project_point

_MIN_PIXELS, _MAX_PIXELS = 14.0, 64.0  # least radius within which a click is meant, and largest one of a ring
_BORDER, _STEP = 40.0, 56.0  # pixels: from the middle of an arrow to the border, and to the next arrow
_LOWER = 100.0  # pixels from the middle of an arrow to the lower border, where messages are
_ARROW = np.array(((-8.0, -12.0), (12.0, 0.0), (-8.0, 12.0)))  # corners of an arrow to the right, pixels


class PlaceFacts(NamedTuple):
    """What is known of a panorama, for its rings.

    Attributes:
        node: its number.
        camera_height: over the floor, metres.
        hidden: the panoramas whose places on the floor surfaces hide from it.
        outlook: what is seen around it (`measure_outlook`); None if that is unknown.
    """

    node: int
    camera_height: float
    hidden: Sequence[int] = ()
    outlook: Float[np.ndarray, "bin"] | None = None


@dataclass(frozen=True)
class Hotspot:
    """The place of a panorama in the image, on the floor below its camera, or where a link leads to it; or an arrow at
    the border to a place outside.

    Attributes:
        node: number of the panorama.
        label: its name, or the text of the link.
        center: pixels, from the left and from the top.
        radius: pixels, within which a click is meant.
        ring: corners of the circle on the floor, or upright on a wall, or of the arrow, pixels.
        is_zoom: whether the way to the panorama is a zoom (`TourGraph.is_zoom`).
        is_arrow: whether it is an arrow.
    """

    node: int
    label: str
    center: tuple[float, float]
    radius: float
    ring: tuple[tuple[float, float], ...]
    is_zoom: bool = False
    is_arrow: bool = False


def find_hotspots(
    tour: TourGraph,
    facts: PlaceFacts,
    camera: Camera,
    size: tuple[int, int],
    left: float = 0.0,
) -> list[Hotspot]:
    """The rings of the nearest panorama (`choose_rings`), and arrows to those that are outside of the image or whose
    places are unknown; the nearest in the image last.

    Args:
        tour: the graph.
        facts: what is known of the nearest panorama.
        camera: of the image.
        size: width and height of the image, pixels.
        left: width of what covers the image from the left, pixels.
    """
    here, position = facts.node, np.asarray(camera.position)
    below = facts.camera_height * np.asarray(camera.level)[:, 1]
    feet = []
    for node, offset in choose_rings(tour, here, facts.camera_height, facts.hidden, facts.outlook):
        label, place = tour.panoramas[node].label, tour.positions[node]
        if offset is not None:
            feet.append((node, tour.positions[here] + offset, tour.links[here, node].text or label, True))
        elif np.linalg.norm(place - position) >= RING_DISTANCE:
            feet.append((node, place + below, label, tour.worlds[node] == tour.worlds[here]))
    found: list[Hotspot] = []
    arrows: list[Hotspot] = []
    for node, foot, label, is_known in sorted(feet, key=lambda item: -np.linalg.norm(item[1] - position)):
        is_zoom, is_upright = tour.is_zoom(here, node), bool((foot - position - below) @ below < -1e-6)
        hotspot = _make_hotspot(camera, size, node, label, foot, is_zoom=is_zoom, is_upright=is_upright)
        if not is_known:
            hotspot = None
        if hotspot is not None and hotspot.center[0] >= left:
            found.append(hotspot)
        else:
            arrows.append(_make_arrow(camera, size, left, node, label, foot, is_zoom, arrows))
    return arrows + found


def _make_hotspot(
    camera: Camera,
    size: tuple[int, int],
    node: int,
    label: str,
    foot: Float[np.ndarray, "3"],
    *,
    is_zoom: bool,
    is_upright: bool,
) -> Hotspot | None:
    """The hotspot of a panorama around a place on the floor or a wall; None if it is not in an image of this size."""
    right, down, forward = np.asarray(camera.level).T
    across, along = (np.cross(down, foot - camera.position), down) if is_upright else (right, forward)
    angles = np.arange(24) * (2 * np.pi / 24)
    circle = np.cos(angles)[:, None] * (across / np.linalg.norm(across)) + np.sin(angles)[:, None] * along
    circle = foot + RING_RADIUS * circle
    center = project_point(camera, tuple(foot), size)
    ring = [project_point(camera, tuple(corner), size) for corner in circle]
    if center is None or None in ring or not (0 <= center[0] < size[0] and 0 <= center[1] < size[1]):
        return None
    radius = float(np.ptp([corner[0] for corner in ring])) / 2
    shrunk = np.array(center) + min(_MAX_PIXELS / max(radius, 1e-9), 1.0) * (np.array(ring) - center)
    return Hotspot(
        node, label, center, min(max(radius, _MIN_PIXELS), _MAX_PIXELS), tuple(map(tuple, shrunk.tolist())), is_zoom
    )


def _make_arrow(
    camera: Camera,
    size: tuple[int, int],
    left: float,
    node: int,
    label: str,
    foot: Float[np.ndarray, "3"],
    is_zoom: bool,
    others: Sequence[Hotspot],
) -> Hotspot:
    """The arrow to which the camera turns to see a place, beside `others`: at the side, or at the lower border."""
    (width, height), focal = size, camera.find_focal(size[1])
    right, _, forward = np.asarray(camera.level).T @ (foot - camera.position)
    around = wrap_angle(math.atan2(right, forward) - camera.yaw_radians)
    across = 0.5 * width + focal * math.tan(min(max(around, -1.5), 1.5))
    if left <= across < width:
        center = np.array((min(max(across, left + _BORDER), width - _BORDER), height - _LOWER))
        turn, step = np.array(((0, -1), (1, 0))), np.array((_STEP, 0))
    else:
        sign = 1.0 if around > 0 else -1.0
        center = np.array((width - _BORDER if around > 0 else left + _BORDER, 0.5 * height))
        turn, step = np.diag((sign, 1.0)), np.array((0, _STEP))
    while any(np.linalg.norm(center - other.center) < 0.9 * _STEP for other in others):
        center = center + step
    x, y = center.tolist()
    ring = tuple(map(tuple, (center + _ARROW @ turn.T).tolist()))
    return Hotspot(node, label, (x, y), _MIN_PIXELS, ring, is_zoom, is_arrow=True)


def find_clicked(hotspots: Sequence[Hotspot], pixel: tuple[float, float]) -> int | None:
    """The panorama of the hotspot at a pixel, the nearest one first; None if there is none."""
    for hotspot in reversed(hotspots):
        if np.hypot(pixel[0] - hotspot.center[0], pixel[1] - hotspot.center[1]) <= hotspot.radius:
            return hotspot.node
    return None
