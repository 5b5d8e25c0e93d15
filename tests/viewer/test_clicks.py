"""Synthetic clicks and keys, on a context without a window, change the rendered image."""

import json
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import get_args

import moderngl
import numpy as np
import OpenEXR
import pytest
import torch
from imgui_bundle import imgui
from PIL import Image
from synthetic_scenes import make_balls

from pansplat.errors import InputError
from pansplat.gaussians.scene import Scene
from pansplat.geometry.equirect import pixel_directions, sample_equirect, uv_from_directions
from pansplat.geometry.fibonacci import fibonacci_directions
from pansplat.images.image_files import write_image
from pansplat.inputs.folders import load_sets
from pansplat.inputs.panorama_sets import Panorama
from pansplat.poses.dense import Surroundings
from pansplat.poses.depth import DepthMap
from pansplat.poses.placing import Piece
from pansplat.system.progress import report_progress
from pansplat.tours.graph import find_tours
from pansplat_viewer.core.loader import LoadedScene, SceneEntry, SceneLoader
from pansplat_viewer.core.settings import Display, DrawSettings
from pansplat_viewer.core.state import ViewerState
from pansplat_viewer.draw.cpu_renderer import CpuRenderer
from pansplat_viewer.draw.frame_renderer import Pacing
from pansplat_viewer.draw.resolution import BUDGET_MS, SETTLE_AFTER
from pansplat_viewer.ui.minimap import describe_panorama, describe_panoramas
from pansplat_viewer.ui.photograph_textures import PhotographTextures
from pansplat_viewer.ui.placing_panel import describe_state
from pansplat_viewer.viewer import Viewer

pytestmark = pytest.mark.gl

SIZE = (560, 900)
IMAGE = (slice(20, 560), slice(310, 560))  # rows and columns without panels
NAMES = ["first", "second"]
SMALL = Pacing(min_size=(64, 64), settle_seconds=0.02, turn_ms=1000 / 60, waits_while_moving=True)

# Widgets that must change the image, and the modes in which some of them have something to change.
IMAGE_WIDGETS = (
    "joint", "deferred", "view 0", "view 1", "0##level", "1##level", "2##level", "3##level",
)  # fmt: skip
INITIAL_MODES = {"joint": "deferred", "deferred": "joint", "view 0": "joint", "view 1": "joint"}
# Widgets whose effect has its own test.
OTHER_WIDGETS = {
    "pair", "path", "Open", "Reload", "Photographs", "visit", "Fly",
    "Notes", "note", "Put at the middle", "Remove",
    "Film", "PNG", "EXR + depth", "360 PNG", "Add key frame", "time", "path file", "Save", "Load",
    "Expert", *get_args(Display), "photographs at panoramas",
}  # fmt: skip


