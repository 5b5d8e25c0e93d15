"""Files that `pansplat-view` writes without a window: the fly-through of a pair, films of tours and of camera paths."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8

from pansplat.export.film import FilmPhotographs
from pansplat.export.photographs import list_photographs
from pansplat.gaussians.scene import Scene
from pansplat.geometry.path import fly_pose, path_poses
from pansplat.geometry.pose import interpolate_poses
from pansplat.images.image_files import write_image
from pansplat.images.video import VIDEO_SUFFIXES, write_video
from pansplat.inputs.pairs import Pair
from pansplat.rendering.image_planes import ImagePlane, image_planes
from pansplat.tours.floor import paint_floor_plan
from pansplat.tours.graph import TourGraph
from pansplat.tours.route import FADE_SECONDS, Route
from pansplat_viewer.draw.frame_renderer import FrameRenderer
from pansplat_viewer.draw.stereo import ImageFormat, render_image
from pansplat_viewer.scene import camera as cameras
from pansplat_viewer.scene.camera import Camera
from pansplat_viewer.scene.key_frames import CameraPath
from pansplat_viewer.scene.loader import LoadedScene, SceneEntry, make_file_name
from pansplat_viewer.scene.settings import DrawSettings
from pansplat_viewer.scene.state import NEAR_OF_FAR, ViewerState, enter_scene, fit_settings
from pansplat_viewer.scene.tour import CrossFade, TourScenes

_FADING_COST = 0.2  # of a still in the first moment of a fade, as a distance from the panorama, fraction of far
FILM_SECONDS = 4.0  # of a pair
STILLS = (0.0, 0.25, 0.5, 0.75, 1.0)  # fractions of the flight
_NO_PHOTOGRAPHS = FilmPhotographs((), torch.zeros(0, 4, 4))


@dataclass(frozen=True)
class Film:
    """Sizes and times of a fly-through."""

    size: tuple[int, int] = (1920, 1080)  # of film and stills, pixels (width, height)
    seconds: float | None = None  # length of the film; None is 4, and for a tour the duration of its route
    fps: float = 24.0  # frames per second
    at: float = 0.5  # fraction of the flight at which the panorama is rendered
    vertical_fov_degrees: float = 75.0  # of film and stills
    panorama_height: int | None = None  # pixels; None is the height that the scene was predicted at

    def count_frames(self, route: Route | None = None) -> int:
        """Number of frames of the film of a pair, or of a tour's route."""
        seconds = self.seconds
        if seconds is None:
            seconds = FILM_SECONDS if route is None else route.seconds
        return max(round(seconds * self.fps), 2)


def compute_flight_pose(scene: Scene, fraction: float) -> Float[np.ndarray, "4 4"]:
    """Return the pose at a fraction of the scene's flight; a scene without cameras is orbited once."""
    if len(scene.cam2world):
        return fly_pose(scene.cam2world, fraction).numpy()
    state = ViewerState()
    enter_scene(state, scene)
    height = 1000
    return cameras.orbit(state.camera, (2 * height * fraction, 0.0), height).cam2world


def compute_panorama_pose(scene: Scene, fraction: float) -> Float[np.ndarray, "4 4"]:
    """Return a level pose between the first and last camera; the image centre is in the direction of flight."""
    if not len(scene.cam2world):
        return compute_flight_pose(scene, fraction)
    level = path_poses(scene.cam2world)
    return interpolate_poses(level[0], level[-1], fraction).numpy()


