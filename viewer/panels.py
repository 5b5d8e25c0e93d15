"""imgui on an OpenGL context, and the panels over the image: scene, settings, camera, photograph and screenshots."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from importlib import resources
from typing import get_args

import imgui_bundle
import moderngl
from imgui_bundle import imgui

from pansplat_viewer import camera as cameras
from pansplat_viewer.input import HELP, Commands
from pansplat_viewer.key_frames import KeyFrame
from pansplat_viewer.minimap import SIZE, Minimap
from pansplat_viewer.picking import project_point
from pansplat_viewer.settings import FrameStats, Kernel, Lowpass, Order, Projection
from pansplat_viewer.state import KEY_SECONDS, ViewerState, add_key_frame, fly_to, jump_to_view, show_path, toggle_play
from pansplat_viewer.tour import Hotspot, TourScenes

Rectangle = tuple[float, float, float, float]  # left, top, right, bottom, pixels

_FONT_PIXELS = 16.0
_PANEL_WIDTH = 290.0
_MARGIN = 10.0
_FIXED = (
    imgui.WindowFlags_.no_move.value | imgui.WindowFlags_.no_resize.value | imgui.WindowFlags_.no_saved_settings.value
)
_LABEL = (
    _FIXED
    | imgui.WindowFlags_.no_title_bar.value
    | imgui.WindowFlags_.always_auto_resize.value
    | imgui.WindowFlags_.no_inputs.value
    | imgui.WindowFlags_.no_focus_on_appearing.value
    | imgui.WindowFlags_.no_nav.value
)


@dataclass
class PanelData:
    """Data that the panels show but do not change.

    Attributes:
        entries: names of the scenes to choose from; `current` is the index of the scene that is shown.
        stats: of the last image; `frame_ms` is the time of a whole frame, smoothed.
        size: of the rendered image, pixels; smaller than the window while the camera moves.
        photo_name: of the nearest input photograph; None if the scene has none.
        loading: name, task, fraction done; None if nothing is loading.
        refinement: fraction done; 1 if the refined scene is there, None if there is no refinement.
        error: message of the last failure.
        film: fraction of the film that is written; None if none is being written.
        tour: the scenes of the tour that is shown; None for other scenes.
        hotspots: places of its panoramas in the image.
        background: work of the loader on the tour, and the fraction done.
    """

    entries: list[str] = field(default_factory=list)
    current: int = -1
    stats: FrameStats = field(default_factory=FrameStats)
    frame_ms: float = 0.0
    size: tuple[int, int] = (0, 0)
    photo_name: str | None = None
    loading: tuple[str, str, float] | None = None
    refinement: float | None = None
    error: str | None = None
    film: float | None = None
    tour: TourScenes | None = None
    hotspots: list[Hotspot] = field(default_factory=list)
    background: tuple[str, float] | None = None


class Gui:
    """An imgui context that imgui's OpenGL 3 backend draws.

    Create it while the OpenGL context is current. A thread can have one at a time.
    """

    def __init__(self, dpi_scale: float = 1.0) -> None:
        """Create the context; `dpi_scale` enlarges text and widgets on high-resolution screens."""
        self._context = imgui.create_context()
        imgui.set_current_context(self._context)
        io = imgui.get_io()
        io.set_ini_filename("")  # write no imgui.ini into the current folder
        io.config_flags |= imgui.ConfigFlags_.no_mouse_cursor_change.value
        io.config_windows_move_from_title_bar_only = True
        imgui.style_colors_dark()
        style = imgui.get_style()
        style.window_rounding = style.frame_rounding = style.grab_rounding = 4.0
        style.frame_padding = imgui.ImVec2(6, 2)
        style.item_spacing = imgui.ImVec2(6, 4)
        style.window_padding = imgui.ImVec2(8, 6)
        style.window_border_size = 0.0
        style.set_color_(imgui.Col_.window_bg.value, (0.08, 0.09, 0.1, 0.88))
        style.set_color_(imgui.Col_.frame_bg.value, (0.26, 0.29, 0.33, 0.9))
        style.scale_all_sizes(dpi_scale)
        style.font_scale_dpi = dpi_scale
        font = resources.files(imgui_bundle) / "assets/fonts/Roboto/Roboto-Regular.ttf"
        if font.is_file():
            io.fonts.add_font_from_file_ttf(str(font), _FONT_PIXELS)
        imgui.backends.opengl3_init("#version 330")

    def begin(self, seconds: float, new_frame: Callable[[], None] | None) -> None:
        """Start a frame; `new_frame` starts the frame of the window's backend."""
        imgui.set_current_context(self._context)
        imgui.backends.opengl3_new_frame()
        if new_frame is not None:
            new_frame()
        imgui.get_io().delta_time = max(seconds, 1e-4)
        imgui.new_frame()

    def end(self, ctx: moderngl.Context, target: moderngl.Framebuffer) -> None:
        """Draw the frame's widgets over the content of `target`."""
        imgui.render()
        target.use()
        imgui.backends.opengl3_render_draw_data(imgui.get_draw_data())
        # The backend changes OpenGL state that moderngl does not track.
        ctx.scissor = None
        ctx.disable(moderngl.BLEND | moderngl.CULL_FACE | moderngl.DEPTH_TEST)

    def close(self) -> None:
        """Free the backend's GL objects and the imgui context."""
        imgui.set_current_context(self._context)
        imgui.backends.opengl3_shutdown()
        imgui.destroy_context(self._context)


