"""Files that `pansplat-view` writes without a window: films of ways, and of turns around scenes, with stills."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from pansplat.export.film import Film, FilmPhotographs, Shot, choose_scenes, list_frames, plan_visits, write_film
from pansplat.gaussians.scene import Scene
from pansplat.images.image_files import write_image
from pansplat.inputs.panorama_sets import PanoramaSet
from pansplat.tours.facts import TourFacts
from pansplat.tours.graph import TourGraph
from pansplat.tours.route import NEAR_OF_FAR
from pansplat_viewer.core import camera as cameras
from pansplat_viewer.core.loader import make_file_name
from pansplat_viewer.core.settings import DrawSettings
from pansplat_viewer.core.state import ViewerState, enter_scene, fit_settings
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
    scene: Scene,
    source: PanoramaSet | TourGraph | None,
    size: tuple[int, int],
    settings: DrawSettings,
) -> Iterator[Film]:
    """A film of a scene, or of a tour whose scenes fade into each other.

    Args:
        create_renderer: called for one or two renderers, which are released at the end.
        scene: of all panoramas.
        source: its photographs, if they are shown.
        size: (width, height), pixels.
        settings: draw settings.
    """
    photographs = None if source is None else FilmPhotographs.open(source, scene)
    if scene.tour is not None:
        settings = replace(settings, near=NEAR_OF_FAR * scene.far)
    renderers = [create_renderer() for _ in range(1 if scene.tour is None else 2)]
    uploaded: list[Scene | None] = [None, None]

    def draw(slot: int, shown: Scene, shot: Shot) -> np.ndarray:
        if uploaded[slot] is not shown:
            renderers[slot].upload(shown)
            uploaded[slot] = shown
        fitted = replace(fit_settings(settings, shown), vertical_fov_degrees=shot.vertical_fov_degrees)
        return render_image(renderers[slot], shot.pose, size, fitted)[0]

    try:
        yield Film(choose_scenes(scene), draw, "pinhole", (size[1], size[0]), photographs)
    finally:
        for renderer in renderers:
            renderer.release()


def write_flight(
    film: Film, facts: TourFacts, folder: Path, fps: float, seconds: float | None, show_file: Callable[[Path], None]
) -> None:
    """Write the film of the way through a scene (`film.mp4`), and a still at each panorama before it (`01_NAME.png`).

    Around a scene without cameras, the film is a turn, with four stills.

    Args:
        film: of the scene.
        facts: of the scene.
        folder: created if it does not exist.
        fps, seconds: see `list_frames`.
        show_file: called with each file that is written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if not len(facts.scene.cam2world):
        shots = orbit_scene(facts.scene, fps, seconds)
        visits, names = {k: k / _ORBIT_STILLS for k in range(_ORBIT_STILLS)}, ["view"] * _ORBIT_STILLS
    else:
        route = plan_visits(facts)
        shots, visits = list_frames(route, fps, FIELD_OF_VIEW, seconds), route.visits
        names = [panorama.label for panorama in facts.tour.panoramas]
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
