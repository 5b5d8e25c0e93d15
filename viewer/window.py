"""The window: glfw, the loop, files dropped on it. imgui_bundle goes before glfw, whose library it brings."""

import ctypes
import os
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import moderngl
from imgui_bundle import imgui

from pansplat_viewer.llvm import load_before_mesa
from pansplat_viewer.viewer import Viewer

_DEBIAN = "on Debian or Ubuntu: apt-get install libgl1 libegl1 libgl1-mesa-dri libgles2"
_IDLE_SECONDS = 0.1  # between frames when nothing moves: a prediction in its thread needs the processor


class NoWindowError(Exception):
    """No window can be opened here; the message says why, in one line."""


def display_problem() -> str | None:
    """Why there can be no window, as far as the environment tells; None when it is worth trying."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return "no display (neither DISPLAY nor WAYLAND_DISPLAY is set)"
    return None


class Window:
    """A glfw window with a current OpenGL 3.3 core context.

    Attributes:
        ctx: moderngl's view of the context.
        dropped: paths dropped on the window since they were last taken.
    """

    def __init__(self, title: str, size: tuple[int, int]) -> None:
        """Open it, `size` in screen coordinates.

        Raises:
            NoWindowError: no display, or none with OpenGL 3.3.
        """
        problem = display_problem()
        if problem:
            raise NoWindowError(problem)
        load_before_mesa()
        self._glfw = _import_glfw()
        self.dropped: list[Path] = []
        self._handle = self._create(title, size)
        self._glfw.set_drop_callback(self._handle, self._drop)
        self._backend = False

    def _create(self, title: str, size: tuple[int, int]) -> Any:
        glfw = self._glfw
        with warnings.catch_warnings(record=True) as caught:  # glfw's errors arrive as warnings
            warnings.simplefilter("always")
            if not glfw.init():
                raise NoWindowError(f"the display cannot be used ({_reason(caught)})")
            glfw.window_hint(glfw.CONTEXT_VERSION_MAJOR, 3)
            glfw.window_hint(glfw.CONTEXT_VERSION_MINOR, 3)
            glfw.window_hint(glfw.OPENGL_PROFILE, glfw.OPENGL_CORE_PROFILE)
            glfw.window_hint(glfw.OPENGL_FORWARD_COMPAT, True)
            glfw.window_hint(glfw.SCALE_TO_MONITOR, True)
            handle = glfw.create_window(*size, title, None, None)
            if not handle:
                glfw.terminate()
                raise NoWindowError(f"the display has no OpenGL 3.3 ({_reason(caught)}); {_DEBIAN}")
        glfw.make_context_current(handle)
        glfw.swap_interval(1)
        try:
            self.ctx = moderngl.create_context(require=330)
        except Exception as error:  # moderngl raises its own and plain exceptions
            glfw.terminate()
            raise NoWindowError(f"the display has no OpenGL 3.3 ({error}); {_DEBIAN}") from error
        return handle

    @property
    def dpi_scale(self) -> float:
        """How much larger text must be than on a plain screen, in the window's coordinates."""
        content = self._glfw.get_window_content_scale(self._handle)[0]
        pixels = self._glfw.get_framebuffer_size(self._handle)[0]
        points = self._glfw.get_window_size(self._handle)[0]
        return max(content * points / max(pixels, 1), 1.0)

    @property
    def framebuffer_size(self) -> tuple[int, int]:
        """Pixels of the window's content; 0 while it is minimised."""
        return self._glfw.get_framebuffer_size(self._handle)

    def attach_gui(self) -> None:
        """Give imgui the window's events; after imgui's context was made."""
        address = ctypes.cast(self._handle, ctypes.c_void_p).value
        assert address is not None
        imgui.backends.glfw_init_for_opengl(address, True)
        self._backend = True

    def detach_gui(self) -> None:
        """Take the events away again; before imgui's context goes."""
        if self._backend:
            imgui.backends.glfw_shutdown()
            self._backend = False

    def wait(self, seconds: float) -> None:
        """Take in events; sleep until one comes, at most so long."""
        if seconds <= 0:
            self._glfw.poll_events()
        else:
            self._glfw.wait_events_timeout(seconds)

    @property
    def closing(self) -> bool:
        """Whether the person closed the window."""
        return bool(self._glfw.window_should_close(self._handle))

    def set_title(self, title: str) -> None:
        """Show another title."""
        self._glfw.set_window_title(self._handle, title)

    def swap(self) -> None:
        """Show what was drawn."""
        self._glfw.swap_buffers(self._handle)

    def close(self) -> None:
        """Destroy the window and leave glfw."""
        self._glfw.destroy_window(self._handle)
        self._glfw.terminate()

    def _drop(self, _: Any, paths: list[str]) -> None:
        self.dropped.extend(Path(path) for path in paths)


def run(window: Window, make_viewer: Callable[[moderngl.Context, float], Viewer]) -> None:
    """Show a viewer until the person leaves; everything is freed, threads are joined."""
    viewer = make_viewer(window.ctx, window.dpi_scale)
    try:
        window.attach_gui()
        _loop(window, viewer)
    finally:
        window.detach_gui()
        viewer.close()
        window.close()


def _loop(window: Window, viewer: Viewer) -> None:
    last, title = time.perf_counter(), None
    active_until = 0.0
    target = window.ctx.detect_framebuffer(0)
    while not (window.closing or viewer.state.quit):
        before = time.perf_counter()
        moving = viewer.moving or before < active_until
        window.wait(0.0 if moving else _IDLE_SECONDS)
        if not moving and time.perf_counter() - before < 0.9 * _IDLE_SECONDS:
            active_until = time.perf_counter() + 0.25  # an event: imgui needs a few frames to answer it
        if window.dropped:
            viewer.open(window.dropped[-1])
            window.dropped.clear()
        now = time.perf_counter()
        seconds, last = now - last, now
        size = window.framebuffer_size
        if 0 in size:
            continue
        target.viewport = (0, 0, *size)
        viewer.frame(target, seconds, imgui.backends.glfw_new_frame)
        window.swap()
        if title != (title := _title(viewer)):
            window.set_title(title)


def _title(viewer: Viewer) -> str:
    current = viewer.facts.current
    return f"{viewer.facts.entries[current]} - pansplat" if current >= 0 else "pansplat"


def _import_glfw() -> Any:
    try:
        import glfw
    except ImportError as error:
        raise NoWindowError(f"glfw cannot be loaded ({error})") from error
    return glfw


def _reason(caught: list[warnings.WarningMessage]) -> str:
    text = str(caught[-1].message) if caught else "no reason given"
    return " ".join(text.split())
