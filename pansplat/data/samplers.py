"""Which frames of a sequence are the context, and which the targets.

Source: OFFICIAL.md 2.5.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pansplat.errors import InputError


@dataclass(frozen=True)
class Draw:
    """Frame numbers: the two of the context, and the targets."""

    left: int
    right: int
    targets: tuple[int, ...]


@dataclass(frozen=True)
class BoundedSampler:
    """Two frames some frames apart, and targets from the one to the other.

    Attributes:
        min_gap, max_gap: frames from left to right; 2 and 5 for 360Loc, 2 and 30 for Insta360.
        training_gap: "uniform" draws from min_gap to max_gap. "original" is what the original code does: it takes
            min_gap for max_gap on paths that are not circles, so that the gap is always min_gap.
    """

    min_gap: int = 2
    max_gap: int = 5
    training_gap: Literal["uniform", "original"] = "uniform"

    def __post_init__(self) -> None:
        if not 1 <= self.min_gap <= self.max_gap:
            raise InputError(f"needed 1 <= min_gap <= max_gap frames, got {self.min_gap} and {self.max_gap}.")

    def training(self, count: int, generator: np.random.Generator) -> Draw:
        """A random pair of a sequence of `count` frames, and one target between or at them."""
        longest = _longest_gap(count)
        most = min(self.max_gap if self.training_gap == "uniform" else self.min_gap, longest)
        gap = int(generator.integers(min(self.min_gap, most), most, endpoint=True))
        left = int(generator.integers(0, count - gap))
        return Draw(left, left + gap, (int(generator.integers(left, left + gap, endpoint=True)),))

    def evaluation(self, count: int, draws: int = 100) -> list[Draw]:
        """Pairs spread evenly over a sequence of `count` frames, each with all frames from left to right."""
        gap = min((self.min_gap + self.max_gap) // 2, _longest_gap(count))
        lefts = [(count - gap - 1) * i // max(draws - 1, 1) for i in range(draws)]
        return [_with_all_between(left, left + gap) for left in lefts]


def sequence_draws(count: int, skip: int, *, start: int = 0, overlap: int = 0) -> list[Draw]:
    """Pairs one after another along a long video of `count` frames, each with all frames from left to right.

    Args:
        count: frames of the video.
        skip: frames from left to right.
        start: the first left frame.
        overlap: frames that a pair shares with the one before.

    Raises:
        InputError: the pairs would not move on, or the video is too short for one.
    """
    if not 0 <= overlap < skip:
        raise InputError(f"needed 0 <= overlap < skip frames, got overlap={overlap} and skip={skip}.")
    lefts = range(start, count - skip, skip - overlap)
    if start < 0 or not lefts:
        raise InputError(
            f"needed a first pair within {count} frames, got start={start} and skip={skip}; choose smaller ones."
        )
    return [_with_all_between(left, left + skip) for left in lefts]


def _with_all_between(left: int, right: int) -> Draw:
    return Draw(left, right, tuple(range(left, right + 1)))


def _longest_gap(count: int) -> int:
    if count < 2:
        raise InputError(f"needed a sequence of two or more posed frames, got {count}; leave it out.")
    return count - 1
