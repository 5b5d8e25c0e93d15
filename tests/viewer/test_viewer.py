"""State and input of the whole viewer, without OpenGL and without a window: nothing is drawn."""

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock, Mock

import moderngl
import numpy as np
import pytest
import torch
from imgui_bundle import imgui

from pansplat import pipeline
from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.geometry.level import find_direction
from pansplat.images.image_files import write_image
from pansplat.inputs.folders import load_panoramas
from pansplat.inputs.panorama_sets import Panorama, PanoramaSet
from pansplat.prediction_options import PredictOptions
from pansplat.system.progress import report_progress
from pansplat_viewer.core.loader import LoadedScene, SceneEntry, SceneLoader, load_entry
from pansplat_viewer.core.settings import FrameStats
from pansplat_viewer.core.state import ViewerState
from pansplat_viewer.draw.frame_renderer import Pacing
from pansplat_viewer.viewer import Viewer
from pansplat_viewer.window.input import FAST, KEYS, SLOW, WALK_SPEED, Input

SIZE = (560, 900)


class NoRenderer:
    """A renderer that keeps its scene and draws nothing.

    Attributes:
        refuse: the error of an upload of a scene; None to accept it.
        problem: the error of the next images.
        scales: of the images.
    """

    pacing = Pacing(min_size=(64, 64), settle_seconds=0.02, turn_ms=1000 / 60, waits_while_moving=True)
    pending = None
    refuse: Callable[[Scene], Exception | None] = staticmethod(lambda scene: None)
    problem: Exception | None = None

    def __init__(self) -> None:
        self.stats, self.scales = FrameStats(), []

    @staticmethod
    def prepare(scene: Scene, report: Callable[[float], None] = lambda done: None) -> Scene:
        return scene

    def upload(self, scene: Scene, prepared: object = None) -> None:
        if (error := NoRenderer.refuse(scene)) is not None:
            raise error
        self.stats = FrameStats()

    def render(self, cam2world: np.ndarray, size: tuple[int, int], settings: Any, *, wait: bool = True) -> Mock:
        if NoRenderer.problem is not None:
            raise NoRenderer.problem
        before = settings if not self.scales else self.last
        self.scales.append(settings.scale)
        self.last = settings  # as a GPU, the time that is known is that of the image before
        self.size, self.stats = size, FrameStats(frame_ms=1.0, timed=before)
        return Mock()

    def read_color(self) -> np.ndarray:
        return np.zeros((*self.size[::-1], 4), np.float32)

    def read_depth(self) -> np.ndarray:
        return np.full(self.size[::-1], 3.0, np.float32)

    has_faces = draw_faces = release = lambda self, *_: None


class App:
    """A viewer to which a test gives input.

    Attributes:
        load, find: what the viewer's loader calls; a test may replace them.
    """

    def __init__(self, load: Callable[..., LoadedScene], folder: Path, **options: Any) -> None:
        self.load, self.now, self.events = load, 0.0, Input()
        self.find: Callable[..., list[SceneEntry]] = lambda path, show: [SceneEntry("opened")]
        loader = SceneLoader(lambda *arguments: self.load(*arguments))
        self.viewer = Viewer(
            MagicMock(), loader, find=lambda *arguments: self.find(*arguments), folder=folder, clock=lambda: self.now,
            **options,
        )  # fmt: skip
        self.state, self.session, self.target = self.viewer.state, self.viewer.session, Mock(viewport=(0, 0, *SIZE))
        self.state.stops = False  # the camera is at a panorama, and tests count images of the scene

    def frame(self, seconds: float = 1 / 30, **events: Any) -> None:
        self.now += seconds
        self.events = Input(**events)
        self.viewer.frame(self.target, seconds)
        self.events = Input()

    def frames(self, count: int, seconds: float = 1 / 30) -> None:
        for _ in range(count):
            self.frame(seconds)

    def press(self, *keys: str, held: str = "") -> None:
        self.frame(pressed=frozenset(keys), held=frozenset((*keys, *held.split())))

    def until(self, condition: Callable[[], object], expected: str, seconds: float = 1 / 30) -> None:
        deadline = time.monotonic() + 300
        while not condition():
            assert time.monotonic() < deadline, f"no {expected}"
            self.frame(seconds)
            time.sleep(0.001)

    def settle(self) -> None:
        self.frames(3, 0.2)
        self.until(lambda: not self.viewer.busy, "settled viewer")
        self.frame()

    def show(self, *entries: SceneEntry) -> None:
        self.viewer.session.show(list(entries), 0)
        self.settle()

    def fly(self, seconds: float = 0.2) -> None:
        """Draw frames until the flight has begun and ended."""
        self.frames(2, seconds)
        self.until(lambda: not (self.state.playing or self.viewer.moving), "end of the flight", seconds)

    @property
    def node(self) -> int:
        """The panorama of the tour that is nearest to the camera."""
        return int(np.linalg.norm(self.session.tour.tour.positions - self.state.camera.position, axis=1).argmin())

    @property
    def content(self) -> object:
        """The scene or the number of the photograph that is shown."""
        return self.viewer.stage.fade.contents[self.viewer.stage.fade.front]


