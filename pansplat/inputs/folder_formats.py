"""Folders of posed panoramas by format: poses.json, data sets, and sequences of frames (docs/input.md).

`pansplat.inputs.formats` describes the functions that find and read them.
"""

from __future__ import annotations

import dataclasses
import difflib
import os
import warnings
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import torch
from jaxtyping import Float
from msgspec import Meta, Struct
from torch import Tensor

from pansplat.errors import InputError, InputWarning
from pansplat.inputs.panorama_sets import (
    FAR,
    FAR_SEQUENCE,
    MAX_CONTEXT,
    NEAR,
    Collection,
    Panorama,
    ViewGroup,
    find_mask,
    list_names,
    too_many_panoramas,
)
from pansplat.inputs.photographs import list_further, with_further
from pansplat.inputs.placements import (
    ApproximatePlace,
    Placement,
    is_by_hand,
    read_approximate,
    read_unit,
)
from pansplat.inputs.poses import (
    parse_convention,
    parse_numbers,
    rigid_matrix,
    to_cam2world,
)
from pansplat.inputs.stated_files import find_inside, locate_inside
from pansplat.inputs.web_tours import find_web_tours, read_web_tour
from pansplat.inputs.web_tours.entries import plain_text
from pansplat.system.descriptions import describe_count
from pansplat.system.files import read_file
from pansplat.system.strict_json import read_field, read_json

POSES, PAIRS = "poses.json", "pairs.json"
_MAX_WORLD = 9999  # largest number of a world in poses.json
MATRIX_KEYS = ("cam2world", "world2cam", "pose")
_IMAGE_FOLDERS = ("image", "images", "panos", "frames", ".")  # folders of a sequence that may hold its pictures
_Z_UP = torch.tensor(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)), dtype=torch.float64)
CAMERA_POSES = "camera_pose.json"  # name of 360Loc's file


# poses.json with an optional pairs.json: the package's own format.


def read_pose_file(source: Path, folder: Path, convention: str | None = None) -> Collection:
    """The panoramas of poses.json, and the groups of pairs.json. File names in them are relative to the folder.

    Warns about other panoramas of the folder, and of the folders of those in poses.json, which have no pose.
    """
    content = read_json(source)
    entries = content.get("poses") if isinstance(content, dict) else None
    if not isinstance(entries, dict):
        raise InputError(
            f'{source}: needed {{"convention": ..., "poses": {{image: pose, ...}}}}, got no object "poses"; '
            "see docs/input.md."
        )
    is_stated = convention is None
    convention = convention or parse_convention(content.get("convention"), source)
    tour = _read_tour_of_folder(folder)
    panoramas = tuple(
        _read_pose_entry(folder, name, entry, convention, is_stated, tour.get(name)) for name, entry in entries.items()
    )
    if not panoramas:
        raise InputError(f"{source}: needed poses of one or more panoramas, got none; add them or remove the file.")
    panoramas = tuple(_judge_entries(content, panoramas, source))
    folders = tuple(dict.fromkeys((folder, *(view.image.parent for view in panoramas))))
    reasons, known = _read_reasons(content), {view.image for view in panoramas}
    rest = [view for view in dict.fromkeys(tour.values()) if view.image not in known]
    further = rest if tour else list_further(source, folders, panoramas, reasons)
    units = {name: read_unit(content, view.world) for name, view in zip(entries, panoramas, strict=True)}
    named = tour | {os.path.relpath(view.image, folder).replace(os.sep, "/"): view for view in further}
    named |= dict(zip(entries, panoramas, strict=True))
    about = read_approximate(content.get("estimate"), {n: view.image for n, view in named.items()}, units)
    unposed = [_explain_unposed(view, reasons, about.get(view.image), source) for view in further]
    ranges = _read_ranges(content, source)
    near, far = (
        read_field(content, key, float, source, default)
        for key, default in zip(("near", "far"), ranges.pop(0, (NEAR, FAR)), strict=True)
    )
    groups = _read_groups(folder / PAIRS, list(entries)) if (folder / PAIRS).is_file() else None
    if groups is not None:
        groups = _drop_groups_of_several_worlds(folder / PAIRS, groups, panoramas)
    worlds = Counter(panorama.world for panorama in panoramas)
    count = sum(max(size - 1, 1) for size in worlds.values()) if groups is None else len(groups)
    is_single = count == 1 and (len(panoramas) > 1 or not unposed)
    return Collection(
        source,
        folder,
        panoramas,
        groups,
        near=near,
        far=far,
        ranges=ranges,
        name=folder.resolve().name if is_single else None,
        unposed=tuple(unposed),
        folders=folders,
    )


