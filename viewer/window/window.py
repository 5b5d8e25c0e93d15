"""The glfw window and its event loop.

imgui_bundle must be imported before glfw, because it selects the glfw library.
"""

import contextlib
import ctypes
import os
import sys
import time
from pathlib import Path
from typing import Any

import moderngl
from imgui_bundle import imgui

from pansplat.errors import InputError
from pansplat_viewer.draw.offscreen import load_llvm_before_mesa
from pansplat_viewer.viewer import Viewer

_DEBIAN = "on Debian or Ubuntu: apt-get install libgl1 libegl1 libgl1-mesa-dri libgles2"
_IDLE_SECONDS = 0.1  # time between frames when nothing moves; so that a prediction gets the CPU
_PENDING_SECONDS = 0.05  # time between frames while an image is drawn in the background; so that it gets the CPU


class NoWindowError(Exception):
    """No window can be opened; the message has the reason, in one line."""


class ContextLostError(InputError):
    """The graphics card was reset, so all OpenGL objects are gone."""


class Window:
    """A glfw window with a current OpenGL 3.3 core context.

    Attributes:
        ctx: the context.
        dropped: paths that were dropped on the window and not yet opened.
        scale_changed: whether the window came to a screen of another resolution since this was set to False.
    """

    def __init__(self, title: str, size: tuple[int, int]) -> None:
        """Open the window; `size` is in screen coordinates.

        Raises:
            NoWindowError: there is no display, or it has no OpenGL 3.3.
        """
        if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            raise NoWindowError("no display (neither DISPLAY nor WAYLAND_DISPLAY is set)")
        load_llvm_before_mesa()
        try:
            import glfw
        except ImportError as error:
            raise NoWindowError(f"glfw cannot be loaded ({error})") from error
        self._glfw = glfw
        self.dropped: list[Path] = []
        self._handle = self._create(title, size)
        self.scale_changed = False
        self._glfw.set_drop_callback(self._handle, self._drop)
        self._glfw.set_window_content_scale_callback(self._handle, lambda *_: setattr(self, "scale_changed", True))
        address = self._glfw.get_proc_address("glGetGraphicsResetStatus")
        self._reset_status = ctypes.CFUNCTYPE(ctypes.c_uint)(address) if address else lambda: 0

    def _create(self, title: str, size: tuple[int, int]) -> Any:
        glfw = self._glfw
        errors = ["unknown reason"]
        glfw.set_error_callback(lambda _, text: errors.append(" ".join(text.decode("utf-8", "replace").split())))
        if not glfw.init():
            raise NoWindowError(f"the display cannot be used ({errors[-1]})")
        glfw.window_hint(glfw.OPENGL_PROFILE, glfw.OPENGL_CORE_PROFILE)
        glfw.window_hint(glfw.OPENGL_FORWARD_COMPAT, True)
        glfw.window_hint(glfw.SCALE_TO_MONITOR, True)
        glfw.window_hint(glfw.VISIBLE, False)  # until the first frame: an empty window is black
        glfw.window_hint(glfw.CONTEXT_ROBUSTNESS, glfw.LOSE_CONTEXT_ON_RESET)
        glfw.window_hint(glfw.CONTEXT_VERSION_MAJOR, 3)
        glfw.window_hint(glfw.CONTEXT_VERSION_MINOR, 3)
        handle = glfw.create_window(*size, title, None, None)
        if not handle:
            glfw.terminate()
            raise NoWindowError(f"the display has no OpenGL 3.3 ({errors[-1]}); {_DEBIAN}")
        glfw.make_context_current(handle)
        glfw.swap_interval(1)
        try:
            self.ctx = moderngl.create_context(require=330)
        except Exception as error:  # moderngl raises moderngl.Error and plain Exception
            glfw.terminate()
            raise NoWindowError(f"the display has no OpenGL 3.3 ({error}); {_DEBIAN}") from error
        return handle

    @property
    def dpi_scale(self) -> float:
        """Scale of text relative to a standard-resolution screen, in window coordinates."""
        content = self._glfw.get_window_content_scale(self._handle)[0]
        pixels = self._glfw.get_framebuffer_size(self._handle)[0]
        points = self._glfw.get_window_size(self._handle)[0]
        return max(content * points / max(pixels, 1), 1.0)

    @property
    def framebuffer_size(self) -> tuple[int, int]:
        """Size of the window's content, pixels; may be 0."""
        return self._glfw.get_framebuffer_size(self._handle)

    @property
    def is_visible(self) -> bool:
        """Whether the window has pixels and is not minimised."""
        return 0 not in self.framebuffer_size and not self._glfw.get_window_attrib(self._handle, self._glfw.ICONIFIED)

    def check_context(self) -> None:
        """Raise `ContextLostError` if the graphics card was reset."""
        if self._reset_status() != 0:
            raise ContextLostError("the graphics card was reset")

    def new_frame(self) -> None:
        """Send size, pointer and keys to imgui."""
        imgui.backends.glfw_new_frame()

    def attach_gui(self) -> None:
        """Send the window's events to imgui; call after imgui's context is created."""
        address = ctypes.cast(self._handle, ctypes.c_void_p).value
        assert address is not None
        imgui.backends.glfw_init_for_opengl(address, True)

    def detach_gui(self) -> None:
        """Stop sending events to imgui; call before imgui's context is destroyed."""
        imgui.backends.glfw_shutdown()

    def wait(self, seconds: float) -> None:
        """Process events; wait up to `seconds` for the first."""
        if seconds <= 0:
            self._glfw.poll_events()
        else:
            self._glfw.wait_events_timeout(seconds)

    def wake(self) -> None:
        """End `wait`; any thread may call this."""
        self._glfw.post_empty_event()

    @property
    def closing(self) -> bool:
        """Whether the user closed the window."""
        return bool(self._glfw.window_should_close(self._handle))

    def set_title(self, title: str) -> None:
        """Set the window's title."""
        self._glfw.set_window_title(self._handle, title)

    def show(self) -> None:
        """Make the window visible."""
        self._glfw.show_window(self._handle)

    def swap(self) -> None:
        """Swap front and back buffers."""
        self._glfw.swap_buffers(self._handle)

    def close(self) -> None:
        """Destroy the window and terminate glfw."""
        self._glfw.destroy_window(self._handle)
        self._glfw.terminate()

    def _drop(self, _: Any, paths: list[str]) -> None:
        self.dropped.extend(Path(path) for path in paths)