@pytest.fixture
def make_app(small_scene, load_house, tmp_path, monkeypatch) -> Iterator[Callable[..., App]]:
    """Makes a viewer whose window has `SIZE`; everything of OpenGL and of imgui's panels is replaced."""
    apps: list[App] = []

    def load(entry: SceneEntry, show: object) -> LoadedScene:
        if entry.name == "damaged":
            raise InputError("damaged.ply: 100% unreadable; export it again")
        return load_house(entry) if entry.tour is not None else LoadedScene(entry, small_scene)

    def make(**options: Any) -> App:
        apps.append(App(load, tmp_path / "renders", **options))
        return apps[-1]

    context = imgui.create_context()
    imgui.set_current_context(context)
    imgui.get_io().display_size = SIZE
    for name in ("viewer.Gui", "viewer.Panels", "ui.stage.Presenter", "ui.stage.PhotographLayer"):
        monkeypatch.setattr(f"pansplat_viewer.{name}", MagicMock(return_value=MagicMock(width=0.0)))
    monkeypatch.setattr("pansplat_viewer.ui.stage.create_renderer", lambda ctx, choice: NoRenderer())
    monkeypatch.setattr("pansplat_viewer.viewer.read_input", lambda seconds: replace(apps[-1].events, seconds=seconds))
    yield make
    for app in apps:
        app.viewer.close()
    monkeypatch.setattr(NoRenderer, "refuse", staticmethod(lambda scene: None))
    imgui.destroy_context(context)


@pytest.fixture
def app(make_app, pair) -> App:
    """A viewer that shows a pair."""
    app = make_app()
    app.entries = [SceneEntry(name, pair=pair) for name in ("first", "second")]
    app.show(*app.entries)
    return app


class Gate:
    """A load that waits for `open`, with a progress."""

    def __init__(self, load: Callable[[SceneEntry], LoadedScene], *progress: object) -> None:
        self.load, self.progress, self.event, self.entered = load, progress, threading.Event(), threading.Event()
        self.ended = 0

    def __call__(self, entry: SceneEntry, show: object) -> LoadedScene:
        try:
            self.entered.set()
            while not self.event.wait(0.003):
                report_progress(*self.progress)
            return self.load(entry)
        finally:
            self.ended += 1

    def open(self) -> None:
        self.event.set()


# --- what a user does, and the state after it ---

