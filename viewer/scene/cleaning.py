"""The work of the section "Clean up": floaters, the file of a cleaned scene, and masks painted on photographs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float

from pansplat.data.blur_masks import name_blur_mask
from pansplat.data.images import read_hidden, write_image
from pansplat.data.pairs import Panorama
from pansplat.errors import InputError
from pansplat.gaussians.scene import Scene
from pansplat.geometry.equirect import directions_from_uv, pixel_directions
from pansplat_viewer.scene.background import BackgroundWorker, Report
from pansplat_viewer.scene.settings import DrawSettings

_ROWS = 512  # of a mask
_STEP = 0.5  # between the circles of a stroke, in brush radii
_STRAIGHT = 1.0  # pixels, of an outline


@dataclass(frozen=True, eq=False)
class Cleaned:
    """A result.

    Attributes:
        message: what was done.
        given: the scene before.
        scene: to show in its place; None if nothing has changed.
    """

    message: str
    given: Scene
    scene: Scene | None = None


class Cleaner:
    """Removes floaters and writes scenes in a worker thread."""

    def __init__(self) -> None:
        """The thread starts with the first work."""
        self._worker: BackgroundWorker[Cleaned] = BackgroundWorker("scene-cleaner")

    @property
    def progress(self) -> tuple[str, float] | None:
        """Description of the work and the fraction done; None if there is none."""
        return self._worker.progress

    def remove_floaters(self, scene: Scene) -> None:
        """Start to remove the floaters of a scene."""
        from pansplat.cleanup import Cleaning, clean_up

        def work(report: Report) -> Cleaned:
            cleaned, (change,) = clean_up(scene, Cleaning(floaters=False), progress=report)
            return Cleaned(str(change), scene, cleaned if change.after < change.before else None)

        self._worker.start(work, "looking for floaters")

    def save(self, scene: Scene, settings: DrawSettings, path: Path) -> None:
        """Start to write a scene without what the box and the least opacity of the settings hide."""
        from pansplat.cleanup import Cleaning, clean_up
        from pansplat.gaussians.formats import save_scene

        def work(report: Report) -> Cleaned:
            cleaning = Cleaning(box=settings.box, min_opacity=settings.opacity_threshold)
            cleaned, changes = clean_up(scene, cleaning, progress=report)
            save_scene(cleaned, path)
            lines = [str(change) for change in changes]
            return Cleaned("\n".join([*lines, f"wrote {path}: {len(cleaned.gaussians):,} Gaussians"]), scene)

        self._worker.start(work, f"writing {path.name}")

    def poll(self) -> Cleaned | BaseException | None:
        """The result or the exception of work that is finished, once; None before."""
        return self._worker.poll()

    def cancel(self) -> None:
        """End the work."""
        self._worker.cancel()

    def close(self) -> None:
        """End the work and wait for the thread."""
        self._worker.close()


def measure_bounds(scene: Scene) -> tuple[float, ...]:
    """The box of the finite centres of a scene's Gaussians: x, y, z of its least and of its greatest corner, metres."""
    means = scene.gaussians.means
    means = means[torch.isfinite(means).all(dim=1)]
    if not len(means):
        return (-1.0, -1.0, -1.0, 1.0, 1.0, 1.0)
    return tuple(torch.cat((means.amin(dim=0), means.amax(dim=0))).double().tolist())


class MaskPainter:
    """The blur mask of one photograph while it is painted.

    Attributes:
        hidden: what it hides.
        is_changed: whether it differs from its file.
    """

    def __init__(self, panorama: Panorama) -> None:
        """Start with the mask of the photograph, if it has one; raises an InputError if that cannot be used."""
        self.panorama = panorama
        self.hidden: Bool[np.ndarray, "height width"] = read_hidden(panorama.image, _ROWS)
        self.is_changed = False
        self.move(panorama)
        self._last: Float[np.ndarray, "3"] | None = None  # of the stroke
        self._rays = pixel_directions(_ROWS, 2 * _ROWS).numpy()

    def move(self, panorama: Panorama) -> None:
        """Go on with the same photograph, which was loaded again."""
        self.panorama = panorama
        self._rotation = panorama.cam2world[:3, :3].double().numpy()

    def paint(self, direction: Float[np.ndarray, "3"], radius: float, *, erase: bool = False) -> None:
        """Continue a stroke to a direction.

        Args:
            direction: unit, world axes.
            radius: of the brush, radians.
            erase: show again what is below the brush.
        """
        local = self._rotation.T @ direction
        start = local if self._last is None else self._last
        steps = int(np.ceil(np.arccos(np.clip(start @ local, -1, 1)) / (_STEP * radius)))
        for step in range(steps + 1):
            center = start + (local - start) * (step / max(steps, 1))
            center /= max(float(np.linalg.norm(center)), 1e-9)
            self.hidden[self._rays @ center.astype(np.float32) > np.cos(radius)] = not erase
        self._last, self.is_changed = local, True

    def lift(self) -> None:
        """End the stroke."""
        self._last = None

    def clear(self) -> None:
        """Show all of the photograph."""
        self.is_changed |= bool(self.hidden.any())
        self.hidden[:] = False

    def list_outlines(self) -> list[Float[np.ndarray, "point 3"]]:
        """The borders of what is hidden, as unit directions in world axes."""
        outlines, _ = cv2.findContours(self.hidden.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
        found = []
        for outline in outlines:
            corners = cv2.approxPolyDP(outline, _STRAIGHT, True)[:, 0].astype(np.float64)
            uv = torch.from_numpy((corners + 0.5) / (2 * _ROWS, _ROWS))
            found.append(directions_from_uv(uv).numpy() @ self._rotation.T)
        return found

    def save(self) -> Path:
        """Write the mask beside its photograph, and return its file.

        Raises:
            InputError: it cannot be written, or hides all.
        """
        path = name_blur_mask(self.panorama.image)
        if self.hidden.all():
            raise InputError(f"{path}: needed a part of the photograph that is shown, got a mask of all of it; erase")
        white = np.where(self.hidden[..., None], np.uint8(255), np.uint8(0)).repeat(3, axis=2)
        write_image(path, white, panorama=False)
        self.is_changed = False
        return path
