"""The viewer's state: values that keys and panels change and that a frame reads. Needs neither window nor GL."""

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float

from pansplat.constants import NEAR
from pansplat.gaussians.scene import Scene
from pansplat.geometry.path import (
    find_direction,
    fly_pose,
    level_axes,
    level_pose,
    up_direction,
)
from pansplat.tours.camera_path import CameraPath, KeyFrame
from pansplat.tours.graph import TourGraph
from pansplat.tours.limits import limit_step
from pansplat.tours.route import NEAR_OF_FAR, Moment, Route
from pansplat_viewer.scene.camera import Camera, focus_on_point, move_to_pose
from pansplat_viewer.scene.picking import PickedPoint
from pansplat_viewer.scene.settings import Display, DrawSettings

FLIGHT_SECONDS = 6.0
KEY_SECONDS = 2.0  # between key frames that are added one after the other
_MAX_SAMPLES = 100_000  # Gaussians that percentiles are measured on


@dataclass
class ViewerState:
    """Everything that a user can change, and the scene's cameras and levels.

    The camera moves in two ways without input: along the flight between panoramas (`flight`, in a tour along
    `route`), and along the path of key frames (`path`).

    Attributes:
        overlay, help: whether panels and key help are shown.
        context: poses of the input cameras; empty for a file without cameras. Of a tour, of all panoramas.
        minimap, hotspots: whether the floor plan of a tour and the places of its panoramas are shown.
    """

    camera: Camera = field(default_factory=Camera)  # the current camera; `home` is the camera that R restores
    home: Camera = field(default_factory=Camera)
    orbiting: bool = False  # whether the camera orbits (True) or flies (False)
    settings: DrawSettings = field(default_factory=DrawSettings)  # draw settings; the field of view is the camera's
    flight: float = 0.0  # fraction of the flight between the panoramas, in [0, 1]
    playing: bool = False  # whether this flight goes on
    overlay: bool = True
    help: bool = False
    stops: bool = True  # whether the photograph is shown where the camera stands at a panorama
    speed: float = 1.0  # of flying, metres per second
    context: Float[np.ndarray, "view 4 4"] = field(default_factory=lambda: np.zeros((0, 4, 4)))
    num_views: int = 0  # number of input cameras of the scene that is shown
    tour: TourGraph | None = None  # that is shown; None for other scenes
    route: Route | None = None  # the flight through a tour; None if none is planned, and in other scenes
    target: int | None = None  # the panorama of a tour to fly to; None if there is none
    bounds: TourGraph | None = None  # whose surfaces stop the camera in a scene that is no tour
    has_stopped: bool = False  # whether they have, and a message has said so
    minimap: bool = True
    hotspots: bool = True
    path: CameraPath = field(default_factory=CameraPath)  # key frames of the camera path that is edited
    path_seconds: float = 0.0  # time on the path that the panel shows
    path_playing: bool = False  # whether the camera moves along the path
    depth_max: float = 1.0  # distance within which most Gaussians are, metres; the range of the display of depths
    levels: tuple[int, ...] = ()  # pyramid levels of the scene, ascending
    points: list[PickedPoint] = field(default_factory=list)  # the last picked points, two at most
    now: float = 0.0  # time of the frame, seconds of the viewer's clock
    message: str = ""  # a text to show until `message_until`
    message_until: float = 0.0
    quit: bool = False  # whether to close the viewer

    @property
    def moment(self) -> Moment | None:
        """Of the route through a tour, while the camera follows it."""
        return self.route.at(self.flight) if self.route is not None and self.playing else None

    @property
    def draw_settings(self) -> DrawSettings:
        """The settings of the next frame, with the camera's field of view."""
        return replace(self.settings, vertical_fov_degrees=self.camera.vertical_fov_degrees)

    def show_message(self, message: str) -> None:
        """Show a message for four seconds."""
        self.message, self.message_until = message, self.now + 4


