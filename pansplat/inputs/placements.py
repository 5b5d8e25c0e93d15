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
        is_rejected: whether a user has rejected its pose.
        about: where one that is not placed may be.
    """

    state: State = "placed"
    reason: str = ""
    source: Path | None = None
    is_rejected: bool = False
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


@dataclass(frozen=True)
class Hold:
    """What holds a panorama in its group, if that is only probable.

    Attributes:
        ties: the probable pairs between its part and the core.
        members: the panoramas that leave the group without them, in the group's order.
    """

    ties: tuple[Tie, ...]
    members: tuple[str, ...]

    @property
    def reason(self) -> str:
        """The ties, for people."""
        return "by probable pairs only: " + ", ".join(f"{tie.first} - {tie.second}" for tie in self.ties)


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


def read_rejected(content: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The entries by name of each rejection that poses.json records; invalid ones are ignored."""
    records = content.get("rejected")
    records = records if isinstance(records, list) else []
    found = [record.get("poses") for record in records if isinstance(record, Mapping)]
    return [poses for poses in found if isinstance(poses, dict)]


def find_holds(names: Sequence[str], ties: Iterable[Tie], fixed: Collection[str] = ()) -> dict[str, Hold]:
    """What holds each panorama of a group that is only probably placed.

    Args:
        names: of the group.
        ties: of it; those with other panoramas are ignored. A panorama without any is placed otherwise.
        fixed: panoramas that are placed by hand.
    """
    inside = set(names) - set(fixed)
    own = [tie for tie in ties if tie.first in inside and tie.second in inside]
    part = {name: number for number, name in enumerate(names)}
    for tie in own:
        if tie.is_certain:
            joined = part[tie.first], part[tie.second]
            part = {name: min(joined) if number in joined else number for name, number in part.items()}
    tied = [name for name in names if any(name in tie[:2] for tie in own)]
    if not tied:
        return {}
    numbers = [part[name] for name in tied]
    core = max(numbers, key=lambda number: (numbers.count(number), -number))
    links = [tie for tie in own if part[tie.first] != part[tie.second]]
    depth = _measure_depths(core, {(part[tie.first], part[tie.second]) for tie in links})
    holds = {}
    for number in sorted(set(numbers) & set(depth) - {core}):
        holding = tuple(tie for tie in links if _is_towards_core(tie, number, part, depth))
        reached = _measure_depths(core, {(part[tie.first], part[tie.second]) for tie in links if tie not in holding})
        members = tuple(name for name in tied if part[name] in depth and part[name] not in reached)
        holds |= {name: Hold(holding, members) for name in tied if part[name] == number}
    is_single = numbers.count(core) == 1
    if is_single and holds:  # no pair of the group is certain
        name = next(name for name in tied if part[name] == core)
        holding = tuple(tie for tie in links if name in tie[:2])
        holds[name] = Hold(holding, (name,))
    return holds


def _is_towards_core(tie: Tie, number: int, part: Mapping[str, int], depth: Mapping[int, int]) -> bool:
    ends = part[tie.first], part[tie.second]
    return number in ends and depth[sum(ends) - number] <= depth[number]


def _measure_depths(start: int, edges: Collection[tuple[int, int]]) -> dict[int, int]:
    """The number of edges from a part to those that edges connect with it."""
    depth, last = {start: 0}, [start]
    while last:
        beside = {b for a, b in edges if a in last} | {a for a, b in edges if b in last}
        last = sorted(beside - set(depth))
        depth |= dict.fromkeys(last, max(depth.values()) + 1)
    return depth


def judge(
    names: Sequence[str], ties: Iterable[Tie], by_hand: Collection[str], source: Path | None
) -> dict[str, Placement]:
    """The placements of the panoramas of one group; see `find_holds`."""
    if len(names) == 1:
        return {names[0]: Placement("not placed", "no other panorama has a pose with it", source)}
    holds = find_holds(names, ties, by_hand)
    placements = {}
    for name in names:
        if name in by_hand:
            placements[name] = Placement("by hand", source=source)
        elif name in holds:
            placements[name] = Placement("probable", holds[name].reason, source)
        else:
            placements[name] = Placement(source=source)
    return placements