STEP = WALK_SPEED / 30  # of a frame
ROWS = [  # at the first of two panoramas, which are 0.5 m apart
    *[(f"hold {key}", "camera.position == approx((0, 0, STEP))") for key in ("w", "up")],
    *[(f"hold {key}", "camera.position == approx((0, 0, -STEP))") for key in ("s", "down")],
    *[(f"hold {key}", "camera.position == approx((STEP, 0, 0))") for key in ("d", "right")],
    *[(f"hold {key}", "camera.position == approx((-STEP, 0, 0))") for key in ("a", "left")],
    *[(f"hold {key}", f"camera.position == approx((0, {sign}STEP, 0))") for key, sign in (("e", "-"), ("q", ""))],
    ("hold w shift", "camera.position[2] == approx(FAST * STEP)"),
    ("hold w alt", "camera.position[2] == approx(SLOW * STEP)"),
    ("hold w s a d q e", "camera == home"),
    ("drag 40 0", "camera.yaw_radians < 0 and camera.position == home.position"),
    ("pan 30 0", "camera.position[0] < 0 and camera.position[2] == approx(0)"),
    ("scroll 1", "camera.vertical_fov_degrees < home.vertical_fov_degrees"),
    ("press v", "state.orbiting and camera == home"),
    ("press v; press v", "not state.orbiting"),
    ("press v; scroll 1", "camera.distance < home.distance"),
    ("press v; scroll 1", "camera.vertical_fov_degrees == home.vertical_fov_degrees"),
    *[
        (f"press v; {turn}", "camera != home and camera.orbit_center == approx(home.orbit_center)")
        for turn in ("drag 80 10", "scroll 1", *(f"hold {key}" for key in "wasdqe"))
    ],
    ("click 0.5 0.5; press f", "state.orbiting and camera.orbit_center == approx(state.points[0].position)"),
    ("press 2; wait 0.6", "state.playing and 0 < camera.position[2] < 0.5"),
    ("press 2; wait 3", "camera.position == approx((0, 0, 0.5)) and state.route_fraction == 1 and not state.playing"),
    ("press 2; wait 3; press 1; wait 3", "camera.position == approx((0, 0, 0)) and abs(camera.yaw_radians) > 3"),
    ("press 2; wait 3; press 3; wait 3", "camera.position == approx((0, 0, 0.5))"),
    ("press page down; wait 3", "camera.position == approx((0, 0, 0.5))"),
    ("press page down; wait 3; press page down; wait 3", "camera.position == approx((0, 0, 0))"),
    ("press page up; wait 3", "camera.position == approx((0, 0, 0.5))"),
    ("press space", "state.playing"),
    (
        "press space; wait 12",
        "not state.playing and state.route_fraction == 1 and camera.position == approx((0, 0, 0.5))",
    ),
    ("press space; wait 12; press space", "state.playing and state.route_fraction < 0.1"),
    ("press space; wait 1; press space; wait 1", "not state.playing and 0.1 < state.route_fraction < 0.3"),
    ("press space; scroll 1", "state.playing"),
    ("press space; hold w", "not state.playing"),
    ("press tab", "not state.overlay"),
    ("press tab; press tab", "state.overlay"),
    ("press h", "state.help"),
    ("press h; press escape", "not state.help and not state.quit"),
    ("press escape", "state.quit"),
    ("press q", "not state.quit"),
    ("press q ctrl", "state.quit and camera == home"),
    ("press k", "len(state.path) == 1"),
    ("press p", "state.message.endswith('view_001.png')"),
    ("press p shift", "state.message.endswith('view_001.exr')"),
    ("click 0.5 0.5", "len(state.points) == 1 and 1 < state.points[0].depth < 5"),
    ("click 0.5 0.5; click 0.6 0.5; click 0.7 0.5", "len(state.points) == 2"),
    ("click 0.5 0.5; press r", "state.points == []"),
    ("hold w d; drag 40 10; scroll 2; press r", "camera == home"),
]  # fmt: skip


def act(app: App, text: str) -> None:
    """Do what a user does: `press KEY HELD`, `hold KEYS`, `wait SECONDS`, or another event with its numbers."""
    for step in filter(str.strip, text.split(";")):
        kind, *words = step.replace("page ", "page-").split()
        keys = [word.replace("-", " ") for word in words]
        if kind == "press":
            app.press(keys[0], held=" ".join(keys[1:]))
        elif kind == "hold":
            app.frame(held=frozenset(keys))
        elif kind == "wait":
            app.frames(round(10 * float(words[0])), 0.1)
        else:
            numbers = tuple(map(float, words))
            app.frame(**{kind: numbers[0] if kind == "scroll" else numbers})


RESET = ("orbiting", "playing", "route_fraction", "overlay", "help", "quit", "path", "points")


def test_the_state_of_the_window_after_what_a_user_does(app):
    state, start, failed = app.state, ViewerState(), []
    names = {"state": state, "viewer": app.viewer, "approx": pytest.approx, "STEP": STEP, "FAST": FAST, "SLOW": SLOW}
    for actions, expected in ROWS:
        for name in RESET:
            setattr(state, name, getattr(start, name))
        state.camera = state.home
        app.settle()
        act(app, actions)
        if not eval(expected, names | {"camera": state.camera, "home": state.home}):
            failed.append((actions, expected, state.camera))
    assert not failed


def test_each_key_has_one_action():
    keys = [key for row in KEYS for key in row.actions]
    assert len(set(keys)) == len(keys)


def test_errors_of_paths_and_scenes_keep_what_is_shown(app, small_scene):
    def find(path: Path, show: object) -> list[SceneEntry]:
        raise InputError(f"{path}: no such file or folder")

    app.find = find
    app.session.search(Path("nothing"))
    app.settle()
    assert "no such file" in app.viewer.error
    app.viewer.dismiss_error()
    app.show(SceneEntry("damaged"))
    assert app.viewer.error.startswith("damaged.ply: 100% unreadable")
    assert app.session.names == ["first", "second"] and app.session.current == 0
    assert app.viewer.stage.slot.scene is small_scene
    app.viewer.dismiss_error()
    assert app.viewer.error is None


