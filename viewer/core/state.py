"""The viewer's state: values that keys and panels change and that a frame reads. Needs neither window nor GL."""

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float

from pansplat.constants import NEAR
from pansplat.gaussians.scene import Scene
from pansplat.geometry.level import level_axes
from pansplat.tours.camera_path import CameraPath, KeyFrame
from pansplat.tours.graph import TourGraph
from pansplat.tours.limits import limit_step
from pansplat.tours.route import NEAR_OF_FAR, Moment, Route, plan_route
from pansplat.tours.scene_graph import make_graph
from pansplat.tours.walks import plan_walk
from pansplat_viewer.core.camera import Camera, move_to_pose
from pansplat_viewer.core.picking import PickedPoint
from pansplat_viewer.core.settings import Display, DrawSettings

KEY_SECONDS = 2.0  # between key frames that are added one after the other
_MAX_SAMPLES = 100_000  # Gaussians that percentiles are measured on


@dataclass
class ViewerState:
    """Everything that a user can change, and the scene's cameras and levels.

    The camera moves in two ways without input: along the way between panoramas (`route`), and along the path of key
    frames (`path`).

    Attributes:
        overlay, help: whether panels and key help are shown.
        context: poses of the input cameras; empty for a file without cameras. Of a tour, of all panoramas.
        plan: whether the floor plan of a tour, the rings of its panoramas and notes are shown.
    """

    camera: Camera = field(default_factory=Camera)  # the current camera; `home` is the camera that R restores
    home: Camera = field(default_factory=Camera)
    orbiting: bool = False  # whether the camera orbits (True) or flies (False)
    settings: DrawSettings = field(default_factory=DrawSettings)  # draw settings; the field of view is the camera's
    route_fraction: float = 0.0  # of the duration of `route` that is done, in [0, 1]
    playing: bool = False  # whether the camera follows it
    overlay: bool = True
    help: bool = False
    stops: bool = True  # whether the photograph is shown where the camera stands at a panorama
    context: Float[np.ndarray, "view 4 4"] = field(default_factory=lambda: np.zeros((0, 4, 4)))
    num_views: int = 0  # number of input cameras of the scene that is shown
    graph: TourGraph | None = None  # the input cameras, whose surfaces stop the camera; None without any
    is_tour: bool = False  # whether that is the graph of a tour
    route: Route | None = None  # the way through the panoramas; None without cameras
    target: int | None = None  # the panorama to go to; None if there is none
    has_stopped: bool = False  # whether the message that surfaces stop the camera was shown
    plan: bool = True
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
        """Of the route, while the camera follows it."""
        return self.route.at(self.route_fraction) if self.route is not None and self.playing else None

    @property
    def is_zooming(self) -> bool:
        """Whether the camera is in a zoom of the route."""
        moment = self.moment
        return moment is not None and moment.arrival is not None

    @property
    def draw_settings(self) -> DrawSettings:
        """The settings of the next frame, with the camera's field of view."""
        return replace(self.settings, vertical_fov_degrees=self.camera.vertical_fov_degrees)

    def show_message(self, message: str) -> None:
        """Show a message for four seconds."""
        self.message, self.message_until = message, self.now + 4


def enter_scene(state: ViewerState, scene: Scene, tour: TourGraph | None = None, start: int | None = None) -> None:
    """Start in a scene; settings that it does not support are reset.

    In a scene of the same cameras as the one before, the camera stays where it is.

    Args:
        state: is changed.
        scene: that is shown, of a tour the first one.
        tour: None for another scene, in which cameras may fly between any two panoramas.
        start: the panorama of the tour at which the way through it starts; None to choose one.
    """
    graph = tour or (make_graph(scene).with_all_edges() if len(scene.cam2world) else None)
    context = np.zeros((0, 4, 4)) if graph is None else graph.cam2world.numpy()
    before = state.camera if _are_same(state.context, context) else None
    adapt_settings(state, scene, keep_levels=False)
    state.settings = replace(state.settings, near=NEAR if tour is None else NEAR_OF_FAR * tour.far)
    state.graph, state.is_tour, state.context, state.target, state.route = graph, tour is not None, context, None, None
    state.playing, state.route_fraction, state.points = False, 0.0, []
    if graph is None:
        level, pose = level_axes(scene.cam2world), _choose_outside_pose(scene)
    else:
        walk = range(len(graph)) if tour is None else plan_walk(graph, start)
        state.route, level = plan_route(graph, walk), graph.level_axes
        pose = state.route.pose(0.0)
    levelled = replace(state.camera, level=tuple(tuple(row) for row in level.tolist()))
    home = move_to_pose(levelled, pose)
    state.home = replace(home, distance=_measure_distance(scene, 50))
    state.camera = state.home if before is None else replace(before, distance=state.home.distance)
    state.depth_max = _measure_distance(scene, 98)
    choose_display(state, state.settings.display)


def _are_same(first: Float[np.ndarray, "a 4 4"], second: Float[np.ndarray, "b 4 4"]) -> bool:
    """Whether poses of input cameras are the same, up to the rounding of a file."""
    return len(first) == len(second) > 0 and np.allclose(first, second, atol=1e-5)


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
    graph, camera = state.graph, state.camera
    if graph is None or state.orbiting or camera.position == before.position:
        return
    place = np.array(before.position)
    first, last = graph.find_nearest_edge(place)[0]
    if first != last or not state.is_tour:
        place = limit_step(graph, place, np.array(camera.position))
    state.camera = replace(camera, position=tuple(place.tolist()))
    if not state.is_tour and not state.has_stopped and not np.allclose(place, camera.position):
        state.has_stopped = True
        state.show_message("Surfaces stop the camera: no photograph shows what is behind them   (V: orbit around them)")


def go_to_view(state: ViewerState, view: int) -> None:
    """Go to an input camera; does nothing if the scene has no such camera."""
    if view < len(state.context):
        state.target = view


def go_home(state: ViewerState) -> None:
    """Move the camera to the start of the scene."""
    state.playing, state.camera = False, state.home


def toggle_play(state: ViewerState) -> None:
    """Start or stop the way; at its end, start it from the beginning."""
    if state.route is None:
        return
    state.playing = not state.playing
    if state.playing and state.route_fraction >= 1:
        state.route_fraction = 0.0


def advance_route(state: ViewerState, seconds: float) -> None:
    """Move along the route if it is played, and stop at its end."""
    if state.playing and state.route is not None:
        state.route_fraction = min(state.route_fraction + seconds / state.route.seconds, 1.0)
        state.camera = move_to_pose(state.camera, state.route.pose(state.route_fraction))
        state.playing = state.route_fraction < 1


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
        pose, fov = state.path.interpolate(state.path_seconds, np.asarray(state.camera.level), state.graph)
        state.camera = replace(move_to_pose(state.camera, pose), vertical_fov_degrees=fov)


def advance_path(state: ViewerState, seconds: float) -> None:
    """Move along the path if it is played, and stop at its end."""
    if state.path_playing:
        show_path(state, min(state.path_seconds + seconds, state.path.seconds))
        state.path_playing = state.path_seconds < state.path.seconds


def _choose_outside_pose(scene: Scene) -> Float[np.ndarray, "4 4"]:
    """A pose that sees a scene without cameras from outside."""
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
