"""`pansplat bench pose`: estimated camera poses against known ones, for pairs and for whole tours.

A row is a pair of panoramas, or all panoramas of a folder. A pose of a pair is wrong if its rotation differs by more
than 3 degrees or its direction by more than 10, one of a tour if a rotation differs by more than 5 degrees or a
position by more than 0.3 m; a wrong pose that passes the check of the estimate is the error to avoid.

Values of a row: `outcome` is "solved", "flagged" (no pose passed the check), or "wrong" (a wrong pose passed it);
`placed` counts the panoramas of the two largest groups; `rotation_degrees` and `direction_degrees` are errors of the
relative pose, for a tour medians over the pairs within groups, `worst_degrees` the largest rotation; `scale_percent`
that of the distances; `position_cm` the largest error of a position after similarity alignment of each group;
`places` match in the weakest pair; `seconds` of the estimate.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from pansplat.bench.harness import Suite, announce
from pansplat.errors import InputError
from pansplat.evaluation.results import Column, Row
from pansplat.inputs.folders import load_sets
from pansplat.inputs.panorama_sets import Panorama
from pansplat.poses.estimate import PoseEstimate, estimate_poses
from pansplat.poses.solvers import angle_between, rotation_angle

_WRONG_ROTATION, _WRONG_DIRECTION = 3.0, 10.0  # degrees; a pair with larger errors is wrong
_WRONG_TURN, _WRONG_PLACE = 5.0, 30.0  # degrees and centimetres; a tour's camera with larger errors is wrong


def measure_folder(path: Path, *, camera_height: float, pairs: bool, tours: bool) -> Iterator[Row]:
    """Yield a row for each pair of a folder, and for all its panoramas together.

    Args:
        camera_height: mean height of the cameras over the floor, metres.
        pairs: estimate each pair by itself.
        tours: estimate all panoramas together.
    """
    loaded = [pair for pair in load_sets(path) if len(pair.context) > 1]  # a single view has nothing to compare with
    contexts = {frozenset(view.image for view in pair.context): pair for pair in loaded}
    for pair in contexts.values() if pairs else ():
        announce(pair.name)
        yield measure_poses(pair.name, pair.context, camera_height)
    if tours:
        views = {view.image: view for pair in loaded for view in (*pair.context, *pair.targets)}
        announce(f"all {len(views)} panoramas")
        yield measure_poses(path.resolve().name, list(views.values()), camera_height, "tour")


def measure_poses(name: str, panoramas: Sequence[Panorama], camera_height: float, suite: str = "pair") -> Row:
    """Estimate the poses of panoramas and compare them with the known ones.

    The case of the row has their `count`, and `baseline_m`, the median distance to the nearest other camera.
    """
    truth = {panorama.image: panorama.cam2world.numpy() for panorama in panoramas}
    centres = np.stack([pose[:3, 3] for pose in truth.values()])
    distances = np.linalg.norm(centres[:, None] - centres[None], axis=-1) + 1e9 * np.eye(len(centres))
    baseline_m = float(np.median(distances.min(axis=1)))
    row = Row({"suite": suite, "scene": name, "count": len(truth), "baseline_m": baseline_m})
    start = time.perf_counter()
    try:
        estimate = estimate_poses(list(truth), camera_height=camera_height)
    except InputError as error:
        row.values = {"outcome": "flagged", "seconds": time.perf_counter() - start, "note": str(error)}
        return row
    row.values = {"seconds": time.perf_counter() - start, **_compare(estimate, truth)}
    row.values["note"] = "; ".join(f"{image.name}: {reason}" for image, reason in estimate.unplaced.items())
    return row


def _compare(estimate: PoseEstimate, truth: Mapping[Path, Array]) -> dict[str, Any]:
    rotations, directions, ratios, places = [], [], [], []
    for group in estimate.groups:
        for first, second in itertools.combinations(group.poses, 2):
            found, known = (np.linalg.inv(p[second]) @ p[first] for p in (group.poses, truth))
            rotations.append(math.degrees(rotation_angle(found[:3, :3] @ known[:3, :3].T)))
            directions.append(math.degrees(angle_between(found[:3, 3], known[:3, 3])))
            ratios.append(float(np.linalg.norm(found[:3, 3]) / np.linalg.norm(known[:3, 3])))
        positions = [np.stack([poses[image][:3, 3] for image in group.poses]) for poses in (group.poses, truth)]
        places.append(100 * float(_aligned_errors(*positions).max()))
    is_wrong = max(rotations) > _WRONG_ROTATION or max(directions) > _WRONG_DIRECTION
    if len(truth) > 2:
        is_wrong = max(rotations) > _WRONG_TURN or max(places) > _WRONG_PLACE
    matched = [relation.places for relation in estimate.relations.values() if relation.is_reliable]
    return {
        "outcome": "wrong" if is_wrong else "solved",
        "placed": sum(len(group.poses) for group in estimate.groups[:2]),
        "rotation_degrees": float(np.median(rotations)),
        "worst_degrees": max(rotations),
        "direction_degrees": float(np.median(directions)),
        "scale_percent": 100 * (float(np.median(ratios)) - 1),
        "position_cm": max(places) if len(truth) > 2 else None,
        "places": min(matched),
    }


def _aligned_errors(found: Float[Array, "n 3"], known: Float[Array, "n 3"]) -> Float[Array, "n"]:
    """Distances after the best similarity transform. Source: S. Umeyama, PAMI 1991."""
    a, b = found - found.mean(axis=0), known - known.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.array((1.0, 1.0, np.sign(np.linalg.det(u @ vt))))
    scale = (s * sign).sum() / max(float((a**2).sum()), 1e-12)
    return np.linalg.norm(b - scale * a @ (u @ np.diag(sign) @ vt).T, axis=1)


def summarise(rows: Sequence[Row]) -> list[str]:
    """One line about the pairs: outcomes, medians and 95 % quantiles of the solved ones."""
    results = [row.values for row in rows if row.get("suite") == "pair"]
    solved = [result for result in results if result["outcome"] == "solved"]
    counts = {name: sum(result["outcome"] == name for result in results) for name in ("solved", "flagged", "wrong")}
    parts = [", ".join(f"{count} {name}" for name, count in counts.items())]
    for name in ("rotation", "direction") if solved else ():
        median, high = np.quantile([result[f"{name}_degrees"] for result in solved], (0.5, 0.95))
        parts.append(f"{name} median {median:.3f}, 95 % {high:.3f} degrees")
    lines = ["; ".join(parts)] if results else []
    tours = [row for row in rows if row.get("suite") == "tour"]
    if tours:
        placed, count = sum(row.get("placed") or 0 for row in tours), sum(row.get("count") for row in tours)
        wrong = sum(row.get("outcome") == "wrong" for row in tours)
        lines.append(
            f"{len(tours)} tours: {placed} of {count} panoramas ({placed / count:.0%}) are in the two largest groups; "
            f"{wrong} tours with a wrong pose"
        )
    return lines


POSE = Suite(
    "pose",
    (
        Column("panoramas", "scene"),
        Column("baseline m", "baseline_m", ".2f"),
        Column("outcome", "outcome"),
        Column("placed", "placed", ".0f"),
        Column("rotation deg", "rotation_degrees", ".3f"),
        Column("worst", "worst_degrees", ".2f"),
        Column("direction deg", "direction_degrees", ".2f"),
        Column("scale %", "scale_percent", "+.1f"),
        Column("position cm", "position_cm", ".1f"),
        Column("places", "places", ".0f"),
        Column("s", "seconds", ".1f"),
    ),
    lambda row: row.get("suite"),
    lambda rows, header: None,
    summarise,
)
