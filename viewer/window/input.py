"""Keys and mouse: the input of one frame, and its effect on the viewer's state.

`read_input` reads imgui, so a window and synthetic events in tests use the same path. `apply_input` is pure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pansplat_viewer.scene import camera as cameras
from pansplat_viewer.scene.state import ViewerState, add_key_frame, go_home, jump_to_view, step_flight, toggle_play
from pansplat_viewer.window.preferences import Theme

MaskAnswer = Literal["save", "drop", "keep"]

FLY_SPEED = 1.0  # metres per second
FAST, SLOW = 4.0, 0.2
TURN_SPEED = 2.0  # of a gamepad's stick, radians per second
_CLICK_PIXELS = 3.0  # a longer way of the pointer with the button down is a drag
ORBIT_KEY_PIXELS = 400.0  # per second, of a window 1000 pixels high

# Rows of the key help in the window; docs/viewer.md has the same keys.
HELP = (
    ("W A S D", "fly forward, left, back, right"),
    ("Q E", "fly down, up"),
    ("Shift, Alt", "faster, slower"),
    ("drag", "look around (orbit: turn)"),
    ("click", "depth and Gaussian of a point; twice: their distance"),
    ("right drag", "pan"),
    ("scroll", "field of view (orbit: distance)"),
    ("V", "orbit or fly"),
    ("F", "focus the point in the centre"),
    ("1 2 ... 9", "jump to a panorama (tour: fly there)"),
    ("PgDn, PgUp", "the next or previous panorama"),
    ("Space", "play the flight between them"),
    ("M", "floor plan and hotspots of a tour"),
    ("O", "doll's house: all rooms from outside"),
    (", .", "step along the flight (placing: turn)"),
    ("C", "compare with the nearest photograph"),
    ("X", "pin the image, to compare others with it"),
    ("B", "before or after the refinement"),
    ("K", "key frame of the camera path"),
    ("P, Shift P", "screenshot PNG, EXR with depth"),
    ("R", "back to the start"),
    ("Tab", "panels on or off"),
    ("H", "this help"),
    ("Esc, Ctrl Q", "quit"),
)


@dataclass(frozen=True)
class Input:
    """Keys and mouse in one frame.

    Attributes:
        drag: pointer movement over the image with the left button held, pixels (right, down).
        click: place of a click on the image without a drag, as fractions of width and height; None without a click.
        pointer: place of the pointer over the image while the left button is held, in the same unit; else None.
        sticks: of a gamepad, -1 to 1: fly right, up and forward, turn right and up.
    """

    seconds: float = 1 / 60  # since the last frame
    held: frozenset[str] = frozenset()  # names of the keys that are down (lower case: "w", "shift", ...)
    pressed: frozenset[str] = frozenset()  # names of the keys that went down in this frame
    drag: tuple[float, float] = (0.0, 0.0)
    pan: tuple[float, float] = (0.0, 0.0)  # the same with the right or middle button
    scroll: float = 0.0  # wheel steps; positive is scrolling up
    height: int = 720  # of the window, pixels
    click: tuple[float, float] | None = None
    pointer: tuple[float, float] | None = None
    sticks: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass
class Commands:
    """Actions by keys or panels that do not change the state.

    Attributes:
        png, exr, panorama: write a screenshot.
        save_path, open_path: write or read the key frames, to or from this file.
    """

    png: bool = False
    exr: bool = False
    panorama: bool = False
    pin: bool = False  # pin the image
    go_to_photograph: bool = False  # move to the camera of the photograph of the comparison
    focus: bool = False  # orbit the point in the image centre
    pick: tuple[float, float] | None = None  # show the point at this place, as fractions of width and height
    choose: int | None = None  # show the entry of this index
    open: str | None = None  # show the scenes at this path
    reload: bool = False  # load the entry again
    reduce: int | None = None  # show the scene that did not fit, with this number of Gaussians
    theme: Theme | None = None  # choose these colours
    reset_layout: bool = False  # restore the default layout of the panels
    visit: int | None = None  # fly to this panorama of the tour
    remove_floaters: bool = False
    save_scene: str | None = None  # write the scene without what is hidden to this file
    paint: bool | None = None  # start or end to paint a mask
    clear_mask: bool = False
    save_mask: bool = False
    answer: MaskAnswer | None = None  # what to do with a mask that is not saved
    doll_house: bool = False  # go out of the rooms, or back into the last panorama
    save_path: str | None = None
    open_path: str | None = None
    film: bool = False  # write the film of the path
    cancel_film: bool = False  # end the film that is being written
    dismiss_error: bool = False  # close the error message
    cancel_loading: bool = False  # end the search for scenes, or the prediction
    cancel_refinement: bool = False  # keep the prediction


_KEYS = {
    **{letter: letter for letter in "wasdqevfhprcbmkxo"},
    **{digit: f"_{digit}" for digit in "123456789"},
    "space": "space",
    ",": "comma",
    ".": "period",
    "tab": "tab",
    "escape": "escape",
    "page down": "page_down",
    "page up": "page_up",
    "up": "up_arrow",
    "down": "down_arrow",
    "left": "left_arrow",
    "right": "right_arrow",
}

_BUTTONS = {
    "gamepad_face_down": "space",
    "gamepad_face_up": "v",
    "gamepad_face_right": "r",
    "gamepad_start": "tab",
    "gamepad_dpad_left": ",",
    "gamepad_dpad_right": ".",
    "gamepad_l1": "alt",
    "gamepad_r1": "shift",
}
_STICKS = (
    ("gamepad_l_stick_right", "gamepad_l_stick_left"),
    ("gamepad_r2", "gamepad_l2"),
    ("gamepad_l_stick_up", "gamepad_l_stick_down"),
    ("gamepad_r_stick_right", "gamepad_r_stick_left"),
    ("gamepad_r_stick_up", "gamepad_r_stick_down"),
)


def _read_sticks() -> tuple[float, ...]:
    from imgui_bundle import imgui

    def read(name: str) -> float:
        return float(imgui.internal.get_key_data(getattr(imgui.Key, name)).analog_value)

    return tuple(read(positive) - read(negative) for positive, negative in _STICKS)


def read_input(seconds: float) -> Input:
    """Return this frame's input from imgui, without the events that a panel captures."""
    from imgui_bundle import imgui

    io = imgui.get_io()
    held: set[str] = set()
    pressed: set[str] = set()
    keys = [] if io.want_text_input else list(_KEYS.items())
    keys += [(name, button) for button, name in _BUTTONS.items()]
    for name, key in keys:
        value = getattr(imgui.Key, key)
        if imgui.is_key_down(value):
            held.add(name)
        if imgui.is_key_pressed(value, repeat=name in ",."):
            pressed.add(name)
    modifiers = {"shift": io.key_shift, "alt": io.key_alt, "ctrl": io.key_ctrl}
    held |= {name for name, down in modifiers.items() if down}
    drag = pan = (0.0, 0.0)
    scroll, click, pointer = 0.0, None, None
    if not io.want_capture_mouse:
        moved = (float(io.mouse_delta.x), float(io.mouse_delta.y))
        place = (io.mouse_pos.x / max(io.display_size.x, 1), io.mouse_pos.y / max(io.display_size.y, 1))
        pointer = place if imgui.is_mouse_down(0) else None
        if imgui.is_mouse_down(0) and not imgui.is_mouse_clicked(0):
            drag = moved
        elif imgui.is_mouse_down(1) or imgui.is_mouse_down(2):
            pan = moved
        scroll = float(io.mouse_wheel)
        moved_since_click = imgui.get_mouse_drag_delta(0, 0.0)
        if imgui.is_mouse_released(0) and max(abs(moved_since_click.x), abs(moved_since_click.y)) < _CLICK_PIXELS:
            click = place
    height = int(io.display_size.y)
    return Input(
        seconds, frozenset(held), frozenset(pressed), drag, pan, scroll, height, click, pointer, _read_sticks()
    )