def run_viewer(window: Window, viewer: Viewer) -> None:
    """Run a viewer in the window until the user quits, then free everything and join all threads.

    Raises:
        ContextLostError: the graphics card was reset.
    """
    with contextlib.ExitStack() as stack:
        stack.callback(window.close)
        stack.callback(viewer.close)
        window.attach_gui()
        stack.callback(window.detach_gui)
        _run_loop(window, viewer)


def _run_loop(window: Window, viewer: Viewer) -> None:
    last, title = time.perf_counter(), None
    active_until = 0.0
    shown = False
    target = window.ctx.detect_framebuffer(0)
    while not (viewer.state.quit or window.closing):
        before = time.perf_counter()
        visible = window.is_visible
        has_input = before < active_until or viewer.gui.has_input
        moving = visible and (viewer.moving or has_input)
        pending = viewer.pending if visible else None
        if pending is not None:
            pending.add_done_callback(lambda _: window.wake())
            window.wait(_PENDING_SECONDS)
        else:
            window.wait(0.0 if moving else _IDLE_SECONDS)
        if not moving and time.perf_counter() - before < 0.9 * _IDLE_SECONDS:
            active_until = time.perf_counter() + 0.25  # an event: imgui needs a few frames to process it
        if window.dropped:
            viewer.session.search(window.dropped[-1])
            window.dropped.clear()
        now = time.perf_counter()
        seconds, last = now - last, now
        if not (visible and window.is_visible):
            continue
        if window.scale_changed:
            window.scale_changed = False
            viewer.gui.set_scale(window.dpi_scale)
        target.viewport = (0, 0, *window.framebuffer_size)
        viewer.frame(target, seconds, window.new_frame)
        window.swap()
        window.check_context()
        if not shown:
            window.show()
            shown, active_until = True, time.perf_counter() + 0.25
        session = viewer.session
        if session.current >= 0 and title != (title := f"{session.names[session.current]} - pansplat"):
            window.set_title(title)
