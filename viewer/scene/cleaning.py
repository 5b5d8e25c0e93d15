"""The work of the section "Clean up": floaters, the file of a cleaned scene, and masks painted on photographs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float

from pansplat.errors import InputError
from pansplat.gaussians.scene import Scene
from pansplat.geometry.equirect import directions_from_uv, pixel_directions
from pansplat.images.blur_masks import name_blur_mask
from pansplat.images.image_files import read_hidden, write_image
from pansplat.inputs.pairs import Panorama
from pansplat_viewer.scene.background import Report
from pansplat_viewer.scene.picking import compute_pixel_ray
from pansplat_viewer.scene.settings import DrawSettings
from pansplat_viewer.scene.state import ViewerState

if TYPE_CHECKING:
    from pansplat_viewer.window.input import Input

MaskAnswer = Literal["save", "drop", "keep"]

CLEANING_JOB = "cleaning"

_ROWS = 512  # of a mask
_STEP = 0.5  # between the circles of a stroke, in brush radii
_STRAIGHT = 1.0  # pixels, of an outline


def remove_floaters(scene: Scene, report: Report) -> tuple[Scene | None, str]:
    """The scene without floaters, None if there are none; and what was done."""
    from pansplat.export.cleanup import Cleaning, clean_up

    cleaned, (change,) = clean_up(scene, Cleaning(floaters=False), progress=report)
    return cleaned if change.after < change.before else None, str(change)


def save_cleaned(scene: Scene, settings: DrawSettings, path: Path, report: Report) -> str:
    """Write a scene without what the box and the least opacity of the settings hide; returns what was done."""
    from pansplat.export.cleanup import Cleaning, clean_up
    from pansplat.gaussians.formats import save_scene

    cleaning = Cleaning(box=settings.box, min_opacity=settings.opacity_threshold)
    cleaned, changes = clean_up(scene, cleaning, progress=report)
    save_scene(cleaned, path)
    return "\n".join([*map(str, changes), f"wrote {path}: {len(cleaned.gaussians):,} Gaussians"])


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
        """End the stroke of the brush."""
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
        """Write the mask beside its photograph, and return its file."""
        path = name_blur_mask(self.panorama.image)
        if self.hidden.all():
            raise InputError(f"{path}: needed a part of the photograph that is shown, got a mask of all of it; erase")
        white = np.where(self.hidden[..., None], np.uint8(255), np.uint8(0)).repeat(3, axis=2)
        write_image(path, white, panorama=False)
        self.is_changed = False
        return path


class Painting:
    """The mask that is painted on a photograph, and the question before one that is not saved is dropped.

    Attributes:
        painter: the mask; None if none is painted.
    """

    def __init__(self, state: ViewerState, show_error: Callable[[str], None]) -> None:
        """No mask is painted; `show_error` shows a message."""
        self._state, self._show_error = state, show_error
        self.painter: MaskPainter | None = None
        self._held: tuple[Callable[[], None], bool, Callable[[], None]] | None = None  # arguments of `leave`

    @property
    def question(self) -> str | None:
        """The photograph of a mask whose end waits for an answer; None without a question."""
        return None if self._held is None or self.painter is None else self.painter.panorama.label

    def start(self, panoramas: Sequence[Panorama], index: int) -> None:
        """Paint on a photograph, which fills the window."""
        try:
            self.painter = MaskPainter(panoramas[index])
        except InputError as error:
            self._show_error(str(error))
            return
        state = self._state
        state.playing = state.path_playing = False
        state.photograph, state.comparison, state.split = index, "photograph", 0.0
        state.settings = replace(state.settings, stereo="mono")

    def stop(self) -> None:
        """Paint no longer; what is not saved is lost."""
        self._held = None
        if self.painter is not None:
            self.painter, state = None, self._state
            state.photograph, state.comparison, state.split = None, "off", ViewerState().split

    def follow(self, panoramas: Sequence[Panorama]) -> int | None:
        """Go on with the photograph if it is among these, which may have been loaded again; returns its place."""
        image = None if self.painter is None else self.painter.panorama.image
        found = next((index for index, view in enumerate(panoramas) if view.image == image), None)
        if found is not None and self.painter is not None:
            self.painter.move(panoramas[found])
        return found

    def apply(self, events: Input, size: tuple[int, int]) -> Input:
        """Paint with the left button, and return the other input: the right button looks around."""
        if self.painter is None:
            return events
        if events.pointer is None:
            self.painter.lift()
        else:
            pixel = events.pointer[0] * size[0], events.pointer[1] * size[1]
            direction = compute_pixel_ray(self._state.camera, pixel, size)[1]
            radius = math.radians(self._state.brush_degrees)
            self.painter.paint(direction, radius, erase="shift" in events.held)
        if "escape" in events.pressed:
            self.leave(self.stop)
        pressed = events.pressed - {"escape"}
        return replace(events, pressed=pressed, drag=events.pan, pan=(0.0, 0.0), click=None, pointer=None)

    def leave(
        self, action: Callable[[], None], *, after_saving: bool = True, otherwise: Callable[[], None] = lambda: None
    ) -> None:
        """Do what drops the mask, or writes a scene without it; if the mask is not saved, ask first.

        The action is done after the answer to drop the mask, or with `after_saving` to save it; else `otherwise` is.
        """
        if self.painter is not None and self.painter.is_changed:
            self._held = action, after_saving, otherwise
        else:
            action()

    def answer(self, answer: MaskAnswer) -> None:
        """Answer the question about an unsaved mask."""
        if self._held is None:
            return
        (action, after_saving, otherwise), self._held = self._held, None
        if answer == "drop":
            self.stop()
        is_saved = answer == "save" and self.save()
        (action if answer == "drop" or (is_saved and after_saving) else otherwise)()

    def save(self) -> bool:
        """Write the mask; returns whether that was possible."""
        assert self.painter is not None
        try:
            self._state.show_message(f"wrote {self.painter.save()}; Reload predicts the scene again")
        except (InputError, OSError) as error:
            self._show_error(str(error))
        return not self.painter.is_changed