def enter_scene(state: ViewerState, scene: Scene, *, at: float = 0.0) -> None:
    """Start in a scene at a fraction of its flight; settings that the scene does not support are reset.

    In a scene of the same cameras as the one before, the camera stays where it is.
    """
    before = state.camera if _are_same(state.context, scene.cam2world.numpy()) else None
    adapt_settings(state, scene, keep_levels=False)
    state.settings = replace(state.settings, near=NEAR)
    state.context = scene.cam2world.double().numpy()
    state.tour = state.route = state.target = state.bounds = None
    state.playing, state.flight, state.points = False, min(max(at, 0.0), 1.0), []
    level = _level_camera(state.camera, level_axes(scene.cam2world))
    camera = move_to_pose(level, _choose_start_pose(scene, state.flight))
    if state.flight == 0 and scene.starts and scene.starts[0] is not None:
        forward = find_direction(scene.cam2world[0], *scene.starts[0]).numpy()
        camera = focus_on_point(camera, np.asarray(camera.position) + forward)
    state.camera = state.home = replace(camera, distance=_measure_distance(scene, 50))
    if before is not None:
        state.camera = replace(before, distance=state.home.distance)
    state.depth_max = _measure_distance(scene, 98)
    choose_display(state, state.settings.display)


def enter_tour(state: ViewerState, tour: TourGraph, scene: Scene, route: Route, *, at: float = 0.0) -> None:
    """Start in a tour, whose first scene is `scene`, at a fraction of a route through it; see `enter_scene`."""
    before = state.camera if _are_same(state.context, tour.cam2world.numpy()) else None
    enter_scene(state, scene)
    state.settings = replace(state.settings, near=NEAR_OF_FAR * tour.far)
    state.tour, state.context = tour, tour.cam2world.numpy()
    state.route, state.flight = route, min(max(at, 0.0), 1.0)
    level = _level_camera(state.camera, tour.level_axes)
    state.camera = state.home = move_to_pose(level, route.pose(state.flight))
    state.camera = before or state.camera


def _are_same(first: Float[np.ndarray, "a 4 4"], second: Float[np.ndarray, "b 4 4"]) -> bool:
    """Whether poses of input cameras are the same, up to the rounding of a file."""
    return len(first) == len(second) > 0 and np.allclose(first, second, atol=1e-5)


def _level_camera(camera: Camera, axes: Float[np.ndarray, "3 3"]) -> Camera:
    return replace(camera, level=tuple(tuple(float(x) for x in row) for row in axes))


def adapt_settings(state: ViewerState, scene: Scene, *, keep_levels: bool = True) -> None:
    """Set the number of views and the levels to those of a scene, and reset settings that it does not support."""
    state.num_views = len(scene.cam2world)
    state.levels = tuple(torch.bincount(scene.gaussians.levels).nonzero().flatten().tolist())
    settings = state.settings if keep_levels else replace(state.settings, levels=None)
    state.settings = fit_settings(settings, scene)


def choose_display(state: ViewerState, display: Display) -> None:
    """Show a property, in the range of the scene."""
    largest = state.depth_max if display == "depth" else 1.0
    state.settings = replace(state.settings, display=display, display_max=largest)


def fit_settings(settings: DrawSettings, scene: Scene) -> DrawSettings:
    """The settings with a view and a mode that a scene supports."""
    num_views = max(len(scene.cam2world), 1)
    if settings.mode == "deferred" and (num_views < 2 or scene.joint):
        settings = replace(settings, mode="joint")
    return replace(settings, view=min(settings.view, num_views - 1))


def limit_camera(state: ViewerState, before: Camera) -> None:
    """Stop a camera before surfaces, and say once why.

    At a panorama of a tour that no edge leads to, it stays where it is.
    """
    bounds, camera = state.tour or state.bounds, state.camera
    if bounds is None or state.orbiting or camera.position == before.position:
        return
    place = np.array(before.position)
    first, last = bounds.find_nearest_edge(place)[0]
    if first != last or state.tour is None:
        place = limit_step(bounds, place, np.array(camera.position))
    state.camera = replace(camera, position=tuple(place.tolist()))
    if state.tour is None and not state.has_stopped and not np.allclose(place, camera.position):
        state.has_stopped = True
        state.show_message("Surfaces stop the camera: no photograph shows what is behind them   (V: orbit around them)")


def jump_to_view(state: ViewerState, view: int) -> None:
    """Move to an input camera's position and heading, level; does nothing if the scene has no such camera.

    In a tour, the camera flies there, along the graph.
    """
    if view >= len(state.context):
        return
    if state.route is not None:
        state.target = view
        return
    up = up_direction(torch.from_numpy(state.context))
    target = level_pose(torch.from_numpy(state.context[view]), up).numpy()
    state.playing = False
    state.camera = move_to_pose(state.camera, target)
    state.flight = view / max(len(state.context) - 1, 1)


