"""What the image is compared with: the photographs of the scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import moderngl
import numpy as np

from pansplat.errors import InputError
from pansplat_viewer.scene.state import ViewerState
from pansplat_viewer.ui.photographs import Photographs
from pansplat_viewer.ui.presenter import RightSide


class Comparer:
    """Chooses the photograph that is shown.

    Attributes:
        photographs: of the scene.
    """

    def __init__(self, ctx: moderngl.Context, show_error: Callable[[str], None]) -> None:
        """Start without photographs; `show_error` shows that one cannot be read."""
        self.photographs, self._show_error = Photographs(ctx), show_error

    def choose_photograph(self, state: ViewerState) -> int | None:
        """The photograph that the user has chosen, else the nearest one; None if there is none."""
        if state.photograph is not None and state.photograph < len(self.photographs):
            return state.photograph
        return self.photographs.find_nearest(np.asarray(state.camera.position))

    def get_photograph(self, state: ViewerState, index: int | None = None, *, split: float = 0.0) -> RightSide | None:
        """A photograph, the chosen one by default, right of a divider; None while it is read, or without one."""
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
        return RightSide(texture, self.photographs.pose(index), split)

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

    def describe(self, state: ViewerState) -> str | None:
        """The name of what is right of the divider; None if there is nothing."""
        index = self.choose_photograph(state) if state.comparing else None
        return None if index is None else f"photograph {self.photographs.names[index]}"

    def release(self) -> None:
        """Free the GL objects and stop the threads."""
        self.photographs.release()
