"""The list of photographs with the states of their poses, and the window in which one is placed by hand.

All that they change is in `pansplat_viewer.scene.placing`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import moderngl
import numpy as np
from imgui_bundle import imgui
from jaxtyping import Float

from pansplat.inputs.placements import State
from pansplat.poses.placing import Piece
from pansplat_viewer.scene.placing import Nodes, Placing, PlanPose, PlanView
from pansplat_viewer.ui.widgets import Widgets, draw_wrapped

if TYPE_CHECKING:
    from pansplat_viewer.viewer import Viewer

STATE_COLORS: dict[State, tuple[float, float, float, float]] = {
    "placed": (0.45, 0.8, 0.5, 1.0),
    "by hand": (0.5, 0.7, 1.0, 1.0),
    "probable": (1.0, 0.8, 0.3, 1.0),
    "not placed": (0.95, 0.45, 0.4, 1.0),
}
STATE_NAMES: dict[State, str] = {
    "placed": "placed",
    "by hand": "placed by hand",
    "probable": "probably placed",
    "not placed": "not placed",
}
HINT = "drag: move    wheel or knob: turn    Shift: fine    Alt: free"

_WALL, _FLOOR = (0.9, 0.9, 0.92, 1.0), (0.3, 0.33, 0.37, 1.0)
_PIECE, _PIECE_FLOOR = (0.35, 0.8, 1.0, 1.0), (0.35, 0.8, 1.0, 0.22)
_GHOST, _SNAPPED, _BACK = (1.0, 0.8, 0.3, 0.9), (0.5, 1.0, 0.55, 1.0), (0.1, 0.11, 0.13, 1.0)
_GOOD, _BAD = (0.4, 0.9, 0.45), (0.95, 0.4, 0.35)
_KNOB = 34.0  # pixels from the camera to the knob, at a DPI scale of 1
_REACH = 9.0  # pixels around a ghost or the knob
_BUTTONS = 150.0  # pixels from the list's left border to the first button, at a DPI scale of 1
_ROWS = 0.25, 0.7  # of the photograph that are shown
_SIZE = 520.0  # of the window, pixels at a DPI scale of 1

_FLAGS = imgui.WindowFlags_.no_scrollbar.value | imgui.WindowFlags_.no_scroll_with_mouse.value


def count_states(placing: Placing) -> str:
    """The numbers of photographs by state."""
    states = [panorama.placement.state for panorama in placing.panoramas]
    counts = {name: states.count(state) for state, name in STATE_NAMES.items()}
    return ", ".join(f"{count} {name}" for name, count in counts.items() if count)


def draw_photographs(viewer: Viewer, placing: Placing, widgets: Widgets) -> None:
    """Draw the list of photographs with the states of their poses, and buttons to change them."""
    imgui.text_unformatted(count_states(placing))
    gap, column = imgui.get_style().item_spacing.x, _BUTTONS * imgui.get_style().font_scale_dpi
    for node, panorama in enumerate(placing.panoramas):
        imgui.push_id(node)
        placement = panorama.placement
        imgui.align_text_to_frame_padding()
        imgui.text_colored(STATE_COLORS[placement.state], panorama.label)
        imgui.same_line()
        imgui.text_unformatted(STATE_NAMES[placement.state])
        for label, shown, act in (
            ("Reject", placing.can_reject(node), placing.reject),
            ("Restore", placing.can_restore(node), placing.restore),
            ("Place", placing.problem is None and len(placing.panoramas) > 1, placing.start),
        ):
            if shown:
                imgui.same_line(max(imgui.get_item_rect_max().x - imgui.get_window_pos().x + gap, column))
                if widgets.button(f"{label}##{node}"):
                    act(node)
        if placement.reason:
            draw_wrapped(placement.reason, is_disabled=True)
        imgui.pop_id()
    if placing.problem is not None:
        draw_wrapped(placing.problem, is_disabled=True)
    if placing.can_undo and widgets.button("Undo##poses"):
        placing.undo()
    if placing.is_changed:
        if placing.can_undo:
            imgui.same_line()
        if widgets.button("Load the changed poses"):
            viewer.queue(viewer.scenes.reload)


class PlacingWindow:
    """Draws the window of the photograph that is being placed.

    Attributes:
        corner, view: of the plan in the last frame, pixels; for tests that drag.
    """

    def __init__(self, ctx: moderngl.Context, widgets: Widgets) -> None:
        """No texture is made before the first frame."""
        self._ctx, self._widgets = ctx, widgets
        self._texture: moderngl.Texture | None = None
        self._shown: Piece | None = None  # in the texture
        self.corner = (0.0, 0.0)
        self.view = PlanView((0.0, 0.0), 1.0, (1.0, 1.0))
        self._key: tuple[object, ...] = ()
        self._held: str | None = None  # what the pointer drags

    def draw(self, placing: Placing) -> bool:
        """Draw the window; returns whether the scenes are to be loaded again."""
        assert placing.node is not None
        scale, display = imgui.get_style().font_scale_dpi, imgui.get_io().display_size
        first = imgui.Cond_.first_use_ever.value
        size = min(_SIZE * scale, 0.9 * display.x, 0.75 * display.y)
        imgui.set_next_window_pos((display.x / 2, display.y / 2), first, (0.5, 0.5))
        imgui.set_next_window_size((size, min(1.4 * size, 0.95 * display.y)), first)
        shown, is_open = imgui.begin("Place by hand", True, _FLAGS)
        reload = False
        if shown:
            self._draw_choices(placing)
            self._draw_photograph(placing)
            self._draw_plan(placing, scale)
            reload = self._draw_state(placing)
        imgui.end()
        if not is_open:
            placing.stop()
        return reload

    def _draw_choices(self, placing: Placing) -> None:
        node = placing.node
        assert node is not None
        names = [panorama.label for panorama in placing.panoramas]
        imgui.align_text_to_frame_padding()
        imgui.text_colored(_PIECE, names[node])
        imgui.same_line()
        imgui.text_unformatted("beside")
        imgui.same_line()
        options = placing.list_targets(node)
        group = placing.group_of(node)
        if placing.with_group:
            options = [option for option in options if not set(option) & set(group)]
        imgui.set_next_item_width(-1 if len(group) == 1 else -130 * imgui.get_style().font_scale_dpi)
        current = options.index(placing.targets) if placing.targets in options else 0
        changed, chosen = imgui.combo("##beside", current, [_list_names(names, option) for option in options])
        if changed:
            placing.start(node, options[chosen], with_group=placing.with_group)
        if len(group) > 1 and any(not set(option) & set(group) for option in options):
            imgui.same_line()
            label = "only it##group" if placing.with_group else "with its group##group"
            if self._widgets.button(label):
                placing.start(node, with_group=not placing.with_group)

    def release(self) -> None:
        """Free the texture."""
        if self._texture is not None:
            self._texture.release()
        self._texture = self._shown = None

    def _draw_photograph(self, placing: Placing) -> None:
        """Draw the photograph of the piece as far as it is level; its middle is the direction of the camera's mark."""
        assert placing.node is not None
        piece = placing.pieces.get(placing.panoramas[placing.node].image)
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
        imgui.get_window_draw_list().add_line((middle, at.y), (middle, at.y + height), _color((*_PIECE[:3], 0.7)), 1.0)

    def _draw_plan(self, placing: Placing, scale: float) -> None:
        """Draw the plan, and apply the pointer and the wheel to the piece."""
        available = imgui.get_content_region_avail()
        size = (max(available.x, 50.0), max(available.y - 92 * scale, 50.0))
        at = imgui.get_cursor_screen_pos()
        self.corner = (at.x, at.y)
        imgui.invisible_button("plan", size)
        self._widgets.record("plan")
        self._handle(placing, scale)
        self._choose_view(placing, size)
        canvas = imgui.get_window_draw_list()
        canvas.push_clip_rect(self.corner, (at.x + size[0], at.y + size[1]), True)
        canvas.add_rect_filled(self.corner, (at.x + size[0], at.y + size[1]), _color(_BACK))
        self._draw_targets(placing, canvas, scale)
        self._draw_ghosts(placing, canvas, scale)
        self._draw_piece(placing, canvas, scale)
        canvas.pop_clip_rect()

    def _choose_view(self, placing: Placing, size: tuple[float, float]) -> None:
        """Show all when something is new or has left the view, not during a drag."""
        points = placing.list_points()
        key = (placing.node, placing.targets, placing.with_group, len(placing.places), size)
        if key != self._key or (self._held is None and not self.view.contains(points)):
            self._key, self.view = key, PlanView.of_points(points, size)

    def _to_screen(self, places: Float[np.ndarray, "n 2"]) -> list[tuple[float, float]]:
        return [(x + self.corner[0], y + self.corner[1]) for x, y in self.view.to_pixels(places).tolist()]

    def _draw_targets(self, placing: Placing, canvas: imgui.ImDrawList, scale: float) -> None:
        outlines = [placing.outline(target) for target in placing.targets]
        shapes = [self._to_screen(outline) for outline in outlines if outline is not None]
        for points in shapes:
            _draw_line(canvas, points, _WALL, 3 * scale)
        for points in shapes:  # over the lines: an outline that ends in another one's floor draws no wall
            canvas.add_concave_poly_filled(points, _color(_FLOOR))
        for target, place in placing.places.items():
            panorama = placing.panoramas[target]
            self._draw_camera(canvas, place, STATE_COLORS[panorama.placement.state], scale)
            (x, y), *_ = self._to_screen(np.array([place[:2]]))
            canvas.add_text((x + 7 * scale, y - 8 * scale), _color(_WALL), panorama.label)

    def _draw_ghosts(self, placing: Placing, canvas: imgui.ImDrawList, scale: float) -> None:
        hovered = self._find_ghost(placing, scale) if imgui.is_item_hovered() and self._held is None else None
        for number, ghost in enumerate(placing.ghosts):
            color = _SNAPPED if placing.shown.suggestion == number else _GHOST
            self._draw_camera(canvas, ghost.place, color, scale, hollow=True)
            if number == hovered and placing.node is not None:
                piece = placing.pieces[placing.panoramas[placing.node].image]
                points = self._to_screen(piece.draw_outline(ghost.place, placing.floor.unit))
                _draw_line(canvas, points, (*_GHOST[:3], 0.6), scale)
                other = placing.panoramas[ghost.other].label
                percent = 100 * ghost.probability
                share = f"right with {percent:.0f} %" if percent >= 1 else "right with less than 1 %"
                share = "by the links of the tour" if ghost.log_odds == -math.inf else share
                imgui.set_tooltip(f"hypothesis beside {other}: {share}")

    def _draw_camera(
        self, canvas: imgui.ImDrawList, place: PlanPose, color: tuple, scale: float, *, hollow: bool = False
    ) -> None:
        (x, y), *_ = self._to_screen(np.array([place[:2]]))
        tip = (x + 11 * scale * math.sin(place.yaw), y - 11 * scale * math.cos(place.yaw))
        canvas.add_line((x, y), tip, _color(color), 1.5 * scale)
        if hollow:
            canvas.add_circle((x, y), 5 * scale, _color(color), 0, 1.5 * scale)
        else:
            canvas.add_circle_filled((x, y), 4.5 * scale, _color(color))

    def _draw_piece(self, placing: Placing, canvas: imgui.ImDrawList, scale: float) -> None:
        for node in reversed(placing.moved) if placing.node is not None else ():
            outline = placing.outline(node)
            if outline is not None:
                line = _SNAPPED if placing.shown.suggestion is not None or placing.shown.is_aligned else _PIECE
                points = self._to_screen(outline)
                canvas.add_concave_poly_filled(points, _color(_PIECE_FLOOR))
                _draw_line(canvas, points, line, 2 * scale)
        if placing.places:
            self._draw_camera(canvas, placing.shown.place, _PIECE, scale)
            knob = self._find_knob(placing, scale)
            (x, y), *_ = self._to_screen(np.array([placing.shown.place[:2]]))
            canvas.add_circle((x, y), _KNOB * scale, _color((*_PIECE[:3], 0.35)), 0, scale)
            canvas.add_circle_filled(knob, 6 * scale, _color(_PIECE))

    def _find_knob(self, placing: Placing, scale: float) -> tuple[float, float]:
        (x, y), *_ = self._to_screen(np.array([placing.shown.place[:2]]))
        yaw = placing.shown.place.yaw
        return x + _KNOB * scale * math.sin(yaw), y - _KNOB * scale * math.cos(yaw)

    def _find_ghost(self, placing: Placing, scale: float) -> int | None:
        """The number of the ghost under the pointer, if the piece is not there."""
        mouse = imgui.get_mouse_pos()
        (x, y), *_ = self._to_screen(np.array([placing.shown.place[:2]]))
        if math.hypot(mouse.x - x, mouse.y - y) < _REACH * scale:
            return None
        for number, (x, y) in enumerate(
            self._to_screen(np.array([g.place[:2] for g in placing.ghosts]).reshape(-1, 2))
        ):
            if math.hypot(mouse.x - x, mouse.y - y) < _REACH * scale:
                return number
        return None

    def _handle(self, placing: Placing, scale: float) -> None:
        io, mouse = imgui.get_io(), imgui.get_mouse_pos()
        fine, free = io.key_shift, io.key_alt
        if not placing.places or placing.node is None:
            self._held = None
            return
        if imgui.is_item_activated():
            knob = self._find_knob(placing, scale)
            ghost = self._find_ghost(placing, scale)
            if math.hypot(mouse.x - knob[0], mouse.y - knob[1]) < _REACH * scale:
                self._held = "knob"
            elif ghost is not None:
                placing.go_to(ghost)
            else:
                self._held = "piece"
        elif not imgui.is_item_active():
            if self._held is not None:
                placing.drop()
            self._held = None
        elif self._held == "piece" and (io.mouse_delta.x or io.mouse_delta.y):
            metres = 1 / self.view.pixels_per_metre
            placing.move(io.mouse_delta.x * metres, -io.mouse_delta.y * metres, fine=fine, free=free)
        elif self._held == "knob" and (io.mouse_delta.x or io.mouse_delta.y):
            (x, y), *_ = self._to_screen(np.array([placing.shown.place[:2]]))
            placing.turn_to(math.atan2(mouse.x - x, y - mouse.y), free=fine or free)
        steps = io.mouse_wheel if imgui.is_item_hovered() else 0.0
        if steps:
            placing.turn(steps, fine=fine, free=free)

    def _draw_state(self, placing: Placing) -> bool:
        """Draw the fit and the buttons; returns whether the scenes are to be loaded again."""
        if placing.missing:
            progress = "" if not placing.is_reading else f"estimating depth: {placing.missing} photographs to go"
            imgui.text_unformatted(progress or "reading")
        elif placing.fit is None:
            imgui.text_colored((*_BAD, 1.0), "nothing in common with the others at this place")
        else:
            fit, share = placing.fit, placing.fit.quality
            color = tuple(share * good + (1 - share) * bad for good, bad in zip(_GOOD, _BAD, strict=True))
            text = f"likeness {fit.likeness:.2f}   conflict {100 * fit.conflict:.1f} %"
            imgui.text_colored((*color, 1.0), text)
            imgui.progress_bar(share, (-1, 5 * imgui.get_style().font_scale_dpi), "")
        button = self._widgets.button
        imgui.text_disabled(HINT)
        imgui.begin_disabled(placing.fit is None)
        if button("Adjust##pose"):
            placing.adjust()
        imgui.end_disabled()
        imgui.same_line()
        if button("Save, although it fits poorly##pose" if placing.is_doubted else "Save##pose"):
            placing.save()
        imgui.same_line()
        imgui.begin_disabled(not placing.can_undo)
        if button("Undo##pose"):
            placing.undo()
        imgui.end_disabled()
        imgui.same_line()
        if button("Close##pose"):
            placing.stop()
        if not placing.is_changed:
            return False
        imgui.same_line()
        return button("Load the changed poses##pose")


def _list_names(names: list[str], nodes: Nodes) -> str:
    return ", ".join(names[node] for node in nodes)


def _draw_line(canvas: imgui.ImDrawList, points: list[tuple[float, float]], color: tuple, width: float) -> None:
    """Draw a closed line; the order of the arguments differs among imgui's versions."""
    canvas.add_polyline(points, _color(color), flags=imgui.ImDrawFlags_.closed.value, thickness=width)


def _color(color: tuple) -> int:
    return imgui.color_convert_float4_to_u32(color)
