"""The content of a poses.json of estimated poses (docs/input.md)."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pansplat.inputs.folder_formats import MATRIX_KEYS
from pansplat.inputs.placements import is_by_hand
from pansplat.poses.approximate import LinkedPlace
from pansplat.poses.estimate import PoseEstimate, PoseGroup

CONVENTION = "cam2world opencv"


def make_pose_content(estimate: PoseEstimate, names: Mapping[Path, str]) -> dict[str, Any]:
    """The content of a poses.json: the poses of all groups (a world each), and approximate places."""
    poses = {}
    for number, group in enumerate(estimate.groups):
        for image, pose in group.poses.items():
            matrix = np.round(pose, 9).tolist()
            poses[names[image]] = {"cam2world": matrix, "world": number} if number else matrix
    content: dict[str, Any] = {"convention": CONVENTION, "worlds": [*map(make_range, estimate.groups)], "poses": poses}
    content["estimate"] = {
        "summary": estimate.summary,
        "unplaced": {image.name: reason for image, reason in estimate.unplaced.items()},
        "approximate": list_approximate(estimate.approximate, names),
        "written": _join_marks(content),
    }
    return content


def rename_panoramas(content: Mapping[str, Any], names: Mapping[str, str], files: Mapping[str, str]) -> dict[str, Any]:
    """The content of a poses.json, by other names of the panoramas.

    Args:
        content: as `make_pose_content` makes it.
        names: the new one of each name.
        files: the name of the file of each, for reasons.
    """
    renamed = {**content, "poses": {names.get(name, name): entry for name, entry in content["poses"].items()}}
    estimate = content["estimate"]
    renamed["estimate"] = {
        **estimate,
        "unplaced": {files.get(name, name): reason for name, reason in estimate["unplaced"].items()},
        "approximate": [
            about | {key: [names.get(name, name) for name in about[key]] for key in ("between", "by")}
            for about in estimate["approximate"]
        ],
        "written": _join_marks(renamed),
    }
    return renamed


def _join_marks(content: Mapping[str, Any]) -> str:
    return " ".join(mark_worlds(content).values())


def world_of(entry: Any) -> int:
    """The world of an entry."""
    return int(entry.get("world") or 0) if isinstance(entry, dict) else 0


def matrix_of(entry: Any) -> Any:
    """The matrix of an entry; None if it has none."""
    return next((entry[key] for key in MATRIX_KEYS if key in entry), None) if isinstance(entry, dict) else entry


def mark_worlds(content: Mapping[str, Any]) -> dict[int, str]:
    """A hash of the poses and the range of each world, by which those that an estimate wrote are recognised."""
    ranges = [[world.get("near"), world.get("far")] for world in content.get("worlds") or ()]
    states: dict[int, list[Any]] = {}
    for name, entry in sorted(content["poses"].items()):
        state = states.setdefault(world_of(entry), [content["convention"], ranges[world_of(entry) :][:1]])
        state.append((name, matrix_of(entry), is_by_hand(entry)))
    return {
        world: hashlib.blake2b(json.dumps(state).encode(), digest_size=8).hexdigest() for world, state in states.items()
    }


def list_approximate(places: Mapping[Path, LinkedPlace], names: Mapping[Path, str]) -> list[dict[str, Any]]:
    """Approximate places of the second panorama of a pair relative to the first one, and whose links state them."""
    return [
        {
            "between": [names[found.beside], names[image]],
            "place": [round(x, 4) for x in found.place],
            "by": [names[other] for other in found.by],
            "sure": False,
        }
        for image, found in places.items()
    ]


def format_pose_file(content: Mapping[str, Any]) -> str:
    """The text of a poses.json; each row of a matrix is a line."""
    return re.sub(r"\[\n\s+([^\[\]{}\"]*?)\n\s+\]", _join_lines, json.dumps(content, indent=1)) + "\n"


def _join_lines(match: re.Match[str]) -> str:
    return "[" + " ".join(match[1].split()) + "]"


def make_range(group: PoseGroup) -> dict[str, float]:
    return {"near": round(group.near, 3), "far": round(group.far, 3), "unit": round(group.unit, 4)}