class Panels:
    """Draws the panels and applies changes in them to the state.

    Attributes:
        items: rectangle of each widget of the last frame, by its label; for tests that click.
        path, path_file: texts of the fields of scenes and of the camera path.
        minimap: the plan of a tour.
    """

    def __init__(self, ctx: moderngl.Context) -> None:
        self.items: dict[str, Rectangle] = {}
        self.minimap = Minimap(ctx)
        self.path, self.path_file = "", "path.json"

    def draw(self, state: ViewerState, data: PanelData, now: float) -> Commands:
        """Draw the panels that are shown at time `now` (seconds); returns the commands given through them."""
        self.items.clear()
        commands = Commands()
        if state.overlay:
            self._draw_main_panel(state, data, commands)
            _draw_stats(state, data)
        if state.photo and data.photo_name is not None and 0 < state.split < 1:
            _draw_split_line(state.split)
        if state.overlay and state.points:
            _draw_points(state)
        if state.overlay and data.tour is not None:
            if state.hotspots:
                _draw_hotspots(data.tour, data.hotspots)
            self._draw_tour(state, data, data.tour, commands)
        if state.help:
            state.help = _draw_help()
        if data.loading:
            _draw_progress(*data.loading)
        elif data.error:
            self._draw_error(data.error, commands)
        if state.message and now < state.message_until:
            _draw_message(state.message)
        return commands

    def release(self) -> None:
        """Free the GL objects."""
        self.minimap.release()

    def _draw_tour(self, state: ViewerState, data: PanelData, tour: TourScenes, commands: Commands) -> None:
        """Draw the plan and the progress of the tour at the right border, below the statistics."""
        size, scale = imgui.get_io().display_size, imgui.get_style().font_scale_dpi
        imgui.set_next_window_pos((size.x - _MARGIN, 120 * scale), 0, (1.0, 0.0))
        imgui.set_next_window_size(((SIZE + 18) * scale, 0))
        imgui.begin("Tour", None, _FIXED)
        state.minimap = self._check("floor plan", state.minimap)
        imgui.same_line()
        state.hotspots = self._check("hotspots", state.hotspots)
        if state.minimap:
            commands.visit = self.minimap.draw(tour, state.camera)
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

    def _slider(self, label: str, value: float, low: float, high: float, form: str) -> float:
        changed, chosen = imgui.slider_float(label, value, low, high, form, imgui.SliderFlags_.always_clamp.value)
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
        width = _PANEL_WIDTH * scale
        imgui.set_next_window_pos((_MARGIN, _MARGIN))
        imgui.set_next_window_size_constraints((width, 0), (width, max(height - 2 * _MARGIN, 50)))
        opened, _ = imgui.begin("pansplat", None, _FIXED | imgui.WindowFlags_.always_auto_resize.value)
        if opened:
            imgui.push_item_width(-110 * scale)
            self._section("Scene", self._draw_scene, state, data, commands)
            self._section("Gaussians", self._draw_gaussians, state)
            self._section("Drawing", self._draw_settings, state)
            self._section("Camera", self._draw_camera, state)
            self._section("Photograph", self._draw_photograph, state, data)
            self._section("Screenshot", self._draw_screenshot, commands)
            self._section("Camera path", self._draw_path, state, data, commands, opened=False)
            imgui.pop_item_width()
        imgui.end()

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
        if data.refinement is not None:
            if data.refinement < 1:
                commands.cancel_refinement = self._button("Cancel")
                imgui.same_line()
                imgui.progress_bar(data.refinement, (-1, 0), f"refining {100 * data.refinement:.0f}%")
            else:
                state.refined = self._check("refined", state.refined)

    def _draw_gaussians(self, state: ViewerState) -> None:
        settings, num_views = state.settings, state.num_views
        for mode in ("joint", "deferred", "difference") if num_views > 1 else ("joint",):
            if mode != "joint":
                imgui.same_line()
            if self._radio(mode, settings.mode == mode):
                settings = replace(settings, mode=mode, view=0 if mode == "difference" else settings.view)
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

    def _draw_settings(self, state: ViewerState) -> None:
        settings = state.settings
        for name, choices in (("kernel", Kernel), ("order", Order), ("lowpass", Lowpass)):
            _draw_row_label(name)
            for choice in get_args(choices):
                imgui.same_line()
                if self._radio(choice, getattr(settings, name) == choice):
                    settings = replace(settings, **{name: choice})
        _draw_row_label("stereo")
        for label, stereo in (("off", "mono"), ("pair", "side-by-side"), ("red/cyan", "anaglyph")):
            imgui.same_line()
            if self._radio(f"{label}##stereo", settings.stereo == stereo):
                settings = replace(settings, stereo=stereo)
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

    def _draw_camera(self, state: ViewerState) -> None:
        if self._radio("fly", not state.orbiting):
            state.orbiting = False
        imgui.same_line()
        if self._radio("orbit", state.orbiting):
            state.orbiting = True
        imgui.same_line()
        if self._button("Reset"):
            state.playing, state.camera = False, state.home
        fov = state.camera.vertical_fov_degrees
        chosen = self._slider("field of view", fov, cameras.MIN_FOV_DEGREES, cameras.MAX_FOV_DEGREES, "%.0f deg")
        if chosen != fov:
            state.camera = replace(state.camera, vertical_fov_degrees=chosen)
        state.speed = self._slider("speed", state.speed, 0.1, 10.0, "%.1f m/s")
        if not len(state.context):
            return
        for view in range(min(len(state.context), 6)):
            if view % 3:
                imgui.same_line()
            if self._button(f"Panorama {view + 1}"):
                jump_to_view(state, view)
        if self._button("Stop" if state.playing else "Fly"):
            toggle_play(state)
        imgui.same_line()
        imgui.set_next_item_width(-1)
        flight = self._slider("##flight", state.flight, 0.0, 1.0, "%.2f of the way")
        if flight != state.flight:
            state.playing = False
            fly_to(state, flight)

    def _draw_photograph(self, state: ViewerState, data: PanelData) -> None:
        if data.photo_name is None:
            imgui.text_disabled("this scene has no photographs")
            return
        state.photo = self._check("nearest photograph", state.photo)
        state.split = self._slider("split", state.split, 0.0, 1.0, "%.2f")

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

    def _draw_error(self, error: str, commands: Commands) -> None:
        _place_at_center(width=560)
        imgui.begin("Error", None, _FIXED | imgui.WindowFlags_.no_collapse.value)
        imgui.push_text_wrap_pos(0.0)
        imgui.text_unformatted(error)
        imgui.pop_text_wrap_pos()
        commands.dismiss_error = self._button("OK")
        imgui.end()


