"""Clicks and keys, sent to the real panels on a context without a window, change the real picture."""

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import moderngl
import numpy as np
import pytest
import torch
from imgui_bundle import imgui

from pansplat.data.views import Views
from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.geometry.equirect import sample_equirect, uv_from_directions
from pansplat.geometry.fibonacci import fibonacci_directions
from pansplat_viewer.loader import LoadedScene, SceneEntry, SceneLoader
from pansplat_viewer.viewer import Viewer

pytestmark = pytest.mark.gl

SIZE = (560, 680)
PICTURE = (slice(20, 560), slice(310, 560))  # free of panels

# Widgets that must change the picture, each with what to set first so that it has something to change.
PICTURE_WIDGETS = {
    "joint": {"mode": "deferred"},
    "deferred": {"mode": "joint"},
    "difference": {"mode": "joint"},
    "view 0": {"mode": "joint"},
    "view 1": {"mode": "joint"},
    "0##level": {},
    "1##level": {},
    "2##level": {},
    "3##level": {},
    "min. opacity": {},
    "ray": {"kernel": "ewa"},
    "ewa": {"kernel": "ray"},
    "radial": {"order": "z"},
    "z": {"order": "radial"},
    "angular": {"lowpass": "3dgs"},
    "3dgs": {"lowpass": "angular"},
    "black": {"background": (1.0, 1.0, 1.0)},
    "grey": {},
    "white": {},
    "field of view": {},
    "Panorama 2": {},
    "##flight": {},
    "nearest photograph": {},
}
# Widgets whose effect is tested on its own below.
OTHER_WIDGETS = {
    "Scene", "pair", "path", "Open", "Gaussians", "Drawing", "background", "coarser while moving", "Camera",
    "fly", "orbit", "Reset", "speed", "Panorama 1", "Fly", "Photograph", "split", "Screenshot", "PNG",
    "EXR + depth", "360 PNG",
}  # fmt: skip


class Person:
    """Sends events and looks at what comes back."""

    def __init__(self, viewer: Viewer, target: moderngl.Framebuffer, clock: list[float]) -> None:
        self.viewer, self.target, self.clock = viewer, target, clock

    def frames(self, count: int, seconds: float = 1 / 30) -> None:
        for _ in range(count):
            self.clock[0] += seconds
            self.viewer.frame(self.target, seconds)

    def settle(self) -> None:
        """Let time pass until nothing changes by itself."""
        self.frames(10)
        deadline = time.monotonic() + 20
        while self.viewer.busy:
            assert time.monotonic() < deadline, "the viewer never comes to rest"
            self.frames(1)
            time.sleep(0.002)
        self.frames(1)

    def picture(self) -> np.ndarray:
        self.settle()
        pixels = np.frombuffer(self.target.read(components=3), np.uint8).reshape(SIZE[1], SIZE[0], 3)
        return pixels[::-1][PICTURE].astype(int)

    def click(self, label: str) -> None:
        self.frames(1)
        left, top, right, bottom = self.viewer.panels.items[label]
        io = imgui.get_io()
        io.add_mouse_pos_event((left + right) / 2, (top + bottom) / 2)
        if "opacity" in label or label in ("field of view", "split"):  # the label is right of the slider
            io.add_mouse_pos_event(left + 0.4 * (right - left), (top + bottom) / 2)
        elif right - left > 60 and label not in ("path", "pair", "##flight"):
            io.add_mouse_pos_event(left + 10, (top + bottom) / 2)
        self.frames(2)
        io.add_mouse_button_event(0, True)
        self.frames(2)
        io.add_mouse_button_event(0, False)
        self.frames(2)
        io.add_mouse_pos_event(SIZE[0] - 5, SIZE[1] - 5)
        self.frames(1)

    def drag(self, start: tuple[float, float], end: tuple[float, float], button: int = 0) -> None:
        io = imgui.get_io()
        io.add_mouse_pos_event(*start)
        self.frames(2)
        io.add_mouse_button_event(button, True)
        self.frames(1)
        io.add_mouse_pos_event(*end)
        self.frames(1)
        io.add_mouse_button_event(button, False)
        self.frames(1)

    def key(self, *keys: imgui.Key, frames: int = 1) -> None:
        io = imgui.get_io()
        for key in keys:
            io.add_key_event(key, True)
        self.frames(frames)
        for key in keys:
            io.add_key_event(key, False)
        self.frames(1)


