"""The list of panoramas with the states of their poses, and the window in which one is placed by hand.

All that they change is in `pansplat_viewer.core.placing_by_hand`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import moderngl
import numpy as np
from imgui_bundle import imgui
from jaxtyping import Float

from pansplat.inputs.placements import Placement
from pansplat.poses.placing import Piece
from pansplat_viewer.core.placing_by_hand import PlacingByHand, PlanPose, PlanView
from pansplat_viewer.ui.minimap import Color, draw_floors
from pansplat_viewer.ui.widgets import Widgets, draw_wrapped

if TYPE_CHECKING:
    from pansplat_viewer.viewer import Viewer

STATES: dict[str, Color] = {
    "sure": (0.45, 0.8, 0.5, 1.0),
    "about here": (1.0, 0.8, 0.3, 1.0),
    "nowhere": (0.95, 0.45, 0.4, 1.0),
}
_WALL, _FLOOR, _BACK = (0.9, 0.9, 0.92, 1.0), (0.3, 0.33, 0.37, 1.0), (0.1, 0.11, 0.13, 1.0)
_PIECE, _PIECE_FLOOR, _ALIGNED = (0.35, 0.8, 1.0, 1.0), (0.35, 0.8, 1.0, 0.22), (0.5, 1.0, 0.55, 1.0)
_DOOR = (1.0, 0.6, 0.2, 1.0)
_KNOB, _REACH = 34.0, 9.0  # pixels from the camera to the knob, and around the knob, at a DPI scale of 1
_WHEEL = math.radians(1)  # angle that a step of the wheel turns a panorama by
_BUTTONS = 150.0  # pixels from the list's left border to the buttons, at a DPI scale of 1
_ROWS = 0.25, 0.7  # the first and last row of the photograph that is shown, fractions of its height
_SIZE = 520.0  # width of the window, pixels at a DPI scale of 1
_FLAGS = imgui.WindowFlags_.no_scrollbar.value | imgui.WindowFlags_.no_scroll_with_mouse.value


def describe_state(placement: Placement) -> str:
    """How sure a place is; one of `STATES`."""
    if placement.state != "not placed":
        return "sure"
    return "nowhere" if placement.about is None else "about here"


def draw_photographs(viewer: Viewer, placing: PlacingByHand, widgets: Widgets) -> None:
    """Draw the list of panoramas with the states of their poses, and the buttons that change them."""
    column = _BUTTONS * imgui.get_style().font_scale_dpi
    for node, panorama in enumerate(placing.panoramas):
        state = describe_state(panorama.placement)
        imgui.align_text_to_frame_padding()
        imgui.text_colored(STATES[state], f"{panorama.label}  {state}")
        if panorama.placement.reason and imgui.is_item_hovered():
            imgui.set_tooltip(panorama.placement.reason)
        if placing.problem is None and len(placing.panoramas) > 1:
            gap = imgui.get_style().item_spacing.x - imgui.get_window_pos().x
            imgui.same_line(max(imgui.get_item_rect_max().x + gap, column))
            if widgets.button(f"Place##{node}"):
                placing.start(node)
    if placing.problem is not None:
        draw_wrapped(placing.problem, is_disabled=True)
    if placing.can_undo and widgets.button("Undo##poses") and placing.undo():
        viewer.queue(viewer.session.reload)


class PlacingWindow:
    """Draws the window of the panorama that is being placed.

    Attributes:
        view: of the plan in the last frame.
    """

    def __init__(self, ctx: moderngl.Context, widgets: Widgets) -> None:
        """No texture is made before the first frame."""
        self._ctx, self._widgets = ctx, widgets
        self._texture: moderngl.Texture | None = None
        self._shown: Piece | None = None  # in the texture
        self.view = PlanView((0.0, 0.0), 1.0, (1.0, 1.0))
        self._fitted: tuple[object, ...] = ()  # what the view was fitted to
        self._held: str | None = None  # what the pointer drags

    def release(self) -> None:
        """Free the texture."""
        if self._texture is not None:
            self._texture.release()
        self._texture = self._shown = None

    def draw(self, placing: PlacingByHand) -> bool:
        """Draw the window; returns whether poses were changed, so that the scenes are to be loaded again."""
        assert placing.node is not None
        scale, display = imgui.get_style().font_scale_dpi, imgui.get_io().display_size
        first = imgui.Cond_.first_use_ever.value
        size = min(_SIZE * scale, 0.9 * display.x, 0.75 * display.y)
        imgui.set_next_window_pos((display.x / 2, display.y / 2), first, (0.5, 0.5))
        imgui.set_next_window_size((size, min(1.4 * size, 0.95 * display.y)), first)
        shown, is_open = imgui.begin("Place by hand", True, _FLAGS)
        is_changed = False
        if shown:
            self._draw_choice(placing, placing.node)
            self._draw_photograph(placing.pieces.get(placing.panoramas[placing.node].image))
            self._draw_plan(placing, scale)
            imgui.text_disabled(placing.progress or "drag: move    knob: turn    wheel: turn by 1 degree")
            is_changed = self._widgets.button("Save##pose") and placing.save()
            imgui.same_line()
            if self._widgets.button("Close##pose"):
                placing.stop()
        imgui.end()
        if not is_open:
            placing.stop()
        return is_changed

    def _draw_choice(self, placing: PlacingByHand, node: int) -> None:
        """Draw what is placed, and beside which group if there are several."""
        names, options = [panorama.label for panorama in placing.panoramas], placing.list_targets(node)
        imgui.align_text_to_frame_padding()
        imgui.text_colored(_PIECE, ", ".join(names[other] for other in placing.moved))
        if len(options) > 1:
            imgui.same_line()
            imgui.text_unformatted("beside")
            imgui.same_line()
            imgui.set_next_item_width(-1)
            groups = [", ".join(names[other] for other in option) for option in options]
            changed, chosen = imgui.combo("##beside", options.index(placing.targets), groups)
            self._widgets.record("beside")
            if changed:
                placing.start(node, options[chosen])

    def _draw_photograph(self, piece: Piece | None) -> None:
        """Draw the photograph as far as it is level; its middle is the direction of the camera's mark."""
        if piece is None:
            return
        if piece is not self._shown:
            self.release()
            image = piece.surroundings.image
            rows = image[round(_ROWS[0] * len(image)) : round(_ROWS[1] * len(image))]
            pixels = (255 * rows.clip(0, 1)).astype(np.uint8)
            self._texture, self._shown = self._ctx.texture(pixels.shape[1::-1], 3, pixels.tobytes(), alignment=1), piece
            self._texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
        assert self._texture is not None
        width, at = imgui.get_content_region_avail().x, imgui.get_cursor_screen_pos()
        height = width * self._texture.height / self._texture.width
        imgui.image(imgui.ImTextureRef(self._texture.glo), (width, height))
        middle = at.x + width / 2
        imgui.get_window_draw_list().add_line((middle, at.y), (middle, at.y + height), _color(_PIECE), 1.0)

    def _draw_plan(self, placing: PlacingByHand, scale: float) -> None:
        """Draw the plan, and apply the pointer and the wheel to the panorama."""
        available, at = imgui.get_content_region_avail(), imgui.get_cursor_screen_pos()
        size = (max(available.x, 50.0), max(available.y - 56 * scale, 50.0))
        imgui.invisible_button("plan", size)
        self._widgets.record("plan")
        self._handle(placing, scale)
        outlines = {node: placing.outline(node) for node in (*placing.targets, *placing.moved)}
        if placing.place is None:
            outlines.pop(placing.node, None)
        shown = {node: outline for node, outline in outlines.items() if outline is not None}
        if not shown:
            return
        corner, points = (at.x, at.y), np.concatenate(list(shown.values()))
        key = placing.node, tuple(shown), size, corner
        if key != self._fitted or (self._held is None and not self.view.contains(points)):
            self._fitted, self.view = key, PlanView.of_points(points, size, corner)
        canvas, end = imgui.get_window_draw_list(), (at.x + size[0], at.y + size[1])
        canvas.push_clip_rect(corner, end, True)
        canvas.add_rect_filled(corner, end, _color(_BACK))
        shapes = {node: self._to_screen(outline) for node, outline in shown.items()}
        others = [node for node in shown if node in placing.targets]
        draw_floors([shown[node] for node in others], self.view, (_WALL, _FLOOR), scale)
        for node in others:
            place, panorama = placing.find_place(node), placing.panoramas[node]
            x, y = self._draw_camera(canvas, place, STATES[describe_state(panorama.placement)], scale)
            canvas.add_text((x + 7 * scale, y - 8 * scale), _color(_WALL), panorama.label)
        for node in [node for node in shown if node not in others]:
            canvas.add_concave_poly_filled(shapes[node], _color(_PIECE_FLOOR))
            color, closed = _color(_ALIGNED if placing.is_aligned else _PIECE), imgui.ImDrawFlags_.closed.value
            canvas.add_polyline(shapes[node], color, thickness=2 * scale, flags=closed)
        if placing.place is not None:
            half, center = 4 * scale, self._draw_camera(canvas, placing.place, _PIECE, scale)
            canvas.add_circle(center, _KNOB * scale, _color((*_PIECE[:3], 0.35)), 0, scale)
            for x, y in self._to_screen(np.array(placing.find_doors()).reshape(-1, 2)):
                canvas.add_rect_filled((x - half, y - half), (x + half, y + half), _color(_DOOR))
            canvas.add_circle_filled(self.find_knob(placing.place, scale), 6 * scale, _color(_PIECE))
        canvas.pop_clip_rect()

    def _to_screen(self, places: Float[np.ndarray, "n 2"]) -> list[tuple[float, float]]:
        return [(x, y) for x, y in self.view.to_pixels(places).tolist()]

    def _draw_camera(
        self, canvas: imgui.ImDrawList, place: PlanPose, color: Color, scale: float
    ) -> tuple[float, float]:
        """Draw a camera with its heading; returns its pixel."""
        ((x, y),) = self._to_screen(np.array([place[:2]]))
        tip = (x + 11 * scale * math.sin(place.yaw), y - 11 * scale * math.cos(place.yaw))
        canvas.add_line((x, y), tip, _color(color), 1.5 * scale)
        canvas.add_circle_filled((x, y), 4.5 * scale, _color(color))
        return x, y

    def find_knob(self, place: PlanPose, scale: float) -> tuple[float, float]:
        """The pixel of the knob that turns the panorama."""
        ((x, y),) = self._to_screen(np.array([place[:2]]))
        return x + _KNOB * scale * math.sin(place.yaw), y - _KNOB * scale * math.cos(place.yaw)

    def _handle(self, placing: PlacingByHand, scale: float) -> None:
        io, mouse = imgui.get_io(), imgui.get_mouse_pos()
        if placing.place is None or not imgui.is_item_active():
            self._held = None
        elif imgui.is_item_activated():
            knob = self.find_knob(placing.place, scale)
            is_knob = math.hypot(mouse.x - knob[0], mouse.y - knob[1]) < _REACH * scale
            self._held = "knob" if is_knob else "panorama"
        elif self._held == "panorama":
            metres = 1 / self.view.pixels_per_metre
            placing.move(io.mouse_delta.x * metres, -io.mouse_delta.y * metres)
        elif self._held == "knob" and (io.mouse_delta.x or io.mouse_delta.y):
            ((x, y),) = self._to_screen(np.array([placing.place[:2]]))
            placing.turn_to(math.atan2(mouse.x - x, y - mouse.y))
        if imgui.is_item_hovered() and io.mouse_wheel:
            placing.turn(io.mouse_wheel * _WHEEL)


def _color(color: Color) -> int:
    return imgui.color_convert_float4_to_u32(color)
