"""How the poses of panoramas were found: placed, placed by hand, or not placed; and where the last may be."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from msgspec import Struct

from pansplat.errors import InputError
from pansplat.system.strict_json import convert

State = Literal["placed", "by hand", "not placed"]

BY_HAND = "by hand"  # value of "placed" in an entry of poses.json


@dataclass(frozen=True)
class ApproximatePlace:
    """About where a panorama without a pose is. It is drawn on plans; no camera flies there.

    Attributes:
        beside: picture of the panorama that it is relative to.
        right, forward: distances from that camera, level, in the unit of its pose.
        yaw: heading, radians to the right of that camera's.
        by: names of the panoramas whose links state it.
        is_in_heights: whether right and forward are in heights of that camera, as no unit is stated.
    """

    beside: Path
    right: float
    forward: float
    yaw: float
    by: tuple[str, ...] = ()
    is_in_heights: bool = False


@dataclass(frozen=True)
class Placement:
    """How the pose of a panorama was found.

    Attributes:
        reason: why there is no pose.
        source: the poses.json or the cached estimate that states it; None for other formats.
        about: where one that is not placed may be.
    """

    state: State = "placed"
    reason: str = ""
    source: Path | None = None
    about: ApproximatePlace | None = None


PLACED = Placement()


def read_unit(content: Mapping[str, Any], world: int) -> float | None:
    """What is one camera height of the estimated depths in a world of poses.json, if the file states it."""
    worlds = content.get("worlds")
    entry = worlds[world] if isinstance(worlds, list) and 0 <= world < len(worlds) else None
    unit = entry.get("unit") if isinstance(entry, dict) else None
    return float(unit) if isinstance(unit, (int, float)) and not isinstance(unit, bool) and unit > 0 else None


def read_approximate(
    estimate: Any, images: Mapping[str, Path], units: Mapping[str, float | None]
) -> dict[Path, ApproximatePlace]:
    """The approximate places that an estimate states, by image; invalid ones are ignored.

    Args:
        images: by name.
        units: units of the poses that are known, by name (`read_unit`).
    """
    found = {}
    for _, stated in list_stated_places(estimate):
        beside, name = stated.between
        if beside in images and name in images and beside != name:
            unit, (right, forward, yaw) = units.get(beside), stated.place
            place = images[beside], (unit or 1) * right, (unit or 1) * forward, yaw
            found[images[name]] = ApproximatePlace(*place, tuple(stated.by), is_in_heights=unit is None)
    return found


def list_stated_places(estimate: Any) -> list[tuple[dict[str, Any], StatedPlace]]:
    """The valid entries of the approximate places that an estimate states, and what they state."""
    entries, found = estimate.get("approximate") if isinstance(estimate, Mapping) else None, []
    for entry in entries if isinstance(entries, list) else []:
        with contextlib.suppress(InputError):
            found.append((entry, convert(entry, StatedPlace, "approximate")))
    return found


class StatedPlace(Struct):
    """An approximate place as a file states it: the second panorama relative to the first one."""

    between: tuple[str, str]
    place: tuple[float, float, float]
    by: list[str] = []


def is_by_hand(entry: Any) -> bool:
    """Whether an entry of poses.json was placed by hand."""
    return isinstance(entry, dict) and entry.get("placed") == BY_HAND
