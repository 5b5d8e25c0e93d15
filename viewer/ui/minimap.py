"""The floor plan of a tour as a panel: floors, walls, panoramas, and the camera; a click flies to a panorama.

Panoramas without a known place are squares, those that are only probably placed are rings. Other storeys than that of
the camera are faint.
"""

from __future__ import annotations

import math

import moderngl
import numpy as np
from imgui_bundle import imgui

from pansplat.system.descriptions import describe_count
from pansplat.tours.floor import FloorPlan, draw_floor_plan, find_other_storeys
from pansplat.tours.graph import TourGraph
from pansplat_viewer.scene.camera import Camera
from pansplat_viewer.scene.tour import TourScenes
from pansplat_viewer.ui.overlays import FADE_COLOR

SIZE = 210  # of the longer side of the plan, pixels at a DPI scale of 1
_CLICK_PIXELS = 12.0
_VIEW_LENGTH = 1.0  # metres, of the camera's field of view

# Colours of panoramas, of those whose scene is loaded, of edges, of the camera, of links to other parts, and of
# panoramas of other storeys.
_COLORS = (
    (0.75, 0.78, 0.82, 1.0),
    (0.35, 0.8, 1.0, 1.0),
    (0.6, 0.65, 0.7, 0.35),
    (1.0, 0.8, 0.2, 1.0),
    (*FADE_COLOR, 0.35),
    (0.75, 0.78, 0.82, 0.3),
)


def describe_panorama(tour: TourGraph, node: int) -> str:
    """The label of a panorama, and how sure its place is."""
    label, placement = tour.panoramas[node].label, tour.panoramas[node].placement
    if not tour.is_placed(node):
        return f"{label} (not placed)"
    notes = {"probable": " (probably placed)", "by hand": " (placed by hand)"}
    return label + notes.get(placement.state, "")


def describe_panoramas(tour: TourGraph) -> str:
    """The number of panoramas with a known, a probable and no known place, and of fades because of poor flights."""
    flights = sum(a != b for a, b in tour.overlaps) - len(tour.poor)
    ways = f"; {describe_count(flights, 'flight')}, {describe_count(len(tour.poor), 'fade')}" if tour.poor else ""
    alone = sum(not tour.is_placed(node) for node in range(len(tour)))
    probable = sum(is_probable(tour, node) for node in range(len(tour)))
    if not alone and not probable:
        return f"{describe_count(len(tour), 'panorama')}{ways}"
    counts = ((len(tour) - alone - probable, "placed"), (probable, "probably"), (alone, "not placed"))
    return ", ".join(f"{count} {name}" for count, name in counts if count or name == "placed") + ways


def is_probable(tour: TourGraph, node: int) -> bool:
    """Whether a panorama is only probably placed."""
    return tour.panoramas[node].placement.state == "probable" and tour.is_placed(node)


class Minimap:
    """Draws the plan of a tour; keeps the texture of the floors.

    Attributes:
        nodes: pixel of each panorama in the last frame; for tests that click.
    """

    def __init__(self, ctx: moderngl.Context) -> None:
        """No texture is made before the first frame."""
        self._ctx = ctx
        self._texture: moderngl.Texture | None = None
        self._plan: FloorPlan | None = None
        self._key: tuple[object, ...] = ()
        self.nodes: list[tuple[float, float]] = []

    def draw(self, scenes: TourScenes, camera: Camera) -> int | None:
        """Draw the plan into the current imgui window; returns the panorama that was clicked."""
        scale = imgui.get_style().font_scale_dpi
        others = find_other_storeys(scenes.tour, np.asarray(camera.position))
        plan = self._update(scenes, others, round(SIZE * scale))
        assert self._texture is not None
        corner = imgui.get_cursor_screen_pos()
        imgui.image(imgui.ImTextureRef(self._texture.glo), self._texture.size)
        hovered = imgui.is_item_hovered()
        self._draw_marks(scenes, others, camera, plan, (corner.x, corner.y), scale)
        if not hovered:
            return None
        mouse = imgui.get_mouse_pos()
        distances = [math.hypot(x - mouse.x, y - mouse.y) for x, y in self.nodes]
        near = [node for node, distance in enumerate(distances) if distance <= _CLICK_PIXELS * scale]
        if not near:
            return None
        nearest = min(near, key=lambda node: (node in others, distances[node]))
        reason = scenes.tour.panoramas[nearest].placement.reason
        imgui.set_tooltip("\n".join(filter(None, (describe_panorama(scenes.tour, nearest), reason))))
        return nearest if imgui.is_mouse_clicked(0) else None

    def release(self) -> None:
        """Free the texture."""
        if self._texture is not None:
            self._texture.release()
        self._texture, self._key = None, ()

    def _update(self, scenes: TourScenes, others: frozenset[int], size: int) -> FloorPlan:
        """The plan; its texture is written again after a scene was loaded, and in another storey."""
        key = (scenes.tour, others, size, *map(id, scenes.outlines.values()))
        if self._plan is None or key != self._key:
            self.release()
            here, faint = (
                [outline for node, outline in scenes.outlines.items() if (node in others) == is_other]
                for is_other in (False, True)
            )
            self._plan = draw_floor_plan(scenes.tour, here, faint=faint, size=size)
            height, width = self._plan.image.shape[:2]
            self._texture = self._ctx.texture((width, height), 4, self._plan.image.tobytes())
            self._key = key
        return self._plan

    def _draw_marks(
        self,
        scenes: TourScenes,
        others: frozenset[int],
        camera: Camera,
        plan: FloorPlan,
        corner: tuple[float, float],
        scale: float,
    ) -> None:
        tour, canvas = scenes.tour, imgui.get_window_draw_list()
        axes = tour.level_axes[:, (0, 2)]
        self.nodes = [tuple(pixel) for pixel in (plan.to_pixels(tour.positions @ axes) + corner).tolist()]
        colors = [imgui.color_convert_float4_to_u32(color) for color in _COLORS]
        for a, b in tour.overlaps:
            canvas.add_line(self.nodes[a], self.nodes[b], colors[2], scale)
        for a, b in tour.links:
            if tour.is_fade(a, b):
                canvas.add_line(self.nodes[a], self.nodes[b], colors[4], scale)
        loaded, half = {node for views in scenes.loaded for node in views}, 3.5 * scale
        for node, (x, y) in enumerate(self.nodes):
            color = colors[5 if node in others else node in loaded]
            if not tour.is_placed(node):
                canvas.add_rect_filled((x - half, y - half), (x + half, y + half), color)
            elif is_probable(tour, node):
                canvas.add_circle((x, y), 4.0 * scale, color, 0, 1.8 * scale)
            else:
                canvas.add_circle_filled((x, y), 4.0 * scale, color)
        place, rotation = np.asarray(camera.position) @ axes, camera.rotation
        heading = rotation[:, 2] @ axes
        heading = heading / max(float(np.linalg.norm(heading)), 1e-6)
        side = np.array((heading[1], -heading[0])) * math.tan(math.radians(min(camera.vertical_fov_degrees, 120)) / 2)
        ends = [plan.to_pixels(place + _VIEW_LENGTH * (heading + sign * side)) + corner for sign in (-1, 1)]
        at = plan.to_pixels(place) + corner
        for end in ends:
            canvas.add_line(tuple(at.tolist()), tuple(end.tolist()), colors[3], 1.5 * scale)
        canvas.add_circle_filled(tuple(at.tolist()), 4.5 * scale, colors[3])
