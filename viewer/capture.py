"""Files that the viewer writes: numbered screenshots, the fly-through (film, stills and a panorama), and the film of a
tour."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pansplat.data.images import write_image
from pansplat.data.video import write_video
from pansplat.gaussians.scene import Scene
from pansplat.geometry.path import fly_pose, path_poses
from pansplat.geometry.pose import interpolate_poses
from pansplat.tours import FloorPlan, Route, draw_floor_plan
from pansplat_viewer import camera as cameras
from pansplat_viewer.cpu_renderer import Renderer
from pansplat_viewer.loader import LoadedScene, SceneEntry
from pansplat_viewer.settings import DrawSettings
from pansplat_viewer.state import NEAR_OF_FAR, ViewerState, enter_scene, fit_settings
from pansplat_viewer.tour import CrossFade, TourScenes

FILM_SECONDS = 4.0  # of a pair
PLAN_SIZE = 1024  # of the longer side of a floor plan, pixels
STILLS = (0.0, 0.25, 0.5, 0.75, 1.0)  # fractions of the flight


def write_screenshot(
    folder: Path,
    suffix: str,
    color: Float[np.ndarray, "height width 3"],
    depth: Float[np.ndarray, "height width"] | None = None,
    *,
    panorama: bool = False,
) -> Path:
    """Write an image (RGB in [0, 1]) as PNG, or as EXR with radial depth in metres; returns its path.

    The file is the first of `view_001.png`, `view_002.png`, ... (`panorama_001.png`, ...) that does not exist.
    """
    folder.mkdir(parents=True, exist_ok=True)
    stem, number = "panorama" if panorama else "view", 1
    while (path := folder / f"{stem}_{number:03d}.{suffix}").exists():
        number += 1
    write_image(path, np.clip(color, 0, 1), depth=depth, panorama=panorama)
    return path


@dataclass(frozen=True)
class Film:
    """Sizes and times of a fly-through.

    Attributes:
        size: of film and stills, pixels (width, height).
        seconds: length of the film; None is 4, and for a tour the duration of its route.
        fps: frames per second.
        at: fraction of the flight at which the panorama is rendered.
        vertical_fov_degrees: of film and stills.
        panorama_height: pixels; None is the height that the scene was predicted at.
    """

    size: tuple[int, int] = (1280, 720)
    seconds: float | None = None
    fps: float = 24.0
    at: float = 0.5
    vertical_fov_degrees: float = 75.0
    panorama_height: int | None = None

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
    renderer: Renderer,
    scene: Scene,
    folder: Path,
    film: Film,
    settings: DrawSettings,
    progress: Callable[[str, float], None],
) -> list[Path]:
    """Render film, stills and panorama into `folder`; returns the files, each written completely or not at all.

    Args:
        renderer: on any context; the scene is uploaded to it.
        scene: the scene.
        folder: created if it does not exist.
        film: sizes and times.
        settings: draw settings; the film's field of view and layout replace theirs.
        progress: called with the task and the fraction done.

    Raises:
        InputError: the folder cannot be written, or the scene is empty.
    """
    folder.mkdir(parents=True, exist_ok=True)
    renderer.upload(scene)
    settings = replace(settings, vertical_fov_degrees=film.vertical_fov_degrees, layout="pinhole", cached=False)
    num_frames = film.count_frames()
    steps = num_frames + len(STILLS) + 1
    written = []
    for done, fraction in enumerate(STILLS):
        progress("stills", done / steps)
        written.append(folder / f"view_{round(100 * fraction):03d}.png")
        write_image(written[-1], _render(renderer, compute_flight_pose(scene, fraction), film.size, settings))
    progress("panorama", len(STILLS) / steps)
    height = film.panorama_height or scene.height
    written.append(folder / f"panorama_{round(100 * film.at):03d}.png")
    equirect = replace(settings, layout="equirect")
    write_image(written[-1], _render(renderer, compute_panorama_pose(scene, film.at), (2 * height, height), equirect))

    def render_frames() -> Iterator[np.ndarray]:
        for frame in range(num_frames):
            progress("film", (len(STILLS) + 1 + frame) / steps)
            pose = compute_flight_pose(scene, frame / (num_frames - 1))
            yield (_render(renderer, pose, film.size, settings) * 255 + 0.5).astype(np.uint8)

    written.append(folder / "flythrough.mp4")
    write_video(written[-1], render_frames(), film.fps)
    progress("done", 1.0)
    return written


def write_tour(
    renderers: Sequence[Renderer],
    scenes: TourScenes,
    route: Route,
    load: Callable[[SceneEntry], LoadedScene],
    folder: Path,
    film: Film,
    settings: DrawSettings,
    progress: Callable[[str, float], None],
) -> list[Path]:
    """Write the film of a route through a tour (`tour.mp4`) and its floor plan (`floor_plan.png`); returns the files.

    Each scene is loaded when the camera reaches its edge, and fades in as in the window.

    Args:
        renderers: two; scenes are uploaded to them in turn.
        scenes: of the tour; loaded ones are kept within its memory.
        route: the flight.
        load: returns the scene of an entry.
        folder: created if it does not exist.
        film: size and times.
        settings: draw settings; the film's field of view and layout replace theirs.
        progress: called with the task and the fraction done.

    Raises:
        InputError: the folder cannot be written, or a scene cannot be loaded.
    """
    folder.mkdir(parents=True, exist_ok=True)
    settings = replace(
        settings,
        vertical_fov_degrees=film.vertical_fov_degrees,
        layout="pinhole",
        cached=False,
        near=NEAR_OF_FAR * scenes.tour.far,
    )
    num_frames, fade = film.count_frames(route), CrossFade()
    # A film that is shorter or longer than the route changes the speed of the camera and that of the fades.
    seconds_per_frame = route.seconds / num_frames

    def render_frames() -> Iterator[np.ndarray]:
        for frame in range(num_frames):
            fraction, now = frame / (num_frames - 1), frame * seconds_per_frame
            progress("film", frame / num_frames)
            pose = route.pose(fraction)
            scenes.move(pose[:3, 3], route, fraction)
            loaded = scenes.get(scenes.views)
            if loaded is None:
                loaded = load(scenes.make_entry(scenes.views))
                scenes.add(loaded)
            weight = fade.compute_weight(now)
            slot = fade.choose_slot(loaded.scene)
            if slot is not None:
                if fade.scenes[slot] is not loaded.scene:
                    renderers[slot].upload(loaded.scene)
                fade.show(slot, loaded.scene, now)
                weight = fade.compute_weight(now)
            image = 0.0
            for slot, part in ((fade.front, weight), (1 - fade.front, 1 - weight)):
                scene = fade.scenes[slot]
                if part > 0 and scene is not None:
                    image += part * _render(renderers[slot], pose, film.size, fit_settings(settings, scene))
            yield (np.asarray(image) * 255 + 0.5).astype(np.uint8)

    written = [folder / "tour.mp4"]
    write_video(written[0], render_frames(), film.fps)
    plan = draw_floor_plan(scenes.tour, list(scenes.outlines.values()), size=PLAN_SIZE)
    written.append(folder / "floor_plan.png")
    write_image(written[1], _draw_route(plan, scenes, route))
    progress("done", 1.0)
    return written


def _draw_route(plan: FloorPlan, scenes: TourScenes, route: Route) -> Float[np.ndarray, "height width 3"]:
    """The floor plan over dark grey, with the route and the panoramas."""
    import cv2

    alpha = plan.image[..., 3:] / 255.0
    image = np.ascontiguousarray((plan.image[..., :3] * alpha + 24 * (1 - alpha)).astype(np.uint8))
    axes = scenes.tour.level_axes[:, (0, 2)]
    line = plan.to_pixels(route.positions @ axes).round().astype(np.int32)
    cv2.polylines(image, [line], False, (255, 204, 51), 2, cv2.LINE_AA)
    for panorama, (x, y) in zip(scenes.tour.panoramas, plan.to_pixels(scenes.tour.positions @ axes), strict=True):
        cv2.circle(image, (round(x), round(y)), 6, (90, 204, 255), -1, cv2.LINE_AA)
        cv2.putText(image, panorama.name, (round(x) + 9, round(y) + 5), 0, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return image.astype(np.float32) / 255


def _render(
    renderer: Renderer, cam2world: Float[np.ndarray, "4 4"], size: tuple[int, int], settings: DrawSettings
) -> Float[np.ndarray, "height width 3"]:
    renderer.render(cam2world, size, settings, wait=True)
    return np.clip(renderer.read_color()[..., :3], 0.0, 1.0)
