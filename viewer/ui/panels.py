"""The panels over the image: scene, display, Gaussians, camera, comparison, screenshots, camera path and window."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import get_args

import moderngl
from imgui_bundle import imgui

from pansplat_viewer.scene import camera as cameras
from pansplat_viewer.scene.cleaning import MaskPainter
from pansplat_viewer.scene.key_frames import KeyFrame
from pansplat_viewer.scene.placing import Placing
from pansplat_viewer.scene.settings import Comparison, Display, FrameStats, Preset, Projection
from pansplat_viewer.scene.state import (
    KEY_SECONDS,
    ViewerState,
    add_key_frame,
    choose_display,
    fly_to,
    go_home,
    jump_to_view,
    show_path,
    toggle_play,
)
from pansplat_viewer.scene.tour import Hotspot, TourScenes
from pansplat_viewer.ui.cleaning import CleaningSection, draw_mask
from pansplat_viewer.ui.minimap import SIZE, Minimap, describe_panorama, describe_panoramas, is_probable
from pansplat_viewer.ui.overlays import (
    FIXED,
    MARGIN,
    UNITS,
    draw_hotspots,
    draw_legends,
    draw_message,
    draw_points,
    draw_stats,
)
from pansplat_viewer.ui.placing import PlacingWindow, draw_photographs
from pansplat_viewer.window.gui import PANEL_WIDTH
from pansplat_viewer.window.input import HELP, Commands, MaskAnswer
from pansplat_viewer.window.preferences import Preferences, Theme

Rectangle = tuple[float, float, float, float]  # left, top, right, bottom, pixels

_HANDLE = (
    imgui.WindowFlags_.no_decoration.value
    | imgui.WindowFlags_.no_background.value
    | imgui.WindowFlags_.no_move.value
    | imgui.WindowFlags_.no_saved_settings.value
    | imgui.WindowFlags_.no_docking.value
    | imgui.WindowFlags_.no_focus_on_appearing.value
    | imgui.WindowFlags_.no_bring_to_front_on_focus.value
    | imgui.WindowFlags_.no_nav.value
)
_OPENED_NOTES = 3  # at most, at first


@dataclass
class PanelData:
    """Data that the panels show but do not change.

    Attributes:
        entries: names of the scenes to choose from; `current` is the index of the scene that is shown.
        stats: of the last image; `frame_ms` is the time of a whole frame, smoothed.
        reduced: number of Gaussians that are offered in place of a scene that did not fit; None if there is none.
    """

    entries: list[str] = field(default_factory=list)
    current: int = -1
    stats: FrameStats = field(default_factory=FrameStats)
    frame_ms: float = 0.0
    size: tuple[int, int] = (0, 0)  # of the rendered image, pixels; smaller than the window while the camera moves
    photographs: list[str] = field(default_factory=list)  # their names
    panoramas: list[str] = field(default_factory=list)  # names of the input cameras of the scene
    photograph_distance: float = 0.0  # from the camera to that of the photograph of the comparison, metres
    right_name: str | None = None  # of what is shown right of the divider; None if there is nothing
    pinned: bool = False  # whether an image is pinned
    loading: tuple[str, str, float] | None = None  # name, task, fraction done; None if nothing is loading
    refinement: float | None = None  # fraction done; 1 if the refined scene is there, None if there is no refinement
    error: str | None = None  # message of the last failure
    reduced: int | None = None
    changed: bool = False  # whether a file of the scene has changed since it was loaded
    preferences: Preferences = field(default_factory=Preferences)  # the remembered values
    film: float | None = None  # fraction of the film that is written; None if none is being written
    tour: TourScenes | None = None  # the scenes of the tour that is shown; None for other scenes
    hotspots: list[Hotspot] = field(default_factory=list)  # places of panoramas in the image
    doll_house: bool | None = None  # whether the doll's house is shown or prepared; None if there is no scene for it
    background: tuple[str, float] | None = None  # work of the loader on the tour, and the fraction done
    notes: tuple[str, ...] = ()  # what was not used or not placed at the path of the scene, and why
    placing: Placing | None = None  # the photographs and their poses; None if nothing is known of these
    bounds: tuple[float, ...] | None = None  # of the scene, metres; None if it cannot be cropped
    painter: MaskPainter | None = None  # the mask that is painted; None if none is
    unsaved: str | None = None  # the photograph of a mask whose end waits for an answer
    cleaning: tuple[str, float] | None = None  # work on the scene, and the fraction done


class Panels:
    """Draws the panels and applies changes in them to the state.

    Attributes:
        items: rectangle of each widget of the last frame, by its label; for tests that click.
        path, path_file: texts of the fields of scenes and of the camera path.
        minimap: the plan of a tour.
        placing: the window in which a photograph is placed.
        cleaning: the section "Clean up".
    """

    def __init__(self, ctx: moderngl.Context) -> None:
        self.items: dict[str, Rectangle] = {}
        self.minimap, self.placing = Minimap(ctx), PlacingWindow(ctx)
        self.cleaning = CleaningSection(self._slider, self._check, self._button, self._record_rectangle)
        self.path, self.path_file = "", "path.json"

    def draw(self, state: ViewerState, data: PanelData, now: float) -> Commands:
        """Draw the panels that are shown at time `now` (seconds); returns the commands given through them."""
        self.items.clear()
        commands = Commands()
        if state.overlay:
            self._draw_main_panel(state, data, commands)
            if data.stats.total:
                draw_stats(state, data.stats, data.frame_ms, data.size, data.right_name)
        if data.right_name is not None:
            self._draw_divider(state)
        if data.stats.total:
            draw_legends(state)
        if data.painter is not None:
            draw_mask(data.painter, state.camera, state.brush_degrees)
        if state.overlay and state.points:
            draw_points(state)
        if state.overlay and state.hotspots:
            draw_hotspots(data.hotspots)
        if state.overlay and data.tour is not None:
            self._draw_tour(state, data, data.tour, commands)
        if state.overlay and data.placing is not None and data.placing.node is not None:
            commands.reload |= self.placing.draw(data.placing, self._button, self._record_rectangle)
        if state.help:
            state.help = _draw_help()
        if data.unsaved is not None:
            self._draw_question(data.unsaved, commands)
        elif data.loading:
            commands.cancel_loading = self._draw_progress(*data.loading)
        elif data.error:
            self._draw_error(data, data.error, commands)
        if state.message and now < state.message_until:
            draw_message(state.message)
        return commands

    def release(self) -> None:
        """Free the GL objects."""
        self.minimap.release()
        self.placing.release()

    def _draw_tour(self, state: ViewerState, data: PanelData, tour: TourScenes, commands: Commands) -> None:
        """Draw the plan and the progress of the tour at the right border, below the statistics."""
        size, scale = imgui.get_io().display_size, imgui.get_style().font_scale_dpi
        first = (imgui.Cond_.always if commands.reset_layout else imgui.Cond_.first_use_ever).value
        imgui.set_next_window_dock_id(0, first)
        imgui.set_next_window_pos((size.x - MARGIN, 120 * scale), first, (1.0, 0.0))
        imgui.set_next_window_size(((SIZE + 18) * scale, (SIZE + 136) * scale), first)
        imgui.begin("Tour")
        place, width = imgui.get_window_pos(), imgui.get_window_width()
        if place.x + width > size.x:  # the window was larger when the layout was remembered
            imgui.set_window_pos((max(size.x - width, 0.0), place.y))
        state.minimap = self._check("floor plan", state.minimap)
        imgui.same_line()
        state.hotspots = self._check("hotspots", state.hotspots)
        if state.minimap:
            commands.visit = self.minimap.draw(tour, state.camera)
            if any(is_probable(tour.tour, node) for node in range(len(tour.tour))):
                imgui.text_disabled("ring: probably placed")
        imgui.set_next_item_width(-1)
        if imgui.begin_combo("##visit", describe_panoramas(tour.tour)):
            for node in range(len(tour.tour)):
                if imgui.selectable(f"{node + 1}. {describe_panorama(tour.tour, node)}", False)[0]:
                    commands.visit = node
                self._record_rectangle(f"visit {node}")
            imgui.end_combo()
        else:
            self._record_rectangle("visit")
        imgui.text_unformatted(f"{len(tour.loaded)} of {tour.num_scenes} scenes in memory")
        if data.background is not None:
            task, fraction = data.background
            imgui.push_text_wrap_pos(0.0)
            imgui.text_unformatted(task)
            imgui.pop_text_wrap_pos()
            imgui.progress_bar(fraction, (-1, 0), f"{100 * fraction:.0f}%")
        imgui.end()

    def _record_rectangle(self, label: str) -> None:
        low, high = imgui.get_item_rect_min(), imgui.get_item_rect_max()
        self.items[label] = (low.x, low.y, high.x, high.y)

    def _radio(self, label: str, active: bool) -> bool:
        chosen = imgui.radio_button(label, active)
        self._record_rectangle(label)
        return chosen

    def _check(self, label: str, value: bool) -> bool:
        _, value = imgui.checkbox(label, value)
        self._record_rectangle(label)
        return value

    def _button(self, label: str) -> bool:
        pressed = imgui.button(label)
        self._record_rectangle(label)
        return pressed

    def _slider(
        self, label: str, value: float, low: float, high: float, form: str, *, logarithmic: bool = False
    ) -> float:
        flags = imgui.SliderFlags_.always_clamp.value
        flags |= imgui.SliderFlags_.logarithmic.value if logarithmic else 0
        changed, chosen = imgui.slider_float(label, value, low, high, form, flags)
        self._record_rectangle(label)
        return chosen if changed else value  # imgui returns an unchanged value rounded to float32

    def _section(self, label: str, draw: Callable[..., None], *args: object, opened: bool = True) -> None:
        flags = imgui.TreeNodeFlags_.default_open if opened else imgui.TreeNodeFlags_.none
        shown = imgui.collapsing_header(label, flags.value)
        self._record_rectangle(label)
        if shown:
            imgui.push_id(label)
            draw(*args)
            imgui.pop_id()

    def _draw_main_panel(self, state: ViewerState, data: PanelData, commands: Commands) -> None:
        scale, height = imgui.get_style().font_scale_dpi, imgui.get_io().display_size.y
        imgui.set_next_window_size((PANEL_WIDTH * scale, 0.8 * height), imgui.Cond_.first_use_ever.value)
        opened, _ = imgui.begin("pansplat")
        if opened:
            imgui.push_item_width(-110 * scale)
            self._section("Scene", self._draw_scene, state, data, commands)
            if data.notes:
                self._section("Notes", _draw_notes, data.notes, opened=len(data.notes) <= _OPENED_NOTES)
            if data.placing is not None and data.placing.is_listed:
                opened = any(view.placement.state != "placed" for view in data.placing.panoramas)
                self._section("Photographs", self._draw_photographs, data.placing, commands, opened=opened)
            if data.stats.total:
                self._section("Gaussians", self._draw_gaussians, state)
            self._section("Display", self._draw_display, state)
            self._section("Compare", self._draw_comparison, state, data, commands)
            self._section("Camera", self._draw_camera, state, data, commands)
            self._section("Screenshot", self._draw_screenshot, commands)
            self._section("Drawing", self._draw_settings, state, data.stats, opened=False)
            self._section("Clean up", self._draw_cleaning, state, data, commands, opened=False)
            self._section("Camera path", self._draw_path, state, data, commands, opened=False)
            self._section("Window", self._draw_window, data, commands, opened=False)
            imgui.pop_item_width()
        imgui.end()

    def _draw_photographs(self, placing: Placing, commands: Commands) -> None:
        commands.reload |= draw_photographs(placing, self._button)

    def _draw_cleaning(self, state: ViewerState, data: PanelData, commands: Commands) -> None:
        self.cleaning.draw(
            state,
            commands,
            data.bounds,
            data.painter,
            data.cleaning,
            refining=data.refinement is not None and data.refinement < 1,
            can_paint=bool(data.photographs),
        )

    def _draw_scene(self, state: ViewerState, data: PanelData, commands: Commands) -> None:
        if data.entries:
            names = [f"{i + 1}. {name}" for i, name in enumerate(data.entries)]  # numbered, because names may repeat
            imgui.set_next_item_width(-1)
            changed, index = imgui.combo("##pair", max(data.current, 0), names)
            self._record_rectangle("pair")
            if changed:
                commands.choose = index
        imgui.set_next_item_width(-60 * imgui.get_style().font_scale_dpi)
        hint, flags = "folder or scene, or drop it here", imgui.InputTextFlags_.enter_returns_true.value
        entered, self.path = imgui.input_text_with_hint("##path", hint, self.path, flags)
        self._record_rectangle("path")
        imgui.same_line()
        if (self._button("Open") or entered) and self.path.strip():
            commands.open = self.path.strip()
        recent = data.preferences.recent
        if recent:
            imgui.set_next_item_width(-60 * imgui.get_style().font_scale_dpi)
            if imgui.begin_combo("##recent", "recent"):
                for path in recent:
                    if imgui.selectable(path, False)[0]:
                        commands.open = path
                imgui.end_combo()
            self._record_rectangle("recent")
            imgui.same_line()
        if data.entries and self._button("Reload"):
            commands.reload = True
        if data.changed:
            imgui.text_unformatted("changed on disk")
        if data.refinement is not None:
            if data.refinement < 1:
                commands.cancel_refinement = self._button("Cancel")
                imgui.same_line()
                imgui.progress_bar(data.refinement, (-1, 0), f"refining {100 * data.refinement:.0f}%")
            else:
                state.refined = self._check("refined", state.refined)

    def _draw_gaussians(self, state: ViewerState) -> None:
        settings, num_views = state.settings, state.num_views
        for mode in ("joint", "deferred") if num_views > 1 else ("joint",):
            if mode != "joint":
                imgui.same_line()
            if self._radio(mode, settings.mode == mode):
                settings = replace(settings, mode=mode)
        for view in range(num_views):
            if view % 3:
                imgui.same_line()
            if self._radio(f"view {view}", settings.mode == "view" and settings.view == view):
                settings = replace(settings, mode="view", view=view)
        if settings.mode == "deferred" and num_views > 1:
            weights = list(settings.view_weights or (1.0,) * num_views)
            for view in range(num_views):
                weights[view] = self._slider(f"weight {view}", weights[view], 0.0, 1.0, "%.2f")
            settings = replace(settings, view_weights=() if set(weights) == {1.0} else tuple(weights))
        if len(state.levels) > 1:
            shown = set(state.levels if settings.levels is None else settings.levels)
            _draw_row_label("level")
            for level in state.levels:
                imgui.same_line()
                if self._check(f"{level}##level", level in shown):
                    shown.add(level)
                else:
                    shown.discard(level)
            settings = replace(settings, levels=None if shown == set(state.levels) else frozenset(shown))
        threshold = self._slider("min. opacity", settings.opacity_threshold, 0.0, 1.0, "%.2f")
        state.settings = replace(settings, opacity_threshold=threshold)

    def _draw_settings(self, state: ViewerState, stats: FrameStats) -> None:
        settings = state.settings
        _draw_row_label("preset")
        imgui.begin_disabled(stats.tier == "cpu")  # which draws preset exact and one eye only
        for preset in get_args(Preset):
            imgui.same_line()
            if self._radio(preset, settings.preset == preset):
                settings = replace(settings, preset=preset)
        imgui.end_disabled()
        _draw_row_label("stereo")
        imgui.begin_disabled(stats.tier == "cpu")
        for label, stereo in (("off", "mono"), ("pair", "side-by-side"), ("red/cyan", "anaglyph")):
            imgui.same_line()
            if self._radio(f"{label}##stereo", settings.stereo == stereo):
                settings = replace(settings, stereo=stereo)
        imgui.end_disabled()
        if settings.stereo != "mono":
            distance = self._slider("eye distance", 1000 * settings.eye_distance, 10.0, 200.0, "%.0f mm")
            settings = replace(settings, eye_distance=distance / 1000)
        flags = imgui.ColorEditFlags_.no_inputs.value
        changed, background = imgui.color_edit3("background", list(settings.background), flags)
        self._record_rectangle("background")
        for name, color in (("black", 0.0), ("grey", 0.5), ("white", 1.0)):
            imgui.same_line()
            if imgui.small_button(name):
                changed, background = True, [color] * 3
            self._record_rectangle(name)
        if changed:
            settings = replace(settings, background=(background[0], background[1], background[2]))
        state.settings = settings
        state.adaptive = self._check("coarser while moving", state.adaptive)

    def _draw_camera(self, state: ViewerState, data: PanelData, commands: Commands) -> None:
        if self._radio("fly", not state.orbiting):
            state.orbiting = False
        imgui.same_line()
        if self._radio("orbit", state.orbiting):
            state.orbiting = True
        imgui.same_line()
        if self._button("Reset"):
            go_home(state)
        if data.doll_house is not None:
            imgui.same_line()
            if self._check("doll's house", data.doll_house) != data.doll_house:
                commands.doll_house = True
        fov = state.camera.vertical_fov_degrees
        chosen = self._slider("field of view", fov, cameras.MIN_FOV_DEGREES, cameras.MAX_FOV_DEGREES, "%.0f deg")
        if chosen != fov:
            state.camera = replace(state.camera, vertical_fov_degrees=chosen)
        state.speed = self._slider("speed", state.speed, 0.1, 10.0, "%.1f m/s")
        if not len(state.context):
            return
        if state.tour is None:  # which has a list of its own
            self._draw_panoramas(state, data.panoramas)
        if self._button("Stop" if state.playing else "Fly"):
            toggle_play(state)
        imgui.same_line()
        imgui.set_next_item_width(-1)
        flight = self._slider("##flight", state.flight, 0.0, 1.0, "%.2f of the way")
        if flight != state.flight:
            state.playing = False
            fly_to(state, flight)

    def _draw_panoramas(self, state: ViewerState, names: list[str]) -> None:
        """Draw a button for each panorama, in rows."""
        style, right = imgui.get_style(), imgui.get_window_pos().x + imgui.get_window_width()
        for view, name in enumerate(names):
            width = imgui.calc_text_size(name).x + 2 * style.frame_padding.x + style.item_spacing.x
            if view and imgui.get_item_rect_max().x + width < right - style.window_padding.x:
                imgui.same_line()
            if imgui.button(f"{name}##panorama {view}"):
                jump_to_view(state, view)
            self._record_rectangle(f"{view + 1}##panorama")

    def _draw_display(self, state: ViewerState) -> None:
        for number, display in enumerate(get_args(Display)):
            if number % 3:
                imgui.same_line()
            if self._radio(display, state.settings.display == display):
                choose_display(state, display)
        if state.settings.display in UNITS:
            largest = state.settings.display_max
            form = f"%.{1 if largest < 100 else 0}f{UNITS[state.settings.display]}"
            chosen = self._slider("range", largest, 1.0, 1000.0, form, logarithmic=True)
            state.settings = replace(state.settings, display_max=chosen)

    def _draw_comparison(self, state: ViewerState, data: PanelData, commands: Commands) -> None:
        for comparison in get_args(Comparison):
            if comparison in ("photograph", "error"):
                imgui.same_line()
            missing = not (data.pinned if comparison == "pinned" else comparison == "off" or data.photographs)
            imgui.begin_disabled(missing)
            if self._radio(comparison, state.comparison == comparison):
                state.comparison = comparison
            imgui.end_disabled()
        imgui.same_line()
        commands.pin = self._button("Pin this image")
        if state.comparison in ("photograph", "error") and data.photographs:
            chosen = 0 if state.photograph is None else state.photograph + 1
            changed, chosen = imgui.combo("##photograph", chosen, ["nearest photograph", *data.photographs])
            self._record_rectangle("photographs")
            if changed:
                state.photograph = chosen - 1 if chosen else None
            imgui.same_line()
            imgui.begin_disabled(data.photograph_distance == 0)
            commands.go_to_photograph = self._button(f"Go {data.photograph_distance:.2f} m###Go")
            self._record_rectangle("Go")
            imgui.end_disabled()
        if state.comparison == "error":
            state.max_error = self._slider("error up to", state.max_error, 0.01, 1.0, "%.2f")

    def _draw_window(self, data: PanelData, commands: Commands) -> None:
        for theme in get_args(Theme):
            if self._radio(theme, data.preferences.theme == theme):
                commands.theme = theme
            imgui.same_line()
        commands.reset_layout = self._button("Default layout")

    def _draw_divider(self, state: ViewerState) -> None:
        """Draw the line between both sides of a comparison; a drag moves it."""
        size, half = imgui.get_io().display_size, 5.0 * imgui.get_style().font_scale_dpi
        x = min(max(state.split, 0.0), 1.0) * size.x
        color = imgui.color_convert_float4_to_u32((1.0, 1.0, 1.0, 0.9))
        imgui.get_background_draw_list().add_line((x, 0), (x, size.y), color, 2.0)
        imgui.set_next_window_pos((x - half, 0))
        imgui.set_next_window_size((2 * half, size.y))
        imgui.push_style_var(imgui.StyleVar_.window_padding.value, (0.0, 0.0))
        imgui.push_style_var(imgui.StyleVar_.window_min_size.value, (1.0, 1.0))
        imgui.begin("##divider", None, _HANDLE)
        imgui.invisible_button("handle", (2 * half, size.y))
        self._record_rectangle("divider")
        if imgui.is_item_hovered() or imgui.is_item_active():
            imgui.set_mouse_cursor(imgui.MouseCursor_.resize_ew.value)
        if imgui.is_item_active():
            state.split = min(max(state.split + imgui.get_io().mouse_delta.x / size.x, 0.0), 1.0)
        imgui.end()
        imgui.pop_style_var(2)

    def _draw_progress(self, name: str, task: str, fraction: float) -> bool:
        """Draw the progress of a load; returns whether it is to be cancelled."""
        size, scale = imgui.get_io().display_size, imgui.get_style().font_scale_dpi
        imgui.set_next_window_pos((size.x / 2, size.y - 6 * MARGIN * scale), 0, (0.5, 1.0))
        imgui.set_next_window_size((min(420 * scale, size.x - 2 * MARGIN), 0))
        imgui.begin("##progress", None, FIXED | imgui.WindowFlags_.no_title_bar.value)
        imgui.text_unformatted(f"{name}: {task}")
        imgui.progress_bar(fraction, (-80 * imgui.get_style().font_scale_dpi, 0), f"{100 * fraction:.0f}%")
        imgui.same_line()
        cancelled = self._button("Cancel##loading")
        imgui.end()
        return cancelled

    def _draw_screenshot(self, commands: Commands) -> None:
        commands.png = self._button("PNG")
        imgui.same_line()
        commands.exr = self._button("EXR + depth")
        imgui.same_line()
        commands.panorama = self._button("360 PNG")

    def _draw_path(self, state: ViewerState, data: PanelData, commands: Commands) -> None:
        """Draw the editor of key frames."""
        if self._button("Add key frame"):
            add_key_frame(state)
        if len(state.path):
            imgui.same_line()
            if self._button("Pause" if state.path_playing else "Play path"):
                if not state.path_playing and state.path_seconds >= state.path.seconds:
                    state.path_seconds = 0.0
                state.path_playing = not state.path_playing
        longest = max(state.path.seconds + KEY_SECONDS, KEY_SECONDS)
        seconds = self._slider("time", min(state.path_seconds, longest), 0.0, longest, "%.2f s")
        if seconds != state.path_seconds:
            state.path_playing = False
            show_path(state, seconds)
        for index, frame in enumerate(state.path.key_frames):
            imgui.push_id(index)
            if self._button(f"{frame.seconds:.2f} s##{index}"):
                show_path(state, frame.seconds)
            imgui.same_line()
            if self._button(f"Replace##{index}"):
                state.path = state.path.add(KeyFrame.of_camera(state.camera, frame.seconds))
            imgui.same_line()
            if self._button(f"Delete##{index}"):
                state.path = state.path.remove(index)
            imgui.pop_id()
        _, self.path_file = imgui.input_text("##path file", self.path_file)
        self._record_rectangle("path file")
        imgui.same_line()
        if self._button("Save") and len(state.path):
            commands.save_path = self.path_file
        imgui.same_line()
        if self._button("Load"):
            commands.open_path = self.path_file
        if data.film is not None:
            commands.cancel_film = self._button("Cancel##film")
            imgui.same_line()
            imgui.progress_bar(data.film, (-1, 0), f"film {100 * data.film:.0f}%")
        elif len(state.path):
            for suffix in (".mp4", ".webm", ".png", ".exr"):
                if self._radio(suffix, state.film_suffix == suffix):
                    state.film_suffix = suffix
                imgui.same_line()
            commands.film = self._button("Write film")
            for projection in get_args(Projection):
                if self._radio(projection, state.film_projection == projection):
                    state.film_projection = projection
                imgui.same_line()
            imgui.new_line()
            state.film_fps = self._slider("frames per second", state.film_fps, 1.0, 60.0, "%.0f")

    def _draw_error(self, data: PanelData, error: str, commands: Commands) -> None:
        _place_at_center(width=560)
        imgui.begin("Error", None, FIXED | imgui.WindowFlags_.no_collapse.value)
        imgui.push_text_wrap_pos(0.0)
        imgui.text_unformatted(error)
        imgui.pop_text_wrap_pos()
        commands.dismiss_error = self._button("OK")
        if data.reduced is not None:
            imgui.same_line()
            if self._button(f"Show the {data.reduced:,} largest Gaussians###Reduce"):
                commands.reduce = data.reduced
            self._record_rectangle("Reduce")
        imgui.end()

    def _draw_question(self, photograph: str, commands: Commands) -> None:
        _place_at_center()
        imgui.begin("Unsaved mask", None, FIXED | imgui.WindowFlags_.no_collapse.value)
        imgui.text_unformatted(f"What is painted on {photograph} is not saved.")
        answers: dict[str, MaskAnswer] = {"Save mask##answer": "save", "Drop it": "drop", "Go on painting": "keep"}
        for label, answer in answers.items():
            if self._button(label):
                commands.answer = answer
            imgui.same_line()
        imgui.end()


def _draw_notes(notes: tuple[str, ...]) -> None:
    imgui.push_text_wrap_pos(0.0)
    for note in notes:
        imgui.text_unformatted(note)
    imgui.pop_text_wrap_pos()


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
        for row in HELP:
            imgui.table_next_row()
            for text in row:
                imgui.table_next_column()
                imgui.text_unformatted(text)
        imgui.end_table()
    imgui.end()
    return bool(opened)
