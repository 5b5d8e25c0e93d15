"""Keys and mouse: the input of one frame, and its effect on the viewer.

`read_input` reads imgui, so a window and synthetic events in tests use the same path. `apply_input` needs no window.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pansplat.constants import FAST, WALK_SPEED
from pansplat_viewer.core import camera as cameras
from pansplat_viewer.core.state import ViewerState, add_key_frame, go_home, go_to_view, limit_camera, toggle_play

if TYPE_CHECKING:
    from pansplat_viewer.viewer import Viewer

SLOW = 0.2  # factor of the speed while Alt is held
_CLICK_PIXELS = 3.0  # a longer way of the pointer with the button down is a drag
ORBIT_KEY_PIXELS = 400.0  # per second, of a window 1000 pixels high


@dataclass(frozen=True)
class Input:
    """Keys and mouse in one frame.

    Attributes:
        drag: pointer movement over the image with the left button held, pixels (right, down).
        click: place of a click on the image without a drag, as fractions of width and height; None without a click.
    """

    seconds: float = 1 / 60  # since the last frame
    held: frozenset[str] = frozenset()  # names of the keys that are down (lower case: "w", "shift", ...)
    pressed: frozenset[str] = frozenset()  # names of the keys that went down in this frame
    drag: tuple[float, float] = (0.0, 0.0)
    pan: tuple[float, float] = (0.0, 0.0)  # the same with the right or middle button
    scroll: float = 0.0  # wheel steps; positive is scrolling up
    height: int = 720  # height of the window, pixels
    click: tuple[float, float] | None = None


Action = Callable[["Viewer", Input], None]


class KeyRow(NamedTuple):
    """A row of the key help.

    Attributes:
        label: the keys as the help names them.
        help: what they do.
        actions: by key, what happens when it goes down; None for keys that are held to move.
    """

    label: str
    help: str
    actions: Mapping[str, Action | None] = {}


def _change(function: Callable[..., None], *arguments: object) -> Action:
    """Call a function of the state."""
    return lambda viewer, _: function(viewer.state, *arguments)


def _toggle(name: str) -> Action:
    """Change a value of the state between True and False."""
    return lambda viewer, _: setattr(viewer.state, name, not getattr(viewer.state, name))


def _queue(name: str) -> Action:
    """Call a method of the viewer at the end of the frame."""
    return lambda viewer, _: viewer.queue(getattr(viewer, name))


def _write_screenshot(viewer: Viewer, events: Input) -> None:
    viewer.queue(viewer.write_screenshot, "exr" if "shift" in events.held else "png")


def _restart(state: ViewerState) -> None:
    state.points = []
    go_home(state)


def _jump_by(state: ViewerState, steps: int) -> None:
    """Go from the nearest panorama to another one, in the order of the list."""
    if len(state.context):
        distances = np.linalg.norm(state.context[:, :3, 3] - state.camera.position, axis=1)
        go_to_view(state, (int(distances.argmin()) + steps) % len(state.context))


def _escape(viewer: Viewer, _: Input) -> None:
    if viewer.state.help:
        viewer.state.help = False
    else:
        viewer.state.quit = True


KEYS = (
    KeyRow("W A S D", "fly forward, left, back, right", dict.fromkeys((*"wasd", "up", "left", "down", "right"))),
    KeyRow("Q E", "fly down, up", dict.fromkeys("qe")),
    KeyRow("Shift, Alt", "faster, slower"),
    KeyRow("drag", "look around (orbit: turn)"),
    KeyRow("click", "distance of a point; twice: the distance between both"),
    KeyRow("right drag", "pan"),
    KeyRow("scroll", "field of view (orbit: distance)"),
    KeyRow("V", "orbit or fly", {"v": _toggle("orbiting")}),
    KeyRow("F", "focus the point in the centre", {"f": _queue("focus_center")}),
    KeyRow("1 2 ... 9", "go to a panorama", {str(n + 1): _change(go_to_view, n) for n in range(9)}),
    KeyRow(
        "PgDn, PgUp",
        "the next or previous panorama",
        {"page down": _change(_jump_by, 1), "page up": _change(_jump_by, -1)},
    ),
    KeyRow("Space", "play the way through them", {"space": _change(toggle_play)}),
    KeyRow("M", "floor plan and rings of a tour", {"m": _toggle("plan")}),
    KeyRow("K", "key frame of the camera path", {"k": _change(add_key_frame)}),
    KeyRow("P, Shift P", "screenshot PNG, EXR with depth", {"p": _write_screenshot}),
    KeyRow("R", "back to the start", {"r": _change(_restart)}),
    KeyRow("Tab", "panels on or off", {"tab": _toggle("overlay")}),
    KeyRow("H", "this help", {"h": _toggle("help")}),
    KeyRow("Esc, Ctrl Q", "quit", {"escape": _escape}),
)
"""The help in the window and the actions."""

_ACTIONS = {key: action for row in KEYS for key, action in row.actions.items()}
_IMGUI_NAMES = {name: f"{name}_arrow" for name in ("up", "down", "left", "right")}
_IMGUI_NAMES |= {digit: f"_{digit}" for digit in "123456789"}


def read_input(seconds: float) -> Input:
    """Return this frame's input from imgui, without the events that a panel captures."""
    from imgui_bundle import imgui

    io = imgui.get_io()
    held: set[str] = set()
    pressed: set[str] = set()
    keys = [] if io.want_text_input else [(name, _IMGUI_NAMES.get(name, name)) for name in _ACTIONS]
    for name, key in keys:
        value = getattr(imgui.Key, key.replace(" ", "_"))
        if imgui.is_key_down(value):
            held.add(name)
        if imgui.is_key_pressed(value, repeat=False):
            pressed.add(name)
    modifiers = {"shift": io.key_shift, "alt": io.key_alt, "ctrl": io.key_ctrl}
    held |= {name for name, down in modifiers.items() if down}
    drag = pan = (0.0, 0.0)
    scroll, click = 0.0, None
    if not io.want_capture_mouse:
        moved = (float(io.mouse_delta.x), float(io.mouse_delta.y))
        place = (io.mouse_pos.x / max(io.display_size.x, 1), io.mouse_pos.y / max(io.display_size.y, 1))
        if imgui.is_mouse_down(0) and not imgui.is_mouse_clicked(0):
            drag = moved
        elif imgui.is_mouse_down(1) or imgui.is_mouse_down(2):
            pan = moved
        scroll = float(io.mouse_wheel)
        moved_since_click = imgui.get_mouse_drag_delta(0, 0.0)
        if imgui.is_mouse_released(0) and max(abs(moved_since_click.x), abs(moved_since_click.y)) < _CLICK_PIXELS:
            click = place
    height = int(io.display_size.y)
    return Input(seconds, frozenset(held), frozenset(pressed), drag, pan, scroll, height, click)


