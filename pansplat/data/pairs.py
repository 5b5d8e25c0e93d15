"""From a path to pairs, whatever known layout is there."""

from __future__ import annotations

import dataclasses
from collections import Counter
from pathlib import Path

from pansplat.data.collection import Collection, pictures_in
from pansplat.data.game_maps import read_triplet, triplet_files
from pansplat.data.matterport3d import is_matterport3d_scene, read_matterport3d_scene
from pansplat.data.pair import Pair, Panorama
from pansplat.data.pose_file import is_pose_file_folder, read_pose_file_folder
from pansplat.data.sequences import (
    is_loc360_sequence,
    read_loc360_sequence,
    read_trajectory_folder,
    trajectory_file,
)
from pansplat.errors import InputError

__all__ = ["Pair", "Panorama", "load_pairs"]

_DEPTH = 4  # folders in folders that are looked into


def load_pairs(
    path: Path | str, *, convention: str | None = None, near: float | None = None, far: float | None = None
) -> list[Pair]:
    """The pairs at a path, those with targets first. Pictures are read later, when a pair is asked for them.

    Args:
        path: a pair folder, a folder of many posed panoramas, or a folder of such folders; docs/input.md has
            the
            formats (poses.json, PanoGRF, 360Loc, KITTI, TUM, game-map triplets). Also one of their .json
            files.
        convention: pose convention, such as "world2cam opengl", to use instead of what the files say.
        near, far: radial depth range in metres, instead of what the files say.

    Raises:
        InputError: nothing usable there, or the first thing that is wrong in what is there.
    """
    root = Path(path).expanduser()
    if not root.exists():
        raise InputError(f"{root}: needed a folder of posed panoramas, got no such path; check it.")
    triplet = root if root.is_file() and root in triplet_files(root.parent) else None
    if root.is_file():
        if root.suffix.lower() not in (".json", ".kitti", ".tum", ".txt"):
            raise InputError(f"{root}: needed a folder of posed panoramas, got a file; give the folder that holds it.")
        root = root.parent
    try:
        collections = [(root, read_triplet(triplet, convention))] if triplet else _collections(root, convention, _DEPTH)
    except OSError as error:
        raise InputError(
            f"{error.filename or root}: needed a readable folder, got '{error.strerror}'; check its rights."
        ) from error
    if not collections:
        raise _nothing_found(root)
    pairs = [pair for folder, collection in collections for pair in collection.pairs(folder, near, far)]
    return _with_unique_names(sorted(pairs, key=lambda pair: not pair.targets))


def _collections(folder: Path, convention: str | None, depth: int) -> list[tuple[Path, Collection]]:
    """The collections of a folder itself, or else those of the folders in it."""
    if is_pose_file_folder(folder):
        return [(folder, read_pose_file_folder(folder, convention))]
    if is_loc360_sequence(folder):
        return [(folder, read_loc360_sequence(folder, convention))]
    if is_matterport3d_scene(folder):
        return [(folder, read_matterport3d_scene(folder, convention))]
    if triplets := triplet_files(folder):
        return [(folder, read_triplet(path, convention)) for path in triplets]
    if trajectory_file(folder) is not None:
        return [(folder, read_trajectory_folder(folder, convention))]
    if depth == 0:
        return []
    inner = [sub for sub in sorted(folder.iterdir()) if sub.is_dir() and not sub.name.startswith((".", "__"))]
    return [found for sub in inner for found in _collections(sub, convention, depth - 1)]


def _nothing_found(root: Path) -> InputError:
    images = pictures_in(root)
    if images:
        names = ", ".join(path.name for path in images[:3]) + (" ..." if len(images) > 3 else "")
        return InputError(
            f"{root}: needed poses for the panoramas, got pictures only ({names}); add a poses.json "
            "or another pose file, see docs/input.md."
        )
    return InputError(
        f"{root}: needed two or more panoramas with poses (poses.json, camera_pose.json, rot.txt and "
        "tran.txt, *.kitti or *.tum), got none of these files there or in its folders; see docs/input.md."
    )


def _with_unique_names(pairs: list[Pair]) -> list[Pair]:
    """The same pairs; where two have one name the folder's name goes before it, then a number after it."""
    counts = Counter(pair.name for pair in pairs)
    names = [p.name if counts[p.name] == 1 else f"{p.folder.resolve().name}_{p.name}" for p in pairs]
    counts, seen = Counter(names), Counter()
    for i, name in enumerate(names):
        seen[name] += 1
        names[i] = name if counts[name] == 1 else f"{name}_{seen[name]}"
    return [dataclasses.replace(pair, name=name) for pair, name in zip(pairs, names, strict=True)]
