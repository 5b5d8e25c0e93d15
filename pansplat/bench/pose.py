"""`pansplat bench pose`: estimated camera poses against known ones, for pairs and for whole tours.

A row is a pair of panoramas, or all panoramas of a folder. A pose is wrong if its rotation differs by more than 3
degrees or its direction by more than 10; a wrong pose that passes the check of the estimate is the error to avoid.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from pansplat.bench.report import Column, Report, Row, result_column
from pansplat.data.pairs import Panorama
from pansplat.errors import InputError
from pansplat.poses.estimate import PoseEstimate, estimate_poses
from pansplat.poses.solvers import angle_between, rotation_angle

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_WRONG_ROTATION, _WRONG_DIRECTION = 3.0, 10.0  # degrees


@dataclass(frozen=True)
class PoseCase:
    """Panoramas whose poses are estimated together.

    Attributes:
        count: number of panoramas.
        baseline_m: distance of a pair's cameras; for a tour, the median distance to the nearest other camera.
    """

    count: int
    baseline_m: float


@dataclass
class PoseResult:
    """Errors of an estimate; None where there is no pose.

    Attributes:
        outcome: "solved", "flagged" (no pose passed the check), or "wrong" (a wrong pose passed it).
        rotation_degrees, direction_degrees: of the relative pose; for a tour, medians over all pairs.
        scale_percent: of the distances, relative to the known ones.
        position_cm: largest error of a position after similarity alignment.
        places: that match, of the weakest pair.
        seconds: of the estimate.
    """

    outcome: str
    rotation_degrees: float | None = None
    direction_degrees: float | None = None
    scale_percent: float | None = None
    position_cm: float | None = None
    places: float | None = None
    seconds: float = 0.0


PoseRow = Row[PoseCase, PoseResult]


def measure_poses(name: str, panoramas: Sequence[Panorama], camera_height: float, suite: str = "pair") -> PoseRow:
    """Estimate the poses of panoramas and compare them with the known ones."""
    truth = {panorama.image: panorama.cam2world.numpy() for panorama in panoramas}
    centres = np.stack([pose[:3, 3] for pose in truth.values()])
    distances = np.linalg.norm(centres[:, None] - centres[None], axis=-1) + 1e9 * np.eye(len(centres))
    case = PoseCase(len(truth), float(np.median(distances.min(axis=1))))
    start = time.perf_counter()
    try:
        estimate = estimate_poses(list(truth), camera_height=camera_height)
    except InputError as error:
        return Row(suite, name, case, PoseResult("flagged", seconds=time.perf_counter() - start), note=str(error))
    seconds = time.perf_counter() - start
    result = _compare(estimate, truth)
    result.seconds = seconds
    note = "; ".join(f"{image.name}: {reason}" for image, reason in estimate.unplaced.items())
    return Row(suite, name, case, result, note=note)


def _compare(estimate: PoseEstimate, truth: Mapping[Path, Array]) -> PoseResult:
    rotations, directions, ratios = [], [], []
    for first, second in itertools.combinations(estimate.poses, 2):
        found, known = (np.linalg.inv(p[second]) @ p[first] for p in (estimate.poses, truth))
        rotations.append(math.degrees(rotation_angle(found[:3, :3] @ known[:3, :3].T)))
        directions.append(math.degrees(angle_between(found[:3, 3], known[:3, 3])))
        ratios.append(float(np.linalg.norm(found[:3, 3]) / np.linalg.norm(known[:3, 3])))
    is_wrong = max(rotations) > _WRONG_ROTATION or max(directions) > _WRONG_DIRECTION
    places = [relation.places for relation in estimate.relations.values() if relation.is_reliable]
    positions = [np.stack([poses[image][:3, 3] for image in estimate.poses]) for poses in (estimate.poses, truth)]
    return PoseResult(
        "wrong" if is_wrong else "solved",
        float(np.median(rotations)),
        float(np.median(directions)),
        None if estimate.scale_source.startswith("unknown") else 100 * (float(np.median(ratios)) - 1),
        100 * float(_aligned_errors(*positions).max()) if len(positions[0]) > 2 else None,
        min(places),
    )


def _aligned_errors(found: Float[Array, "n 3"], known: Float[Array, "n 3"]) -> Float[Array, "n"]:
    """Distances after the best similarity transform. Source: S. Umeyama, PAMI 1991."""
    a, b = found - found.mean(axis=0), known - known.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.array((1.0, 1.0, np.sign(np.linalg.det(u @ vt))))
    scale = (s * sign).sum() / max(float((a**2).sum()), 1e-12)
    return np.linalg.norm(b - scale * a @ (u @ np.diag(sign) @ vt).T, axis=1)


POSE_COLUMNS: tuple[Column[PoseRow], ...] = (
    Column("panoramas", lambda row: row.scene, "left"),
    Column("baseline m", lambda row: f"{row.case.baseline_m:.2f}"),
    Column("outcome", lambda row: row.result.outcome, "left"),
    result_column("rotation deg", "{:.3f}", "rotation_degrees"),
    result_column("direction deg", "{:.2f}", "direction_degrees"),
    result_column("scale %", "{:+.1f}", "scale_percent"),
    result_column("position cm", "{:.1f}", "position_cm"),
    result_column("places", "{:.0f}", "places"),
    result_column("s", "{:.1f}", "seconds"),
)


def summarise(rows: Sequence[PoseRow]) -> str:
    """One line: outcomes, medians and 95 % quantiles of the solved pairs."""
    counts = {name: sum(row.result.outcome == name for row in rows) for name in ("solved", "flagged", "wrong")}
    solved = [row.result for row in rows if row.result.outcome == "solved"]
    parts = [", ".join(f"{count} {name}" for name, count in counts.items())]
    for title, values in (
        ("rotation", [result.rotation_degrees for result in solved]),
        ("direction", [result.direction_degrees for result in solved]),
    ):
        if values:
            median, high = np.quantile(np.array(values, float), (0.5, 0.95))
            parts.append(f"{title} median {median:.3f}, 95 % {high:.3f} degrees")
    return "; ".join(parts)


def make_pose_report(
    machine: Mapping[str, Any], *, json: Path | None = None, out: Path | None = None
) -> Report[PoseRow]:
    """The report of a run, with pose.md and pose.png in the folder `out`."""
    return Report(
        POSE_COLUMNS,
        lambda row: row.suite,
        machine,
        facts=("cpu", "threads"),
        json_file=json,
        page=None if out is None else out / "pose.md",
        plots={} if out is None else {out / "pose.png": plot_poses},
        print_steps=True,
    )


def plot_poses(rows: Sequence[PoseRow]) -> Figure:
    """Plot the errors of rotation and direction over the baseline, and the cumulative distributions."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 4), layout="constrained")
    axes = figure.subplots(1, 2)
    for outcome, marker in (("solved", "o"), ("wrong", "x")):
        chosen = [row for row in rows if row.result.outcome == outcome and row.case.count == 2]
        for field in ("rotation_degrees", "direction_degrees"):
            values = [getattr(row.result, field) for row in chosen]
            baselines = [row.case.baseline_m for row in chosen]
            label = f"{field.split('_')[0]}, {outcome}"
            if values:
                axes[0].semilogy(baselines, values, marker, label=label)
                axes[1].plot(np.sort(values), np.linspace(0, 1, len(values)), label=label)
    axes[0].set(xlabel="distance of the cameras, m", ylabel="error, degrees")
    axes[1].set(xlabel="error, degrees", ylabel="fraction of the pairs", xlim=(0, 2))
    for ax in axes:
        ax.grid(alpha=0.25)
        if ax.get_legend_handles_labels()[0]:
            ax.legend(fontsize=8)
    return figure