class User:
    """Sends events to a viewer and reads its frames.

    Attributes:
        load, find: what the viewer's loader calls; a test may replace them.
    """

    def __init__(self, viewer: Viewer, target: moderngl.Framebuffer, clock: list[float], load: Callable) -> None:
        self.viewer, self.target, self.clock = viewer, target, clock
        self.load = self.first_load = load
        self.find = lambda path, show: [SceneEntry("opened")]
        self.state, self.panels = viewer.state, viewer.panels

    def draw_frames(self, count: int, seconds: float = 1 / 30) -> None:
        for _ in range(count):
            self.clock[0] += seconds
            self.viewer.frame(self.target, seconds)

    def draw_until(self, condition: Callable[[], object], expected: str, seconds: float = 1 / 30) -> None:
        """Draw frames until a condition is true; their number does not matter, for threads can be slow."""
        deadline = time.monotonic() + 300
        while not condition():
            assert time.monotonic() < deadline, f"no {expected}"
            self.draw_frames(1, seconds)
            time.sleep(0.002)

    def wait_for_progress(self, *expected: object) -> None:
        """Draw frames until the panel shows this progress: name, description, fraction."""
        self.draw_until(lambda: self.viewer.session.loading == expected, f"progress {expected}", 0.01)

    def settle(self, *, refining: bool = False) -> None:
        """Draw frames until nothing changes without input; with `refining`, except the progress of a refinement."""
        self.draw_frames(3, SETTLE_AFTER)
        self.draw_until(lambda: not (self.viewer.moving if refining else self.viewer.busy), "settled viewer")
        self.draw_frames(1)

    def read_window(self) -> np.ndarray:
        """RGB of the last frame."""
        pixels = np.frombuffer(self.target.read(components=3), np.uint8).reshape(SIZE[1], SIZE[0], 3)
        return pixels[::-1].astype(int)

    def read_screen(self) -> np.ndarray:
        """RGB of the last frame, outside the panels."""
        return self.read_window()[IMAGE]

    def read_image(self) -> np.ndarray:
        """RGB of a settled frame, outside the panels."""
        self.settle()
        return self.read_screen()

    def show(self, *entries: SceneEntry) -> None:
        self.viewer.session.show(list(entries), 0)
        self.settle()

    def click(self, label: str) -> None:
        self.draw_frames(1)
        left, top, right, bottom = self.panels.widgets.items[label]
        x = (left + right) / 2
        if right - left > 60 and label not in ("path", "pair"):
            x = left + 10
        self.click_at(x, (top + bottom) / 2)

    def click_at(self, x: float, y: float) -> None:
        self.drag((x, y), (x, y))
        imgui.get_io().add_mouse_pos_event(SIZE[0] - 5, SIZE[1] - 5)
        self.draw_frames(1)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        io = imgui.get_io()
        io.add_mouse_pos_event(*start)
        self.draw_frames(2)
        io.add_mouse_button_event(0, True)
        self.draw_frames(1)
        io.add_mouse_pos_event(*end)
        self.draw_frames(1)
        io.add_mouse_button_event(0, False)
        self.draw_frames(2)

    def slide(self, label: str, fraction: float, start: float = 0.2) -> None:
        """Drag a slider to a fraction of its width, which its label is a part of."""
        left, top, right, bottom = self.panels.widgets.items[label]
        middle = (top + bottom) / 2
        self.drag((left + start * (right - left), middle), (left + fraction * (right - left), middle))

    def press(self, *keys: imgui.Key, frames: int = 1) -> None:
        for down in (True, False):
            for key in keys:
                imgui.get_io().add_key_event(key, down)
            self.draw_frames(frames if down else 1)


def make_sphere_scene(entry: SceneEntry, photos: np.ndarray) -> LoadedScene:
    """A photograph, and the same photograph as Gaussians around its camera, in a world with z up."""
    pose = torch.eye(4, dtype=torch.float64)
    yaw = 0.7
    right, forward = (np.cos(yaw), -np.sin(yaw), 0.0), (np.sin(yaw), np.cos(yaw), 0.0)
    pose[:3, :3] = torch.tensor((right, (0.0, 0.0, -1.0), forward)).T
    pose[:3, 3] = torch.tensor((1.0, -2.0, 0.5))
    directions = fibonacci_directions(3000)
    image = torch.from_numpy(photos[0]).permute(2, 0, 1)
    color = sample_equirect(image, uv_from_directions(directions).float()).T
    gaussians = make_balls(pose[:3, 3] + 3 * directions @ pose[:3, :3].T, 0.2, 0.99, color=color)
    scene = Scene(gaussians, pose[None], 0.45, 10.0, ("a.png",), "synthetic", 128)
    (panorama, *_) = entry.pair.context
    entry = replace(entry, pair=replace(entry.pair, context=(replace(panorama, cam2world=pose),)))
    return LoadedScene(entry, scene)


def both(test: Callable[..., None]) -> Callable[..., None]:
    """Run a test with both renderers; the other tests do not depend on the renderer."""
    test.renderers = ("gl", "cpu")  # type: ignore[attr-defined]
    return test


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "label" in metafunc.fixturenames:
        cases = [("cpu", label) for label in IMAGE_WIDGETS]
        metafunc.parametrize(("session", "label"), cases, indirect=["session"], scope="module")
    elif "session" in metafunc.fixturenames:
        renderers = getattr(metafunc.function, "renderers", ("cpu",))
        metafunc.parametrize("session", renderers, indirect=True, scope="module")