def apply_input(viewer: Viewer, events: Input) -> None:
    """Apply the input to the viewer's state, and queue other actions."""
    if "ctrl" in events.held:
        if "q" in events.pressed:
            viewer.state.quit = True
        return
    for key in events.pressed:
        action = _ACTIONS.get(key)
        if action is not None:
            action(viewer, events)
    _move_camera(viewer.state, events)
    if events.click is not None:
        viewer.queue(viewer.click, events.click)


def _move_camera(state: ViewerState, events: Input) -> None:
    held = events.held
    axes = np.array(
        (
            ("d" in held or "right" in held) - ("a" in held or "left" in held),
            ("e" in held) - ("q" in held),
            ("w" in held or "up" in held) - ("s" in held or "down" in held),
        ),
        dtype=float,
    )
    factor = (FAST if "shift" in held else 1.0) * (SLOW if "alt" in held else 1.0)
    camera = state.camera
    if state.orbiting:
        pixels = ORBIT_KEY_PIXELS * events.seconds * factor * events.height / 1000
        if axes[:2].any():
            camera = cameras.orbit(camera, (-axes[0] * pixels, axes[1] * pixels), events.height)
        if axes[2]:
            camera = cameras.dolly(camera, axes[2] * 6 * events.seconds * factor)
        if any(events.drag):
            camera = cameras.orbit(camera, events.drag, events.height)
        if events.scroll:
            camera = cameras.dolly(camera, events.scroll)
    else:
        step = axes * WALK_SPEED * factor * events.seconds
        if axes.any():
            camera = cameras.fly(camera, *step)
        if any(events.drag):
            camera = cameras.turn_by_drag(camera, events.drag, events.height)
        if events.scroll:
            camera = cameras.zoom(camera, events.scroll)
    if any(events.pan):
        metres = camera.distance / max(events.height, 1)
        camera = cameras.fly(camera, -events.pan[0] * metres, events.pan[1] * metres, 0.0)
    before, state.camera = state.camera, camera
    limit_camera(state, before)
    if replace(state.camera, vertical_fov_degrees=before.vertical_fov_degrees) != before:
        # Moving the camera stops the flight; a change of the field of view alone does not.
        state.playing = state.path_playing = False
