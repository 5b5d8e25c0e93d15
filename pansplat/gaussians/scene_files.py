"""What scene files of all formats share: the pansplat entry, labels, and the removal of Gaussians that are not finite.

Input cameras, the depth range, and the level and view of each Gaussian are no part of the formats. One JSON object, the
pansplat entry, holds them where a format has a place for comments; other tools skip it.
"""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from pansplat.errors import InputError, InputWarning
from pansplat.gaussians.scene import Gains, Gaussians, Links, Overlaps, Scene, Starts, empty_gaussians, prune
from pansplat.geometry.world import MAX_POSITION, WorldFrame, choose_unit, require_depth_range
from pansplat.strict_json import list_field, number_field, parse_json, require_object, text_field

Y_UP = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64))  # from y down to y up, and back

_MAX_RUNS = 4096  # the Gaussians are sorted if the entry would list more runs, which take megabytes
_DEFAULT_NEAR, _DEFAULT_FAR = 0.1, 100.0  # depth range, metres, for a file without one
_MAX_HEIGHT, _MAX_CAMERAS, _MAX_LEVEL = 1 << 16, 1 << 12, 255
_MAX_GAIN = 1e3
_MAX_ANGLE = 4 * np.pi  # radians


def format_entry(scene: Scene, runs: list[list[int]]) -> str:
    """The pansplat entry of a scene as ASCII JSON without line breaks; the Gaussians are not used.

    Positions of files are relative to the origin of the scene's frame, because float32 does not hold large ones.

    Args:
        runs: see `find_label_runs`.
    """
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
        **({"overlaps": scene.overlaps} if scene.overlaps else {}),
        **({"links": [[*link[:4], _escape(link[4])] for link in scene.links]} if scene.links else {}),
        **({"starts": scene.starts} if any(scene.starts) else {}),
        **({"joint": True} if scene.joint else {}),
        "runs": runs,
    }
    return json.dumps(content, separators=(",", ":"))


def _escape(text: str) -> str:
    """The text, valid as Unicode."""
    return text.encode(errors="backslashreplace").decode()


def make_scene(gaussians: Gaussians, entry: str | None, path: Path) -> Scene:
    """The scene of a file, in a unit near metres.

    Without an entry the scene has no cameras, and all Gaussians are at level 0 of view 0. A damaged entry is ignored
    with a warning, and Gaussians with a non-finite value are left out with a warning.

    Args:
        gaussians: all Gaussians of the file in its order; their labels are not used.
        entry: the pansplat entry, if the file has one.
        path: the file that messages name.

    Raises:
        InputError: no Gaussian is finite.
    """
    scene, runs = _parse_entry(entry, path)
    levels, views = _read_labels(runs, len(gaussians), len(scene.cam2world), path)
    kept = select_finite(replace(gaussians, levels=levels, views=views), path)
    if len(gaussians) and not len(kept):
        raise InputError(f"{path}: none of its {len(gaussians)} Gaussians is finite; write the file again")
    return replace(scene, gaussians=kept).scaled(1 / choose_unit(scene.near))


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


_Entry = tuple[Scene, list[Any] | None]
"""A scene without Gaussians, and the runs of labels."""


def _parse_entry(entry: str | None, path: Path) -> _Entry:
    """Content of the entry; the defaults without one, and with a warning when it is damaged."""
    if entry is not None:
        try:
            return _read_entry(parse_json(entry, "comment"))
        except InputError as error:
            warnings.warn(
                f"{path}: its pansplat comment is damaged ({error}); cameras, levels and views are ignored",
                InputWarning,
                stacklevel=4,
            )
    no_cameras = torch.zeros(0, 4, 4, dtype=torch.float64)
    return Scene(empty_gaussians(), no_cameras, _DEFAULT_NEAR, _DEFAULT_FAR), None


def _read_entry(content: Any) -> _Entry:
    """The fields of a pansplat entry; an InputError if one has another type, or is out of range."""
    content = require_object(content, "comment")
    near = number_field(content, "near", "comment")
    far = number_field(content, "far", "comment")
    near, far = _DEFAULT_NEAR if near is None else near, _DEFAULT_FAR if far is None else far
    require_depth_range(near, far, "comment")
    height = number_field(content, "height", "comment", low=1, high=_MAX_HEIGHT, whole=True)
    names = list_field(content, "names", "comment")
    poses = list_field(content, "cam2world", "comment")
    if len(poses) > _MAX_CAMERAS or len(names) > _MAX_CAMERAS:
        raise InputError(f"comment: needed at most {_MAX_CAMERAS} cameras, got {max(len(poses), len(names))}")
    scene = Scene(
        empty_gaussians(),
        torch.from_numpy(np.array([_read_pose(pose) for pose in poses], np.float64).reshape(-1, 4, 4)),
        near,
        far,
        tuple(str(name) for name in names),
        text_field(content, "model", "comment") or "",
        Scene.height if height is None else int(height),
        _read_gains(list_field(content, "gains", "comment"), len(poses)),
        _read_overlaps(list_field(content, "overlaps", "comment"), len(poses)),
        _read_links(list_field(content, "links", "comment"), len(poses)),
        _read_starts(list_field(content, "starts", "comment"), len(poses)),
        joint=content.get("joint") is True,
        frame=WorldFrame(origin=_read_origin(list_field(content, "origin", "comment"))),
    )
    return scene, list_field(content, "runs", "comment")