@pytest.fixture(scope="module")
def session(request, gl_context, small_scene, pair, axis_photos, load_house, tmp_path_factory) -> Iterator[User]:
    def load(entry, show):
        if entry.tour is not None:
            return load_house(entry)
        if entry.name == "sphere":
            return make_sphere_scene(entry, axis_photos)
        if entry.name == "damaged":
            raise InputError("damaged.ply: 100% unreadable; export it again")
        return LoadedScene(entry, small_scene)

    clock = [0.0]
    folder = tmp_path_factory.mktemp("screenshots")
    with gl_context:
        target = gl_context.simple_framebuffer(SIZE, components=3)
        loader = SceneLoader(lambda *arguments: user.load(*arguments))
        find, options = lambda *arguments: user.find(*arguments), {"folder": folder, "renderer": request.param}
        viewer = Viewer(gl_context, loader, find=find, clock=lambda: clock[0], **options)
        imgui.get_io().display_size = SIZE
        user = User(viewer, target, clock, load)
        user.entries = [SceneEntry(name, pair=pair) for name in NAMES]
        user.show(*user.entries)
        user.click("Expert")
    yield user
    with gl_context:
        viewer.close()


@pytest.fixture
def user(session, ctx) -> User:
    """The session with scene, state and camera as at the start."""
    session.load, session.find = session.first_load, lambda path, show: [SceneEntry("opened")]
    if session.viewer.session.names != NAMES or session.viewer.session.current != 0:
        session.show(*session.entries)
    state, start = session.state, ViewerState()
    kept = {"camera", "home", "context", "num_views", "levels", "depth_max", "message", "message_until", "graph"}
    for name in {field.name for field in fields(ViewerState)} - kept - {"route"}:
        setattr(state, name, getattr(start, name))
    state.camera, state.message = state.home, ""
    state.stops = False  # the camera is at a panorama, and tests look at the scene
    session.viewer.error, session.viewer.stage.resolution.budget_ms = None, BUDGET_MS
    imgui.get_io().add_mouse_pos_event(SIZE[0] - 5, SIZE[1] - 5)
    session.draw_frames(2, SETTLE_AFTER)
    return session


def changed_fraction(before: np.ndarray, after: np.ndarray) -> float:
    """Fraction of the pixels that differ visibly."""
    return float((np.abs(before - after).max(-1) > 2).mean())


def test_every_widget_has_a_test_and_fits_without_scrolling(user):
    assert set(user.panels.widgets.items) == set(IMAGE_WIDGETS) | OTHER_WIDGETS
    assert max(rectangle[3] for rectangle in user.panels.widgets.items.values()) < SIZE[1]


@pytest.mark.slow
def test_clicking_the_widget_changes_the_image(user, label):
    user.state.settings = replace(user.state.settings, mode=INITIAL_MODES.get(label, user.state.settings.mode))
    before = user.read_image()
    user.click(label)
    assert changed_fraction(before, user.read_image()) > 3e-4  # 0 without an effect; the filter changes few pixels


CLICKS = [  # in the window of a pair, and what is then true
    ("click Fly", "state.playing"),
    ("click Fly; click Stop", "not state.playing and 0 < state.route_fraction < 1"),
    *[(f"click {display}", f"state.settings.display == '{display}'") for display in get_args(Display)],
    ("click depth; slide range 0.5 0.3", "state.settings.display_max > 6"),
    ("click visit; click visit-1; wait", "camera.position == (0, 0, 0.5)"),
    ("key w", "camera.position[2] > 0"),
    ("wheel 1", "camera.vertical_fov_degrees < home.vertical_fov_degrees"),
    ("point 430 300", "0.5 < state.points[0].depth < 8 and changed > 0.0002"),  # a marker
    ("point 430 300; key r", "state.points == [] and changed == 0"),
    ("key tab", "not panels.widgets.items"),
    ("key tab; key h", "changed > 0.1"),
    ("open pair 20 36", "viewer.session.current == 1"),
]