def write_flythrough(
    frames: SceneFrames,
    scene: Scene,
    folder: Path,
    film: Film,
    progress: Callable[[str, float], None],
    show_file: Callable[[Path], None],
) -> None:
    """Render film, stills and panorama into `folder`, each written completely or not at all.

    Args:
        frames: of the scene.
        scene: the scene.
        folder: created if it does not exist.
        film: sizes and times.
        progress: called with the task and the fraction done.
        show_file: called with each file that is written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    num_frames = film.count_frames()
    steps = num_frames + len(STILLS) + 1

    def draw(fraction: float, seconds: float) -> np.ndarray:
        return frames.draw(compute_flight_pose(scene, fraction), film.vertical_fov_degrees, seconds)[0]

    for done, fraction in enumerate(STILLS):
        progress("stills", done / steps)
        file = folder / f"view_{round(100 * fraction):03d}.png"
        write_image(file, draw(fraction, -1.0 - done))  # seconds apart, and before the film
        show_file(file)
    progress("panorama", len(STILLS) / steps)
    file = folder / f"panorama_{round(100 * film.at):03d}.png"
    height = film.panorama_height or scene.height
    write_image(file, frames.draw_panorama(compute_panorama_pose(scene, film.at), height))
    show_file(file)

    def render_frames() -> Iterator[np.ndarray]:
        for frame in range(num_frames):
            progress("film", (len(STILLS) + 1 + frame) / steps)
            yield to_bytes(draw(frame / (num_frames - 1), frame / film.fps))

    file = folder / "flythrough.mp4"
    write_video(file, render_frames(), film.fps)
    progress("done", 1.0)
    show_file(file)


class SceneFrames:
    """Draws the frames of a film in one scene.

    Attributes:
        image_format: of the frames.
        tour: None.
        unit: see `pansplat.geometry.world.WorldFrame`.
    """

    tour = None

    def __init__(
        self,
        renderer: FrameRenderer,
        scene: Scene,
        size: tuple[int, int],
        settings: DrawSettings,
        image_format: ImageFormat | None = None,
        stops: FilmPhotographs | None = None,
    ) -> None:
        """Upload the scene; `size` is (width, height) of one eye, pixels; `stops` are photographs that films show."""
        renderer.upload(scene)
        self._renderer, self._size, self._stops = renderer, size, stops or _NO_PHOTOGRAPHS
        self._settings, self.unit = fit_settings(settings, scene), scene.frame.unit
        self.image_format = image_format or ImageFormat()

    def draw(
        self, pose: Float[np.ndarray, "4 4"], vertical_fov_degrees: float, now: float, *, with_depth: bool = False
    ) -> tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width"] | None]:
        """Colour of a pose at a time of the film, in seconds, and radial depth in metres if it is asked for."""
        settings = replace(self._settings, vertical_fov_degrees=vertical_fov_degrees)
        draw = partial(render_image, self._renderer, pose, self._size, settings, self.image_format)
        if with_depth:
            return draw(with_depth=True)
        plane = _make_plane(self._size, self.image_format, vertical_fov_degrees)
        return self._stops.mix([(pose, 1.0, lambda: draw()[0])], plane, now), None

    def draw_panorama(self, pose: Float[np.ndarray, "4 4"], height: int) -> Float[np.ndarray, "height width 3"]:
        """Colour of all directions from a pose."""
        size, image_format = (2 * height, height), ImageFormat("equirect")
        return render_image(self._renderer, pose, size, self._settings, image_format)[0]


class TourFrames:
    """Draws the frames of a film in a tour: loads each scene when the camera needs it, and fades it in.

    Attributes:
        image_format: of the frames.
        tour: the graph.
        unit: see `pansplat.geometry.world.WorldFrame`.
    """

    def __init__(
        self,
        renderers: Sequence[FrameRenderer],
        scenes: TourScenes,
        load: Callable[[SceneEntry], LoadedScene],
        size: tuple[int, int],
        settings: DrawSettings,
        image_format: ImageFormat | None = None,
        stops: FilmPhotographs | None = None,
    ) -> None:
        """Prepare the first frame.

        Args:
            renderers: two; scenes are uploaded to them in turn.
            scenes: of the tour; loaded ones are kept within its memory.
            load: returns the scene of an entry.
            size: (width, height) of one eye, pixels.
            settings: draw settings.
            image_format: a perspective image of one eye by default.
            stops: photographs that are shown at panoramas.
        """
        self._stops = stops or _NO_PHOTOGRAPHS
        self.image_format, self.tour = image_format or ImageFormat(), scenes.tour
        self._renderers, self._scenes, self._load, self._size = renderers, scenes, load, size
        self._settings = replace(settings, near=NEAR_OF_FAR * scenes.tour.far)
        self._fade, self.unit = CrossFade(), scenes.tour.panoramas[0].frame.unit

    def draw(
        self, pose: Float[np.ndarray, "4 4"], vertical_fov_degrees: float, now: float, *, with_depth: bool = False
    ) -> tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width"] | None]:
        """Draw a frame like `SceneFrames.draw`; depth is that of the scene that fades in."""
        self._scenes.move(pose[:3, 3])
        return self.draw_scene(pose, vertical_fov_degrees, now, with_depth=with_depth)

    def draw_scene(
        self, pose: Float[np.ndarray, "4 4"], vertical_fov_degrees: float, now: float, *, with_depth: bool = False
    ) -> tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width"] | None]:
        """Draw a frame of the scene of the edge that is chosen already."""
        scenes, fade = self._scenes, self._fade
        loaded = scenes.get(scenes.views)
        if loaded is None:
            for views in scenes.missing:
                scenes.add(self._load(scenes.make_entry(views)))
            loaded = scenes.get(scenes.views)
        assert loaded is not None
        fade.compute_weight(now)
        slot = fade.choose_slot(loaded.scene)
        if slot is not None:
            if fade.contents[slot] is not loaded.scene:
                self._renderers[slot].upload(loaded.scene)
            fade.show(slot, loaded.scene, now, scenes.part)
        fade.move(pose, scenes.part)
        weight, depth = fade.compute_weight(now), None

        def draw(slot: int, view: np.ndarray, scene: Scene) -> np.ndarray:
            nonlocal depth
            settings = replace(fit_settings(self._settings, scene), vertical_fov_degrees=vertical_fov_degrees)
            needs_depth = with_depth and slot == fade.front
            image, found = render_image(
                self._renderers[slot], view, self._size, settings, self.image_format, with_depth=needs_depth
            )
            depth = found if needs_depth else depth
            return image

        frame = [
            (view, part, partial(draw, slot, view, scene))
            for slot, part in ((1 - fade.front, 1 - weight), (fade.front, weight))
            if isinstance(scene := fade.contents[slot], Scene)
            and (view := fade.poses[slot]) is not None
            and (part > 0 or (with_depth and slot == fade.front))
        ]
        plane = _make_plane(self._size, self.image_format, vertical_fov_degrees)
        return (_NO_PHOTOGRAPHS if with_depth else self._stops).mix(frame, plane, now), depth


@contextlib.contextmanager
def open_frames(
    create_renderer: Callable[[], FrameRenderer],
    scene: Scene,
    entry: SceneEntry,
    scenes: TourScenes | None,
    load: Callable[[SceneEntry], LoadedScene],
    size: tuple[int, int],
    settings: DrawSettings,
    image_format: ImageFormat,
) -> Iterator[SceneFrames | TourFrames]:
    """The frames of a film in the scene of an entry, or in a tour whose `scenes` are given.

    They show photographs at panoramas. The renderers are released at the end.
    """
    stops = _NO_PHOTOGRAPHS
    if settings.shows_scene and image_format.stereo == "mono" and image_format.projection != "cubemap":
        stops = _open_photographs(entry, scene)
    renderers = [create_renderer() for _ in range(1 if scenes is None else 2)]
    try:
        if scenes is None:
            yield SceneFrames(renderers[0], scene, size, settings, image_format, stops)
        else:
            yield TourFrames(renderers, scenes, load, size, settings, image_format, stops)
    finally:
        for renderer in renderers:
            renderer.release()


def _open_photographs(entry: SceneEntry, scene: Scene) -> FilmPhotographs:
    """The photographs of the panoramas that a scene, or all scenes of a tour, are predicted from."""
    source = entry.tour or entry.pair
    if entry.merged is not None or source is None:
        return _NO_PHOTOGRAPHS
    panoramas = source.context if isinstance(source, Pair) else source.panoramas
    gains = scene.gains if scene.joint and entry.tour is None else ()
    poses = torch.stack([panorama.cam2world for panorama in panoramas])
    return FilmPhotographs(list_photographs(source, range(len(panoramas))), poses, gains)


def _make_plane(size: tuple[int, int], image_format: ImageFormat, vertical_fov_degrees: float) -> ImagePlane:
    """The image plane of a frame (width, height) of one eye; unused in a film without photographs."""
    layout = "equirect" if image_format.projection == "equirect" else "pinhole"
    return image_planes(layout, size[::-1], vertical_fov_degrees=vertical_fov_degrees)[0]


def write_tour(
    frames: TourFrames,
    scenes: TourScenes,
    route: Route,
    folder: Path,
    film: Film,
    progress: Callable[[str, float], None],
    show_file: Callable[[Path], None],
) -> None:
    """Write the film of a route through a tour (`tour.mp4`), its floor plan, and a still at each panorama.

    The stills (`01_NAME.png`) are written when the flight is there, before the film is complete.

    Args:
        frames: of the tour.
        scenes: of the tour.
        route: the flight.
        folder: created if it does not exist.
        film: size and times.
        progress: called with the task and the fraction done.
        show_file: called with each file that is written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    num_frames = film.count_frames(route)
    fractions = np.arange(num_frames) / (num_frames - 1)
    stills = _find_nearest_frames(scenes.tour, route, fractions)

    def render_frames() -> Iterator[np.ndarray]:
        for frame, fraction in enumerate(fractions.tolist()):
            progress("film", frame / num_frames)
            pose = route.pose(fraction)
            scenes.move(pose[:3, 3], route, fraction)
            # A film that is shorter or longer than the route changes the speed of the camera and that of the fades.
            color, _ = frames.draw_scene(pose, film.vertical_fov_degrees, fraction * route.seconds)
            for node in stills.get(frame, ()):
                file = folder / f"{node + 1:02d}_{make_file_name(scenes.tour.panoramas[node].label)}.png"
                write_image(file, color)
                show_file(file)
            yield to_bytes(color)

    write_video(folder / "tour.mp4", render_frames(), film.fps)
    show_file(folder / "tour.mp4")
    plan = paint_floor_plan(scenes.tour, scenes.outlines, route=route)
    write_image(folder / "floor_plan.png", plan.astype(np.float32) / 255)
    progress("done", 1.0)
    show_file(folder / "floor_plan.png")


