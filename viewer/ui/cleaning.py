"""The section "Clean up" of the panel, and the mask that is painted on a photograph."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from imgui_bundle import imgui

from pansplat_viewer.scene.camera import Camera
from pansplat_viewer.scene.cleaning import MaskPainter
from pansplat_viewer.scene.picking import project_point
from pansplat_viewer.scene.state import ViewerState
from pansplat_viewer.window.input import Commands

_OUTLINE, _BRUSH = (1.0, 0.25, 0.2, 1.0), (1.0, 1.0, 1.0, 0.8)
_LONGEST = 0.1  # of a line of an outline that is drawn, radians; longer ones are divided

Slider = Callable[[str, float, float, float, str], float]
Check = Callable[[str, bool], bool]
Button = Callable[[str], bool]


class CleaningSection:
    """Draws the section.

    Attributes:
        file: text of the field of the cleaned scene.
    """

    def __init__(self, slider: Slider, check: Check, button: Button, record: Callable[[str], None]) -> None:
        """Widgets that record their rectangles."""
        self._slider, self._check, self._button, self._record = slider, check, button, record
        self.file = "clean.ply"

    def draw(
        self,
        state: ViewerState,
        commands: Commands,
        bounds: tuple[float, ...] | None,
        painter: MaskPainter | None,
        progress: tuple[str, float] | None,
        *,
        refining: bool,
        can_paint: bool,
    ) -> None:
        """Draw the widgets.

        Args:
            state: of the viewer.
            commands: of this frame.
            bounds: of the scene; None for scenes that cannot be cropped here.
            painter: the mask that is painted; None if none is.
            progress: of the work on the scene.
            refining: whether another scene will follow.
            can_paint: whether there are photographs.
        """
        if bounds is None:
            imgui.text_disabled("crop a tour with pansplat export --crop")
        else:
            self._draw_box(state, bounds)
            imgui.begin_disabled(progress is not None or refining)
            commands.remove_floaters = self._button("Remove floaters")
            _, self.file = imgui.input_text("##clean file", self.file)
            self._record("clean file")
            imgui.same_line()
            if self._button("Save##clean") and self.file.strip():
                commands.save_scene = self.file.strip()
            imgui.end_disabled()
            if progress is not None:
                imgui.progress_bar(progress[1], (-1, 0), progress[0])
        imgui.begin_disabled(not can_paint)
        is_painted = self._check("paint what to hide", painter is not None)
        commands.paint = None if is_painted == (painter is not None) else is_painted
        imgui.end_disabled()
        if painter is None:
            return
        state.brush_degrees = self._slider("brush", state.brush_degrees, 0.5, 20.0, "%.1f deg")
        imgui.text_disabled("drag: hide    Shift: show    right drag: look")
        commands.clear_mask = self._button("Clear")
        imgui.same_line()
        imgui.begin_disabled(not painter.is_changed)
        commands.save_mask = self._button("Save mask")
        imgui.end_disabled()
        imgui.same_line()
        imgui.text_unformatted(painter.panorama.label)

    def _draw_box(self, state: ViewerState, bounds: tuple[float, ...]) -> None:
        box = state.settings.box
        is_cropped = self._check("crop to a box", box is not None)
        if not is_cropped or box is None:
            state.settings = replace(state.settings, box=bounds if is_cropped else None)
            return
        values = list(box)
        for axis, name in enumerate("xyz"):
            low, high = bounds[axis], max(bounds[axis + 3], bounds[axis] + 1e-6)
            for end, label in ((0, "from"), (3, "to")):
                values[axis + end] = self._slider(f"{name} {label}", values[axis + end], low, high, "%.2f m")
        state.settings = replace(state.settings, box=tuple(values))


def draw_mask(painter: MaskPainter, camera: Camera, brush_degrees: float) -> None:
    """Draw the outlines of what is hidden, and the brush, over the image."""
    size, lines = imgui.get_io().display_size, imgui.get_background_draw_list()
    window, position = (int(size.x), int(size.y)), np.asarray(camera.position)
    color = imgui.color_convert_float4_to_u32(_OUTLINE)
    for outline in painter.list_outlines():
        for start, end in zip(outline, np.roll(outline, -1, axis=0), strict=True):
            count = max(int(np.linalg.norm(end - start) / _LONGEST), 1)
            places = [
                project_point(camera, tuple(position + start + (end - start) * k / count), window)
                for k in range(count + 1)
            ]
            for first, second in itertools.pairwise(places):
                if first is not None and second is not None:
                    lines.add_line(first, second, color, 2.0)
    if not imgui.get_io().want_capture_mouse:
        focal = 0.5 * size.y / math.tan(math.radians(camera.vertical_fov_degrees) / 2)
        radius = focal * math.tan(math.radians(brush_degrees))
        lines.add_circle(imgui.get_io().mouse_pos, radius, imgui.color_convert_float4_to_u32(_BRUSH))