def apply_input(state: ViewerState, events: Input) -> Commands:
    """Apply the input to the state, and return its commands."""
    if "ctrl" in events.held:
        state.quit = state.quit or "q" in events.pressed
        return Commands()
    _apply_pressed(state, events.pressed)
    if state.glide is None:
        _move_camera(state, events)
    shift, screenshot = "shift" in events.held, "p" in events.pressed
    return Commands(
        png=screenshot and not shift,
        exr=screenshot and shift,
        focus="f" in events.pressed,
        pin="x" in events.pressed,
        doll_house="o" in events.pressed,
        pick=events.click,
    )


def _apply_pressed(state: ViewerState, pressed: frozenset[str]) -> None:
    if "escape" in pressed:
        if state.help:
            state.help = False
        else:
            state.quit = True
    for key, name in (("tab", "overlay"), ("h", "help"), ("v", "orbiting"), ("b", "refined")):
        if key in pressed:
            setattr(state, name, not getattr(state, name))
    if "c" in pressed:
        state.comparison = "off" if state.comparison == "photograph" else "photograph"
    if "m" in pressed:
        state.minimap = state.hotspots = not state.minimap
    if "k" in pressed:
        add_key_frame(state)
    if "space" in pressed:
        toggle_play(state)
    if "r" in pressed:
        state.points = []
        go_home(state)
    for view in range(9):
        if str(view + 1) in pressed:
            jump_to_view(state, view)
    for key, steps in (("page up", -1), ("page down", 1)):
        if key in pressed and len(state.context):
            distances = np.linalg.norm(state.context[:, :3, 3] - state.camera.position, axis=1)
            jump_to_view(state, (int(distances.argmin()) + steps) % len(state.context))
    for key, steps in ((",", -1), (".", 1)):
        if key in pressed:
            step_flight(state, steps)


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
    axes += events.sticks[:3]
    factor = (FAST if "shift" in held else 1.0) * (SLOW if "alt" in held else 1.0)
    camera = state.camera
    turn = np.array(events.sticks[3:]) * TURN_SPEED * events.seconds
    if turn.any() and not (state.orbiting or state.doll_house):
        camera = cameras.turn(camera, *turn)
    if state.orbiting or state.doll_house:
        pixels = ORBIT_KEY_PIXELS * events.seconds * factor * events.height / 1000
        across = axes[:2] + events.sticks[3:]
        if across.any():
            camera = cameras.orbit(camera, (-across[0] * pixels, across[1] * pixels), events.height)
        if axes[2]:
            camera = cameras.dolly(camera, axes[2] * 6 * events.seconds * factor)
        if any(events.drag):
            camera = cameras.orbit(camera, events.drag, events.height)
        if events.scroll:
            camera = cameras.dolly(camera, events.scroll)
    else:
        step = axes * FLY_SPEED * state.speed * factor * events.seconds
        if axes.any():
            camera = cameras.fly(camera, *step)
        if any(events.drag):
            camera = cameras.turn_by_drag(camera, events.drag, events.height)
        if events.scroll:
            camera = cameras.zoom(camera, events.scroll)
    if any(events.pan):
        metres = camera.distance / max(events.height, 1)
        camera = cameras.fly(camera, -events.pan[0] * metres, events.pan[1] * metres, 0.0)
    if camera != state.camera:
        # Moving the camera stops the flight; a change of the field of view alone does not.
        moved = replace(camera, vertical_fov_degrees=state.camera.vertical_fov_degrees) != state.camera
        state.playing, state.path_playing = state.playing and not moved, state.path_playing and not moved
        state.camera = camera