def _find_nearest_frames(tour: TourGraph, route: Route, fractions: Float[np.ndarray, "frame"]) -> dict[int, list[int]]:
    """The nodes of a tour by the frame of the flight that is near them, and in which no other image fades out."""
    path = np.stack([route.pose(fraction)[:3, 3] for fraction in fractions.tolist()])
    seconds = fractions * route.seconds
    fading = np.zeros(len(path))
    for jump in route.jumps:
        since = seconds - jump / (len(route.yaws) - 1) * route.seconds
        fading = np.maximum(fading, np.where(since > 0, 1 - since / FADE_SECONDS, 0.0))
    frames: dict[int, list[int]] = {}
    for node, position in enumerate(tour.positions):
        cost = np.linalg.norm(path - position, axis=1) + _FADING_COST * tour.far * fading
        frames.setdefault(int(cost.argmin()), []).append(node)
    return frames


def write_path_film(
    frames: SceneFrames | TourFrames,
    path: CameraPath,
    level: Camera,
    file: Path,
    fps: float,
    progress: Callable[[str, float], None],
) -> list[Path]:
    """Write the film of a camera path; returns the files. Frame i shows the path at i / fps seconds.

    Args:
        frames: of the scene.
        path: key frames.
        level: a camera with the scene's level axes.
        file: a film (.mp4 or .webm), or the name of a sequence: `walk.png` and `walk.exr` (with depth) are written as
            `walk_0000.png` or `walk_0000.exr`, and so on.
        fps: frames per second.
        progress: called with the task and the fraction done.
    """
    num_frames, written = path.count_frames(fps), []

    def draw(frame: int, *, with_depth: bool = False) -> tuple[np.ndarray, np.ndarray | None]:
        progress("film", frame / num_frames)
        camera = path.interpolate(frame / fps, level, frames.tour)
        return frames.draw(camera.cam2world, camera.vertical_fov_degrees, frame / fps, with_depth=with_depth)

    projection, stereo = frames.image_format.projection, frames.image_format.stereo
    panorama = False if projection == "perspective" else projection
    if file.suffix.lower() in VIDEO_SUFFIXES:
        images = (to_bytes(draw(frame)[0]) for frame in range(num_frames))
        write_video(file, images, fps, panorama=panorama, stereo=stereo)
        written.append(file)
    else:
        for frame in range(num_frames):
            color, depth = draw(frame, with_depth=file.suffix.lower() == ".exr")
            depth = None if depth is None else depth * frames.unit
            written.append(name_frame(file, frame))
            write_image(written[-1], color, depth=depth, panorama=(projection, stereo) == ("equirect", "mono"))
    progress("done", 1.0)
    return written


def name_frame(file: Path, frame: int) -> Path:
    """The file of one frame of a sequence, such as `walk_0012.png` of `walk.png`."""
    return file.with_name(f"{file.stem}_{frame:04d}{file.suffix.lower()}")


def to_bytes(color: Float[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "height width 3"]:
    """Colours in [0, 1] as 8 bits."""
    return (color * 255 + 0.5).astype(np.uint8)
