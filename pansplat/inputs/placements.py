"""How the poses of panoramas were found: placed, probably placed, placed by hand, or not placed.

Pairs of panoramas hold a group together. A panorama is probably placed if only probable pairs connect it with the core
of its group: the largest part that certain pairs connect.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from msgspec import Struct

from pansplat.errors import InputError
from pansplat.system.components import label_components
from pansplat.system.strict_json import convert

State = Literal["placed", "probable", "by hand", "not placed"]

BY_HAND = "by hand"  # value of "placed" in an entry of poses.json


@dataclass(frozen=True)
class ApproximatePlace:
    """About where a panorama without a pose is. It is drawn on plans; no camera flies there.

    Attributes:
        beside: picture of the panorama that it is relative to.
        right, forward: of that camera, level, in the unit of its pose.
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
        state: `probable` if it depends on pairs that may be wrong.
        reason: why there is no pose, or by which pairs it is probable.
        source: the poses.json or the cached estimate that states it; None for other formats.
        about: where one that is not placed may be.
    """

    state: State = "placed"
    reason: str = ""
    source: Path | None = None
    about: ApproximatePlace | None = None


PLACED = Placement()


class Tie(NamedTuple):
    """A pair of panoramas, by name, whose relative pose is used.

    Attributes:
        is_certain: else it is probable.
    """

    first: str
    second: str
    is_certain: bool


def read_ties(estimate: Any) -> list[Tie]:
    """The pairs that an estimate (of poses.json or of the cache) states; invalid ones are ignored."""
    pairs = estimate.get("pairs") if isinstance(estimate, Mapping) else None
    ties = []
    for pair in pairs if isinstance(pairs, list) else []:
        names = pair.get("between") if isinstance(pair, Mapping) else None
        if isinstance(names, list) and len(names) == 2 and all(isinstance(name, str) for name in names):
            ties.append(Tie(names[0], names[1], pair.get("check") == "certain"))
    return ties


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
        units: of the poses that are known, by name (`read_unit`).
    """
    entries = estimate.get("approximate") if isinstance(estimate, Mapping) else None
    found = {}
    for entry in entries if isinstance(entries, list) else []:
        with contextlib.suppress(InputError):
            stated = convert(entry, _Stated, "approximate")
            beside, name = stated.between
            if beside in images and name in images and beside != name:
                unit, (right, forward, yaw) = units.get(beside), stated.place
                place = images[beside], (unit or 1) * right, (unit or 1) * forward, yaw
                found[images[name]] = ApproximatePlace(*place, tuple(stated.by), is_in_heights=unit is None)
    return found


class _Stated(Struct):
    """An approximate place as a file states it: the second panorama relative to the first one."""

    between: tuple[str, str]
    place: tuple[float, float, float]
    by: list[str] = []


def is_by_hand(entry: Any) -> bool:
    """Whether an entry of poses.json was placed by hand."""
    return isinstance(entry, dict) and entry.get("placed") == BY_HAND


def find_probable(names: Sequence[str], ties: Iterable[Tie], fixed: Collection[str] = ()) -> dict[str, str]:
    """The panoramas of a group that are only probably placed, and by which pairs.

    Args:
        names: of the group.
        ties: of it; those with other panoramas are ignored. A panorama without any is placed otherwise.
        fixed: panoramas that are placed by hand.
    """
    number = {name: n for n, name in enumerate(names) if name not in fixed}
    own = [tie for tie in ties if tie.first in number and tie.second in number]
    edges = [(number[tie.first], number[tie.second]) for tie in own]
    group = label_components(len(names), edges)
    part = label_components(len(names), [edge for edge, tie in zip(edges, own, strict=True) if tie.is_certain])
    tied = [n for n in number.values() if any(n in edge for edge in edges)]
    parts, found = [part[n] for n in tied], {}
    core = max(dict.fromkeys(parts), key=parts.count, default=0)
    for n in tied:
        is_outside = part[n] != core or parts.count(core) == 1  # in the second case no pair of the group is certain
        if is_outside and group[n] == group[tied[parts.index(core)]]:
            own_ties = [
                tie for (a, b), tie in zip(edges, own, strict=True) if (part[a] == part[n]) != (part[b] == part[n])
            ]
            found[names[n]] = "by probable pairs only: " + ", ".join(f"{tie.first} - {tie.second}" for tie in own_ties)
    return found


def judge(
    names: Sequence[str], ties: Iterable[Tie], by_hand: Collection[str], source: Path | None
) -> dict[str, Placement]:
    """The placements of the panoramas of one group; see `find_probable`."""
    if len(names) == 1:
        return {names[0]: Placement("not placed", "no other panorama has a pose with it", source)}
    probable = find_probable(names, ties, by_hand)
    placements = {}
    for name in names:
        if name in by_hand:
            placements[name] = Placement("by hand", source=source)
        elif name in probable:
            placements[name] = Placement("probable", probable[name], source)
        else:
            placements[name] = Placement(source=source)
    return placements