def _draw_row_label(label: str) -> None:
    imgui.align_text_to_frame_padding()
    imgui.text_unformatted(label)


def _place_at_center(width: float | None = None) -> None:
    """Place the next window at the centre, with a width at a DPI scale of 1 or its automatic size."""
    size = imgui.get_io().display_size
    imgui.set_next_window_pos((size.x / 2, size.y / 2), 0, (0.5, 0.5))
    if width is not None:
        imgui.set_next_window_size((min(width * imgui.get_style().font_scale_dpi, size.x - 2 * _MARGIN), 0))


def _draw_stats(state: ViewerState, data: PanelData) -> None:
    size, scale = imgui.get_io().display_size, imgui.get_style().font_scale_dpi
    if size.x > 2.2 * _PANEL_WIDTH * scale:
        imgui.set_next_window_pos((size.x - _MARGIN, _MARGIN), 0, (1.0, 0.0))
    else:  # too narrow next to the main panel: bottom right
        imgui.set_next_window_pos((size.x - _MARGIN, size.y - _MARGIN), 0, (1.0, 1.0))
    stats = data.stats
    x, y, z = state.camera.position
    lines = [
        f"frame {data.frame_ms:.1f} ms   draw {stats.frame_ms:.1f} ms   sort {stats.sort_ms:.0f} ms",
        f"{stats.drawn:,} drawn of {stats.visible:,} of {stats.total:,}",
        f"{data.size[0]} x {data.size[1]}   {stats.tier}" + ("   cached" if stats.cached else ""),
        f"x {x:.2f}  y {y:.2f}  z {z:.2f} m",
    ]
    if state.photo and data.photo_name is not None:
        lines.append(f"right: {data.photo_name}" if state.split > 0 else data.photo_name)
    _draw_label("##stats", lines, alpha=0.6)