def _read_tour_of_folder(folder: Path) -> dict[str, Panorama]:
    """The panoramas of the web tour in a folder, by the names that poses.json may have for them.

    Empty without a tour, and for a faulty one, with a warning. The names are those of scenes, and files' paths.
    """
    try:
        views = [view for source in find_web_tours(folder) for view in read_web_tour(source, folder).unposed]
    except InputError as error:
        warnings.warn(f"the web tour is left out: {error}", category=InputWarning, stacklevel=4)
        return {}
    paths = {os.path.relpath(view.image, folder).replace(os.sep, "/"): view for view in views}
    return paths | {view.name: view for view in views}


def _judge_entries(content: dict[str, Any], panoramas: Sequence[Panorama], source: Path) -> list[Panorama]:
    """The panoramas of poses.json with their placements."""
    sizes, alone = Counter(view.world for view in panoramas), "no other panorama has a pose with it"
    return [
        dataclasses.replace(
            view,
            placement=Placement("not placed", alone, source)
            if sizes[view.world] == 1
            else Placement("by hand" if is_by_hand(entry) else "placed", source=source),
        )
        for entry, view in zip(content["poses"].values(), panoramas, strict=True)
    ]


def _read_reasons(content: dict[str, Any]) -> dict[str, str]:
    """Why panoramas have no pose, by the names of their files, as poses.json states it."""
    estimate = content.get("estimate")
    reasons = estimate.get("unplaced") if isinstance(estimate, dict) else None
    return reasons if isinstance(reasons, dict) else {}


def _explain_unposed(
    panorama: Panorama, reasons: dict[str, str], about: ApproximatePlace | None, source: Path
) -> Panorama:
    """A panorama beside those of poses.json, with the reason that it states."""
    reason = str(reasons.get(panorama.image.name, f"{POSES} has no pose of it"))
    placement = Placement("not placed", reason, source, about=about)
    return dataclasses.replace(panorama, placement=placement)


def _drop_groups_of_several_worlds(
    source: Path, groups: tuple[ViewGroup, ...], panoramas: Sequence[Panorama]
) -> tuple[ViewGroup, ...] | None:
    """The groups whose panoramas have a common world, with a note if there are others; None if none has one."""
    kept = tuple(group for group in groups if len({panoramas[n].world for part in group for n in part}) == 1)
    if len(kept) < len(groups):
        warnings.warn(
            f"left out of {source}: {len(groups) - len(kept)} of {describe_count(len(groups), 'pair')}, "
            f"whose poses are in different worlds of {POSES}.",
            category=InputWarning,
            stacklevel=4,
        )
    return kept or None


def _read_ranges(content: dict[str, Any], source: Path) -> dict[int, tuple[float, float]]:
    """Near and far of the worlds of poses.json that state both."""
    ranges = {}
    for number, world in enumerate(read_field(content, "worlds", list[dict[str, Any]], source, [])):
        near, far = (read_field(world, key, float, f"{source}, worlds[{number}]") for key in ("near", "far"))
        if near is not None and far is not None:
            ranges[number] = near, far
    return ranges


def _read_pose_entry(
    folder: Path, name: str, entry: Any, convention: str, is_stated: bool, view: Panorama | None
) -> Panorama:
    """One entry of poses.json.

    Args:
        folder: the folder of poses.json.
        name: the key of the entry.
        entry: its value.
        convention: that of the pose.
        is_stated: whether `convention` comes from the file.
        view: what a web tour states of the panorama; None for a file.
    """
    source = f"{folder / POSES}, {name!r}"
    if view is None:
        image = locate_inside(folder, name, source)
        view = Panorama(image.stem, image, torch.eye(4, dtype=torch.float64), find_mask(image, folder))
    matrix, mask, depth, world, room = entry, None, None, 0, ""
    if isinstance(entry, dict):
        key = next((key for key in MATRIX_KEYS if key in entry), None)
        if key is None:
            raise InputError(f'{source}: needed a pose, got only {sorted(entry)}; add its 4x4 matrix as "cam2world".')
        if is_stated and key in ("cam2world", "world2cam") and not convention.startswith(key):
            raise InputError(
                f'{source}: needed one convention, got the key "{key}" under the convention "{convention}"; '
                "make them agree."
            )
        matrix = entry[key]
        mask, depth = (_optional_file(folder, entry, key, source) for key in ("mask", "depth"))
        world = read_field(entry, "world", Annotated[int, Meta(ge=0, le=_MAX_WORLD)], source, 0)
        room = plain_text(entry.get("room"))
    cam2world = to_cam2world(rigid_matrix(matrix, source), convention)
    return dataclasses.replace(
        view, cam2world=cam2world, mask=mask or view.mask, depth=depth, world=world, title=room or view.title
    )


