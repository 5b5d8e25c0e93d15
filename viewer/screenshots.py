"""Screenshots that a user writes from the window."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from pansplat.images.image_files import write_image
from pansplat_viewer.draw.frame_renderer import render_image
from pansplat_viewer.scene.loader import LoadedScene
from pansplat_viewer.scene.state import ViewerState
from pansplat_viewer.ui.stage import DRAW_ERRORS, Stage, describe_error

PANORAMA_HEIGHT = 1024  # pixels


class Screenshots:
    """Writes files of what the stage shows.

    Attributes:
        files: written so far.
    """

    def __init__(self, state: ViewerState, stage: Stage, folder: Path, show_error: Callable[[str], None]) -> None:
        """Files are written to the subfolder of `folder` with the entry's name; `show_error` shows a message."""
        self._state, self._stage, self._folder, self._show_error = state, stage, folder, show_error
        self.files: list[Path] = []

    def write(self, loaded: LoadedScene, suffix: str, *, panorama: bool = False) -> None:
        """Write the image, or the panorama at the camera.

        The file is the first of `view_001.png`, `view_002.png`, ... (`panorama_001.png`, ...) that does not exist.

        Args:
            loaded: the scene.
            suffix: `png`, or `exr` with depth in metres.
            panorama: whether all directions are shown.
        """
        stage, settings = self._stage, self._state.draw_settings
        settings = replace(settings, layout="equirect" if panorama else "pinhole")
        size = (2 * PANORAMA_HEIGHT, PANORAMA_HEIGHT) if panorama else stage.size
        stage.slot.image = None  # the texture will hold the screenshot
        try:
            pose = self._state.camera.cam2world
            color, depth = render_image(stage.renderer, pose, size, settings, with_depth=suffix == "exr")
            depth = None if depth is None else loaded.scene.frame.unit * depth
            folder = self._folder / loaded.entry.folder_name
            folder.mkdir(parents=True, exist_ok=True)
            path = _find_free_name(folder, "panorama" if panorama else "view", suffix)
            write_image(path, color, depth=depth, panorama=panorama)
        except (*DRAW_ERRORS, OSError) as error:
            self._show_error(f"no screenshot written: {describe_error(error)}")
        else:
            self.files.append(path)
            self._state.show_message(f"wrote {path}")


def _find_free_name(folder: Path, stem: str, suffix: str) -> Path:
    number = 1
    while (path := folder / f"{stem}_{number:03d}.{suffix}").exists():
        number += 1
    return path
