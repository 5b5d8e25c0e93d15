"""Files that the viewer writes: numbered screenshots, and the fly-through (film, stills and a panorama)."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pansplat.data.images import write_image
from pansplat.data.video import write_video
from pansplat.gaussians.scene import Scene
from pansplat.geometry.path import fly_pose, path_poses
from pansplat.geometry.pose import interpolate_poses
from pansplat_viewer import camera as cameras
from pansplat_viewer.cpu_renderer import Renderer
from pansplat_viewer.settings import DrawSettings
from pansplat_viewer.state import ViewerState, enter_scene

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
        seconds: length of the film.
        fps: frames per second.
        at: fraction of the flight at which the panorama is rendered.
        vertical_fov_degrees: of film and stills.
        panorama_height: pixels; None is the height that the scene was predicted at.
    """

    size: tuple[int, int] = (1280, 720)
    seconds: float = 4.0
    fps: float = 24.0
    at: float = 0.5
    vertical_fov_degrees: float = 75.0
    panorama_height: int | None = None

    @property
    def num_frames(self) -> int:
        """Number of frames of the film."""
        return max(round(self.seconds * self.fps), 2)


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
    steps = film.num_frames + len(STILLS) + 1
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
        for frame in range(film.num_frames):
            progress("film", (len(STILLS) + 1 + frame) / steps)
            pose = compute_flight_pose(scene, frame / (film.num_frames - 1))
            yield (_render(renderer, pose, film.size, settings) * 255 + 0.5).astype(np.uint8)

    written.append(folder / "flythrough.mp4")
    write_video(written[-1], render_frames(), film.fps)
    progress("done", 1.0)
    return written


def _render(
    renderer: Renderer, cam2world: Float[np.ndarray, "4 4"], size: tuple[int, int], settings: DrawSettings
) -> Float[np.ndarray, "height width 3"]:
    renderer.render(cam2world, size, settings, wait=True)
    return np.clip(renderer.read_color()[..., :3], 0.0, 1.0)
