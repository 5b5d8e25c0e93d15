"""Directions of one panorama in another, which the links of a tour state, as evidence for relative poses."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

_NOISE, _RIGHT = math.radians(15), 0.85  # deviation of a link, which is often on a door; share of right links


class LinkDirections(NamedTuple):
    """Where a tour's links place the other panorama: yaw to the right of the centre column, radians; None without one.

    Attributes:
        there: yaw of the link of the first panorama.
        back: yaw of the link of the second panorama.
    """

    there: float | None = None
    back: float | None = None

    def score(self, rotations: Float[Array, "n 3 3"], translations: Float[Array, "n 3"]) -> Float[Array, "n"]:
        """Logarithm of the likelihood ratio of relative poses against chance."""
        score = np.zeros(len(rotations))
        for yaw, directions in (
            (self.there, -np.einsum("nji,nj->ni", rotations, translations)),
            (self.back, translations),
        ):
            if yaw is not None:
                angle = np.arctan2(directions[:, 0], directions[:, 2]) - yaw
                angle = (angle + math.pi) % (2 * math.pi) - math.pi
                density = np.exp(-0.5 * (angle / _NOISE) ** 2) / (math.sqrt(2 * math.pi) * _NOISE)
                score += np.log(_RIGHT * density * 2 * math.pi + 1 - _RIGHT)
        return score


NO_LINKS = LinkDirections()