def _draw_points(state: ViewerState) -> None:
    """Draw markers at the picked points, and what is known of them at the bottom right."""
    size = imgui.get_io().display_size
    color = imgui.color_convert_float4_to_u32((1.0, 0.85, 0.2, 1.0))
    canvas = imgui.get_background_draw_list()
    pixels = [project_point(state.camera, point.position, (int(size.x), int(size.y))) for point in state.points]
    for pixel in pixels:
        if pixel is not None:
            canvas.add_circle(pixel, 5.0 * imgui.get_style().font_scale_dpi, color, 0, 2.0)
    lines = state.points[-1].describe()
    if len(pixels) == 2:
        if pixels[0] is not None and pixels[1] is not None:
            canvas.add_line(pixels[0], pixels[1], color, 2.0)
        lines.append(f"{math.dist(state.points[0].position, state.points[1].position):.3f} m from the point before")
    imgui.set_next_window_pos((size.x - _MARGIN, size.y - _MARGIN), 0, (1.0, 1.0))
    _draw_label("##point", lines, alpha=0.6)


def _draw_hotspots(tour: TourScenes, hotspots: list[Hotspot]) -> None:
    """Draw a ring on the floor below each panorama, with its name."""
    canvas, color = imgui.get_background_draw_list(), imgui.color_convert_float4_to_u32((1.0, 1.0, 1.0, 0.8))
    for hotspot in hotspots:
        ring = [imgui.ImVec2(*corner) for corner in hotspot.ring]
        canvas.add_polyline(ring, color, thickness=2.0, flags=imgui.ImDrawFlags_.closed.value)
        canvas.add_circle_filled(hotspot.center, 3.0, color)
        name = tour.tour.panoramas[hotspot.node].name
        width = imgui.calc_text_size(name).x
        canvas.add_text((hotspot.center[0] - width / 2, hotspot.center[1] + hotspot.radius), color, name)


def _draw_message(message: str) -> None:
    size = imgui.get_io().display_size
    imgui.set_next_window_pos((size.x / 2, size.y - 2 * _MARGIN), 0, (0.5, 1.0))
    _draw_label("##message", [message], alpha=0.75)


def _draw_label(name: str, lines: list[str], alpha: float) -> None:
    imgui.set_next_window_bg_alpha(alpha)
    imgui.begin(name, None, _LABEL)
    for line in lines:
        imgui.text_unformatted(line)
    imgui.end()


def _draw_help() -> bool:
    """Draw the key help; returns whether it stays open."""
    _place_at_center()
    flags = _FIXED | imgui.WindowFlags_.always_auto_resize.value | imgui.WindowFlags_.no_collapse.value
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


def _draw_progress(name: str, task: str, fraction: float) -> None:
    _place_at_center(width=420)
    imgui.begin("##progress", None, _FIXED | imgui.WindowFlags_.no_title_bar.value | imgui.WindowFlags_.no_inputs.value)
    imgui.text_unformatted(f"{name}: {task}")
    imgui.progress_bar(fraction, (-1, 0), f"{100 * fraction:.0f}%")
    imgui.end()


def _draw_split_line(split: float) -> None:
    size = imgui.get_io().display_size
    color = imgui.color_convert_float4_to_u32((1.0, 1.0, 1.0, 0.9))
    imgui.get_background_draw_list().add_line((split * size.x, 0), (split * size.x, size.y), color, 2.0)
