"""A cross-fade between two pictures (scenes or photographs)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pansplat.gaussians.scene import Scene
from pansplat.tours.route import FADE_SECONDS, ease


class CrossFade:
    """Two slots for what is shown: one is, and the other one fades out for `FADE_SECONDS` after an exchange.

    The content of a slot is a scene or a photograph, by its number. That of another part of a tour than the camera's is
    drawn from the last pose in its part.

    Attributes:
        front: slot of what is shown.
        contents: of both slots; None before the first one.
        parts: of the tour, of both contents.
        poses: from which they are drawn; None before the first one.
    """

    def __init__(self) -> None:
        """Both slots are empty."""
        self.front = 0
        self.contents: list[Scene | int | None] = [None, None]
        self.poses: list[Float[np.ndarray, "4 4"] | None] = [None, None]
        self.parts = [0, 0]
        self._start = -1e9
        self._fading = False

    def choose_slot(self, content: Scene | int) -> int | None:
        """The slot for a content; None while the other one is fading out, or if it is shown already."""
        shown = self.contents[self.front]
        if self._fading or shown is content or (isinstance(content, int) and shown == content):
            return None
        return self.front if shown is None else 1 - self.front

    def show(self, slot: int, content: Scene | int, now: float, part: int = 0, *, at_once: bool = False) -> None:
        """Show what is ready in a slot; at time `now` (seconds) the other one starts to fade out, if not `at_once`."""
        self._fading = not at_once and (self.contents[slot] is not None or slot != self.front)
        self.contents[slot], self.front, self._start = content, slot, now
        self.poses[slot], self.parts[slot] = None, part

    def move(self, pose: Float[np.ndarray, "4 4"], part: int = 0) -> None:
        """Draw the contents of a part from this pose."""
        for slot in range(2):
            if self.parts[slot] == part or self.poses[slot] is None:
                self.poses[slot] = pose

    def compute_weight(self, now: float) -> float:
        """Weight of what is shown, 0 to 1; that of the other slot is the rest."""
        done = (now - self._start) / FADE_SECONDS
        self._fading = self._fading and done < 1
        return ease(done) if self._fading else 1.0

    def clear(self) -> None:
        """Forget both; the first slot is the front."""
        self.front, self.contents, self.poses, self._fading = 0, [None, None], [None, None], False
