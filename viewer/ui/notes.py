"""Notes of panoramas: marks in their directions, and the section that puts one at the middle of the image."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from imgui_bundle import imgui

from pansplat.geometry.level import find_direction
from pansplat_viewer.core.picking import project_point
from pansplat_viewer.ui.widgets import Widgets

if TYPE_CHECKING:
    from pansplat_viewer.viewer import Viewer

_RADIUS = 9.0  # radius of a mark, pixels at a DPI scale of 1


def draw_notes(viewer: Viewer) -> None:
    """Draw a mark for each note of the panorama at the camera, with its text when the pointer is on it."""
    photographs, camera = viewer.stage.photographs, viewer.state.camera
    position = np.asarray(camera.position)
    index = photographs.find_stop(position)
    if index is None:
        return
    size, radius = imgui.get_io().display_size, _RADIUS * imgui.get_style().font_scale_dpi
    black, white = (imgui.color_convert_float4_to_u32((*rgb, 0.85)) for rgb in ((0.0,) * 3, (1.0,) * 3))
    canvas, pointer = imgui.get_background_draw_list(), imgui.get_mouse_pos()
    for note in photographs.list_notes(index):
        away = find_direction(photographs.panoramas[index].cam2world, note.yaw, note.pitch).numpy()
        pixel = project_point(camera, tuple(position + away), (int(size.x), int(size.y)))
        if pixel is None:
            continue
        canvas.add_circle_filled(pixel, radius, white)
        canvas.add_circle(pixel, radius, black, 0, 2.0)
        canvas.add_text((pixel[0] - imgui.calc_text_size("i").x / 2, pixel[1] - imgui.get_font_size() / 2), black, "i")
        if (
            np.hypot(pointer.x - pixel[0], pointer.y - pixel[1]) < 1.5 * radius
            and not imgui.get_io().want_capture_mouse
        ):
            imgui.set_tooltip("\n".join((note.text, *note.addresses)).strip())  # no format: a % is shown as it is


class NotesSection:
    """Draws the section that puts a note at the middle of the image, or takes the one that is there away."""

    def __init__(self, widgets: Widgets) -> None:
        """The field is empty."""
        self._widgets, self._text = widgets, ""

    def draw(self, viewer: Viewer) -> None:
        """Draw the field and the buttons; they stay while the camera flies, so that what is below does not move."""
        self._text = self._widgets.text_field("note", self._text)
        if self._widgets.button("Put at the middle") and self._text.strip():
            viewer.queue(viewer.put_note, self._text)
            self._text = ""
        imgui.same_line()
        if self._widgets.button("Remove"):
            viewer.queue(viewer.put_note, "")
