"""The section "Clean up" of the panel, and the mask that is painted on a photograph."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from imgui_bundle import imgui

from pansplat_viewer.scene.camera import Camera
from pansplat_viewer.scene.cleaning import CLEANING_JOB, MaskPainter
from pansplat_viewer.scene.picking import project_point
from pansplat_viewer.scene.state import ViewerState
from pansplat_viewer.ui.widgets import Widgets

if TYPE_CHECKING:
    from pansplat_viewer.viewer import Viewer

_OUTLINE, _BRUSH = (1.0, 0.25, 0.2, 1.0), (1.0, 1.0, 1.0, 0.8)
_LONGEST = 0.1  # of a line of an outline that is drawn, radians; longer ones are divided


class CleaningSection:
    """Draws the section.

    Attributes:
        file: text of the field of the cleaned scene.
    """

    def __init__(self, widgets: Widgets) -> None:
        self._widgets, self.file = widgets, "clean.ply"

    def draw(self, viewer: Viewer) -> None:
        """Draw the widgets."""
        state, painting, widgets = viewer.state, viewer.painting, self._widgets
        bounds, progress = viewer.bounds, viewer.jobs.progress(CLEANING_JOB)
        if bounds is None:
            imgui.text_disabled("crop a tour with pansplat export --crop")
        else:
            self._draw_box(state, bounds)
            is_refining = viewer.refinement is not None and viewer.refinement < 1  # another scene will follow
            imgui.begin_disabled(progress is not None or is_refining)
            if widgets.button("Remove floaters"):
                viewer.queue(viewer.remove_floaters)
            self.file = widgets.text_field("clean file", self.file)
            imgui.same_line()
            if widgets.button("Save##clean") and self.file.strip():
                viewer.queue(viewer.save_scene, self.file.strip())
            imgui.end_disabled()
            if progress is not None:
                imgui.progress_bar(progress[1], (-1, 0), progress[0])
        painter, was_painted = painting.painter, painting.painter is not None
        imgui.begin_disabled(not len(viewer.stage.comparer.photographs))
        if widgets.check("paint what to hide", was_painted) != was_painted:
            viewer.queue(*((painting.leave, painting.stop) if was_painted else (viewer.start_painting,)))
        imgui.end_disabled()
        if painter is None:
            return
        state.brush_degrees = widgets.slider("brush", state.brush_degrees, 0.5, 20.0, "%.1f deg")
        imgui.text_disabled("drag: hide    Shift: show    right drag: look")
        if widgets.button("Clear"):
            viewer.queue(painter.clear)
        imgui.same_line()
        imgui.begin_disabled(not painter.is_changed)
        if widgets.button("Save mask"):
            viewer.queue(painting.save)
        imgui.end_disabled()
        imgui.same_line()
        imgui.text_unformatted(painter.panorama.label)

    def _draw_box(self, state: ViewerState, bounds: tuple[float, ...]) -> None:
        box = state.settings.box
        is_cropped = self._widgets.check("crop to a box", box is not None)
        if not is_cropped or box is None:
            state.settings = replace(state.settings, box=bounds if is_cropped else None)
            return
        values = list(box)
        for axis, name in enumerate("xyz"):
            low, high = bounds[axis], max(bounds[axis + 3], bounds[axis] + 1e-6)
            for end, label in ((0, "from"), (3, "to")):
                values[axis + end] = self._widgets.slider(f"{name} {label}", values[axis + end], low, high, "%.2f m")
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
