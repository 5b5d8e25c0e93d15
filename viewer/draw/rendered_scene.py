"""A renderer with its scene and last image, and the conversion of scenes for renderers in a worker thread."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import moderngl
import numpy as np
from jaxtyping import Float

from pansplat.gaussians.scene import Scene
from pansplat_viewer.core.background import BackgroundWorker
from pansplat_viewer.core.settings import DrawSettings
from pansplat_viewer.draw.frame_renderer import FrameRenderer

_SMALL_SCENE = 100_000  # Gaussians; converted without a thread, because that takes less time than a frame
_LARGE_SCENE = 2_000_000  # Gaussians; the first image is not waited for, because it can take seconds


class RenderedScene:
    """A renderer, the scene that it draws, and its last image, which is drawn again only if something changed.

    Attributes:
        renderer: draws the scene.
        scene: None before the first upload.
        image: the last image; None if it has to be drawn again, or if the first one is not finished.
    """

    def __init__(self, renderer: FrameRenderer) -> None:
        """The slot is empty."""
        self.renderer = renderer
        self.scene: Scene | None = None
        self.image: moderngl.Texture | None = None
        self._key: tuple[object, ...] = ()
        self._waits = True  # for an image if there is none

    def upload(self, scene: Scene, prepared: Any = None) -> None:
        """Replace the scene, which may be `prepared`; raises the renderer's errors, and keeps the old scene then."""
        self.image = None
        self.renderer.upload(scene, prepared)
        self.scene = scene
        self._waits = len(scene.gaussians) <= _LARGE_SCENE

    def draw(
        self, cam2world: Float[np.ndarray, "4 4"], size: tuple[int, int], settings: DrawSettings, *, wait: bool
    ) -> float:
        """Make `image` that of a pose, size (width, height) and settings.

        The first image of a scene is waited for, unless the scene is large.

        Returns:
            Milliseconds; 0 if nothing was drawn, or the image is not finished.
        """
        key = (cam2world.tobytes(), size, settings)
        if self.image is not None and key == self._key and self.renderer.stats.settled:
            return 0.0
        self.image = self.renderer.render(cam2world, size, settings, wait=self._waits and (wait or self.image is None))
        self._waits = self._waits or self.image is not None
        self._key = key
        if not wait and not settings.cached and self.renderer.stats.settled:
            self.renderer.draw_faces(cam2world, size, settings)
        return self.renderer.stats.frame_ms


class ScenePreparer:
    """Converts scenes for a renderer in a worker thread, one at a time, so that a window stays responsive."""

    def __init__(self, prepare: Callable[[Scene, Callable[[float], None]], Any]) -> None:
        """`prepare` is that of the renderer."""
        self._prepare = prepare
        self._worker: BackgroundWorker[Any] = BackgroundWorker("scene-preparer")
        self._scene: Scene | None = None

    @property
    def progress(self) -> float | None:
        """Fraction of the conversion that is done; None if there is none."""
        future, progress = self._worker.future, self._worker.progress
        return None if future is None or progress is None or future.done() else progress[1]

    def is_ready(self, scene: Scene) -> bool:
        """Whether `take` returns at once; starts the conversion of a large scene, in place of that of another one."""
        if len(scene.gaussians) <= _SMALL_SCENE:
            return True
        if self._scene is not scene or self._worker.future is None:
            self._scene = scene
            self._worker.start(lambda report: self._prepare(scene, lambda done: report("", done)), "")
        assert self._worker.future is not None
        return self._worker.future.done()

    def take(self, scene: Scene) -> Any:
        """The converted scene, or its exception; None if it has not been converted."""
        future = self._worker.future
        if self._scene is not scene or future is None:
            return None
        self._scene = None
        try:
            return future.result()
        finally:
            self._worker.cancel()

    def stop(self) -> None:
        """End the conversion."""
        self._worker.cancel()

    def close(self) -> None:
        """End the conversion and wait for the thread."""
        self._worker.close()