def test_the_state_after_clicks_and_keys_of_imgui(user):
    io, start, failed = imgui.get_io(), ViewerState(), []
    before = user.read_image()
    for actions, expected in CLICKS:
        for name in ("orbiting", "playing", "route_fraction", "overlay", "help", "quit", "points", "settings"):
            setattr(user.state, name, getattr(start, name))
        user.state.camera, user.state.message = user.state.home, ""
        user.settle()
        for kind, *words in map(str.split, actions.split(";")):
            numbers = [float(word) for word in words if word[0].isdigit() and "##" not in word]
            if kind == "click":
                user.click(words[0].replace("-", " "))
            elif kind == "open":  # a list, of which a place relative to its lower left corner is clicked
                left, top, _, bottom = user.panels.widgets.items[words[0]]
                user.click_at(left + 5, (top + bottom) / 2)
                user.draw_frames(2)
                user.click_at(left + numbers[0], bottom + numbers[1])
            elif kind == "slide":
                user.slide(words[0], *numbers)
            elif kind == "drag":
                user.drag(numbers[:2], numbers[2:])
            elif kind == "point":
                user.click_at(*numbers)
            elif kind == "wait":
                user.draw_frames(30, 0.1)
            elif kind == "key":
                user.press(getattr(imgui.Key, words[0]))
            else:
                io.add_mouse_wheel_event(0, *numbers)
                user.draw_frames(2)
        names = {"state": user.state, "viewer": user.viewer, "panels": user.panels, "home": user.state.home}
        names |= {"camera": user.state.camera}
        if "changed" in expected:
            names["changed"] = changed_fraction(before, user.read_image())
        if not eval(expected, names):
            failed.append((actions, expected))
    assert not failed


def test_a_prediction_a_refinement_and_an_error_have_their_buttons(user, small_scene):
    session, before = user.viewer.session, user.read_image()

    def load(entry, show):
        if entry.name == "kitchen":
            show(LoadedScene(entry, small_scene, is_final=False))
        while True:
            report_progress("estimating poses", 0.3)
            time.sleep(0.002)

    user.load = load
    user.click("Reload")
    user.draw_until(lambda: session.loading is not None, "progress")
    user.draw_frames(2)
    left, top, right, bottom = user.panels.widgets.items["Cancel##loading"]
    assert 0 < left < right < SIZE[0] and 0 < top < bottom < SIZE[1], "next to a progress bar at the bottom"
    user.click("Cancel##loading")
    user.settle()
    assert session.loading is user.viewer.error is None
    session.show([SceneEntry("kitchen")], 0)
    user.draw_until(lambda: session.refinement is not None, "refinement")
    user.draw_frames(2)
    user.click("Cancel")
    assert changed_fraction(before, user.read_image()) == 0, "the prediction"
    user.load = user.first_load
    user.show(SceneEntry("damaged"))
    assert changed_fraction(before, user.read_image()) > 0.02, "the message is on the screen"
    user.click("OK")
    assert user.viewer.error is None and changed_fraction(before, user.read_image()) == 0


def test_typing_a_path_does_not_fly_and_enter_opens_it(user):
    user.click("path")
    io = imgui.get_io()
    for character in "wasd":
        io.add_key_event(getattr(imgui.Key, character), True)
        io.add_input_character(ord(character))
        assert user.viewer.gui.has_input
        user.draw_frames(3)
        assert not user.viewer.gui.has_input
        io.add_key_event(getattr(imgui.Key, character), False)
        user.draw_frames(1)
    assert user.panels.path == "wasd"
    assert user.state.camera == user.state.home
    user.press(imgui.Key.enter)
    user.settle()
    assert user.viewer.session.names == ["opened"]


def test_a_recent_path_is_opened_and_so_is_one_by_the_button(user, pair, monkeypatch):
    opened = []

    def find(path: Path, show: object) -> list[SceneEntry]:
        opened.append(path.name)
        return [SceneEntry(f"{path.name} {len(opened)}", pair=pair)]

    user.find = find
    monkeypatch.setattr(user.viewer, "recent", ())
    user.panels.path = "kitchen"
    user.click("Open")
    user.settle()
    user.panels.path = ""
    assert user.viewer.session.names == ["kitchen 1"] and user.viewer.recent == (str(Path("kitchen").absolute()),)
    user.draw_frames(2)
    user.click("recent")
    left, _, _, bottom = user.panels.widgets.items["recent"]
    user.click_at(left + 30, bottom + 12)
    user.settle()
    assert user.viewer.session.names == ["kitchen 2"]


