"""Files that `pansplat-view` writes without a window: films of ways, and of turns around scenes, with stills."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from pansplat.export.film import Film, FilmPhotographs, Shot, list_frames, plan_visits, write_film
from pansplat.gaussians.scene import Scene
from pansplat.images.image_files import write_image
from pansplat.tours.route import NEAR_OF_FAR, REST_SECONDS, plan_route
from pansplat.tours.walks import plan_walk
from pansplat_viewer.core import camera as cameras
from pansplat_viewer.core.loader import LoadedScene, SceneEntry, make_file_name
from pansplat_viewer.core.settings import DrawSettings
from pansplat_viewer.core.state import ViewerState, enter_scene, fit_settings
from pansplat_viewer.core.tour_scenes import TourScenes
from pansplat_viewer.draw.frame_renderer import FrameRenderer, render_image

FIELD_OF_VIEW = 75.0  # vertical field of view of films, degrees
_ORBIT_SECONDS, _ORBIT_STILLS = 4.0, 4  # duration of the film around a scene without cameras, and its stills


def orbit_scene(scene: Scene, fps: float, seconds: float | None) -> list[Shot]:
    """The frames of a turn around a scene without cameras."""
    state, height = ViewerState(), 1000
    enter_scene(state, scene)
    shots = []
    for fraction in np.linspace(0, 1, max(round((seconds or _ORBIT_SECONDS) * fps), 2)).tolist():
        camera = cameras.orbit(state.camera, (2 * height * fraction, 0.0), height)
        shots.append(Shot(camera.cam2world, FIELD_OF_VIEW, len(shots) / fps))
    return shots


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
    loaded: LoadedScene,
    scenes: TourScenes | None,
    folder: Path,
    fps: float,
    seconds: float | None,
    show_file: Callable[[Path], None],
) -> None:
    """Write the film of the way through a scene (`film.mp4`), and a still at each panorama before it (`01_NAME.png`).

    Around a scene without cameras, the film is a turn, with four stills.

    Args:
        film: of the scene or tour.
        loaded: the scene, or the first one of the tour.
        scenes: those of the tour; None for another scene.
        folder: created if it does not exist.
        fps, seconds: see `list_frames`.
        show_file: called with each file that is written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if scenes is None and loaded.facts is None:
        shots = orbit_scene(loaded.scene, fps, seconds)
        visits, names = {k: k / _ORBIT_STILLS for k in range(_ORBIT_STILLS)}, ["view"] * _ORBIT_STILLS
    else:
        if scenes is None:
            tour, route = loaded.facts.tour, plan_visits(loaded.facts)
        else:  # in its graph, walls and poor edges are known
            tour = scenes.tour
            route = plan_route(tour, plan_walk(tour), rest=REST_SECONDS, outlooks=scenes.outlooks)
        shots, visits = list_frames(route, fps, FIELD_OF_VIEW, seconds), route.visits
        names = [panorama.label for panorama in tour.panoramas]
    stills: dict[int, list[str]] = {}
    for node, at in visits.items():
        still = f"{node + 1:02d}_{make_file_name(names[node])}.png"
        stills.setdefault(math.ceil(at * (len(shots) - 1)), []).append(still)

    def show(number: int, color: np.ndarray) -> None:
        for name in stills.get(number, ()):
            write_image(folder / name, color)
            show_file(folder / name)

    write_film(folder / "film.mp4", film, shots, fps, show=show)
    show_file(folder / "film.mp4")
