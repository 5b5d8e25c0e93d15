"""The learning rate of every step: one cycle of two cosines.

Source: OFFICIAL.md, section 11; Smith and Topin, https://arxiv.org/abs/1708.07120 (one cycle).
"""

from __future__ import annotations

import math

_START = 25.0  # how many times smaller than the peak the first rate is
_END = 1e4  # how many times smaller than the first the last rate is


def one_cycle(step: int, total: int, peak: float, *, rise: float = 0.01) -> float:
    """The rate of a step, from peak / 25 up to the peak and down to peak / 250,000; the last beyond the end.

    Args:
        step: counted from 0.
        total: steps of the cycle; the original takes ten more than it trains.
        rise: part of the steps in which the rate rises.
    """
    start, last = peak / _START, total - 1
    top = rise * total - 1
    if step < top:
        return _cosine(start, peak, step / top)
    return _cosine(peak, start / _END, min(1.0, (step - max(top, 0.0)) / max(1e-9, last - max(top, 0.0))))


def _cosine(first: float, last: float, part: float) -> float:
    return last + (first - last) * (1 + math.cos(math.pi * part)) / 2
