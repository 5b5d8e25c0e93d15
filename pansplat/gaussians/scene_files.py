"""What scene files of all formats share: the pansplat entry, labels, and the removal of Gaussians that are not finite.

Input cameras, the depth range, and the level and view of each Gaussian are no part of the formats. One JSON object, the
pansplat entry, holds them where a format has a place for comments; other tools skip it.
"""

from __future__ import annotations

import json
import math
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import torch
from jaxtyping import Bool
from msgspec import Meta, Struct
from torch import Tensor

from pansplat.errors import InputError, InputWarning
from pansplat.gaussians.scene import Gaussians, Scene, SceneTour, prune
from pansplat.geometry.world import MAX_POSITION, WorldFrame, choose_unit, require_depth_range
from pansplat.system.strict_json import convert, parse_json

Y_UP = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64))  # turns y down to y up, and back

_MAX_RUNS = 4096  # runs in the entry, which take megabytes; Gaussians with more runs are sorted
_MAX_CAMERAS = 1 << 12  # cameras that a scene may have
_Camera = Annotated[int, Meta(ge=0)]
_Level = Annotated[int, Meta(ge=0, le=255)]
_Position = Annotated[float, Meta(ge=-MAX_POSITION, le=MAX_POSITION)]
_Row = tuple[_Position, _Position, _Position, _Position]
_Gain = Annotated[float, Meta(gt=0, lt=1e3)]
_Angle = Annotated[float, Meta(ge=-4 * math.pi, le=4 * math.pi)]


def format_entry(scene: Scene, runs: list[list[int]]) -> str:
    """The pansplat entry of a scene as ASCII JSON without line breaks; the Gaussians are not used.

    Positions of files are relative to the origin of the scene's frame, because float32 does not hold large ones.

    Args:
        runs: see `find_label_runs`.
    """
    tour = scene.tour or SceneTour(())
    content = {
        "version": 1,
        "model": scene.model,
        "height": scene.height,
        "near": scene.near,
        "far": scene.far,
        "names": [_escape(name) for name in scene.names],
        "cam2world": scene.cam2world.double().cpu().tolist(),
        **({"origin": scene.frame.origin} if any(scene.frame.origin) else {}),
        **({"gains": scene.gains} if scene.gains else {}),
        **({"overlaps": tour.overlaps} if tour.overlaps else {}),
        **({"links": [[*link[:4], _escape(link[4])] for link in tour.links]} if tour.links else {}),
        **({"starts": scene.starts} if any(scene.starts) else {}),
        **({"approximate": tour.approximate} if tour.approximate else {}),
        **({"joint": True} if scene.joint else {}),
        "runs": runs,
    }
    return json.dumps(content, separators=(",", ":"))


def _escape(text: str) -> str:
    """The text, valid as Unicode."""
    return text.encode(errors="backslashreplace").decode()


def restore_scene(gaussians: Gaussians, entry: str | None, path: Path) -> Scene:
    """The scene of a file, in a unit near metres.

    Without an entry the scene has no cameras, and all Gaussians are at level 0 of view 0. A damaged entry is ignored
    with a warning, and Gaussians with a non-finite value are left out with a warning.

    Args:
        gaussians: all Gaussians of the file in its order; their labels are not used.
        entry: the pansplat entry, if the file has one.
        path: the file that messages name.
    """
    stated = _parse_entry(entry, path)
    levels, views = _read_labels(stated.runs, len(gaussians), len(stated.cam2world), path)
    kept = select_finite(replace(gaussians, levels=levels, views=views), path)
    if len(gaussians) and not len(kept):
        raise InputError(f"{path}: none of its {len(gaussians)} Gaussians is finite; write the file again")
    overlaps = tuple({pair[:2]: pair for pair in stated.overlaps}.values())
    scene = Scene(
        kept,
        torch.tensor(stated.cam2world, dtype=torch.float64).reshape(-1, 4, 4),
        stated.near,
        stated.far,
        tuple(stated.names),
        stated.model,
        stated.height,
        tuple(stated.gains),
        tuple(stated.starts),
        SceneTour(overlaps, tuple(stated.links), tuple(stated.approximate)) if overlaps else None,
        joint=stated.joint is True,
        frame=WorldFrame(origin=stated.origin),
    )
    return scene.scaled(1 / choose_unit(scene.near))


def select_finite(gaussians: Gaussians, path: Path) -> Gaussians:
    """The Gaussians without NaN and infinite values; a warning says how many are left out."""
    finite = finite_mask(gaussians)
    dropped = len(gaussians) - int(finite.sum())
    if not dropped:
        return gaussians
    warnings.warn(
        f"{path}: left out {dropped} of {len(gaussians)} Gaussians that are not finite", InputWarning, stacklevel=3
    )
    return gaussians.select(finite)


def finite_mask(gaussians: Gaussians) -> Bool[Tensor, "n"]:
    """Mask of the Gaussians without NaN and infinite values."""
    finite = torch.isfinite(gaussians.opacities)
    for field in (gaussians.means, gaussians.scales, gaussians.quats, gaussians.harmonics.flatten(1)):
        # A finite sum has finite terms. Rows with a non-finite sum, which may be an overflow, are checked by term.
        suspect = ~torch.isfinite(field.sum(dim=1))
        finite[suspect] &= torch.isfinite(field[suspect]).all(dim=1)
    return finite