def _sphere(entry: SceneEntry, photos: np.ndarray) -> LoadedScene:
    """A photograph, and the same photograph as Gaussians around its camera, in a world with z up."""
    pose = torch.eye(4, dtype=torch.float64)
    yaw = 0.7
    right, forward = (np.cos(yaw), -np.sin(yaw), 0.0), (np.sin(yaw), np.cos(yaw), 0.0)
    pose[:3, :3] = torch.tensor((right, (0.0, 0.0, -1.0), forward)).T
    pose[:3, 3] = torch.tensor((1.0, -2.0, 0.5))
    count = 3000
    directions = fibonacci_directions(count)
    image = torch.from_numpy(photos[0]).permute(2, 0, 1)
    color = sample_equirect(image, uv_from_directions(directions).float()).T
    gaussians = Gaussians(
        means=(pose[:3, 3] + 3 * directions @ pose[:3, :3].T).float(),
        scales=torch.full((count, 3), 0.2),
        quats=torch.tensor((1.0, 0, 0, 0)).expand(count, 4),
        opacities=torch.full((count,), 0.99),
        harmonics=((color - 0.5) / 0.28209479177387814)[:, None],
        levels=torch.zeros(count, dtype=torch.int64),
        views=torch.zeros(count, dtype=torch.int64),
    )
    scene = Scene(gaussians, pose[None], 0.45, 10.0, ("a.png",), "synthetic", 128)
    mask = torch.ones(1, *image.shape[1:], dtype=torch.bool)
    return LoadedScene(entry, scene, Views(image[None], pose[None], mask, 0.45, 10.0, ("a.png",)))


@pytest.fixture(scope="module")
def session(gl_context, small_scene, axis_photos, tmp_path_factory) -> Iterator[Person]:
    photos = Views(
        torch.from_numpy(axis_photos).permute(0, 3, 1, 2),
        small_scene.cam2world,
        torch.ones(2, 128, 256, dtype=torch.bool),
        0.45,
        10.0,
        small_scene.names,
    )

    def load(entry, progress):
        if entry.name == "sphere":
            return _sphere(entry, axis_photos)
        if entry.name == "damaged":
            raise InputError("damaged.ply: 100% unreadable; export it again")
        return LoadedScene(entry, small_scene, None if entry.name == "no photographs" else photos)

    def find(path: Path) -> list[SceneEntry]:
        if path.name == "nothing":
            raise InputError(f"{path}: no such file or folder")
        return [SceneEntry("opened")]

    clock = [0.0]
    gl_context.__enter__()
    target = gl_context.simple_framebuffer(SIZE, components=3)
    folder = tmp_path_factory.mktemp("shots")
    viewer = Viewer(gl_context, SceneLoader(load), find=find, folder=folder, clock=lambda: clock[0])
    imgui.get_io().display_size = SIZE
    person = Person(viewer, target, clock)
    viewer.show([SceneEntry("first"), SceneEntry("second")], 0)
    person.settle()
    yield person
    with gl_context:
        viewer.close()


@pytest.fixture
def person(session, ctx) -> Person:
    """The session with everything back to where it began."""
    state, start = session.viewer.state, type(session.viewer.state)()
    state.settings = replace(start.settings, levels=None)
    for name in (
        "orbiting",
        "flight",
        "playing",
        "overlay",
        "help",
        "photo",
        "split",
        "speed",
        "message",
        "quit",
    ):
        setattr(state, name, getattr(start, name))
    state.camera, state.adaptive = state.home, True
    session.viewer.panel_data.error = None
    imgui.get_io().add_mouse_pos_event(SIZE[0] - 5, SIZE[1] - 5)
    session.settle()
    state.message = ""
    return session


def changed(before: np.ndarray, after: np.ndarray) -> float:
    """Share of the pixels that differ visibly."""
    return float((np.abs(before - after).max(-1) > 2).mean())


