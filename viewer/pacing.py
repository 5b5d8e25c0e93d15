"""How finely to draw: full resolution when still, as coarse as the time allows while moving."""

from dataclasses import dataclass

SCALES = (1.0, 0.75, 0.5, 0.35, 0.25)  # few, because a new size means new GL targets
BUDGET_MS = 50.0
REFINE_AFTER = 0.2  # seconds of stillness


@dataclass(frozen=True)
class Plan:
    """One frame's drawing.

    Attributes:
        scale: of the window's width and height.
        cached: look up the six faces kept for this position instead of drawing.
    """

    scale: float
    cached: bool


@dataclass
class Pacer:
    """Chooses each frame's resolution from what the last ones took.

    Attributes:
        budget_ms: time that a frame may take while the camera moves.
        step: index into SCALES of the resolution while moving.
        full_ms: what a frame at full resolution takes, by the last measurement.
    """

    budget_ms: float = BUDGET_MS
    step: int = 0
    full_ms: float = 0.0
    last_motion: float = -1e9
    travelled: bool = False

    def plan(self, now: float, *, moved: bool, turned: bool, adaptive: bool = True) -> Plan:
        """Decide the frame at time `now` (seconds) after the camera moved, turned, both or neither."""
        if moved or turned:
            self.last_motion, self.travelled = now, moved
        moving = now - self.last_motion < REFINE_AFTER
        if not adaptive or not moving:
            return Plan(1.0, cached=False)
        slow = self.full_ms > self.budget_ms
        return Plan(SCALES[self.step], cached=slow and not self.travelled)

    def measure(self, plan: Plan, frame_ms: float) -> None:
        """Learn from a frame that was drawn (not looked up) as planned."""
        if plan.cached:
            return
        if plan.scale == 1.0:
            self.full_ms = frame_ms
        if frame_ms > 1.2 * self.budget_ms and plan.scale == SCALES[self.step]:
            self.step = min(self.step + 1, len(SCALES) - 1)
        elif self.step > 0 and plan.scale == SCALES[self.step]:
            # Only go finer when the next size should fit, else the picture would breathe.
            growth = (SCALES[self.step - 1] / SCALES[self.step]) ** 2
            if frame_ms * growth < 0.9 * self.budget_ms:
                self.step -= 1
