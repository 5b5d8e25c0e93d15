"""The unit of a world: limits of depths and positions, and the factor to a unit near metres.

Poses may be in any unit from micrometres to thousands of kilometres. The networks, the matching and the rasterisers
have thresholds in metres and sums in float32. They work in a world whose smallest depth is of the order of a metre.
"""

from __future__ import annotations

import math

from jaxtyping import Float
from torch import Tensor

from pansplat.errors import InputError

MIN_DEPTH, MAX_DEPTH = 1e-9, 1e9
MAX_POSITION = 1e12  # of a camera
MIN_RATIO = 1.001  # of the largest to the smallest depth

_METRES = (1 / 64, 64.0)  # smallest depths of worlds that are left as they are
_WORKING_NEAR = 0.5  # metres; the smallest depth of other worlds becomes 1/2 to 1 of it


def require_depth_range(near: float, far: float, source: object, advice: str = "correct them") -> None:
    """Check a range of depths.

    Args:
        source: file or argument that error messages name.
        advice: what to do, for messages.

    Raises:
        InputError: not 0 < near < far, out of the supported range, or equal in float32.
    """
    if not 0 < near < far < math.inf:
        raise InputError(f"{source}: needed 0 < near < far in metres, got near={near:g} and far={far:g}; {advice}.")
    if near < MIN_DEPTH or far > MAX_DEPTH or far < MIN_RATIO * near:
        raise InputError(
            f"{source}: needed near and far of {MIN_DEPTH:g} to {MAX_DEPTH:g}, with far at least {MIN_RATIO} "
            f"times near, got near={near:g} and far={far:g}; {advice}."
        )


def working_factor(near: float) -> float:
    """The power of two by which a world is multiplied so that its smallest depth is near a metre; 1 for most worlds.

    A power of two changes no digit of a number.
    """
    if _METRES[0] <= near <= _METRES[1]:
        return 1.0
    return 2.0 ** math.floor(math.log2(_WORKING_NEAR / near))


def scale_poses(cam2world: Float[Tensor, "*batch 4 4"], factor: float) -> Float[Tensor, "*batch 4 4"]:
    """Poses with their translations multiplied by a factor."""
    if factor == 1:
        return cam2world
    scaled = cam2world.clone()
    scaled[..., :3, 3] *= factor
    return scaled