@both
@pytest.mark.slow
def test_rendering_at_an_input_camera_looks_like_its_photograph(user, pair):
    user.show(SceneEntry("sphere", pair=pair))
    state = user.state
    for yaw, pitch in ((0.0, 0.0), (2.0, 0.5), (-2.0, -0.9)):
        state.camera = replace(state.home, yaw_radians=yaw, pitch_radians=pitch)
        state.stops = False
        rendered = user.read_image()
        state.stops = True
        user.draw_frames(20)  # the photograph of the panorama at which the camera stands fades in
        photograph = user.read_image()
        assert np.abs(rendered - photograph).mean() < 4
        assert np.abs(rendered - photograph[:, ::-1]).mean() > 8, "not mirrored"
        assert np.abs(rendered - photograph[::-1]).mean() > 8, "not upside down"


def test_photographs_of_a_pair_that_is_read_again_are_read_again(ctx, pair, tmp_path, axis_photos):
    photographs = PhotographTextures(ctx)
    (first, *_) = pair.context

    def read(panorama: Panorama) -> np.ndarray:
        photographs.open([panorama])
        while (texture := photographs.get(0)) is None:
            time.sleep(0.002)
        return np.frombuffer(texture.read(), np.uint8)

    write_image(tmp_path / "a.png", axis_photos[0])
    before = read(panorama := replace(first, image=tmp_path / "a.png"))
    write_image(tmp_path / "a.png", axis_photos[1])
    assert (read(panorama) == before).all()
    pose = first.cam2world.clone()
    pose[0, 3] += 5
    assert (read(replace(panorama, cam2world=pose)) != before).any()
    assert photographs.pose(0)[0, 3] == pose[0, 3] and photographs.find_nearest(np.zeros(3)) == 0
    photographs.release()


@both
def test_screenshots_show_the_image_without_the_panels(user, monkeypatch):
    monkeypatch.setattr("pansplat_viewer.viewer.PANORAMA_HEIGHT", 128)
    image, files = user.read_image(), []
    user.press(imgui.Key.left_shift, imgui.Key.mod_shift, imgui.Key.p)
    for label in ("EXR + depth", "PNG", "360 PNG", None):
        files.append(Path(user.state.message.removeprefix("wrote ")))
        if label is not None:
            user.click(label)
    by_key, exr, png, panorama = files
    assert by_key.suffix == exr.suffix == ".exr"
    with OpenEXR.File(str(exr)) as file:
        depth = file.channels()["Z"].pixels
        assert depth.shape == SIZE[::-1] and file.channels()["RGB"].pixels.shape == (*SIZE[::-1], 3)
    assert 1.5 < np.median(depth[depth > 0]) < 4.5
    with Image.open(png) as file:
        assert file.size == SIZE
        pixels = np.asarray(file).astype(int)
    assert np.abs(pixels[IMAGE] - image).max() <= 3
    assert changed_fraction(pixels[20:560, 20:290], np.zeros_like(pixels[20:560, 20:290])) > 0.3
    with Image.open(panorama) as file:
        assert file.size == (256, 128)
    user.state.message = ""
    assert changed_fraction(image, user.read_image()) == 0, "the window shows the view again"


def test_the_photograph_is_shown_where_the_camera_stands_at_a_panorama(user):
    scene, state = user.read_image(), user.state
    user.viewer.stage.photographs.wait(0)
    user.click("photographs at panoramas")
    user.draw_frames(1, 1 / 60)
    fading = user.read_screen()
    photograph = user.read_image()
    assert state.stops and changed_fraction(scene, photograph) > 0.5
    between = np.abs(fading - scene).sum() / np.abs(photograph - scene).sum()
    assert 0 < between < 0.7 and user.viewer.stage.stop.weight == 1
    assert match_photograph(user, 0) < 1
    state.camera = replace(state.camera, yaw_radians=state.camera.yaw_radians + 0.3)
    user.settle()
    assert match_photograph(user, 0) < 1, "also in another direction"
    for change in ({"display": "depth"}, {"levels": frozenset((0,))}, {"mode": "view"}):
        state.settings = replace(DrawSettings(), **change)
        user.settle()
        assert user.viewer.stage.stop.weight == 0, change
    state.settings = DrawSettings()
    state.camera = state.home
    user.settle()
    x, y, z = state.home.position
    state.camera = replace(state.home, position=(x, y, z + 0.05))
    user.draw_frames(1, 1 / 60)
    assert 0 < user.viewer.stage.stop.weight < 1
    user.settle()
    assert user.viewer.stage.stop.weight == 0
    state.camera = state.home
    user.settle()
    user.click("photographs at panoramas")
    assert changed_fraction(user.read_image(), scene) < 0.01