def test_photographs_are_shown_while_their_poses_are_estimated(make_app, parted_house, house):
    quarter = np.array(((0.0, 0, 1), (0, 1, 0), (-1, 0, 0)))
    views = [replace(view, cam2world=view.cam2world.clone()) for view in house.panoramas]
    for view in views:
        view.cam2world[:3] = torch.from_numpy(quarter) @ view.cam2world[:3]
    turned = replace(house, panoramas=tuple(views))
    gate = Gate(lambda _: [SceneEntry("placed", tour=turned)], "pairs of panoramas", 0.3)

    def find(path: Path, show: Callable[..., None]) -> object:
        show([SceneEntry("unplaced", tour=parted_house)])
        return gate(path, None)

    app = make_app()
    app.find = find
    app.session.search(Path("home"))
    app.until(lambda: app.session.tour is not None, "photographs")
    assert app.session.names == ["unplaced"] and isinstance(app.content, int) and app.session.loaded is None
    app.until(lambda: app.session.loading == ("home", "pairs of panoramas", 0.3), "progress")
    assert app.session.loader.entry is None, "nothing is predicted from panoramas that may get poses"
    app.state.target = 2
    app.fly()
    app.frame(drag=(120.0, 40.0))
    seen = app.state.camera.rotation[:, 2]
    gate.open()
    app.settle()
    assert app.session.names == ["placed"] and app.session.loaded.entry.tour is turned
    assert np.allclose(app.state.camera.position, turned.positions[2])
    assert np.allclose(app.state.camera.rotation[:, 2], quarter @ seen), "the same place of the same photograph"
    gate.event.clear()
    shown = app.session.loaded
    app.session.search(Path("another"))
    app.until(lambda: app.session.loading == ("another", "pairs of panoramas", 0.3), "progress")
    app.frames(2)
    assert app.session.loaded is shown and app.session.names == ["placed"]
    gate.open()


def test_a_search_and_a_prediction_can_be_cancelled(app, small_scene):
    gate = Gate(lambda entry: LoadedScene(entry, small_scene), "estimating poses", 0.3)
    app.find = lambda path, show: gate(path, None)
    app.session.search(Path("unposed"))
    app.until(lambda: app.session.loading == ("unposed", "estimating poses", 0.3), "search")
    app.session.cancel_loading()
    assert app.session.loading is None and app.session.current == 0, "the scene is still the current one"
    app.load = gate
    app.session.reload()
    app.until(lambda: app.session.loading == ("first", "estimating poses", 0.3), "prediction")
    app.session.cancel_loading()
    app.settle()
    assert app.session.loading is app.viewer.error is None
    app.until(lambda: gate.ended == 2, "end of both threads")


def test_the_refined_scene_replaces_the_prediction_at_rest_and_keeps_the_camera(app, small_scene):
    go, refined = threading.Event(), replace(small_scene, near=0.5)

    def load(entry: SceneEntry, show: Callable[..., None]) -> LoadedScene:
        show(LoadedScene(entry, small_scene, is_final=False))
        report_progress("refining", 0.75)
        assert go.wait(300)
        return LoadedScene(entry, refined)

    app.load = load
    app.session.show([SceneEntry("kitchen")], 0)
    app.until(lambda: app.session.refinement == 0.5, "refinement")
    assert app.session.loading is None and not app.session.loaded.is_final
    app.frame(held=frozenset("w"))
    camera, stage = app.state.camera, app.viewer.stage
    go.set()
    app.until(lambda: app.session.loader.refinement is None, "refined scene")
    app.settle()
    assert stage.slot.scene is refined and app.state.camera == camera
    assert app.session.loader.poll() is None


def test_a_refined_scene_that_cannot_be_drawn_is_one_error_and_the_prediction_stays(app, small_scene, monkeypatch):
    refined, refusals = replace(small_scene, near=0.5), []
    prediction = replace(small_scene, near=0.4)

    def load(entry: SceneEntry, show: Callable[..., None]) -> LoadedScene:
        show(LoadedScene(entry, prediction, is_final=False))
        return LoadedScene(entry, refined)

    def refuse(scene: Scene) -> Exception | None:
        return refusals.append(scene) or MemoryError("no memory") if scene is refined else None

    monkeypatch.setattr(NoRenderer, "refuse", staticmethod(refuse))
    app.load = load
    app.show(SceneEntry("kitchen"))
    app.until(lambda: app.viewer.error, "error")
    app.viewer.dismiss_error()
    app.settle()
    assert app.viewer.stage.slot.scene is prediction and refusals == [refined] and app.viewer.error is None


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (MemoryError("too many"), "large: the memory is exhausted (MemoryError: too many); open a scene with fewer"),
        (moderngl.Error("GLSL Compiler failed"), "large: OpenGL failed: GLSL Compiler failed"),
    ],
)
def test_a_scene_that_cannot_be_drawn_is_an_error_and_the_old_one_stays(app, small_scene, monkeypatch, error, message):
    twice = replace(small_scene, gaussians=Gaussians.cat([small_scene.gaussians] * 2))
    monkeypatch.setattr(NoRenderer, "refuse", staticmethod(lambda scene: error if scene is twice else None))
    app.load = lambda entry, *_: LoadedScene(entry, twice)
    app.show(SceneEntry("large"))
    assert app.viewer.error.startswith(message) and app.session.names == ["large"]
    app.viewer.dismiss_error()
    assert app.viewer.stage.slot.scene is small_scene and app.session.names == ["first", "second"]


