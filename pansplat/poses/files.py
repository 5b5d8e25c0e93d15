"""Pose files of estimated poses, and the automatic estimate for a folder of panoramas without poses."""

from __future__ import annotations

import hashlib
import json
import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pansplat.atomic import replacing
from pansplat.cache import cache_folders, write_cache_file
from pansplat.data.folders import read_pose_file_folder
from pansplat.data.pairs import Pair
from pansplat.errors import InputError
from pansplat.geometry.pose import quats_from_rotations
from pansplat.poses.estimate import PoseEstimate, estimate_poses
from pansplat.predictor import Progress
from pansplat.strict_json import read_json

_FORMAT = "2"  # version of the estimate; part of the cache's key
SUFFIXES = (".json", ".tum", ".kitti")


def write_poses(estimate: PoseEstimate, path: Path) -> None:
    """Write a poses.json, or a trajectory in the TUM or KITTI format by the suffix.

    Names in a poses.json are relative to its folder. A trajectory has one line for each panorama that has a pose, in
    the order of the names; the timestamps of TUM are the panoramas' numbers.

    Raises:
        InputError: another suffix, or the file cannot be written.
    """
    if path.suffix.lower() == ".json":
        folder = path.resolve().parent
        names = {image: Path(os.path.relpath(image.resolve(), folder)).as_posix() for image in estimate.poses}
        _write(path, json.dumps(_make_content(estimate, names), indent=1) + "\n")
        return
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: needed a name ending in {', '.join(SUFFIXES)}, got {path.suffix!r}; rename it.")
    lines = []
    for image, pose in sorted(estimate.poses.items()):
        if path.suffix.lower() == ".kitti":
            numbers = list(pose[:3].reshape(-1))
        else:
            w, x, y, z = quats_from_rotations(torch.from_numpy(pose[:3, :3])).tolist()
            numbers = [float(estimate.images.index(image)), *pose[:3, 3], x, y, z, w]
        lines.append(" ".join(f"{number:.9g}" for number in numbers))
    _write(path, "\n".join(lines) + "\n")


def _write(path: Path, text: str) -> None:
    with replacing(path) as temporary:
        temporary.write_text(text)


def _make_content(estimate: PoseEstimate, names: Mapping[Path, str]) -> dict[str, Any]:
    return {
        "convention": "cam2world opencv",
        "near": round(estimate.near, 3),
        "far": round(estimate.far, 3),
        "poses": {names[image]: np.round(pose, 9).tolist() for image, pose in estimate.poses.items()},
        "estimate": {
            "summary": estimate.summary,
            "unplaced": {image.name: reason for image, reason in estimate.unplaced.items()},
        },
    }


def estimate_pairs(
    folder: Path,
    images: list[Path],
    *,
    near: float | None = None,
    far: float | None = None,
    progress: Progress | None = None,
) -> list[Pair]:
    """The pairs of a folder of panoramas without poses; the estimated poses are cached like predictions.

    A warning states the figures of the check, and the panoramas that have no pose.

    Raises:
        InputError: see `estimate_poses`.
    """
    name = f"poses-{_hash_files(images)}.json"
    folders = cache_folders(folder)
    source = next((cache / name for cache in folders if (cache / name).is_file()), None)
    if source is None:
        estimate = estimate_poses(images, progress=progress)
        content = _make_content(estimate, {image: image.name for image in images})
        source = write_cache_file(folders, name, json.dumps(content).encode())
        if source is None:
            raise InputError(
                f"{folder}: needed a writable cache folder for the poses, got none of {folders}; make one."
            )
    _report(folder, read_json(source))
    return read_pose_file_folder(folder, source=source).pairs(folder, near, far)


def _report(folder: Path, content: dict[str, Any]) -> None:
    estimate = content["estimate"]
    warnings.warn(
        f"{folder} has no poses; they were estimated: {estimate['summary']}. `pansplat pose` writes them to a file.",
        stacklevel=4,
    )
    for image, reason in estimate["unplaced"].items():
        warnings.warn(f"{image} has no pose: {reason}", stacklevel=4)


def _hash_files(images: list[Path]) -> str:
    digest = hashlib.blake2b(_FORMAT.encode(), digest_size=12)
    for image in images:
        state = image.stat()
        digest.update(os.fsencode(f"{image.name} {state.st_size} {state.st_mtime_ns};"))
    return digest.hexdigest()