def _optional_file(folder: Path, entry: dict[str, Any], key: str, source: str) -> Path | None:
    if entry.get(key) is None:
        return None
    path = locate_inside(folder, str(entry[key]), source)
    if path.is_file():
        return path
    if key != "depth":
        raise InputError(f'{source}: needed the {key} file {path}, got no such file; correct or remove "{key}".')
    warnings.warn(f"{source}: its depth is left out: there is no file {path}.", InputWarning, stacklevel=5)
    return None


class _Group(Struct):
    context: list[str]
    target: str | list[str] | None = None


class _Groups(Struct):
    triplets: list[_Group] = []
    pairs: list[_Group] = []


def _read_groups(source: Path, names: list[str]) -> tuple[ViewGroup, ...]:
    """Triplets, then pairs of a pairs.json, as indices into `names`.

    Images without a pose are left out, and pairs that need them, with a note, if a pair remains.
    """
    content = read_json(source, _Groups)
    stated = [
        *((f"{source}, triplets {number}", group) for number, group in enumerate(content.triplets, start=1)),
        *((f"{source}, pairs {number}", group) for number, group in enumerate(content.pairs, start=1)),
    ]
    if not stated:
        raise InputError(
            f'{source}: needed {{"pairs": [{{"context": [a, b], "target": [m]}}]}}, got none; add one or remove the '
            "file (docs/input.md)."
        )
    groups, numbers = [], {name: number for number, name in enumerate(names)}
    unposed: dict[str, str] = {}  # image, and the first entry that names it
    for where, group in stated:
        context, targets = group.context, [group.target] if isinstance(group.target, str) else group.target or []
        if len(set(context)) < max(2, len(context)):
            raise InputError(
                f'{where}: needed two or more different images as "context", a list of names, got {str(context)[:60]}; '
                "correct it."
            )
        if len(context) > MAX_CONTEXT:
            raise too_many_panoramas(where, len(context))
        unposed |= {
            name: where
            for name in (*context, *targets)
            if name not in {**numbers, **unposed} and find_inside(source.parent, name) is not None
        }
        first, second = (
            tuple(_find_name(name, numbers, where) for name in part if name not in unposed)
            for part in (context, targets)
        )
        if len(first) > 1:
            groups.append((first, second))
    if unposed and not groups:
        _find_name(*next((name, numbers, where) for name, where in unposed.items()))
    if unposed:
        dropped = len(stated) - len(groups)
        pairs = f"; pairs that need them: {dropped} of {len(stated)}" if dropped else ""
        warnings.warn(
            f"left out of {source}, without a pose in {POSES}: {list_names([Path(name) for name in unposed])}{pairs}.",
            category=InputWarning,
            stacklevel=4,
        )
    return tuple(groups)


def _find_name(name: str, names: dict[str, int], where: str) -> int:
    if name in names:
        return names[name]
    close = difflib.get_close_matches(name, names, n=1)
    suggestion = f" (did you mean {close[0]!r}?)" if close else ""
    raise InputError(f"{where}: needed images that have a pose in {POSES}, got {name!r}{suggestion}; add its pose.")


# PanoGRF's rendered Matterport3D scenes (docs/official.md, section 2.1): one folder per view with rgb.png, depth.png
# (uint16, millimetres), rot.txt (3x3) and tran.txt (3), camera to world with Habitat's axes (camera and world y up).


def list_panogrf_files(folder: Path) -> list[Path]:
    """The poses of the views of a scene folder."""
    folders = [view for view in sorted(folder.iterdir()) if view.is_dir()]
    return [file for view in folders for name in ("rot.txt", "tran.txt") if (file := view / name).is_file()]


def find_panogrf(folder: Path) -> list[Path]:
    """The folder, if it is that of a scene."""
    return [folder] if list_panogrf_files(folder) else []


def read_panogrf_scene(source: Path, folder: Path, convention: str | None = None) -> Collection:
    """The views of a scene folder, sorted by name: the first and last are the context, those between are targets.

    The world is rotated to z-up, as in the official code.
    """
    convention = convention or "cam2world opengl"
    views = dict.fromkeys(file.parent for file in list_panogrf_files(source))
    panoramas = [_read_view_folder(view, folder, convention) for view in views]
    return _join_ends(source, folder, panoramas, folder.resolve().name)


