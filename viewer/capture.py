"""Files that `pansplat-view` writes without a window: films of flights and of camera paths, with stills."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pansplat import pipeline
from pansplat.export.film import Film, FilmPhotographs, Shot, list_flight, write_film
from pansplat.gaussians.scene import Scene
from pansplat.geometry.path import fly_pose
from pansplat.images.image_files import write_image
from pansplat.tours.route import NEAR_OF_FAR, REST_SECONDS, plan_route
from pansplat.tours.walks import plan_walk
from pansplat_viewer.draw.frame_renderer import FrameRenderer, render_image
from pansplat_viewer.scene import camera as cameras
from pansplat_viewer.scene.loader import LoadedScene, SceneEntry, make_file_name
from pansplat_viewer.scene.settings import DrawSettings
from pansplat_viewer.scene.state import ViewerState, enter_scene, fit_settings
from pansplat_viewer.scene.tour import TourScenes

FIELD_OF_VIEW = 75.0  # of flights, vertical, degrees
STILLS = (0.0, 0.25, 0.5, 0.75, 1.0)  # fractions of the flight


def compute_flight_pose(scene: Scene, fraction: float) -> Float[np.ndarray, "4 4"]:
    """Return the pose at a fraction of the scene's flight; a scene without cameras is orbited once."""
    if len(scene.cam2world):
        return fly_pose(scene.cam2world, fraction).numpy()
    state = ViewerState()
    enter_scene(state, scene)
    height = 1000
    return cameras.orbit(state.camera, (2 * height * fraction, 0.0), height).cam2world


@contextlib.contextmanager
def open_film(
    create_renderer: Callable[[], FrameRenderer],
    loaded: LoadedScene,
    scenes: TourScenes | None,
    load: Callable[[SceneEntry], LoadedScene],
    size: tuple[int, int],
    settings: DrawSettings,
) -> Iterator[Film]:
    """A film of a scene, or of a tour whose scenes are loaded when the camera needs them.

    Args:
        create_renderer: called for one or two renderers, which are released at the end.
        loaded: the scene, or the first one of the tour.
        scenes: of the tour; None for another scene.
        load: returns the scene of an entry.
        size: (width, height), pixels.
        settings: draw settings.
    """
    entry, photographs = loaded.entry, None
    source = entry.tour or entry.pair
    if source is not None and entry.merged is None and settings.shows_scene:
        photographs = FilmPhotographs.open(source, loaded.scene)
    if scenes is not None:
        settings = replace(settings, near=NEAR_OF_FAR * scenes.tour.far)
    renderers = [create_renderer() for _ in range(1 if scenes is None else 2)]
    uploaded: list[Scene | None] = [None, None]

    def draw(slot: int, scene: Scene, shot: Shot) -> np.ndarray:
        if uploaded[slot] is not scene:
            renderers[slot].upload(scene)
            uploaded[slot] = scene
        fitted = replace(fit_settings(settings, scene), vertical_fov_degrees=shot.vertical_fov_degrees)
        return render_image(renderers[slot], shot.pose, size, fitted)[0]

    def choose(shot: Shot) -> tuple[Scene, int]:
        assert scenes is not None
        scenes.move(shot.pose[:3, 3], shot.edge)
        if scenes.get(scenes.views) is None:
            for views in scenes.missing:
                scenes.add(load(scenes.make_entry(views)))
        shown = scenes.get(scenes.views)
        assert shown is not None
        return shown.scene, scenes.part

    chosen = choose if scenes is not None else lambda shot: (loaded.scene, 0)
    try:
        yield Film(chosen, draw, "pinhole", (size[1], size[0]), photographs)
    finally:
        for renderer in renderers:
            renderer.release()


def write_flight(
    film: Film,
    scene: Scene,
    scenes: TourScenes | None,
    folder: Path,
    fps: float,
    seconds: float | None,
    at: float,
    settings: DrawSettings,
    show_file: Callable[[Path], None],
) -> None:
    """Write the film of a flight, and frames of it as stills before the film is complete.

    For a scene these are `flythrough.mp4`, `view_000.png` and so on, and a panorama; for a tour `tour.mp4` and a still
    at each panorama (`01_NAME.png`).

    Args:
        film: of the scene or tour.
        scene: the scene, or the first one of the tour.
        scenes: of the tour; None for another scene.
        folder: created if it does not exist.
        fps, seconds: see `list_flight`.
        at: fraction of the flight at which the panorama is rendered.
        settings: draw settings, whose mode the panorama has.
        show_file: called with each file that is written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    stills: dict[int, list[str]] = {}
    if scenes is None:
        shots = list_flight(partial(compute_flight_pose, scene), fps, FIELD_OF_VIEW, seconds)
        for still in STILLS:
            stills.setdefault(round(still * (len(shots) - 1)), []).append(f"view_{round(100 * still):03d}.png")
    else:
        tour, route = scenes.tour, plan_route(scenes.tour, plan_walk(scenes.tour), rest=REST_SECONDS)
        shots = list_flight(route, fps, FIELD_OF_VIEW, seconds)
        for node, at in route.visits.items():
            still = f"{node + 1:02d}_{make_file_name(tour.panoramas[node].label)}.png"
            stills.setdefault(math.ceil(at * (len(shots) - 1)), []).append(still)

    def show(number: int, color: np.ndarray) -> None:
        for name in stills.get(number, ()):
            write_image(folder / name, color)
            show_file(folder / name)

    name = "flythrough.mp4" if scenes is None else "tour.mp4"
    write_film(folder / name, film, shots, fps, show=show)
    show_file(folder / name)
    if scenes is None:
        file = folder / f"panorama_{round(100 * at):03d}.png"
        write_image(file, pipeline.render(scene, compute_flight_pose(scene, at), blend=settings.mode).color)
        show_file(file)
