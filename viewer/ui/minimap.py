"""The floor plan of a tour as a panel: floors, walls, panoramas, and the camera; a click flies to a panorama.

Panoramas without a known place are squares, floors at approximate places are dashed. Other storeys than that of the
camera are faint.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import shapely
from imgui_bundle import imgui
from jaxtyping import Float

from pansplat.system.descriptions import describe_count
from pansplat.tours.floor import choose_camera_height, find_other_storeys
from pansplat.tours.graph import TourGraph
from pansplat.tours.linked_rooms import DrawnPlace, place_rooms
from pansplat_viewer.core.camera import Camera
from pansplat_viewer.core.placing_by_hand import PlanView
from pansplat_viewer.core.tour_scenes import TourScenes
from pansplat_viewer.ui.overlays import ZOOM_COLOR

SIZE = 210  # longer side of the plan, pixels at a DPI scale of 1
_CLICK_PIXELS = 12.0  # distance from a panorama within which a click leads there, at a DPI scale of 1
_VIEW_LENGTH = 1.0  # length of the lines that show the field of view, metres
_DASH = 5.0  # length of a dash of an outline, pixels at a DPI scale of 1

Color = tuple[float, float, float, float]

_FLOORS: tuple[Color, Color] = (0.9, 0.9, 0.92, 1.0), (0.38, 0.41, 0.45, 1.0)  # walls, and floors
_FAINT_FLOORS: tuple[Color, Color] = (0.35, 0.36, 0.37, 1.0), (0.18, 0.19, 0.21, 1.0)
# Colours of panoramas, of those whose scene is loaded, of edges, of the camera, of links to other parts, and of
# panoramas of other storeys.
_COLORS = (
    (0.75, 0.78, 0.82, 1.0),
    (0.35, 0.8, 1.0, 1.0),
    (0.6, 0.65, 0.7, 0.35),
    (1.0, 0.8, 0.2, 1.0),
    (*ZOOM_COLOR, 0.35),
    (0.75, 0.78, 0.82, 0.3),
)


def describe_panorama(tour: TourGraph, node: int) -> str:
    """The label of a panorama, and how sure its place is."""
    label, placement = tour.panoramas[node].label, tour.panoramas[node].placement
    if not any(map(tour.is_placed, range(len(tour)))):
        return label
    if not tour.is_placed(node):
        return f"{label} ({'about here' if node in tour.approximate else 'not placed'})"
    return f"{label} (placed by hand)" if placement.state == "by hand" else label


def describe_panoramas(tour: TourGraph) -> str:
    """The number of panoramas, of several those with a known, approximate and no place."""
    alone = sum(not tour.is_placed(node) for node in range(len(tour)))
    if alone in (0, len(tour)):
        return describe_count(len(tour), "panorama")
    about = len(tour.approximate)
    counts = (len(tour) - alone, "placed"), (about, "about here"), (alone - about, "not placed")
    return ", ".join(f"{count} {name}" for count, name in counts if count)


class Minimap:
    """Draws the plan of a tour.

    Attributes:
        nodes: pixel of each panorama in the last frame; for tests that click.
    """

    def __init__(self) -> None:
        self.nodes: list[tuple[float, float]] = []
        self._drawn: dict[int, DrawnPlace] = {}
        self._known: tuple[TourGraph, frozenset[int]] | None = None  # what these places are by

    def draw(self, scenes: TourScenes, camera: Camera) -> int | None:
        """Draw the plan into the current imgui window; returns the panorama that was clicked."""
        scale, tour = imgui.get_style().font_scale_dpi, scenes.tour
        others = find_other_storeys(tour, np.asarray(camera.position))
        self._place(scenes)
        dots = {node for node, place in self._drawn.items() if place.turn is None}
        floors = {n: self._move(n, outline.corners) for n, outline in scenes.outlines.items() if n not in dots}
        cameras = tour.positions @ tour.level_axes[:, (0, 2)]
        nodes = np.stack([self._move(node, place) for node, place in enumerate(cameras)])
        corner, points = imgui.get_cursor_screen_pos(), np.concatenate([nodes, *floors.values()])
        extent = np.ptp(points, axis=0) + 1.0  # metres
        width, height = (SIZE * scale * extent / extent.max()).tolist()
        view = PlanView.of_points(points, (width, height), (corner.x, corner.y))
        to_pixels = view.to_pixels
        imgui.dummy((width, height))
        hovered = imgui.is_item_hovered()
        for is_other, colors in ((True, _FAINT_FLOORS), (False, _FLOORS)):
            shown = [node for node in floors if (node in others) == is_other and node not in self._drawn]
            draw_floors([floors[node] for node in shown], view, colors, scale)
        for node in self._drawn.keys() & floors.keys():
            _draw_dashed(to_pixels(floors[node]), scale)
        self.nodes = [tuple(pixel) for pixel in to_pixels(nodes).tolist()]
        self._draw_marks(scenes, others, camera, to_pixels, scale)
        if not hovered:
            return None
        mouse = imgui.get_mouse_pos()
        distances = [math.hypot(x - mouse.x, y - mouse.y) for x, y in self.nodes]
        near = [node for node, distance in enumerate(distances) if distance <= _CLICK_PIXELS * scale]
        if not near:
            return None
        nearest = min(near, key=lambda node: (node in others, distances[node]))
        reason = tour.panoramas[nearest].placement.reason
        imgui.set_tooltip("\n".join(filter(None, (describe_panorama(tour, nearest), reason))))
        return nearest if imgui.is_mouse_clicked(0) else None

    def _place(self, scenes: TourScenes) -> None:
        """Find the places of rooms beside others, by the floors that are known."""
        tour, outlines = scenes.tour, scenes.outlines
        if self._known != (tour, outlines.keys()):
            self._known = tour, frozenset(outlines)
            boxes = shapely.oriented_envelope([shapely.Polygon(outline.corners) for outline in outlines.values()])
            corners = [shapely.get_coordinates(box)[:-1] for box in shapely.orient_polygons(boxes)]
            unit = choose_camera_height((outline.camera_height for outline in outlines.values()), tour.far)
            self._drawn = place_rooms(tour, dict(zip(outlines, corners, strict=True)), unit)

    def _move(self, node: int, places: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Where the plan shows places around a panorama."""
        return self._drawn[node].move(places) if node in self._drawn else places

    def _draw_marks(
        self,
        scenes: TourScenes,
        others: frozenset[int],
        camera: Camera,
        to_pixels: Callable[[Float[np.ndarray, "*batch 2"]], Float[np.ndarray, "*batch 2"]],
        scale: float,
    ) -> None:
        tour, canvas = scenes.tour, imgui.get_window_draw_list()
        axes = tour.level_axes[:, (0, 2)]
        colors = [imgui.color_convert_float4_to_u32(color) for color in _COLORS]
        for a, b in tour.overlaps:
            canvas.add_line(self.nodes[a], self.nodes[b], colors[2], scale)
        for a, b in tour.links:
            if tour.is_zoom(a, b):
                canvas.add_line(self.nodes[a], self.nodes[b], colors[4], scale)
        loaded, half = {node for views in scenes.loaded for node in views}, 3.5 * scale
        for node, (x, y) in enumerate(self.nodes):
            color = colors[5 if node in others else node in loaded]
            if not tour.is_placed(node):
                canvas.add_rect_filled((x - half, y - half), (x + half, y + half), color)
            else:
                canvas.add_circle_filled((x, y), 4.0 * scale, color)
        here = tour.find_nearest(np.asarray(camera.position))
        points = (np.asarray(camera.position) + ahead * camera.rotation[:, 2] for ahead in (0, 1))
        place, ahead = (self._move(here, point @ axes) for point in points)
        heading = (ahead - place) / max(float(np.linalg.norm(ahead - place)), 1e-6)
        side = np.array((heading[1], -heading[0])) * math.tan(math.radians(min(camera.vertical_fov_degrees, 120)) / 2)
        ends = [to_pixels(place + _VIEW_LENGTH * (heading + sign * side)) for sign in (-1, 1)]
        at = to_pixels(place)
        for end in ends:
            canvas.add_line(tuple(at.tolist()), tuple(end.tolist()), colors[3], 1.5 * scale)
        canvas.add_circle_filled(tuple(at.tolist()), 4.5 * scale, colors[3])


