"""Screenshots and films that a user writes from the window.

`pansplat_viewer.capture` is imported when one is written, because with all that films need it takes .4 s.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pansplat_viewer.draw.cpu_renderer import CpuRenderer
from pansplat_viewer.draw.stereo import choose_format, render_image
from pansplat_viewer.scene.background import Jobs, Report
from pansplat_viewer.scene.loader import LoadedScene, SceneEntry, SceneLoader
from pansplat_viewer.scene.state import ViewerState
from pansplat_viewer.scene.tour import TourScenes
from pansplat_viewer.ui.stage import DRAW_ERRORS, Stage, describe_error

PANORAMA_HEIGHT = 1024  # of a panorama screenshot, pixels
FILM_JOB = "film"


class Recorder:
    """Writes files of what the stage shows.

    Attributes:
        files: written so far.
    """

    def __init__(
        self, state: ViewerState, stage: Stage, jobs: Jobs, folder: Path, show_error: Callable[[str], None]
    ) -> None:
        """Files are written to the subfolder of `folder` with the entry's name; `show_error` shows a message."""
        self._state, self._stage, self._jobs, self._folder = state, stage, jobs, folder
        self._show_error = show_error
        self.files: list[Path] = []

    def write_screenshot(self, loaded: LoadedScene, suffix: str, *, panorama: bool = False) -> None:
        """Write the image, or the panorama at the camera; in stereo of both eyes, in a panorama the left one above.

        Args:
            loaded: the scene.
            suffix: `png`, or `exr` with depth in metres.
            panorama: whether all directions are shown.
        """
        from pansplat_viewer.capture import write_screenshot

        stage, settings = self._stage, self._state.draw_settings
        image_format = choose_format("equirect" if panorama else "perspective", settings)
        size = (2 * PANORAMA_HEIGHT, PANORAMA_HEIGHT) if panorama else stage.eye_size
        on_processor = CpuRenderer(None) if image_format.is_omnidirectional else None
        stage.slot.image = None  # the texture will hold the screenshot
        try:
            image_format.check(size, settings.preset)
            if on_processor is not None and stage.slot.scene is not None:
                on_processor.upload(stage.slot.scene)
            renderer, pose = on_processor or stage.renderer, self._state.camera.cam2world
            color, depth = render_image(renderer, pose, size, settings, image_format, with_depth=suffix == "exr")
            depth = None if depth is None else loaded.scene.frame.unit * depth
            folder = self._folder / loaded.entry.folder_name
            self._report([write_screenshot(folder, suffix, color, depth, panorama=panorama)])
        except (*DRAW_ERRORS, OSError) as error:
            self._show_error(f"no screenshot written: {describe_error(error)}")
        finally:
            if on_processor is not None:
                on_processor.release()

    def _report(self, files: list[Path]) -> None:
        self.files += files
        self._state.show_message(f"wrote {files[-1]}")

    def start_film(self, loaded: LoadedScene, tour: TourScenes | None, loader: SceneLoader) -> None:
        """Write the film of the path in a worker thread, drawn on the processor, so that the window stays free."""
        from pansplat_viewer.capture import find_free_name, open_frames, write_path_film

        state, scene, settings = self._state, self._stage.slot.scene, self._state.draw_settings
        path, level, fps, scenes = state.path, state.camera, state.film_fps, None if tour is None else tour.copy()
        image_format = choose_format(state.film_projection, settings)
        size = self._stage.size if state.film_projection == "perspective" else image_format.default_size
        image_format.check(size, settings.preset)
        assert scene is not None
        folder = self._folder / loaded.entry.folder_name
        folder.mkdir(parents=True, exist_ok=True)
        file = find_free_name(folder, "path", state.film_suffix)

        def write(progress: Report) -> list[Path]:
            def load(entry: SceneEntry) -> LoadedScene:  # a film that is cancelled does not wait for a prediction
                return loader.load(entry, lambda task, done: progress())

            with open_frames(
                lambda: CpuRenderer(None), scene, loaded.entry, scenes, load, size, settings, image_format
            ) as frames:
                return write_path_film(frames, path, level, file, fps, progress)

        self._jobs.start(FILM_JOB, write, self._report, failure="no film written: ")
