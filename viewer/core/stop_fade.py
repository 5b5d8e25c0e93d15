"""How the photograph fades over the scene where the camera stands at a panorama, and over another one in a zoom."""

from __future__ import annotations

from pansplat.tours.route import STOP_SECONDS, Moment

_LARGEST_STEP = 1 / 3  # largest part of the fade in a frame, also after a pause without frames


class StopFade:
    """The photograph of the panorama at which the camera stands; it fades in and out for `STOP_SECONDS`.

    Attributes:
        index: number of the photograph; None if none is shown.
        before: of a zoom, the photograph that it begins with; else None.
        weight: of the photograph over that one or the scene, 0 to 1.
    """

    def __init__(self) -> None:
        """No photograph is shown."""
        self.index: int | None = None
        self.before: int | None = None
        self.weight = 0.0
        self._last = 0.0

    @property
    def is_whole(self) -> bool:
        """Whether nothing is seen of the scene."""
        return self.weight >= 1 or self.before is not None

    def follow(self, moment: Moment, now: float) -> None:
        """Show what a route shows at time `now` (seconds)."""
        self._last, self.before, self.index, self.weight = now, None, moment.photograph, moment.weight
        if moment.arrival is not None:
            self.before, self.index, self.weight = self.index, moment.step.nodes[1], moment.arrived

    def update(self, index: int | None, now: float, *, at_once: bool = False) -> None:
        """Go on to time `now`, while the camera stands at a panorama, or at none.

        With `at_once` its photograph is shown already and does not fade in.
        """
        step = min(max(now - self._last, 0.0) / STOP_SECONDS, _LARGEST_STEP)
        at_once = at_once or self.before is not None  # a zoom has shown it
        self._last, self.before = now, None
        if self.weight <= 0 or at_once:
            self.index = index
        is_here = index is not None and index == self.index
        self.weight = 1.0 if is_here and at_once else min(max(self.weight + (step if is_here else -step), 0.0), 1.0)