def _read_origin(values: list[Any]) -> tuple[float, float, float]:
    if values and not (len(values) == 3 and all(type(v) in (int, float) and abs(v) <= MAX_POSITION for v in values)):
        raise InputError(f"comment: needed three numbers up to {MAX_POSITION:g} in origin, got {values!r:.60}")
    x, y, z = map(float, values or (0, 0, 0))
    return x, y, z


def _read_gains(rows: list[Any], cameras: int) -> Gains:
    """Three factors for each camera, or nothing."""
    numbers = [value for row in rows for value in (row if isinstance(row, list) else [None])]
    are_factors = all(type(value) in (int, float) and 0 < value < _MAX_GAIN for value in numbers)
    if rows and not (are_factors and len(rows) == cameras and all(len(row) == 3 for row in rows)):
        raise InputError(
            f"comment: needed three numbers above 0 and below {_MAX_GAIN:g} for each of the {cameras} cameras in "
            f"gains, got {rows!r:.60}"
        )
    return tuple(tuple(map(float, row)) for row in rows)


def _read_overlaps(rows: list[Any], cameras: int) -> Overlaps:
    """Edges of which each camera has one or more, or nothing."""
    edges: dict[tuple[int, int], float] = {}
    for row in rows:
        a, b, overlap = row if isinstance(row, list) and len(row) == 3 else (None, None, None)
        is_edge = _is_camera(a, cameras) and _is_camera(b, cameras) and a <= b
        if not is_edge or type(overlap) not in (int, float) or not 0 <= overlap <= 1:
            raise InputError(
                f"comment: needed two of the {cameras} cameras and a number from 0 to 1 in overlaps, got {row!r:.60}"
            )
        edges[a, b] = overlap
    if edges and (missing := set(range(cameras)) - {camera for edge in edges for camera in edge}):
        raise InputError(f"comment: needed overlaps of all {cameras} cameras, got none of camera {min(missing)}")
    return tuple((a, b, overlap) for (a, b), overlap in edges.items())


def _read_links(rows: list[Any], cameras: int) -> Links:
    """Links between two cameras, or nothing."""
    links: list[tuple[int, int, float, float, str]] = []
    for row in rows:
        a, b, *angles, text = row if isinstance(row, list) and len(row) == 5 else (None,) * 5
        are_cameras = _is_camera(a, cameras) and _is_camera(b, cameras) and a != b
        if not are_cameras or not _are_angles(angles) or not isinstance(text, str):
            raise InputError(
                f"comment: needed two of the {cameras} cameras, two angles and a text in links, got {row!r:.60}"
            )
        links.append((a, b, *map(float, angles), text))
    return tuple(links)


def _read_starts(rows: list[Any], cameras: int) -> Starts:
    """Two angles or nothing for each camera, or nothing."""
    for row in rows:
        if row is not None and not (isinstance(row, list) and _are_angles(row)):
            raise InputError(f"comment: needed two angles, or null, in starts, got {row!r:.60}")
    if rows and len(rows) != cameras:
        raise InputError(f"comment: needed one of each of the {cameras} cameras in starts, got {len(rows)}")
    return tuple(None if row is None else tuple(map(float, row)) for row in rows)


def _is_camera(value: Any, cameras: int) -> bool:
    return type(value) is int and 0 <= value < cameras


def _are_angles(values: list[Any]) -> bool:
    """Whether the values are two angles within two turns, radians."""
    return len(values) == 2 and all(type(value) in (int, float) and abs(value) <= _MAX_ANGLE for value in values)


def _read_pose(rows: Any) -> np.ndarray:
    """A pose (4, 4) of the comment; the reader of JSON has refused numbers that are not finite."""
    try:
        pose = np.array(rows, np.float64)
    except (TypeError, ValueError):
        pose = np.zeros(0)
    if pose.shape != (4, 4) or not np.abs(pose).max() <= MAX_POSITION:  # null is NaN
        raise InputError(f"comment: needed 4x4 numbers up to {MAX_POSITION:g} in cam2world, got {rows!r:.60}")
    return pose


def _read_labels(runs: list[Any] | None, count: int, cameras: int, path: Path) -> tuple[Tensor, Tensor]:
    """Level and view of each vertex; zeros without labels, or with a warning when they do not fit `count`."""
    zeros = torch.zeros(count, dtype=torch.int64), torch.zeros(count, dtype=torch.int64)
    if runs is None:
        return zeros
    if not _are_runs(runs, count, max(cameras, 1)):
        warnings.warn(
            f"{path}: its levels and views do not fit its {count} Gaussians (edited by another tool?) and are ignored",
            InputWarning,
            stacklevel=3,
        )
        return zeros
    levels, views, counts = torch.tensor(runs, dtype=torch.int64).reshape(-1, 3).T
    return torch.repeat_interleave(levels, counts), torch.repeat_interleave(views, counts)


def _are_runs(runs: list[Any], count: int, views: int) -> bool:
    """Whether the runs are [level, view, length] whose lengths sum to `count`, in Python's integers of any size."""
    for run in runs:
        if not isinstance(run, list) or len(run) != 3 or any(type(number) is not int or number < 0 for number in run):
            return False
        if run[0] > _MAX_LEVEL or run[1] >= views or run[2] > count:
            return False
    return sum(run[2] for run in runs) == count