def limit_degree(gaussians: Gaussians, degree: int, path: Path) -> Gaussians:
    """The Gaussians with harmonics up to a degree; a warning if they have a higher one."""
    if gaussians.degree > degree:
        warnings.warn(
            f"{path}: the format holds harmonics up to degree {degree}, those up to {gaussians.degree} are left out",
            InputWarning,
            stacklevel=4,
        )
    return prune(gaussians, degree=degree)


def sort_by_label(gaussians: Gaussians) -> Gaussians:
    """The Gaussians, sorted by level and view if they have more than a few thousand runs of equal labels."""
    if len(find_label_runs(gaussians)) <= _MAX_RUNS:
        return gaussians
    key = gaussians.levels.long() * (int(gaussians.views.max()) + 1) + gaussians.views.long()
    return gaussians.select(torch.sort(key, stable=True).indices)


def find_label_runs(gaussians: Gaussians) -> list[list[int]]:
    """Runs of equal level and view as [level, view, count], in file order."""
    levels, views = gaussians.levels.long().cpu(), gaussians.views.long().cpu()
    if not len(gaussians):
        return []
    changes = ((levels[1:] != levels[:-1]) | (views[1:] != views[:-1])).nonzero()[:, 0] + 1
    starts = torch.cat((changes.new_zeros(1), changes))
    counts = torch.diff(starts, append=starts.new_tensor([len(gaussians)]))
    return torch.stack((levels[starts], views[starts], counts), dim=1).tolist()


class _Entry(Struct):
    """The fields of a pansplat entry; angles in radians."""

    near: float = 0.1
    far: float = 100.0
    height: Annotated[int, Meta(ge=1, le=1 << 16)] = Scene.height
    model: str = ""
    names: Annotated[list[str], Meta(max_length=_MAX_CAMERAS)] = []
    cam2world: Annotated[list[tuple[_Row, _Row, _Row, _Row]], Meta(max_length=_MAX_CAMERAS)] = []
    origin: tuple[_Position, _Position, _Position] = (0.0, 0.0, 0.0)
    gains: list[tuple[_Gain, _Gain, _Gain]] = []
    overlaps: list[tuple[_Camera, _Camera, Annotated[float, Meta(ge=0, le=1)]]] = []
    links: list[tuple[_Camera, _Camera, _Angle, _Angle, str]] = []
    starts: list[tuple[_Angle, _Angle] | None] = []
    approximate: list[tuple[_Camera, _Camera, _Position, _Position, _Angle]] = []
    joint: Any = False
    runs: list[Any] | None = None


def _parse_entry(text: str | None, path: Path) -> _Entry:
    """Content of the entry; the defaults without one, and with a warning when it is damaged."""
    if text is not None:
        try:
            entry = convert(parse_json(text, "comment"), _Entry, "comment")
            require_depth_range(entry.near, entry.far, "comment")
            _require_cameras(entry)
            return entry
        except InputError as error:
            warnings.warn(
                f"{path}: its pansplat comment is damaged ({error}); cameras, levels and views are ignored",
                InputWarning,
                stacklevel=4,
            )
    return _Entry()


def _require_cameras(entry: _Entry) -> None:
    """Raise an InputError if what is stated of the cameras does not fit them."""
    cameras, overlaps = len(entry.cam2world), [pair[:2] for pair in entry.overlaps]
    seen = {camera for pair in overlaps for camera in pair}
    fits = {
        "gains": len(entry.gains) in (0, cameras),
        "overlaps": all(a <= b < cameras for a, b in overlaps) and len(seen) in (0, cameras),
        "links": all(a != b and max(a, b) < cameras for a, b, *_ in entry.links),
        "starts": len(entry.starts) in (0, cameras),
        "approximate": all(a != b and max(a, b) < cameras for a, b, *_ in entry.approximate),
    }
    for name in (name for name, is_fitting in fits.items() if not is_fitting):
        raise InputError(f"comment: needed {name} of its {cameras} cameras, got {getattr(entry, name)!r:.60}")


def _read_labels(runs: list[Any] | None, count: int, cameras: int, path: Path) -> tuple[Tensor, Tensor]:
    """Level and view of each vertex; zeros without labels, or with a warning when they do not fit `count`."""
    try:
        labels = convert(runs or [], list[tuple[_Level, _Camera, _Camera]], path)
        is_fitting = all(view < max(cameras, 1) for _, view, _ in labels) and sum(run[2] for run in labels) == count
    except InputError:
        labels, is_fitting = [], False
    if is_fitting:
        levels, views, counts = torch.tensor(labels, dtype=torch.int64).reshape(-1, 3).T
        return torch.repeat_interleave(levels, counts), torch.repeat_interleave(views, counts)
    if runs is not None:
        warnings.warn(
            f"{path}: its levels and views do not fit its {count} Gaussians (edited by another tool?) and are ignored",
            InputWarning,
            stacklevel=3,
        )
    return torch.zeros(count, dtype=torch.int64), torch.zeros(count, dtype=torch.int64)
