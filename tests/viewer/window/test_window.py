"""The window, run in a process under Xvfb with synthetic mouse and key events."""

import os
import shutil
import signal
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytestmark = [pytest.mark.gl, pytest.mark.slow]

# The file `still` exists at the start of a frame that does not differ from the last one without new input.
PROGRAM = """
from pathlib import Path
from pansplat_viewer import main
from pansplat_viewer.viewer import Viewer

still, draw_frame = Path("still"), Viewer.frame

def frame(viewer, *arguments):
    still.unlink(missing_ok=True) if viewer.busy else still.touch()
    draw_frame(viewer, *arguments)

Viewer.frame = frame
main()
"""
TITLE = "room - pansplat"


class Display:
    """An X server without a screen, whose framebuffer is a file."""

    def __init__(self, folder: Path) -> None:
        read, write = os.pipe()
        # -noreset: otherwise the server restarts, and refuses clients, when its last client (xdotool) disconnects.
        command = ["Xvfb", "-displayfd", str(write), "-screen", "0", "1280x800x24", "-fbdir", str(folder)]
        command += ["-noreset", "-nolisten", "tcp"]
        self._server = subprocess.Popen(command, pass_fds=(write,), stderr=subprocess.DEVNULL)
        os.close(write)
        with os.fdopen(read) as answer:
            self.name = f":{answer.readline().strip()}"
        self._file = folder / "Xvfb_screen0"

    def screen(self) -> np.ndarray:
        """The screen's RGB pixels; the file has the XWD format."""
        data = self._file.read_bytes()
        header = struct.unpack(">25I", data[:100])
        size, width, height, stride, colors = header[0], header[4], header[5], header[12], header[19]
        start = size + 12 * colors
        rows = np.frombuffer(data, np.uint8, height * stride, start).reshape(height, stride)
        return rows[:, : 4 * width].reshape(height, width, 4)[..., 2::-1].astype(int)

    def run_xdotool(self, *command: str) -> str:
        """Run xdotool on this display and return its output."""
        environment = {**os.environ, "DISPLAY": self.name}
        result = subprocess.run(["xdotool", *command], env=environment, capture_output=True, text=True, timeout=600)
        return result.stdout.strip()

    def close(self) -> None:
        self._server.terminate()
        self._server.wait(300)


@pytest.fixture(scope="module")
def display(tmp_path_factory) -> Iterator[Display]:
    missing = [program for program in ("Xvfb", "xdotool") if not shutil.which(program)]
    if missing and os.environ.get("CI"):
        pytest.fail(f"CI needs {missing}: apt-get install xvfb xdotool")
    if missing:
        pytest.skip(f"needs {missing} (Debian packages xvfb, xdotool)")
    display = Display(tmp_path_factory.mktemp("display"))
    yield display
    display.close()


@contextmanager
def running(display: Display, room: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    """Runs the command in a process that is killed when the block ends."""
    config = {"XDG_CONFIG_HOME": str(room.parent / "config")}  # the layout of the user is neither read nor changed
    environment = {**os.environ, "DISPLAY": display.name, "WAYLAND_DISPLAY": "", **config}
    viewer = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(room), *options],
        env=environment,
        cwd=room.parent,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    with viewer:
        try:
            yield viewer
        finally:
            viewer.kill()


def test_mouse_and_keys_move_the_camera_and_escape_closes_the_window(display, room, wait_until):
    with running(display, room, "--size", "640x480") as viewer:
        find = ("search", "--name", f"^{TITLE}$")
        window = wait_until(lambda: display.run_xdotool(*find), "window").split()[0]
        display.run_xdotool("windowmove", window, "0", "0")
        display.run_xdotool("windowfocus", window)
        image = (slice(10, 370), slice(320, 630))
        wait_until(lambda: (display.screen()[image].max(-1) > 60).mean() > 0.3, "scene")
        wait_until((room.parent / "still").exists, "end of the first animation")
        before = display.screen()[image]
        display.run_xdotool("mousemove", "450", "200", "mousedown", "1")
        display.run_xdotool("mousemove", "380", "200")
        wait_until(lambda: np.abs(display.screen()[image] - before).mean() > 5, "rotation of the view")
        display.run_xdotool("mouseup", "1")

        panel = (slice(20, 300), slice(20, 280))
        with_panel = display.screen()[panel]
        display.run_xdotool("key", "Tab")
        wait_until(lambda: np.abs(display.screen()[panel] - with_panel).mean() > 5, "change of the panels")

        display.run_xdotool("key", "p")
        shot = room.parent / "renders" / "room" / "view_001.png"
        wait_until(shot.exists, "screenshot")
        with Image.open(shot) as file:
            assert file.size == (640, 480)

        display.run_xdotool("windowsize", window, "800", "600")
        outside = (slice(490, 590), slice(500, 790))
        wait_until(lambda: (display.screen()[outside].max(-1) > 60).mean() > 0.2, "larger image")

        display.run_xdotool("key", "Escape")
        output, errors = viewer.communicate(timeout=600)
        assert viewer.returncode == 0, errors
        assert errors == "" and output == ""


def test_an_interrupt_ends_with_status_130(display, room, wait_until):
    with running(display, room, "--size", "320x240") as viewer:
        wait_until(lambda: display.run_xdotool("search", "--name", f"^{TITLE}$"), "window")
        viewer.send_signal(signal.SIGINT)
        _, errors = viewer.communicate(timeout=600)
        assert viewer.returncode == 130 and "Traceback" not in errors
