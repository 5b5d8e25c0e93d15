"""The resolution of each frame: full when the camera stands still, within a time budget when it moves."""

from dataclasses import dataclass

# Sides of a drawn image over those of the window; few, because a new size allocates new textures.
SCALES = (1.0, 0.75, 0.5, 0.35, 0.25)
BUDGET_MS = 50.0  # longest time of a frame while the camera moves: 20 frames a second are still smooth
SETTLE_AFTER = 0.2  # time from the last movement to the image at full resolution, seconds


@dataclass(frozen=True)
class ResolutionPlan:
    """How one frame is rendered."""

    scale: float  # rendered pixels over screen pixels, along each side
    cached: bool  # whether the image is read from cube faces that are kept for this position
    moving: bool = False  # whether the camera has just moved or turned


@dataclass
class AdaptiveResolution:
    """Chooses the resolution of each frame: full when the camera stands still, within a time budget when it moves."""

    budget_ms: float = BUDGET_MS  # time of a frame while the camera moves
    step: int = 0  # index into SCALES of the scale while the camera moves
    full_ms: float = 0.0  # time of the last frame at full resolution
    last_motion: float = -1e9  # time of the last movement, seconds
    translated: bool = False  # whether the last movement changed the position
    settle_after: float = SETTLE_AFTER  # seconds after the last movement until the resolution is full
    turn_ms: float = BUDGET_MS  # time of a frame at full resolution above which turns read cached faces
    num_scales: int = len(SCALES)  # how many of SCALES may be used, from the largest on

    def plan(self, now: float, *, moved: bool, turned: bool) -> ResolutionPlan:
        """Return the plan of the frame at time `now` (seconds) after the camera moved, turned or did neither."""
        if moved or turned:
            self.last_motion, self.translated = now, moved
        self.step = min(self.step, self.num_scales - 1)
        moving = now - self.last_motion < self.settle_after
        if not moving:
            return ResolutionPlan(1.0, cached=False, moving=moving)
        slow = self.full_ms > min(self.turn_ms, self.budget_ms)
        return ResolutionPlan(SCALES[self.step], cached=slow and not self.translated, moving=True)

    def limit(self, size: tuple[int, int], min_size: tuple[int, int]) -> None:
        """Use no scale that makes an image of `size` smaller than `min_size`, pixels."""
        fits = [scale for scale in SCALES if all(a * scale >= b for a, b in zip(size, min_size, strict=True))]
        self.num_scales = max(len(fits), 1)

    def record(self, plan: ResolutionPlan, frame_ms: float) -> None:
        """Record the time of a frame and adjust the scale; frames from cached faces are ignored."""
        if plan.cached:
            return
        if plan.scale == 1.0:
            self.full_ms = frame_ms
        if frame_ms > 1.2 * self.budget_ms and plan.scale == SCALES[self.step]:
            self.step = min(self.step + 1, self.num_scales - 1)
        elif self.step > 0 and plan.scale == SCALES[self.step]:
            # A finer scale only if the next one is expected to fit the budget, else the resolution would oscillate.
            growth = (SCALES[self.step - 1] / SCALES[self.step]) ** 2
            if frame_ms * growth < 0.9 * self.budget_ms:
                self.step -= 1
