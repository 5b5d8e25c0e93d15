"""imgui on an OpenGL context: style, scale, theme, docking, and the layout as text."""

from __future__ import annotations

from collections.abc import Callable
from importlib import resources

import imgui_bundle
import moderngl
from imgui_bundle import imgui

from pansplat_viewer.window.preferences import Theme

PANEL_WIDTH = 290.0  # pixels at a scale of 1
_FONT_PIXELS = 16.0
_DOCKING = (
    imgui.DockNodeFlags_.passthru_central_node.value
    | imgui.DockNodeFlags_.no_docking_over_central_node.value
    | imgui.DockNodeFlags_.auto_hide_tab_bar.value
)


class Gui:
    """An imgui context that imgui's OpenGL 3 backend draws.

    Create it while the OpenGL context is current. A thread can have one at a time.

    Attributes:
        scale: size of text and widgets; 1 is for screens of standard resolution.
    """

    def __init__(self, scale: float = 1.0, *, theme: Theme = "dark", layout: str = "") -> None:
        """Create the context.

        Args:
            scale: size of text and widgets.
            theme: colours.
            layout: of an earlier `save_layout`; empty is the default one.
        """
        self._context = imgui.create_context()
        imgui.set_current_context(self._context)
        io = imgui.get_io()
        io.set_ini_filename("")  # write no imgui.ini into the current folder
        io.config_flags |= imgui.ConfigFlags_.docking_enable.value
        io.config_windows_move_from_title_bar_only = True
        style = imgui.get_style()
        style.window_rounding = style.frame_rounding = style.grab_rounding = 4.0
        style.frame_padding = imgui.ImVec2(6, 2)
        style.item_spacing = imgui.ImVec2(6, 4)
        style.window_padding = imgui.ImVec2(8, 6)
        style.window_border_size = 0.0
        self.scale = 1.0
        self.set_scale(scale)
        self.set_theme(theme)
        font = resources.files(imgui_bundle) / "assets/fonts/Roboto/Roboto-Regular.ttf"
        if font.is_file():
            io.fonts.add_font_from_file_ttf(str(font), _FONT_PIXELS)
        imgui.backends.opengl3_init("#version 330")
        self._has_layout = bool(layout)
        if layout:
            imgui.load_ini_settings_from_memory(layout)

    def set_theme(self, theme: Theme) -> None:
        """Choose the colours of the panels."""
        imgui.set_current_context(self._context)
        style, opaque = imgui.get_style(), 0.88
        if theme == "light":
            imgui.style_colors_light()
            style.set_color_(imgui.Col_.window_bg.value, (0.94, 0.94, 0.94, opaque))
            style.set_color_(imgui.Col_.frame_bg.value, (1.0, 1.0, 1.0, 0.9))
        else:
            imgui.style_colors_dark()
            style.set_color_(imgui.Col_.window_bg.value, (0.08, 0.09, 0.1, opaque))
            style.set_color_(imgui.Col_.frame_bg.value, (0.26, 0.29, 0.33, 0.9))

    def set_scale(self, scale: float) -> None:
        """Change the size of text and widgets, such as for a screen of another resolution."""
        imgui.set_current_context(self._context)
        style = imgui.get_style()
        style.scale_all_sizes(scale / self.scale)
        style.font_scale_dpi = self.scale = scale

    def begin(self, seconds: float, new_frame: Callable[[], None] | None) -> None:
        """Start a frame; `new_frame` starts the frame of the window's backend."""
        imgui.set_current_context(self._context)
        imgui.backends.opengl3_new_frame()
        if new_frame is not None:
            new_frame()
        imgui.get_io().delta_time = max(seconds, 1e-4)
        imgui.new_frame()
        dockspace = imgui.dock_space_over_viewport(0, imgui.get_main_viewport(), _DOCKING)
        if not self._has_layout:
            self._dock_panel(dockspace)

    def _dock_panel(self, dockspace: int) -> None:
        """Dock the main panel at the left."""
        self._has_layout, builder = True, imgui.internal
        builder.dock_builder_remove_node_child_nodes(dockspace)
        fraction = min(PANEL_WIDTH * self.scale / max(imgui.get_io().display_size.x, 1.0), 0.6)
        _, left, _ = builder.dock_builder_split_node_py(dockspace, imgui.Dir.left, fraction)
        builder.dock_builder_dock_window("pansplat", left)
        builder.dock_builder_finish(dockspace)

    @property
    def has_input(self) -> bool:
        """Whether input waits for the next frames: imgui applies one change of a key in a frame."""
        imgui.set_current_context(self._context)
        return len(imgui.get_current_context().input_events_queue) > 0

    def reset_layout(self) -> None:
        """Restore the default layout in the next frame."""
        self._has_layout = False

    def save_layout(self, *, changed: bool = True) -> str | None:
        """The layout as text; with `changed`, None if it has not changed for some seconds."""
        io = imgui.get_io()
        if changed and not io.want_save_ini_settings:
            return None
        io.want_save_ini_settings = False
        return imgui.save_ini_settings_to_memory()

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
