"""imgui on an OpenGL context: its life, its look and its two halves of a frame."""

from collections.abc import Callable
from importlib import resources

import imgui_bundle
import moderngl
from imgui_bundle import imgui

_FONT_PIXELS = 16.0


class Gui:
    """One imgui context drawn by imgui's own OpenGL 3 backend.

    Create it while the OpenGL context is current; only one lives at a time in a thread.
    """

    def __init__(self, dpi_scale: float = 1.0) -> None:
        """`dpi_scale` enlarges text and widgets on dense screens."""
        self._context = imgui.create_context()
        imgui.set_current_context(self._context)
        io = imgui.get_io()
        io.set_ini_filename("")  # leave no imgui.ini where the command was started
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
        """Start a frame; `new_frame` is the window backend's half."""
        imgui.set_current_context(self._context)
        imgui.backends.opengl3_new_frame()
        if new_frame is not None:
            new_frame()
        imgui.get_io().delta_time = max(seconds, 1e-4)
        imgui.new_frame()

    def end(self, ctx: moderngl.Context, target: moderngl.Framebuffer) -> None:
        """Draw the frame's widgets over what `target` holds."""
        imgui.render()
        target.use()
        imgui.backends.opengl3_render_draw_data(imgui.get_draw_data())
        # The backend's state is not in moderngl's books.
        ctx.scissor = None
        ctx.disable(moderngl.BLEND | moderngl.CULL_FACE | moderngl.DEPTH_TEST)

    def close(self) -> None:
        """Free the backend's GL objects and the context."""
        imgui.set_current_context(self._context)
        imgui.backends.opengl3_shutdown()
        imgui.destroy_context(self._context)