def test_every_widget_of_the_panel_is_covered_here(person):
    assert set(person.viewer.panels.items) == set(PICTURE_WIDGETS) | OTHER_WIDGETS
    bottoms = [rectangle[3] for rectangle in person.viewer.panels.items.values()]
    assert max(bottoms) < SIZE[1], "the panel fits without scrolling"


@pytest.mark.parametrize("label", PICTURE_WIDGETS)
def test_clicking_the_widget_changes_the_picture(person, label):
    person.viewer.state.settings = replace(person.viewer.state.settings, **PICTURE_WIDGETS[label])
    before = person.picture()
    person.click(label)
    assert changed(before, person.picture()) > 0.001


def test_nothing_changes_without_a_click(person):
    before = person.picture()
    person.frames(5)
    assert changed(before, person.picture()) == 0


@pytest.mark.parametrize("label", ["0##level", "nearest photograph"])
def test_clicking_a_check_box_twice_restores_the_picture(person, label):
    before = person.picture()
    person.click(label)
    person.picture()
    person.click(label)
    assert changed(before, person.picture()) == 0


def test_hiding_every_level_leaves_the_background(person):
    for level in range(4):
        person.click(f"{level}##level")
    assert person.picture().max() == 0
    person.click("white")
    assert person.picture().min() == 255


def test_fly_button_plays_and_stop_pauses(person):
    person.click("Fly")
    assert person.viewer.state.playing
    assert "Stop" in person.viewer.panels.items
    person.click("Stop")
    assert not person.viewer.state.playing and 0 < person.viewer.state.flight < 1


def test_orbit_fly_and_reset_buttons(person):
    person.click("orbit")
    assert person.viewer.state.orbiting
    person.drag((500, 400), (560, 400))
    assert person.viewer.state.camera.position != person.viewer.state.home.position
    person.click("fly")
    assert not person.viewer.state.orbiting
    person.click("Reset")
    assert person.viewer.state.camera == person.viewer.state.home
    person.click("Panorama 2")
    person.click("Panorama 1")
    assert person.viewer.state.camera.position == (0, 0, 0)


def test_speed_slider_changes_the_speed(person):
    before = person.viewer.state.speed
    left, top, _, bottom = person.viewer.panels.items["speed"]
    person.drag((left + 20, (top + bottom) / 2), (left + 80, (top + bottom) / 2))
    assert person.viewer.state.speed > before
    assert person.viewer.state.camera == person.viewer.state.home, "a drag on a panel is not a drag on the scene"


def test_dragging_the_picture_looks_around_and_carries_it_along(person):
    before = person.picture()
    person.drag((500, 400), (470, 400))
    after = person.picture()
    assert person.viewer.state.camera.yaw_radians > 0
    # The scene sticks to the pointer: shifted back by 30 pixels the pictures agree best.
    errors = {s: np.abs(before[100:380, 60:200] - after[100:380, 60 + s : 200 + s]).mean() for s in (-30, 0, 30)}
    assert min(errors, key=errors.get) == -30


def test_keys_move_the_camera(person):
    person.key(imgui.Key.w, frames=5)
    assert person.viewer.state.camera.position[2] > 0.1
    person.key(imgui.Key.r)
    assert person.viewer.state.camera == person.viewer.state.home


def test_scrolling_changes_the_field_of_view(person):
    before = person.picture()
    imgui.get_io().add_mouse_wheel_event(0, 1)
    person.frames(2)
    assert person.viewer.state.camera.vertical_fov_degrees < person.viewer.state.home.vertical_fov_degrees
    assert changed(before, person.picture()) > 0.1


def test_tab_hides_the_panels_and_h_shows_the_keys(person):
    person.key(imgui.Key.tab)
    assert not person.viewer.panels.items
    plain = person.picture()
    person.key(imgui.Key.h)
    assert changed(plain, person.picture()) > 0.1
    person.key(imgui.Key.escape)
    assert changed(plain, person.picture()) == 0 and not person.viewer.state.quit