def test_memory_that_ends_while_drawing_is_an_error_and_drawing_goes_on(app, monkeypatch):
    monkeypatch.setattr(NoRenderer, "problem", MemoryError("no memory"))
    app.state.camera = replace(app.state.camera, yaw_radians=0.5)
    app.until(lambda: app.viewer.error and not app.viewer.moving, "error", 0.2)
    assert "the memory is exhausted" in app.viewer.error and app.viewer.stage.has_failed
    monkeypatch.setattr(NoRenderer, "problem", None)
    app.viewer.dismiss_error()
    app.frame()
    assert app.viewer.error is None and not app.viewer.stage.has_failed


def test_a_large_scene_is_converted_while_the_window_accepts_input(make_app, pair, small_scene, monkeypatch):
    go, other = threading.Event(), replace(small_scene, near=0.5)

    def prepare(scene: Scene, report: Callable[[float], None]) -> Scene:
        report(0.25)
        assert scene is small_scene or go.wait(300)
        return scene

    monkeypatch.setattr(NoRenderer, "prepare", staticmethod(prepare))
    monkeypatch.setattr("pansplat_viewer.draw.rendered_scene._SMALL_SCENE", 0)
    app = make_app()
    app.show(SceneEntry("first", pair=pair))
    app.load = lambda entry, *_: LoadedScene(entry, other)
    app.session.show([SceneEntry("large")], 0)
    app.until(lambda: app.session.loading == ("large", "preparing 1,200 Gaussians", 0.25), "preparation")
    assert app.viewer.busy and app.viewer.stage.slot.scene is small_scene
    app.frame(drag=(30.0, 0.0))
    assert app.state.camera.yaw_radians != 0
    go.set()
    app.settle()
    assert app.viewer.stage.slot.scene is other and app.session.loading is None


def test_the_time_of_a_frame_is_recorded_for_its_own_resolution(app, monkeypatch):
    resolution, recorded = app.viewer.stage.resolution, []
    monkeypatch.setattr(resolution, "record", lambda plan, ms: recorded.append(plan.scale))
    scales = app.viewer.stage.renderer.scales
    scales.clear()
    for step in (0, 1, 2, 1, 0):
        resolution.step = step
        app.state.camera = replace(app.state.camera, position=(0.0, 0.0, 0.01 + 0.01 * len(scales)))
        app.frame()
    assert scales == [1.0, 0.75, 0.5, 0.75, 1.0] and recorded[-4:] == scales[:-1]


def test_a_reload_searches_the_folder_again(app, pair, tmp_path):
    folder, found = tmp_path, []

    def find(path: Path, show: object) -> list[SceneEntry]:
        found.append(path)
        return [SceneEntry(name, pair=pair) for name in ("new", "pair 1", "pair 2")[len(found) == 1 :]]

    app.find = find
    app.session.search(folder)
    app.settle()
    assert app.session.names == ["pair 1", "pair 2"]
    app.session.reload()
    app.settle()
    assert found == [folder] * 2
    assert app.session.names[app.session.current] == "pair 1" and app.session.current == 1


def test_a_panorama_alone_is_entered_in_a_wide_view(make_app, tmp_path):
    image = np.full((64, 128, 3), 0.6, np.float32)
    image[20:44, 90:106:2] = 0.1  # 0.37 to 0.41 of a turn right of the left border, at 1.67 radians
    write_image(tmp_path / "alone.png", image)
    panorama = Panorama("alone", tmp_path / "alone.png", torch.eye(4, dtype=torch.float64))
    for start, yaw in ((None, 2 * np.pi * (98 / 128 - 0.5)), ((0.5, 0.0), 0.5)):
        app = make_app()
        pair = PanoramaSet("alone", tmp_path, (replace(panorama, start=start),), (), 0.45, 10.0)
        app.session.show([SceneEntry("alone", pair=pair)], 0)
        assert app.state.camera == app.state.home
        assert app.state.camera.yaw_radians == pytest.approx(yaw, abs=0.1)


