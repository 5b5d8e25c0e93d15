"""What the image is compared with: the photographs of the scene, and an image that is pinned."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import moderngl
import numpy as np

from pansplat.errors import InputError
from pansplat.gaussians.scene import Scene
from pansplat_viewer.draw.stereo import WindowRenderer
from pansplat_viewer.scene.settings import DrawSettings
from pansplat_viewer.scene.slots import SceneSlot
from pansplat_viewer.scene.state import ViewerState, fit_settings
from pansplat_viewer.ui.photographs import Photographs
from pansplat_viewer.ui.presenter import RightSide


@dataclass(frozen=True, eq=False)
class PinnedImage:
    """A scene and the settings with which it is drawn right of the divider."""

    slot: SceneSlot  # the scene, with a renderer of its own
    settings: DrawSettings  # the field of view is the camera's
    name: str  # for the screen


class Comparer:
    """Photographs and the pinned image.

    Attributes:
        photographs: of the scene.
        pinned: the pinned image; None if there is none.
    """

    def __init__(
        self, ctx: moderngl.Context, create_renderer: Callable[[], WindowRenderer], show_error: Callable[[str], None]
    ) -> None:
        """Start without photographs.

        Args:
            ctx: the context.
            create_renderer: makes the renderer of the pinned image, at the first one.
            show_error: shows that a photograph cannot be read.
        """
        self.photographs = Photographs(ctx)
        self.pinned: PinnedImage | None = None
        self._create_renderer, self._show_error = create_renderer, show_error

    def choose_photograph(self, state: ViewerState) -> int | None:
        """The photograph that the user has chosen, else the nearest one; None if there is none."""
        if state.photograph is not None and state.photograph < len(self.photographs):
            return state.photograph
        return self.photographs.find_nearest(np.asarray(state.camera.position))

    def get_photograph(
        self, state: ViewerState, index: int | None = None, *, error: bool = False, split: float = 0.0
    ) -> RightSide | None:
        """A photograph, the chosen one by default, or the error against it; None while it is read, or without one."""
        index = self.choose_photograph(state) if index is None else index
        if index is None or index >= len(self.photographs):
            return None
        try:
            texture = self.photographs.get(index)
        except InputError as problem:
            self._show_error(str(problem))
            return None
        if texture is None:
            return None
        pose = self.photographs.pose(index)
        return RightSide("error" if error else "photograph", texture, pose, split, state.max_error)

    def get_right_side(
        self, state: ViewerState, draw: Callable[[SceneSlot, DrawSettings], moderngl.Texture | None]
    ) -> RightSide | None:
        """What the state's comparison shows; `draw` makes the image of a slot."""
        if state.comparison in ("photograph", "error"):
            return self.get_photograph(state, error=state.comparison == "error", split=state.split)
        if state.comparison == "off" or self.pinned is None:
            return None
        fov = state.camera.vertical_fov_degrees
        texture = draw(self.pinned.slot, replace(self.pinned.settings, vertical_fov_degrees=fov))
        return None if texture is None else RightSide("pinned", texture, split=state.split)

    def measure_distance(self, state: ViewerState) -> float:
        """Distance of the camera from that of the chosen photograph, metres; 0 if there is none."""
        index = self.choose_photograph(state)
        if index is None:
            return 0.0
        return float(np.linalg.norm(self.photographs.pose(index)[:3, 3] - np.asarray(state.camera.position)))

    def go_to_photograph(self, state: ViewerState) -> None:
        """Move to the camera of the chosen photograph, and keep the viewing direction."""
        index = self.choose_photograph(state)
        if index is not None:
            x, y, z = self.photographs.pose(index)[:3, 3].tolist()
            state.playing, state.camera = False, replace(state.camera, position=(x, y, z))

    def pin(self, scene: Scene, settings: DrawSettings, name: str) -> None:
        """Pin an image; raises the renderer's errors, and nothing is pinned then."""
        slot = SceneSlot(self._create_renderer()) if self.pinned is None else self.pinned.slot
        if slot.scene is not scene:
            slot.upload(scene)
        self.pinned = PinnedImage(slot, fit_settings(settings, scene), name)

    def describe(self, state: ViewerState) -> str | None:
        """The name of what is right of the divider; None if there is nothing."""
        if state.comparison == "pinned":
            return None if self.pinned is None else self.pinned.name
        index = None if state.comparison == "off" else self.choose_photograph(state)
        if index is None:
            return None
        name = self.photographs.names[index]
        return f"photograph {name}" if state.comparison == "photograph" else f"error against {name}"

    def release(self) -> None:
        """Free the GL objects and stop the threads."""
        self.photographs.release()
        if self.pinned is not None:
            self.pinned.slot.renderer.release()