def test_typing_a_path_does_not_fly_and_enter_opens_it(person):
    person.click("path")
    io = imgui.get_io()
    for character in "wasd":
        io.add_key_event(getattr(imgui.Key, character), True)
        io.add_input_character(ord(character))
        person.frames(2)
        io.add_key_event(getattr(imgui.Key, character), False)
        person.frames(1)
    assert person.viewer.panels.path == "wasd"
    assert person.viewer.state.camera == person.viewer.state.home
    person.key(imgui.Key.enter)
    person.settle()
    assert person.viewer.panel_data.entries == ["opened"]
    person.viewer.show([SceneEntry("first"), SceneEntry("second")], 0)
    person.settle()


def test_the_chooser_loads_the_other_pair(person):
    person.click("pair")
    left, _, _, bottom = person.viewer.panels.items["pair"]
    io = imgui.get_io()
    io.add_mouse_pos_event(left + 30, bottom + 36)
    person.frames(2)
    io.add_mouse_button_event(0, True)
    person.frames(1)
    io.add_mouse_button_event(0, False)
    person.frames(2)
    person.settle()
    assert person.viewer.panel_data.current == 1
    person.viewer.show(person.viewer.entries, 0)
    person.settle()


def test_opening_something_unusable_says_so_and_keeps_the_scene(person):
    before = person.picture()
    person.viewer.open(Path("nothing"))
    person.frames(2)
    assert "no such file" in person.viewer.panel_data.error
    assert changed(before, person.picture()) > 0.02, "the message is on the screen"
    person.click("OK")
    assert person.viewer.panel_data.error is None
    assert changed(before, person.picture()) == 0


def test_a_scene_that_cannot_be_read_says_so_and_keeps_the_scene(person):
    person.viewer.show([SceneEntry("damaged")], 0)
    person.settle()
    assert person.viewer.panel_data.error.startswith("damaged.ply: 100% unreadable")
    person.viewer.show([SceneEntry("first"), SceneEntry("second")], 0)
    person.settle()


def test_the_photograph_shows_what_lies_in_the_viewing_direction(person):
    state = person.viewer.state
    state.photo, state.split = True, 0.0
    state.settings = replace(state.settings, levels=frozenset())  # hidden by the photograph anyway
    state.camera = replace(state.home, yaw_radians=np.pi / 2, vertical_fov_degrees=30)
    red, green, blue = person.picture()[180:200].mean((0, 1)) / 255
    assert red > 0.95 and 0.4 < green < 0.6 and 0.4 < blue < 0.6, "right is red"
    rows = person.picture()[..., 1].mean(1)
    assert rows[0] > rows[-1] + 20, "up is green: upright"
    state.camera = replace(state.camera, yaw_radians=0.0)
    columns = person.picture()[..., 0].mean(0)
    assert columns[-1] > columns[0] + 20, "right is red: not mirrored"
    state.camera = replace(state.camera, position=(0.0, 0.0, 0.4))
    assert person.picture().max() < 90, "the nearest photograph is the second, dim one"


def test_at_an_input_camera_the_rendering_looks_like_its_photograph(person):
    person.viewer.show([SceneEntry("sphere")], 0)
    person.settle()
    state = person.viewer.state
    for yaw, pitch in ((0.0, 0.0), (2.0, 0.5), (-2.0, -0.9)):
        state.camera = replace(state.home, yaw_radians=yaw, pitch_radians=pitch)
        state.photo = False
        rendered = person.picture()
        state.photo, state.split = True, 0.0
        photograph = person.picture()
        assert np.abs(rendered - photograph).mean() < 4
        assert np.abs(rendered - photograph[:, ::-1]).mean() > 8, "a mirrored one would be told apart"
        assert np.abs(rendered - photograph[::-1]).mean() > 8, "and one upside down"
    person.viewer.show([SceneEntry("first"), SceneEntry("second")], 0)
    person.settle()


def test_the_split_keeps_the_rendering_on_its_left(person):
    rendered = person.picture()
    person.click("nearest photograph")
    person.viewer.state.split = 0.75
    compared = person.picture()
    middle = int(0.75 * SIZE[0]) - 310
    assert changed(rendered[:, : middle - 2], compared[:, : middle - 2]) == 0
    assert changed(rendered[:, middle + 2 :], compared[:, middle + 2 :]) > 0.9
    person.click("split")
    assert person.viewer.state.split < 0.75