def test_the_view_of_a_photograph_is_kept_when_its_scene_is_there(make_app, pair, small_scene):
    app = make_app()
    app.load = gate = Gate(lambda entry: LoadedScene(entry, small_scene), "matching", 0.5)
    app.session.show([SceneEntry("kitchen", pair=pair)], 0)
    app.until(lambda: app.content == 0, "photograph")
    app.frame(drag=(-120.0, 0.0))
    camera = app.state.camera
    gate.open()
    app.until(lambda: app.content is small_scene, "scene")
    assert camera.yaw_radians > 0.1 and app.state.camera == replace(camera, distance=app.state.camera.distance)


def test_a_photograph_that_cannot_be_read_is_an_error(app, pair, tmp_path):
    broken = replace(pair.context[0], image=tmp_path / "gone.png")
    app.state.stops = True
    app.show(SceneEntry("broken", pair=replace(pair, context=(broken, pair.context[1]))))
    app.settle()
    assert "gone.png" in app.viewer.error


def test_a_screenshot_without_memory_is_reported(app, monkeypatch):
    monkeypatch.setattr("pansplat_viewer.viewer.write_image", Mock(side_effect=MemoryError("no memory")))
    app.press("p")
    assert app.viewer.error.startswith("no screenshot written: the memory is exhausted (MemoryError: no memory)")


def test_a_path_replaces_its_own_file_only(app, tmp_path):
    app.press("k")
    viewer, walk, own = app.viewer, str(tmp_path / "walk.json"), tmp_path / "own.json"
    for _ in range(2):
        viewer.save_path(walk)
        assert viewer.error is None, "pansplat wrote the file"
    own.write_text("{}")
    for act, name in ((viewer.open_path, "missing.json"), (viewer.save_path, "own.json")):
        act(str(tmp_path / name))
        assert name in viewer.error
    assert own.read_text() == "{}"


@pytest.mark.parametrize("found", [{"poor": [(1, 2)]}, {"walls": [(1, 2)]}])
def test_a_refined_part_stays_in_the_tour_whose_edges_the_prediction_changed(make_app, house, load_house, found):
    app, go = make_app(), threading.Event()

    def load(entry: SceneEntry, show: Callable[..., None]) -> LoadedScene:
        if not entry.views:
            return load_house(replace(entry, views=(0, 1), pair=house.make_set((0, 1)), max_views=64))
        facts = SimpleNamespace(outlines={}, views=(), outlooks=(), hidden=(), graph=replace(house, **found))
        loaded = replace(load_house(entry), facts=facts)
        if len(entry.views) == 4:
            show(replace(loaded, is_final=False))
            assert go.wait(300)
        return loaded

    app.load = load
    app.session.show([SceneEntry(house.name, tour=house)], 0)
    session = app.session
    app.until(lambda: session.tour is not None and (session.tour.tour.poor or session.tour.tour.walls), "edges")
    tour, edges = app.session.tour, app.session.tour.tour
    go.set()
    app.settle()
    assert app.session.tour is tour and tour.tour is edges and app.viewer.error is None
    assert tour.loaded == list(tour._sources)


def test_a_note_is_put_at_the_middle_and_removed(make_app, house):
    app = make_app()
    app.session.show([SceneEntry(house.name, tour=house)], 0, house.folder)
    app.settle()
    photographs, file = app.viewer.stage.photographs, house.folder / "links.json"
    app.state.camera = replace(app.state.camera, yaw_radians=0.4, pitch_radians=0.2)
    app.viewer.put_note("  sofa\nof 1960 ")
    app.state.camera = replace(app.state.camera, yaw_radians=-1.0)
    app.viewer.put_note("door")
    index = photographs.find_stop(np.asarray(app.state.camera.position))
    assert [note.text for note in photographs.list_notes(index)] == ["sofa\nof 1960", "door"]
    app.state.camera = replace(app.state.camera, yaw_radians=0.43)
    app.viewer.put_note("")
    (note,) = load_panoramas(house.folder)[index].notes
    expected = replace(app.state.camera, yaw_radians=-1.0).rotation[:, 2]
    assert note.text == "door" and photographs.list_notes(index)[0].text == "door"
    seen = find_direction(house.panoramas[index].cam2world, note.yaw, note.pitch).numpy()
    assert seen == pytest.approx(expected, abs=1e-4)
    written = file.read_bytes()
    app.state.camera = replace(app.state.camera, position=(0.0, 0.0, 0.4))
    app.viewer.put_note("between")
    assert file.read_bytes() == written and "at a panorama" in app.state.message
    file.unlink()


