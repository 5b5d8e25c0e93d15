"""The panel over the image: photographs, plan, notes and film, and what only experts need.

It reads the viewer and changes its state at once; other actions are queued.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import moderngl
from imgui_bundle import imgui

from pansplat.tours.graph import TourGraph
from pansplat_viewer.core.settings import Display
from pansplat_viewer.core.state import (
    KEY_SECONDS,
    ViewerState,
    add_key_frame,
    choose_display,
    go_to_view,
    make_key_frame,
    show_path,
    toggle_play,
)
from pansplat_viewer.core.tour_scenes import TourScenes
from pansplat_viewer.ui.minimap import Minimap, describe_panorama, describe_panoramas
from pansplat_viewer.ui.notes import NotesSection, draw_notes
from pansplat_viewer.ui.overlays import (
    FIXED,
    MARGIN,
    PANEL_WIDTH,
    UNITS,
    draw_hotspots,
    draw_legend,
    draw_message,
    draw_points,
)
from pansplat_viewer.ui.placing_panel import PlacingWindow, draw_photographs
from pansplat_viewer.ui.widgets import Widgets, draw_wrapped
from pansplat_viewer.window.input import KEYS

if TYPE_CHECKING:
    from pansplat_viewer.viewer import Viewer

_BAR_COLOR = (0.2, 0.4, 0.7, 1.0)  # RGBA of a progress bar behind a white text
_PANEL = imgui.WindowFlags_.no_title_bar.value | imgui.WindowFlags_.no_bring_to_front_on_focus.value


class Panels:
    """Draws all panels of the window.

    Attributes:
        widgets: has the rectangles of the last frame.
        path, path_file: texts of the fields of scenes and of the camera path.
        minimap: the plan of a tour.
        placing: the window in which a photograph is placed.
        notes: the field and buttons of notes.
        width: of the main panel in the last frame, pixels.
    """

    def __init__(self, ctx: moderngl.Context) -> None:
        self.widgets = Widgets()
        self.minimap, self.placing = Minimap(), PlacingWindow(ctx, self.widgets)
        self.notes = NotesSection(self.widgets)
        self.path, self.path_file, self.width = "", "path.json", 0.0

    def draw(self, viewer: Viewer) -> None:
        """Draw the panels that are shown."""
        self.widgets.items.clear()
        state, placing = viewer.state, viewer.placing
        if state.overlay:
            self._draw_main_panel(viewer)
        if viewer.stage.slot.scene is not None:
            draw_legend(state)
        if state.overlay and state.points:
            draw_points(state)
        if state.overlay and state.plan:
            draw_hotspots(viewer.hotspots)
            draw_notes(viewer)
        if state.overlay and placing is not None and placing.node is not None and self.placing.draw(placing):
            viewer.queue(viewer.session.reload)
        if state.help:
            state.help = _draw_help()
        if viewer.session.loading:
            self._draw_progress(viewer, *viewer.session.loading)
        elif viewer.error:
            self._draw_error(viewer, viewer.error)
        if state.message and state.now < state.message_until:
            draw_message(state.message)

    def release(self) -> None:
        """Free the GL objects."""
        self.placing.release()

    def _draw_main_panel(self, viewer: Viewer) -> None:
        scale, size = imgui.get_style().font_scale_dpi, imgui.get_io().display_size
        imgui.set_next_window_pos((0, 0))
        imgui.set_next_window_size((PANEL_WIDTH * scale, size.y), imgui.Cond_.first_use_ever.value)
        imgui.set_next_window_size_constraints((0, size.y), (0.6 * size.x, size.y))
        imgui.set_next_window_bg_alpha(0.98)
        imgui.begin("pansplat", None, _PANEL)
        self.width = imgui.get_window_width()
        imgui.push_item_width(-110 * scale)
        self._draw_sections(viewer)
        imgui.pop_item_width()
        imgui.end()

    def _draw_sections(self, viewer: Viewer) -> None:
        """Draw what everybody needs, open, and the rest, closed."""
        section = self.widgets.section
        self._draw_scene(viewer)
        if viewer.session.tour is not None:
            section("Plan", partial(self._draw_plan, viewer, viewer.session.tour))
        if viewer.state.context.size:
            section("Photographs", partial(self._draw_photographs, viewer))
        if viewer.session.notes or len(viewer.stage.photographs):
            section("Notes", partial(self._draw_notes, viewer))
        section("Film", partial(self._draw_film, viewer))
        section("Expert", partial(self._draw_expert, viewer), opened=False)

    def _draw_photographs(self, viewer: Viewer) -> None:
        """Draw where the camera can go, and the states of estimated poses."""
        state, placing = viewer.state, viewer.placing
        if state.graph is not None:
            self._draw_list(state, state.graph)
        if self.widgets.button("Stop" if state.playing else "Fly"):
            toggle_play(state)
        if placing is not None and placing.is_listed:
            opened = any(view.placement.state != "placed" for view in placing.panoramas)
            self.widgets.section("Poses", partial(draw_photographs, viewer, placing, self.widgets), opened=opened)

    def _draw_plan(self, viewer: Viewer, tour: TourScenes) -> None:
        """Draw the floor plan, and the progress of the prediction."""
        state = viewer.state
        state.plan = self.widgets.check("floor plan and rings", state.plan)
        if state.plan and (tour.outlines or any(map(tour.tour.is_placed, range(len(tour.tour))))):  # else side by side
            clicked = self.minimap.draw(tour, state.camera)
            state.target = state.target if clicked is None else clicked
            if tour.tour.approximate:
                imgui.text_disabled("dashed: about here")
        if viewer.session.background is not None:
            task, fraction = viewer.session.background
            draw_wrapped(task)
            imgui.progress_bar(fraction, (-1, 0), f"{100 * fraction:.0f}%")

    def _draw_notes(self, viewer: Viewer) -> None:
        """Draw the note at the middle of the image, and what was not used of the folder."""
        if len(viewer.stage.photographs):
            self.notes.draw(viewer)
        for note in viewer.session.notes:
            draw_wrapped(note, is_disabled=True)

    def _draw_film(self, viewer: Viewer) -> None:
        """Draw the buttons of pictures and the editor of the camera path."""
        self._draw_screenshot(viewer)
        self._draw_path(viewer)

    def _draw_expert(self, viewer: Viewer) -> None:
        """Draw what is drawn of the Gaussians."""
        state = viewer.state
        if viewer.stage.slot.scene is not None:
            self._draw_gaussians(state)
        self._draw_display(state)
        state.stops = self.widgets.check("photographs at panoramas", state.stops)

    def _draw_scene(self, viewer: Viewer) -> None:
        session, recent, width = viewer.session, viewer.recent, -60 * imgui.get_style().font_scale_dpi
        if session.entries:
            names = [f"{i + 1}. {name}" for i, name in enumerate(session.names)]  # numbered, because names may repeat
            imgui.set_next_item_width(-1)
            changed, index = imgui.combo("##pair", max(session.current, 0), names)
            self.widgets.record("pair")
            if changed:
                viewer.queue(session.choose, index)
        imgui.set_next_item_width(width)
        hint, flags = "folder or scene, or drop it here", imgui.InputTextFlags_.enter_returns_true.value
        entered, self.path = imgui.input_text_with_hint("##path", hint, self.path, flags)
        self.widgets.record("path")
        imgui.same_line()
        if (self.widgets.button("Open") or entered) and self.path.strip():
            viewer.queue(session.search, Path(self.path.strip()).expanduser())
        if recent:
            imgui.set_next_item_width(width)
            if imgui.begin_combo("##recent", "recent"):
                for path in recent:
                    if imgui.selectable(path, False)[0]:
                        viewer.queue(session.search, Path(path))
                imgui.end_combo()
            self.widgets.record("recent")
            imgui.same_line()
        if session.entries and self.widgets.button("Reload"):
            viewer.queue(session.reload)
        if (fraction := session.refinement) is not None:
            if self.widgets.button("Cancel"):
                viewer.queue(session.cancel_refinement)
            imgui.same_line()
            imgui.progress_bar(fraction, (-1, 0), f"refining {100 * fraction:.0f}%")

    def _draw_gaussians(self, state: ViewerState) -> None:
        settings, num_views = state.settings, state.num_views
        for mode in ("joint", "deferred") if num_views > 1 else ("joint",):
            if mode != "joint":
                imgui.same_line()
            if self.widgets.radio(mode, settings.mode == mode):
                settings = replace(settings, mode=mode)
        for view in range(num_views):
            if view % 3:
                imgui.same_line()
            if self.widgets.radio(f"view {view}", settings.mode == "view" and settings.view == view):
                settings = replace(settings, mode="view", view=view)
        if len(state.levels) > 1:
            shown = set(state.levels if settings.levels is None else settings.levels)
            _draw_row_label("level")
            for level in state.levels:
                imgui.same_line()
                if self.widgets.check(f"{level}##level", level in shown):
                    shown.add(level)
                else:
                    shown.discard(level)
            settings = replace(settings, levels=None if shown == set(state.levels) else frozenset(shown))
        state.settings = settings

    def _draw_list(self, state: ViewerState, graph: TourGraph) -> None:
        """Draw the list of panoramas; a click leads there."""
        imgui.set_next_item_width(-1)
        if imgui.begin_combo("##visit", describe_panoramas(graph)):
            for node in range(len(graph)):
                if imgui.selectable(f"{node + 1}. {describe_panorama(graph, node)}", False)[0]:
                    go_to_view(state, node)
                self.widgets.record(f"visit {node}")
            imgui.end_combo()
        else:
            self.widgets.record("visit")

    def _draw_display(self, state: ViewerState) -> None:
        for number, display in enumerate(get_args(Display)):
            if number % 3:
                imgui.same_line()
            if self.widgets.radio(display, state.settings.display == display):
                choose_display(state, display)
        if state.settings.display in UNITS:
            largest = state.settings.display_max
            form = f"%.{1 if largest < 100 else 0}f{UNITS[state.settings.display]}"
            chosen = self.widgets.slider("range", largest, 1.0, 1000.0, form, logarithmic=True)
            state.settings = replace(state.settings, display_max=chosen)

    def _draw_progress(self, viewer: Viewer, name: str, task: str, fraction: float) -> None:
        """Draw the progress of a load."""
        size, scale = imgui.get_io().display_size, imgui.get_style().font_scale_dpi
        imgui.set_next_window_pos((size.x / 2, size.y - 6 * MARGIN * scale), 0, (0.5, 1.0))
        imgui.set_next_window_size((min(620 * scale, size.x - 2 * MARGIN), 0))
        imgui.begin("##progress", None, FIXED | imgui.WindowFlags_.no_title_bar.value)
        text = ", ".join(filter(None, (f"{name}: {task}", viewer.session.loader.describe_time())))
        at = fraction or -viewer.state.now  # a bar that moves, while nothing is done
        imgui.push_style_color(imgui.Col_.plot_histogram.value, _BAR_COLOR)
        imgui.progress_bar(at, (-80 * scale, 0), "")
        imgui.pop_style_color()
        corner, white = imgui.get_item_rect_min(), imgui.color_convert_float4_to_u32((1.0, 1.0, 1.0, 1.0))
        place = corner.x + 6 * scale, corner.y + imgui.get_style().frame_padding.y
        imgui.get_window_draw_list().add_text(place, white, text)
        imgui.same_line()
        if self.widgets.button("Cancel##loading"):
            viewer.queue(viewer.session.cancel_loading)
        imgui.end()

    def _draw_screenshot(self, viewer: Viewer) -> None:
        _draw_row_label("picture")
        imgui.same_line()
        if self.widgets.button("PNG"):
            viewer.queue(viewer.write_screenshot, "png")
        imgui.same_line()
        if self.widgets.button("EXR + depth"):
            viewer.queue(viewer.write_screenshot, "exr")
        imgui.same_line()
        if self.widgets.button("360 PNG"):
            viewer.queue(viewer.write_screenshot, "png", True)

    def _draw_path(self, viewer: Viewer) -> None:
        """Draw the editor of key frames."""
        state = viewer.state
        if self.widgets.button("Add key frame"):
            add_key_frame(state)
        if len(state.path):
            imgui.same_line()
            if self.widgets.button("Pause" if state.path_playing else "Play path"):
                if not state.path_playing and state.path_seconds >= state.path.seconds:
                    state.path_seconds = 0.0
                state.path_playing = not state.path_playing
        longest = max(state.path.seconds + KEY_SECONDS, KEY_SECONDS)
        seconds = self.widgets.slider("time", min(state.path_seconds, longest), 0.0, longest, "%.2f s")
        if seconds != state.path_seconds:
            state.path_playing = False
            show_path(state, seconds)
        for index, frame in enumerate(state.path.key_frames):
            imgui.push_id(index)
            if self.widgets.button(f"{frame.seconds:.2f} s##{index}"):
                show_path(state, frame.seconds)
            imgui.same_line()
            if self.widgets.button(f"Replace##{index}"):
                state.path = state.path.add(make_key_frame(state.camera, frame.seconds))
            imgui.same_line()
            if self.widgets.button(f"Delete##{index}"):
                state.path = state.path.remove(index)
            imgui.pop_id()
        self.path_file = self.widgets.text_field("path file", self.path_file)
        imgui.same_line()
        if self.widgets.button("Save") and len(state.path):
            viewer.queue(viewer.save_path, self.path_file)
        imgui.same_line()
        if self.widgets.button("Load"):
            viewer.queue(viewer.open_path, self.path_file)

    def _draw_error(self, viewer: Viewer, error: str) -> None:
        _place_at_center(width=560)
        imgui.begin("Error", None, FIXED | imgui.WindowFlags_.no_collapse.value)
        draw_wrapped(error)
        if self.widgets.button("OK"):
            viewer.queue(viewer.dismiss_error)
        imgui.end()


def _draw_row_label(label: str) -> None:
    imgui.align_text_to_frame_padding()
    imgui.text_unformatted(label)


def _place_at_center(width: float | None = None) -> None:
    """Place the next window at the centre, with a width at a DPI scale of 1 or its automatic size."""
    size = imgui.get_io().display_size
    imgui.set_next_window_pos((size.x / 2, size.y / 2), 0, (0.5, 0.5))
    if width is not None:
        imgui.set_next_window_size((min(width * imgui.get_style().font_scale_dpi, size.x - 2 * MARGIN), 0))


def _draw_help() -> bool:
    """Draw the key help; returns whether it stays open."""
    _place_at_center()
    flags = FIXED | imgui.WindowFlags_.always_auto_resize.value | imgui.WindowFlags_.no_collapse.value
    _, opened = imgui.begin("Keys", True, flags)
    if imgui.begin_table("keys", 2, imgui.TableFlags_.sizing_fixed_fit.value):
        for row in KEYS:
            imgui.table_next_row()
            for text in (row.label, row.help):
                imgui.table_next_column()
                imgui.text_unformatted(text)
        imgui.end_table()
    imgui.end()
    return bool(opened)
