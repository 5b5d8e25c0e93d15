"""imgui on an OpenGL context: style and scale."""

from __future__ import annotations

from collections.abc import Callable
from importlib import resources

import imgui_bundle
import moderngl
from imgui_bundle import imgui

_FONT_PIXELS = 16.0  # height of the text at a DPI scale of 1


class Gui:
    """An imgui context that imgui's OpenGL 3 backend draws.

    Create it while the OpenGL context is current. A thread can have one at a time.

    Attributes:
        scale: size of text and widgets; 1 is for screens of standard resolution.
    """

    def __init__(self, scale: float = 1.0) -> None:
        """Create the context; `scale` is the size of text and widgets."""
        self._context = imgui.create_context()
        imgui.set_current_context(self._context)
        io = imgui.get_io()
        io.set_ini_filename("")  # write no imgui.ini into the current folder
        io.config_windows_move_from_title_bar_only = True
        style = imgui.get_style()
        style.window_rounding = style.frame_rounding = style.grab_rounding = 4.0
        style.frame_padding = imgui.ImVec2(6, 2)
        style.item_spacing = imgui.ImVec2(6, 4)
        style.window_padding = imgui.ImVec2(8, 6)
        style.window_border_size = 0.0
        self.scale = 1.0
        self.set_scale(scale)
        imgui.style_colors_dark()
        style.set_color_(imgui.Col_.window_bg.value, (0.08, 0.09, 0.1, 0.88))
        style.set_color_(imgui.Col_.frame_bg.value, (0.26, 0.29, 0.33, 0.9))
        font = resources.files(imgui_bundle) / "assets/fonts/Roboto/Roboto-Regular.ttf"
        if font.is_file():
            io.fonts.add_font_from_file_ttf(str(font), _FONT_PIXELS)
        imgui.backends.opengl3_init("#version 330")

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

    @property
    def has_input(self) -> bool:
        """Whether input waits for the next frames: imgui applies one change of a key in a frame."""
        imgui.set_current_context(self._context)
        return len(imgui.get_current_context().input_events_queue) > 0

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