def test_before_surfaces_the_camera_stops_and_says_why_once(make_app, sphere_predictor, monkeypatch, house):
    """In the scene of a single photograph, and of two, also if it flew before the scene was there."""
    monkeypatch.setitem(pipeline.models._MODELS, "sphere", sphere_predictor)
    options = PredictOptions("sphere", height=64, refine_steps=0, cache=False)
    for views, farthest in (((0,), 1.8), ((0, 1), 2.6)):
        app = make_app()
        gate = Gate(lambda entry: load_entry(entry, options), "waiting", 0.0)
        app.load = gate
        app.session.show([SceneEntry("room", pair=house.make_set(views))], 0)
        for _ in range(20):
            app.frame(0.2, held=frozenset("w"))
        gate.open()
        app.settle()
        assert app.state.has_stopped and 1.7 < np.linalg.norm(app.state.camera.position) < farthest
        assert "no photograph shows what is behind" in app.state.message
        app.state.message = ""
        for _ in range(20):
            app.frame(0.2, held=frozenset("w"))
        assert 1.7 < np.linalg.norm(app.state.camera.position) < farthest and not app.state.message
        for _ in range(10):
            app.frame(0.2, held=frozenset("s"))
        assert np.linalg.norm(app.state.camera.position) < 0.6


@pytest.fixture
def tour_app(make_app, house) -> App:
    """The viewer in a tour, at its first panorama."""
    app = make_app()
    app.show(SceneEntry(house.name, tour=house))
    return app


def test_hotspots_are_in_points_of_a_screen_with_two_pixels_a_point(tour_app):
    app = tour_app
    app.state.camera = replace(app.state.camera, pitch_radians=-0.9)
    app.frames(2)
    expected = [(spot.node, spot.center) for spot in app.viewer.hotspots]
    app.target.viewport = (0, 0, 2 * SIZE[0], 2 * SIZE[1])
    app.frames(2)
    assert expected and [(spot.node, spot.center) for spot in app.viewer.hotspots] == expected


def test_a_flight_shows_photographs_where_no_scene_is_ready(make_app, house, load_house):
    app, gate = make_app(), Gate(load_house, "predicting", 0.5)
    app.load = lambda entry, *rest: gate(entry, *rest) if entry.views not in ((), (0, 1)) else load_house(entry)
    app.session.show([SceneEntry(house.name, tour=house)], 0)
    app.until(lambda: app.session.loaded is not None, "tour")
    first, contents = app.viewer.stage.slot.scene, []
    app.press("4")

    def has_ended() -> bool:
        contents.append(app.content)
        return not (app.state.playing or app.viewer.stage.is_animated(app.now)) and len(contents) > 3

    app.until(has_ended, "end of the flight", 1 / 10)
    assert app.node == 3, "it does not wait"
    order = [content for content, before in zip(contents, [None, *contents], strict=False) if content is not before]
    assert order[0] is first and order[-1] == 3 and set(order[1:]) <= {1, 2, 3}, "the scene ends near its last panorama"
    app.press("p")
    assert "no scene" in app.state.message
    gate.open()
    app.until(lambda: app.viewer.stage.photograph is None, "scene")
    app.settle()
    assert app.viewer.stage.slot.scene is app.session.tour.get((2, 3)).scene


def test_a_tour_shows_its_photographs_before_the_first_scene(make_app, house, load_house):
    app, gate = make_app(), Gate(load_house, "predicting", 0.5)
    app.load = lambda entry, *rest: load_house(entry) if entry.views else gate(entry, *rest)
    app.session.show([SceneEntry(house.name, tour=house)], 0)
    app.frame()
    assert app.content == 0 and app.state.camera.yaw_radians == 0, "towards its neighbour"
    app.press("3")
    app.fly()
    app.until(lambda: app.content == 2, "photograph")
    assert app.node == 2
    app.press("space")
    app.frames(5, 1 / 10)
    gate.open()
    app.until(lambda: app.session.loaded is not None, "first scene", 1e-3)
    assert app.state.playing, "the flight goes on"
    assert app.content == 2, "the scene of panoramas 0 and 1 is not shown from here"
    app.until(lambda: app.viewer.stage.photograph is None, "scene", 1 / 10)
    assert 2 in app.viewer.stage.scene_views


def test_space_plays_the_tour_through_all_panoramas_within_the_memory(make_app, house, monkeypatch):
    monkeypatch.setattr("pansplat_viewer.core.tour_scenes._MEMORY", 0)
    app = make_app()
    app.show(SceneEntry(house.name, tour=house))
    app.press("space")
    visited = set()

    def has_ended() -> bool:
        visited.add(app.node)
        assert len(app.session.tour.loaded) <= 3, "a scene, that of the camera and the one before"
        return not app.state.playing

    app.until(has_ended, "end of the tour", 1 / 4)
    assert visited == {0, 1, 2, 3}
    before = app.state.camera
    app.frame(0.1, held=frozenset("w"))
    app.press("space")
    moved = np.linalg.norm(np.subtract(app.state.camera.position, before.position))
    assert app.state.playing and moved < 1.0, "the flight starts where the camera is"