def test_the_first_image_of_a_large_scene_is_drawn_in_the_background(user, pair, small_scene, monkeypatch):
    monkeypatch.setattr("pansplat_viewer.draw.rendered_scene._LARGE_SCENE", 0)
    before, go, draw = user.read_image(), threading.Event(), CpuRenderer._draw
    monkeypatch.setattr(CpuRenderer, "_draw", lambda *arguments: go.wait(300) and draw(*arguments))
    other = replace(small_scene, gaussians=small_scene.gaussians.select(small_scene.gaussians.views == 0))
    user.load = lambda entry, show: LoadedScene(entry, other)
    user.viewer.session.show([SceneEntry("large", pair=pair)], 0)
    stage = user.viewer.stage
    user.draw_until(lambda: stage.slot.scene is other and stage.photographs._textures, "photograph")
    user.draw_frames(1)
    assert user.viewer.pending is not None and user.viewer.busy and user.viewer.error is None
    photograph = user.read_screen()
    assert changed_fraction(before, photograph) > 0.3 and photograph.mean() > 60
    go.set()
    image = user.read_image()
    assert changed_fraction(photograph, image) > 0.3 and changed_fraction(before, image) > 0.1


def test_the_panel_has_the_height_of_the_window_and_the_scale_of_its_screen(user):
    user.click("Film")  # closed for space
    panel, (_, top, _, bottom) = imgui.internal.find_window_by_name("pansplat"), user.panels.widgets.items["joint"]
    height = bottom - top
    for x, width in ((500, 0.6 * SIZE[0]), (290, 290)):
        user.drag((panel.size.x - 3, SIZE[1] - 3), (x, 400))  # the lower right corner
        assert (panel.pos.x, panel.pos.y, panel.size.y) == (0, 0, SIZE[1])
        assert panel.size.x == pytest.approx(width, abs=4)
    user.viewer.gui.set_scale(1.5)
    user.draw_frames(3)
    _, top, _, bottom = user.panels.widgets.items["joint"]
    assert bottom - top == pytest.approx(1.5 * height, abs=2)
    user.viewer.gui.set_scale(1.0)
    user.draw_frames(3)
    user.click("Film")


@pytest.fixture
def small_pacing(monkeypatch) -> Callable[[User], None]:
    """Lets the renderers of a viewer draw small images while the camera moves."""

    def shrink(user: User) -> None:
        for slot in user.viewer.stage.slots:
            monkeypatch.setattr(slot.renderer, "pacing", SMALL)

    return shrink


@pytest.fixture
def tour_user(user, house, small_pacing) -> User:
    """The session in the tour, at its first panorama, with all that is next in memory."""
    user.show(SceneEntry(house.name, tour=house))
    user.settle()
    small_pacing(user)
    return user


def test_a_note_is_typed_shown_and_removed(tour_user, house, monkeypatch):
    user, file, center = tour_user, house.folder / "links.json", tour_user.state.camera
    aside = replace(center, yaw_radians=center.yaw_radians - 0.3, pitch_radians=0.15)  # the panels cover the middle
    monkeypatch.setattr(user.viewer.session, "path", house.folder)
    shown = []
    for button in ("", "Put at the middle", "Remove"):
        user.state.camera = center
        if button:
            user.click("note")
            for character in "oak":
                imgui.get_io().add_input_character(ord(character))
            user.draw_frames(2)
            user.click(button)
            notes = json.loads(file.read_text())["room0.png"]["notes"]
            assert [note["text"][:3] for note in notes] == (["oak"] if button.startswith("Put") else [])
        user.state.camera, user.state.message = aside, ""
        shown.append(user.read_image()[450:])
    changed = [int((np.abs(image - shown[0]).max(axis=2) > 20).sum()) for image in shown[1:]]
    assert 100 < changed[0] < 600 and changed[1] == 0, "its mark"
    file.unlink()