def _join_ends(source: Path, folder: Path, panoramas: Sequence[Panorama], name: str) -> Collection:
    """The first and the last panorama as the context, and those between as targets."""
    last = len(panoramas) - 1
    groups = (((0, last), tuple(range(1, last))),) if last > 0 else None
    return Collection(source, folder, tuple(panoramas), groups, name=name)


def _read_view_folder(view: Path, folder: Path, convention: str) -> Panorama:
    image = view / "rgb.png"
    if not image.is_file():
        raise InputError(f"{view}: needed rgb.png next to rot.txt and tran.txt, got none; add it.")
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = _read_numbers(view / "rot.txt", 9).reshape(3, 3)
    matrix[:3, 3] = _read_numbers(view / "tran.txt", 3)
    cam2world = _Z_UP @ to_cam2world(rigid_matrix(matrix.tolist(), f"{view / 'rot.txt'} with tran.txt"), convention)
    depth = view / "depth.png"
    mask = find_mask(image, folder)
    return Panorama(view.name, image, cam2world, mask, depth if depth.is_file() else None, is_scan=True)


def _read_numbers(path: Path, count: int) -> Float[Tensor, "count"]:
    """Exactly `count` numbers from a text file."""
    if not path.is_file():
        raise InputError(f"{path}: needed the pose of the view, got no such file; add it.")
    return parse_numbers(read_file(path, limit=1 << 20).decode(errors="replace"), count, path)


# Triplets rendered from game maps: NAME.json with NAME_0.png, NAME_1.png, NAME_2.png and their _depth.png (uint16,
# radial, millimetres).


def find_triplets(folder: Path) -> list[Path]:
    """The NAME.json files of a folder that have a NAME_0.png."""
    return [path for path in sorted(folder.glob("*.json")) if path.with_name(f"{path.stem}_0.png").is_file()]


def read_triplet(source: Path, folder: Path, convention: str | None = None) -> Collection:
    """The views of a NAME.json, which has `c2w`, a list of cam2world matrices with OpenCV axes.

    The first and last view are the context, those between are targets.
    """
    content = read_json(source)
    matrices = content.get("c2w") if isinstance(content, dict) else None
    if not isinstance(matrices, list) or len(matrices) < 2:
        raise InputError(f'{source}: needed a list of two or more 4x4 matrices as "c2w", got none; see docs/input.md.')
    panoramas = []
    for i, matrix in enumerate(matrices):
        image = source.with_name(f"{source.stem}_{i}.png")
        if not image.is_file():
            raise InputError(f"{source}: needed the image {image.name} for pose {i}, got no such file; add it.")
        depth = source.with_name(f"{source.stem}_{i}_depth.png")
        cam2world = to_cam2world(rigid_matrix(matrix, f"{source}, pose {i}"), convention or "cam2world opencv")
        mask = find_mask(image, folder)
        panoramas.append(Panorama(image.stem, image, cam2world, mask, depth if depth.is_file() else None))
    return _join_ends(source, folder, panoramas, source.stem)


# Sequences of frames: a 360Loc camera_pose.json (docs/official.md, section 2.2).


def read_loc360_sequence(source: Path, folder: Path, convention: str | None = None) -> Collection:
    """The frames of a 360Loc sequence in the order of camera_pose.json ({frame: 4x4 matrix}); images are in image/.

    The matrices are cam2world with OpenCV axes, as the official code reads them.
    """
    convention = convention or "cam2world opencv"
    content = read_json(source)
    if not isinstance(content, dict) or not content:
        raise InputError(f"{source}: needed {{frame: 4x4 matrix, ...}}, got {str(content)[:40]}; see docs/input.md.")
    panoramas = []
    for frame, matrix in content.items():
        inside = locate_inside(folder, frame, f"{source}, {frame!r}").relative_to(folder)
        places = [folder / sub / inside for sub in _IMAGE_FOLDERS]
        image = next((place for place in places if place.is_file()), places[0])
        cam2world = to_cam2world(rigid_matrix(matrix, f"{source}, {frame!r}"), convention)
        panoramas.append(Panorama(image.stem, image, cam2world, find_mask(image, folder)))
    return with_further(Collection(source, folder, tuple(panoramas), ordered=True, far=FAR_SEQUENCE))