def test_a_file_of_a_tour_is_flown_along_its_edges(make_app, house_file):
    app = make_app()
    app.load = lambda entry, *rest: load_entry(entry, PredictOptions(), *rest)
    app.show(SceneEntry("home", file=house_file))
    first = app.viewer.stage.slot.scene
    assert first.gaussians.views.unique().tolist() == [0, 1], "only the views of the edge are blended"
    app.state.target = 3
    app.fly(0.5)
    assert app.node == 3 and np.allclose(app.viewer.stage.slot.scene.cam2world, app.state.context[2:])


def test_a_link_leads_to_a_panorama_without_a_place_and_the_scene_before_stays(make_app, parted_house):
    notes = ("room3.png: no pose was found; it is a part of its own",)
    app = make_app()
    app.show(SceneEntry(parted_house.name, tour=parted_house, notes=notes))
    assert app.session.notes == notes
    app.state.target = 2
    app.fly(1.0)
    app.state.camera = replace(app.state.camera, pitch_radians=-0.25, yaw_radians=-0.1)
    app.frames(2)
    (spot,) = [spot for spot in app.viewer.hotspots if not spot.is_arrow]
    assert (spot.node, spot.label, spot.is_zoom) == (3, "to the hall", True)
    left, stage = app.viewer.stage.slot.scene, app.viewer.stage
    app.frame(click=(spot.center[0] / SIZE[0], spot.center[1] / SIZE[1]))
    app.until(lambda: app.session.tour.part == 1, "fade", 0.2)
    poses, front = stage.fade.poses, stage.fade.front
    assert np.linalg.norm(poses[1 - front][:3, 3] - parted_house.positions[2]) < 1e-6, "the scene before stays"
    assert np.allclose(poses[front], app.state.camera.cam2world) and stage.slots[1 - front].scene is left
    app.fly(0.5)
    assert app.node == 3 and stage.slot.scene is not left
    app.frame(0.5, held=frozenset("w"))
    assert app.state.camera.position == tuple(parted_house.positions[3]), "one photograph is not walked in"
    app.state.target = 1
    app.fly(0.5)
    assert app.node == 1


def test_a_scene_that_is_chosen_in_a_tour_stays_while_it_is_prepared(tour_app, load_house, small_scene, monkeypatch):
    app, ready, requested = tour_app, threading.Event(), []

    def load(entry: SceneEntry, *_: object) -> LoadedScene:
        requested.append(entry.name)
        return LoadedScene(entry, small_scene) if entry.tour is None else load_house(entry)

    next(each for each in app.session.tour._predictions.values() if each.loaded).drop()  # one is missing
    is_ready = app.viewer.stage.preparer.is_ready
    monkeypatch.setattr(
        app.viewer.stage.preparer,
        "is_ready",
        lambda scene: is_ready(scene) and (scene is not small_scene or ready.is_set()),
    )
    app.session.loader.cancel()
    app.load = load
    app.session.show([SceneEntry("large")], 0)
    app.until(lambda: requested, "request")
    app.frames(5)
    ready.set()
    app.settle()
    assert requested == ["large"], "the tour requests nothing"
    assert app.session.loaded.entry.name == "large" and app.session.tour is None


def test_a_scene_of_a_tour_that_fails_is_reported_once(make_app, house, load_house):
    app, failed = make_app(), []

    def load(entry: SceneEntry, *_: object) -> LoadedScene:
        if entry.views == (1, 2):
            failed.append(entry.name)
            raise InputError("room2.png: no such file")
        return load_house(entry)

    app.load = load
    app.session.show([SceneEntry(house.name, tour=house)], 0)
    app.until(lambda: app.viewer.error, "error")
    app.viewer.error = None
    app.settle()
    assert failed == ["room1-room2"] and app.viewer.error is None
    app.press("3")
    app.fly(0.25)
    app.until(lambda: app.content == 2, "photograph: there is no scene of the edge")
    assert app.node == 2


def test_a_scene_after_a_tour_does_not_fade_from_it(tour_app, pair):
    app = tour_app
    app.state.target = 3
    app.fly(1.0)
    app.session.show([SceneEntry("first", pair=pair)], 0)
    app.until(lambda: app.session.tour is None, "pair")
    assert app.viewer.stage.fade.compute_weight(app.now) == 1