def go_home(state: ViewerState) -> None:
    """Move the camera to the start of the scene."""
    state.playing, state.camera = False, state.home


def fly_to(state: ViewerState, fraction: float) -> None:
    """Move the camera to a fraction of the flight."""
    state.flight = min(max(fraction, 0.0), 1.0)
    if state.route is not None:
        state.camera = move_to_pose(state.camera, state.route.pose(state.flight))
    elif len(state.context):
        target = fly_pose(torch.from_numpy(state.context), state.flight).numpy()
        state.camera = move_to_pose(state.camera, target)


def toggle_play(state: ViewerState) -> None:
    """Start or stop the flight; at its end, start it from the beginning."""
    if not len(state.context):
        return
    state.playing = not state.playing
    if state.playing and state.flight >= 1:
        state.flight = 0.0


def advance_flight(state: ViewerState, seconds: float) -> None:
    """Move along the flight if it is playing, and stop at its end."""
    if state.playing:
        duration = FLIGHT_SECONDS if state.route is None else state.route.seconds
        fly_to(state, state.flight + seconds / duration)
        state.playing = state.flight < 1


def add_key_frame(state: ViewerState) -> None:
    """Add the camera as a key frame at the time that the panel shows, or `KEY_SECONDS` after the last one."""
    seconds = state.path_seconds
    if any(abs(frame.seconds - seconds) < 1e-3 for frame in state.path.key_frames):
        seconds = state.path.seconds + KEY_SECONDS
    state.path = state.path.add(make_key_frame(state.camera, seconds))
    state.path_seconds, state.path_playing = seconds, False


def make_key_frame(camera: Camera, seconds: float) -> KeyFrame:
    """The camera as a key frame."""
    place, ahead = (tuple(camera.cam2world[:3, column].tolist()) for column in (3, 2))
    return KeyFrame(seconds, place, ahead, camera.vertical_fov_degrees)


def show_path(state: ViewerState, seconds: float) -> None:
    """Move the camera to a time of the path."""
    state.playing, state.path_seconds = False, max(seconds, 0.0)
    if len(state.path):
        pose, fov = state.path.interpolate(state.path_seconds, np.asarray(state.camera.level), state.tour)
        state.camera = replace(move_to_pose(state.camera, pose), vertical_fov_degrees=fov)


def advance_path(state: ViewerState, seconds: float) -> None:
    """Move along the path if it is played, and stop at its end."""
    if state.path_playing:
        show_path(state, min(state.path_seconds + seconds, state.path.seconds))
        state.path_playing = state.path_seconds < state.path.seconds


def _choose_start_pose(scene: Scene, fraction: float) -> Float[np.ndarray, "4 4"]:
    """Return the pose at a fraction of the flight; in a scene without cameras, a pose that sees it from outside."""
    if len(scene.cam2world):
        return fly_pose(scene.cam2world, fraction).numpy()
    matrix = np.eye(4)
    matrix[:3, :3] = level_axes(scene.cam2world)
    means = _sample_means(scene)
    if len(means):
        middle = np.median(means, axis=0)
        matrix[:3, 3] = middle - 2 * _measure_percentile(means, middle) * matrix[:3, 2]
    return matrix


def _measure_distance(scene: Scene, percent: float) -> float:
    """Return a percentile of the distances from the first camera (else the start pose), metres; 2 if none."""
    means = _sample_means(scene)
    if not len(means):
        return 2.0
    if len(scene.cam2world):
        return _measure_percentile(means, scene.cam2world[0, :3, 3].double().numpy(), percent)
    return 2 * _measure_percentile(means, np.median(means, axis=0), percent)


def _sample_means(scene: Scene) -> Float[np.ndarray, "m 3"]:
    """The centres of every n-th Gaussian, enough for percentiles."""
    means = scene.gaussians.means
    return means[:: max(len(means) // _MAX_SAMPLES, 1)].double().numpy()


def _measure_percentile(means: Float[np.ndarray, "n 3"], point: Float[np.ndarray, "3"], percent: float = 50) -> float:
    distances = np.linalg.norm(means - point, axis=1)
    return float(np.percentile(distances[np.isfinite(distances)], percent)) or 1.0
