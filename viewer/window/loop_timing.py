"""`python -m pansplat_viewer.window.loop_timing SCENE` measures whole frames of the viewer: input, image, panels.

It draws on a context without a window, so the exchange of a window's buffers is missing. The camera flies, stops and
turns, several times. One line is printed for each mode:

    deferred: moving 22.1 frames per second at 640x360, sharp 0.11 s after stopping, turning 78.7 frames per second
"""

from __future__ import annotations

import concurrent.futures
import statistics
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import moderngl
from imgui_bundle import imgui

from pansplat.errors import InputError
from pansplat_viewer.draw.offscreen import create_context
from pansplat_viewer.scene.loader import LoadOptions, SceneLoader, find_entries, load_entry
from pansplat_viewer.scene.settings import DrawSettings
from pansplat_viewer.scene.state import ViewerState
from pansplat_viewer.viewer import Viewer

_SIZE = (1280, 720)
_TURN_PIXELS = 6  # of the pointer in a frame
_WAIT_SECONDS = 0.05  # as the window waits for an image


@dataclass(frozen=True)
class LoopTimes:
    """Medians over the frames of one mode of drawing."""

    moving_ms: float  # time of a frame of a flight
    moving_size: tuple[int, int]  # (width, height) at which its images are drawn, pixels
    sharp_seconds: float  # from the last input of a flight until the full image is shown
    turning_ms: float  # time of a frame of a turn whose cube faces are finished

    def __str__(self) -> str:
        (width, height), sharp = self.moving_size, self.sharp_seconds
        return (
            f"moving {1e3 / self.moving_ms:.1f} frames per second at {width}x{height}, "
            f"sharp {sharp:.2f} s after stopping, turning {1e3 / self.turning_ms:.1f} frames per second"
        )


class _Loop:
    """A viewer whose input is synthetic."""

    def __init__(self, ctx: moderngl.Context, path: Path, mode: Literal["joint", "deferred"], size: tuple[int, int]):
        options, self._ctx = LoadOptions(), ctx
        self._target, self._last = ctx.simple_framebuffer(size, components=4), time.perf_counter()
        loader = SceneLoader(lambda entry, show: load_entry(entry, options, show))
        state = ViewerState(settings=DrawSettings(mode=mode), stops=False)
        self.viewer = Viewer(ctx, loader, find=lambda path, *calls: find_entries(path, options, *calls), state=state)
        imgui.get_io().display_size = size
        self.viewer.show(find_entries(path, options), 0)
        self.rest(0.0)

    def draw(self) -> float:
        """Draw a frame; returns milliseconds."""
        now = time.perf_counter()
        self.viewer.frame(self._target, now - self._last)
        self._ctx.finish()
        self._last = now
        return 1e3 * (time.perf_counter() - now)

    def rest(self, seconds: float) -> None:
        """Draw for some seconds, and until nothing changes."""
        end = time.perf_counter() + seconds
        while self.viewer.busy or time.perf_counter() < end:
            self.draw()
            time.sleep(0.01)
        if self.viewer.error is not None:
            raise InputError(self.viewer.error)

    def fly(self, key: imgui.Key, frames: int) -> list[float]:
        """Hold a key; returns the times of the later half of the frames."""
        imgui.get_io().add_key_event(key, True)
        times = [self.draw() for _ in range(frames)]
        imgui.get_io().add_key_event(key, False)
        return times[frames // 2 :]

    def wait_until_sharp(self) -> float:
        """Draw, and wait as the window does, until the full image is shown; returns seconds."""
        start, viewer = time.perf_counter(), self.viewer
        self.draw()
        while viewer.stage.image_size != self._target.size or viewer.moving:
            if viewer.pending is not None:
                concurrent.futures.wait([viewer.pending], _WAIT_SECONDS)
            self.draw()
        return time.perf_counter() - start

    def turn(self, frames: int) -> list[float]:
        """Drag the pointer; returns the times of the frames."""
        io, (width, height) = imgui.get_io(), self._target.size
        x = 0.8 * width
        io.add_mouse_pos_event(x, height / 2)
        io.add_mouse_button_event(0, True)
        self.draw()
        times = []
        for index in range(frames):
            io.add_mouse_pos_event(x - _TURN_PIXELS * index, height / 2)
            times.append(self.draw())
        io.add_mouse_button_event(0, False)
        self.draw()
        return times


def measure_loop(
    path: Path,
    mode: Literal["joint", "deferred"],
    *,
    size: tuple[int, int] = _SIZE,
    frames: int = 40,
    repeats: int = 4,
    rest_seconds: float = 2.0,
) -> LoopTimes:
    """Fly forward and back, stop and turn.

    Args:
        path: a scene, as for `pansplat-view`.
        mode: blending.
        size: of the window, pixels.
        frames: of each flight and each turn.
        repeats: of all.
        rest_seconds: before a turn, so that its cube faces are finished.
    """
    ctx = create_context()
    try:
        loop = _Loop(ctx, path, mode, size)
        try:
            moving, sharp, turning = [], [], []
            for index in range(repeats):
                moving += loop.fly((imgui.Key.w, imgui.Key.s)[index % 2], frames)
                moving_size = loop.viewer.stage.image_size
                sharp.append(loop.wait_until_sharp())
                loop.rest(rest_seconds)
                turning += loop.turn(frames)
                loop.rest(0.0)
        finally:
            loop.viewer.close()
    finally:
        ctx.release()
    medians = [statistics.median(times) for times in (moving, sharp, turning)]
    return LoopTimes(medians[0], moving_size, medians[1], medians[2])


def main(arguments: Sequence[str]) -> int:
    """Print the times of both modes; returns 0, or 2 if the scene cannot be shown."""
    if len(arguments) != 1:
        print("usage: python -m pansplat_viewer.window.loop_timing SCENE", file=sys.stderr)
        return 2
    try:
        for mode in ("joint", "deferred"):
            print(f"{mode}: {measure_loop(Path(arguments[0]), mode)}", flush=True)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