def _draw_dashed(corners: Float[np.ndarray, "corner 2"], scale: float) -> None:
    """Draw the outline of a floor with dashes of equal length."""
    canvas, color = imgui.get_window_draw_list(), imgui.color_convert_float4_to_u32(_FLOORS[0])
    line = shapely.LinearRing(corners)
    for start in np.arange(0.0, line.length, 2 * _DASH * scale):
        first, last = (line.interpolate(at) for at in (start, start + _DASH * scale))
        canvas.add_line((first.x, first.y), (last.x, last.y), color, 1.5 * scale)


def draw_floors(
    floors: list[Float[np.ndarray, "corner 2"]], view: PlanView, colors: tuple[Color, Color], scale: float
) -> None:
    """Draw walls around all floors together: an outline that ends in another one's floor has no wall there."""
    canvas = imgui.get_window_draw_list()
    wall, floor = map(imgui.color_convert_float4_to_u32, colors)
    shapes = [[imgui.ImVec2(x, y) for x, y in view.to_pixels(corners).tolist()] for corners in floors]
    for shape in shapes:
        canvas.add_polyline(shape, wall, thickness=3.0 * scale, flags=imgui.ImDrawFlags_.closed.value)
    for shape in shapes:
        canvas.add_concave_poly_filled(shape, floor)
