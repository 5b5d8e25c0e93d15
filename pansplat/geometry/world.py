"""The world in memory, near a metre and near its origin, and where it is in the user's world, that of files.

Poses of files may be in any unit from micrometres to thousands of kilometres, and far from their origin, as UTM
coordinates are. The networks, the matching and the flights have thresholds in metres, and Gaussians are float32. Poses
and scenes are therefore brought to a working world once, when they are loaded, and back once, when they are saved.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.errors import InputError

MIN_DEPTH, MAX_DEPTH = 1e-9, 1e9  # limits of depths, in the unit of the poses
MAX_POSITION = 1e12  # largest coordinate of a camera, in the unit of the poses
MIN_RATIO = 1.001  # least ratio of the largest to the smallest depth

_NEAR_RANGE = (1 / 64, 64.0)  # metres; worlds whose smallest depth is in this range keep their unit
_MAX_LOCAL = 1e5  # metres of a camera from the origin; farther out, float32 has steps of a centimetre
_MAX_CENTER = 256.0  # metres; worlds whose cameras have their middle within this of the origin keep it
_ORIGIN_CELL = 64.0  # metres; new origins are multiples of it, so that they seldom change when a camera is added


@dataclass(frozen=True)
class WorldFrame:
    """Where the working world is in the user's world: a place p of the first is at `unit` p + `origin` of the second.

    Attributes:
        unit: what the working world counts in, about a metre, in the user's unit: 1, or a power of 1000.
        origin: where the working world begins, in the user's unit.
    """

    unit: float = 1.0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def localize(self, cam2world: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
        """Poses of the user's world in the working world, float64."""
        return _with_places(cam2world, self.localize_places(cam2world[..., :3, 3]))

    def globalize(self, cam2world: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
        """Poses of the working world in the user's world, float64."""
        return _with_places(cam2world, self.globalize_places(cam2world[..., :3, 3]))

    def localize_places(self, places: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Places of the user's world in the working world, float64."""
        return (places.double() - self._origin_as(places)) / self.unit

    def globalize_places(self, places: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Places of the working world in the user's world, float64."""
        return places.double() * self.unit + self._origin_as(places)

    def _origin_as(self, places: Tensor) -> Tensor:
        return torch.tensor(self.origin, dtype=torch.float64, device=places.device)


def _with_places(cam2world: Tensor, places: Tensor) -> Tensor:
    moved = cam2world.double().clone()
    moved[..., :3, 3] = places
    return moved


USER_FRAME = WorldFrame()


def choose_frame(cam2world: Float[Tensor, "*batch 4 4"], near: float) -> WorldFrame:
    """The frame of a working world for cameras of the user's world, of which `near` is the smallest depth.

    A world of metres whose cameras are around its origin, within 256 m, is kept.
    """
    unit = choose_unit(near)
    center = cam2world[..., :3, 3].double().reshape(-1, 3).mean(dim=0).cpu()
    if float(center.abs().max()) <= _MAX_CENTER * unit:
        return WorldFrame(unit)
    x, y, z = (torch.round(center / (_ORIGIN_CELL * unit)) * _ORIGIN_CELL * unit).tolist()
    return WorldFrame(unit, (x, y, z))


def choose_unit(near: float) -> float:
    """The unit of a working world, see `WorldFrame`: that of micrometres, millimetres, metres, kilometres and so on in
    which the smallest depth is nearest to 1; 1 for most worlds."""
    return 1.0 if _NEAR_RANGE[0] <= near <= _NEAR_RANGE[1] else 1000.0 ** round(math.log(near, 1000))


def require_working_world(cam2world: Float[Tensor, "*batch 4 4"], near: float, far: float) -> None:
    """Check poses and depths of a prediction."""
    require_depth_range(near, far, "`near` and `far`")
    farthest = float(cam2world[..., :3, 3].abs().max())
    if choose_unit(near) != 1 or farthest > _MAX_LOCAL:
        raise InputError(
            f"`near` and `cam2world`: needed depths from {_NEAR_RANGE[0]:g} to {_NEAR_RANGE[1]:g} m and cameras within "
            f"{_MAX_LOCAL:g} m of the origin, got near={near:g} and a camera at {farthest:g}; bring them to a world of "
            "metres (pansplat.geometry.world.choose_frame)."
        )


def require_depth_range(near: float, far: float, source: object, advice: str = "correct them") -> None:
    """Check a range of depths.

    Args:
        source: file or argument that error messages name.
        advice: what to do, for messages.
    """
    if not 0 < near < far < math.inf:
        raise InputError(f"{source}: needed 0 < near < far in metres, got near={near:g} and far={far:g}; {advice}.")
    if near < MIN_DEPTH or far > MAX_DEPTH or far < MIN_RATIO * near:
        raise InputError(
            f"{source}: needed near and far of {MIN_DEPTH:g} to {MAX_DEPTH:g}, with far at least {MIN_RATIO} "
            f"times near, got near={near:g} and far={far:g}; {advice}."
        )