def test_the_hotspots_and_the_floor_plan_of_a_tour_can_be_hidden_and_a_click_on_them_leads_there(tour_user):
    user = tour_user
    assert user.viewer.session.tour.tour.name == "house tour"
    # The hotspot is right of the panel, above the statistics and messages.
    user.state.camera = replace(user.state.camera, yaw_radians=-0.25, pitch_radians=-0.4)

    def read() -> np.ndarray:
        user.settle()
        return user.read_window()[:760]

    before = read()
    user.click("floor plan and rings")
    hidden = read()
    assert changed_fraction(before, hidden) > 0.002
    user.press(imgui.Key.m)
    assert user.state.plan and changed_fraction(before, read()) == 0
    camera = user.state.camera
    for node, place in ((3, user.panels.minimap.nodes[3]), (1, user.viewer.hotspots[-1].center)):
        user.state.playing, user.state.camera = False, camera
        user.draw_frames(2)
        user.click_at(*place)
        assert user.state.playing and user.state.route.walk[-1] == node and not user.state.points


def match_photograph(user: User, node: int) -> float:
    """The mean difference of the screen from a photograph in the direction of the camera."""
    user.draw_frames(3, SETTLE_AFTER)
    shown = user.read_screen()
    stage = user.viewer.stage
    stage.photographs.wait(node)
    photograph = stage.get_photograph(node)
    assert photograph is not None
    stage.presenter.draw_photograph(photograph, user.target, user.state.camera)
    return float(np.abs(user.read_screen() - shown).mean())


@pytest.fixture
def placing_user(user, tmp_path, monkeypatch) -> User:
    """The session in a tour of a, b, c and d: d is about 1 m to the right of a."""
    for name in "abcd":
        pixels = np.random.default_rng(ord(name)).integers(0, 255, (32, 64, 3), np.uint8)
        Image.fromarray(pixels).resize((256, 128)).save(tmp_path / f"{name}.png")
    poses = {f"{name}.png": np.eye(4).tolist() for name in "abc"}
    for step, pose in enumerate(poses.values()):
        pose[2][3] = 0.8 * step
    place = {"between": ["a.png", "d.png"], "place": [1.0, 0.0, 0.5]}
    estimate = {"unplaced": {"d.png": "no door in d"}, "approximate": [place]}
    content = {"convention": "cam2world opencv", "worlds": [{"unit": 1.0}], "poses": poses, "estimate": estimate}
    (tmp_path / "poses.json").write_text(json.dumps(content))

    def find(path: Path, show: object) -> list[SceneEntry]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return [SceneEntry(tour.name, tour=tour) for tour in find_tours(load_sets(path))]

    def read(image: Path) -> Piece:
        depth = DepthMap(np.zeros((32, 64)), np.full((8, 16), 0.05), np.eye(3))
        rays = pixel_directions(32, 64).numpy()
        np.log(1 / np.abs(rays).max(axis=-1), out=depth.log_depth)  # a cube
        return Piece(Surroundings(np.full((32, 64, 3), 0.5), depth), 0.0)

    user.find = find
    monkeypatch.setattr("pansplat_viewer.core.placing_by_hand.read_piece", read)
    user.viewer.session.search(tmp_path)
    session = user.viewer.session
    user.draw_until(lambda: session.tour is not None and not session.loader.is_searching, "tour")
    user.settle()
    yield user
    user.viewer.placing.stop()