def test_a_scene_without_photographs_offers_no_comparison(person):
    person.viewer.show([SceneEntry("no photographs")], 0)
    person.settle()
    assert "nearest photograph" not in person.viewer.panels.items
    before = person.picture()
    person.key(imgui.Key.c)
    assert changed(before, person.picture()) == 0
    person.viewer.show([SceneEntry("first"), SceneEntry("second")], 0)
    person.settle()


def test_screenshots_are_the_picture_without_the_panels(person, monkeypatch):
    from PIL import Image

    monkeypatch.setattr("pansplat_viewer.viewer.PANORAMA_HEIGHT", 128)
    picture = person.picture()
    for label in ("PNG", "360 PNG"):
        person.click(label)
    png, panorama = person.viewer.screenshots[-2:]
    with Image.open(png) as image:
        assert image.size == SIZE
        pixels = np.asarray(image).astype(int)
    assert np.abs(pixels[PICTURE] - picture).max() <= 3
    assert changed(pixels[20:560, 20:290], np.zeros_like(pixels[20:560, 20:290])) > 0.3
    with Image.open(panorama) as image:
        assert image.size == (256, 128)
    person.viewer.state.message = ""
    assert changed(picture, person.picture()) == 0, "the window shows the view again"


def test_exr_holds_colour_and_radial_depth(person):
    import OpenEXR

    person.key(imgui.Key.left_shift, imgui.Key.mod_shift, imgui.Key.p)
    path = person.viewer.screenshots[-1]
    assert path.suffix == ".exr"
    with OpenEXR.File(str(path)) as file:
        depth = file.channels()["Z"].pixels
        assert depth.shape == SIZE[::-1] and file.channels()["RGB"].pixels.shape == (*SIZE[::-1], 3)
    assert 1.5 < np.median(depth[depth > 0]) < 4.5


def test_focus_orbits_what_is_in_the_middle(person):
    person.settle()
    person.key(imgui.Key.f)
    assert person.viewer.state.orbiting
    assert 1.5 < person.viewer.state.camera.distance < 4.5
    assert person.viewer.state.camera.position == person.viewer.state.home.position


def test_moving_coarsens_and_standing_still_refines(person):
    viewer = person.viewer
    viewer._resolution.budget_ms = 1e-3
    io = imgui.get_io()
    io.add_key_event(imgui.Key.w, True)
    person.frames(8)
    assert viewer.panel_data.size[0] < SIZE[0]
    io.add_key_event(imgui.Key.w, False)
    person.settle()
    assert viewer.panel_data.size == SIZE
    person.click("coarser while moving")
    io.add_key_event(imgui.Key.w, True)
    person.frames(4)
    assert viewer.panel_data.size == SIZE
    io.add_key_event(imgui.Key.w, False)
    person.frames(1)


def test_the_window_stays_alive_and_shows_progress_while_loading(person, small_scene):
    import threading

    go = threading.Event()
    viewer, loader = person.viewer, person.viewer.loader

    def slow(entry, progress):
        progress("searching depth", 0.5)
        assert go.wait(20)
        return LoadedScene(entry, small_scene)

    before = person.picture()
    fast, loader._load = loader._load, slow
    viewer.show([SceneEntry("slow")], 0)
    person.frames(5)
    assert viewer.panel_data.loading == ("slow", "searching depth", 0.5)
    pixels = np.frombuffer(person.target.read(components=3), np.uint8).reshape(SIZE[1], SIZE[0], 3)
    assert changed(before, pixels[::-1][PICTURE].astype(int)) > 0.02, "a bar is on the screen"
    person.key(imgui.Key.w, frames=3)
    assert viewer.state.camera.position[2] > 0, "one can fly meanwhile"
    go.set()
    loader._load = fast
    person.settle()
    assert viewer.panel_data.loading is None
    viewer.show([SceneEntry("first"), SceneEntry("second")], 0)
    person.settle()