@pytest.mark.filterwarnings("ignore:.*has no pose of")
def test_a_photograph_at_an_approximate_place_is_on_the_plan_beside_its_neighbour(placing_user):
    user, tour = placing_user, placing_user.viewer.session.tour.tour
    shown = [describe_panorama(tour, node) for node in range(4)]
    assert shown == ["a", "b", "c", "d (about here)"]
    assert describe_panoramas(tour) == "3 placed, 1 about here"
    a, _, _, d = np.array(user.panels.minimap.nodes)
    assert abs(d[1] - a[1]) < 1 and d[0] > a[0] + 10, "it is to the right of a"
    assert find_states(user) == ["sure", "sure", "sure", "about here"]


def test_a_photograph_is_dragged_turned_saved_shown_in_the_tour_and_undone(placing_user, tmp_path):
    user, before = placing_user, (tmp_path / "poses.json").read_bytes()
    user.click("Place##3")
    placing, window, io = user.viewer.placing, user.panels.placing, imgui.get_io()
    user.draw_until(lambda: placing.progress is None and placing.place, "pieces")
    user.draw_frames(2)

    def find_pixel() -> np.ndarray:
        return window.view.to_pixels(np.array(placing.place[:2]))

    start, (x, y), scale = placing.place, find_pixel(), window.view.pixels_per_metre
    assert start[:2] == pytest.approx((1, 0)), "about here"
    user.drag((x, y), (x + 0.6 * scale, y - 0.5 * scale))
    assert placing.place == pytest.approx((start.right + 0.6, start.forward + 0.5, start.yaw), abs=0.02)

    camera, fraction = user.state.camera, user.state.route_fraction
    io.add_mouse_pos_event(*find_pixel())
    user.draw_frames(2)
    io.add_mouse_wheel_event(0.0, 2.0)
    user.draw_frames(2)
    assert placing.place.yaw == pytest.approx(start.yaw + np.radians(2), abs=1e-3)
    assert (user.state.camera, user.state.route_fraction) == (camera, fraction), "the wheel turns the photograph only"
    x, y = find_pixel()
    user.drag(window.find_knob(placing.place, 1.0), (x + 60, y + 2))  # to the right of the camera
    assert placing.is_aligned and placing.place.yaw == pytest.approx(np.pi / 2)

    user.press(imgui.Key.escape)
    assert placing.node is None and not user.state.quit and (tmp_path / "poses.json").read_bytes() == before
    user.click("Place##3")
    user.draw_until(lambda: placing.place, "place")
    user.draw_frames(2)
    user.click("Save##pose")
    user.draw_until(lambda: find_states(user)[3] == "sure", "loaded poses")
    user.settle()
    assert describe_panorama(user.viewer.session.tour.tour, 3) == "d (placed by hand)"
    user.click("Undo##poses")
    assert (tmp_path / "poses.json").read_bytes() == before
    user.draw_until(lambda: find_states(user)[3] == "about here", "former poses")


def find_states(user: User) -> list[str]:
    return [describe_state(panorama.placement) for panorama in user.viewer.placing.panoramas]


def test_a_path_is_made_played_edited_and_saved_by_buttons(user, tmp_path):
    state = user.state
    user.click("Add key frame")
    state.camera = replace(state.camera, position=(0.2, 0.0, 0.3), yaw_radians=0.5)
    state.path_seconds = 1.0
    user.click("Add key frame")
    assert [frame.seconds for frame in state.path.key_frames] == [0.0, 1.0]
    user.click("0.00 s##0")
    assert state.camera.position == (0, 0, 0)
    user.click("Play path")
    user.click("Pause")
    assert not state.path_playing and 0 < state.path_seconds < 1
    user.click("Play path")
    user.draw_frames(5, 0.25)
    assert not state.path_playing and state.camera.position == pytest.approx((0.2, 0.0, 0.3))
    user.slide("time", 0.15, start=0.02)
    assert 0 < state.path_seconds < 1 and 0 < state.camera.position[2] < 0.3
    user.panels.path_file, path = str(tmp_path / "walk.json"), state.path
    user.click("Save")
    user.click("1.00 s##1")
    user.click("Replace##0")
    assert state.path.key_frames[0].position == (0.2, 0.0, 0.3)
    user.click("Delete##0")
    user.click("Delete##0")
    assert len(state.path) == 0 and "Play path" not in user.panels.widgets.items
    user.click("Load")
    assert state.path == path
