"""Formats of panoramas on disk: `load_pairs` recognises and reads them (docs/input.md).

Each format has a function that recognises a folder and one that reads it into a `Collection`. The argument `convention`
of the readers overrides the format's pose convention. Readers raise an InputError for missing or invalid files; the
message names the file and the entry.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import os
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from jaxtyping import Float
from msgspec import Meta
from torch import Tensor

from pansplat.errors import InputError, InputWarning
from pansplat.images.blur_masks import MASK_SUFFIX, fold_name, list_folders_once, locate_panorama, split_mask_name
from pansplat.images.image_files import READABLE_SUFFIXES, list_masks, list_pictures, require_panorama
from pansplat.inputs.pairs import (
    FAR,
    FAR_SEQUENCE,
    MAX_CONTEXT,
    NEAR,
    Collection,
    Pair,
    Panorama,
    ViewGroup,
    find_mask,
    list_names,
    list_panorama_files,
    localize_pairs,
    single_view_pairs,
    too_many_panoramas,
)
from pansplat.inputs.photographs import (
    LINKS,
    add_links,
    list_further_photographs,
    list_photographs,
    list_unread_panoramas,
    read_photograph,
)
from pansplat.inputs.placements import Placement, is_by_hand, judge, read_rejected, read_ties
from pansplat.inputs.poses import parse_convention, read_number, read_trajectory, rigid_matrix, to_cam2world
from pansplat.inputs.reconstructions import find_reconstruction, read_reconstruction
from pansplat.inputs.stated_files import find_inside, locate_inside
from pansplat.inputs.web_tours import find_web_tour, is_web_tour_file, read_web_tour
from pansplat.inputs.web_tours.entries import plain_text
from pansplat.system.files import expand_home, is_scene_file, is_written, read_file
from pansplat.system.strict_json import read_field, read_json

_POSES, _PAIRS = "poses.json", "pairs.json"
VIDEO_FILES = (".mp4", ".mov", ".mkv", ".webm")
_RAW_SUFFIXES = (".insp", ".insv", ".360", ".dng", ".osv")  # of 360-degree cameras, not stitched
_TABLE_SUFFIXES = (".csv", ".txt", ".json", ".xml", ".bin")  # that may hold poses
_CAMERA_POSES = "camera_pose.json"  # of 360Loc
_PICTURES = (*READABLE_SUFFIXES, ".bmp", ".gif")  # that may be masks

_REJECTED = "rejected by hand"
_MAX_WORLD = 9999  # of poses.json
_MAX_DEPTH = 4  # levels of nested folders that are searched
MATRIX_KEYS = ("cam2world", "world2cam", "pose")
_IMAGE_FOLDERS = ("image", "images", "panos", "frames", ".")  # of a sequence
_Z_UP = torch.tensor(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)), dtype=torch.float64)


@list_folders_once()
def load_pairs(
    path: Path | str, *, convention: str | None = None, near: float | None = None, far: float | None = None
) -> list[Pair]:
    """The pairs at a path, those with targets first. Image files are read when a pair is loaded.

    Poses are in a world of metres around its origin; `Panorama.frame` states where it is in the world of the files.

    Args:
        path: a panorama; a pair folder, a folder of many posed panoramas, or a folder of such folders, in one of the
            formats of docs/input.md (poses.json, nerfstudio, COLMAP, openMVG, OpenSfM, Metashape, PanoGRF, 360Loc,
            KITTI, TUM, game-map triplets); or one of their files with poses. A folder or web tour of a single panorama
            is a pair of one view.
        convention: pose convention, such as "world2cam opengl"; overrides that of the files.
        near, far: radial depth range in metres; overrides that of the files.

    Raises:
        UnposedPanoramasError: the folder or web tour holds two or more panoramas, and no poses.
    """
    root = expand_home(path)
    try:
        pairs = _load_pairs(root, convention, near, far)
    except UnposedPanoramasError as error:
        require_known_masks(root, error.panoramas)
        raise
    require_known_masks(root, [view for pair in pairs for view in pair.context + pair.targets])
    return localize_pairs(pairs)


def load_panoramas(path: Path | str) -> list[Panorama]:
    """All panoramas at a path (see `load_pairs`), with titles, links and start views, with or without poses."""
    try:
        pairs = load_pairs(path)
    except UnposedPanoramasError as error:
        return error.panoramas
    return list({view.image: view for pair in pairs for view in pair.context + pair.targets}.values())


def require_known_masks(root: Path, panoramas: Iterable[Panorama] = ()) -> None:
    """Check that every mask is applied: another one would show what it should hide.

    Args:
        root: a file, or a folder that is searched as by `load_pairs`.
        panoramas: that were read there.
    """
    views = {view.image: view for view in panoramas}
    for image in (*views, *([root] if root.is_file() else ())):
        if split_mask_name(image) is not None:
            raise InputError(f"{image}: needed a panorama, got the mask of another by its name; rename or remove it.")
    folders = dict.fromkeys(_list_folders(root, _MAX_DEPTH) if root.is_dir() else [root.parent])
    read: set[Path] = set()  # pictures
    used: set[Path] = set()
    names: dict[str, Path] = {}  # pictures by their names
    for image, view in views.items():
        places = *list_pictures(image), locate_panorama(image)
        read |= {picture.resolve() for picture in places}
        folders |= dict.fromkeys(folder for file in places for folder in (file.parent, file.resolve().parent))
        used |= {mask.resolve() for mask in (view.mask, *list_masks(image, check=True)) if mask is not None}
        names[fold_name(view.name)] = places[-1]
    listed = ((folder, name) for folder in folders for name in sorted(next(os.walk(folder), ("", [], []))[2]))
    files = [folder / name for folder, name in listed if not (name.startswith(".") or is_scene_file(name))]
    masks = {file: name for file in files if (name := split_mask_name(file)) and file.resolve() not in used}
    pictures = [file for file in files if file.suffix.lower() in _PICTURES and not split_mask_name(file)]
    names |= {fold_name(picture.stem): picture for picture in pictures}
    for mask, (stem, kind) in masks.items():
        own = [
            file for file in pictures if file.parent == mask.parent and fold_name(stem) in ("", fold_name(file.stem))
        ]
        is_named = bool(own) or (mask.parent == root and not stem)
        # Pictures that are not read have masks, too, and poses.json may state another mask of the scene.
        is_spare = kind == MASK_SUFFIX or (stem and read.isdisjoint(file.resolve() for file in own))
        if (is_named and is_spare and mask.suffix.lower() == ".png") or not (
            is_named or mask.suffix.lower() in _PICTURES
        ):
            continue
        near = [names[name] for name in difflib.get_close_matches(fold_name(stem), names, n=1)]
        paths = [file.with_name(f"{file.stem}{kind}.png") for file in near]
        suggestions = [f" (did you mean {path.name if path.parent == mask.parent else path}?)" for path in paths]
        raise InputError(
            f"{mask}: needed the name of a panorama before {kind}.png, got {mask.name!r}{''.join(suggestions)}; "
            "rename, convert or remove the mask."
        )


def _list_folders(folder: Path, depth: int) -> Iterator[Path]:
    """A folder and those below it that can be searched."""
    yield folder
    with contextlib.suppress(OSError):
        for sub in _list_subfolders(folder, depth):
            yield from _list_folders(sub, depth - 1)


def _load_pairs(root: Path, convention: str | None, near: float | None, far: float | None) -> list[Pair]:
    if not root.exists():
        raise InputError(f"{root}: needed a panorama, or a folder of panoramas, got no such path; check it.")
    if root.is_file() and root.suffix.lower() in (*VIDEO_FILES, *_RAW_SUFFIXES):
        raise InputError(f"{root}: needed panoramas, got {_advise_on_file(root)}.")
    try:
        if root.suffix.lower() in READABLE_SUFFIXES and root.is_file():
            return single_view_pairs([read_photograph(root)], root.parent, near, far)
        if root.is_file() and root in triplet_files(root.parent):
            collections = [(root.parent, read_triplet(root, convention))]
        elif root.is_file() and not _is_pose_file(root) and not _is_posed_tour(root):
            return _make_unposed_pairs(root.parent, _read_tour_file(root), near, far)
        else:
            root = root.parent if root.is_file() else root
            collections = _search(root, partial(_find_collections, convention=convention))
            if collections:
                _note_unread_panoramas(root, *_list_files(collections))
        unposed = [] if collections else _list_unposed(root)
    except OSError as error:
        raise InputError(
            f"{error.filename or root}: needed a readable folder, got '{error.strerror}'; check its permissions."
        ) from error
    if unposed:
        return _make_unposed_pairs(root, unposed, near, far)
    if not collections:
        require_known_masks(root)
        raise _nothing_found(root)
    collections = [(folder, _leave_out_damaged(collection)) for folder, collection in collections]
    pairs = [pair for folder, collection in collections for pair in collection.pairs(folder, near, far)]
    return make_names_unique(sorted(pairs, key=lambda pair: not pair.targets))


def _is_pose_file(file: Path) -> bool:
    stated = file.name in (_POSES, _PAIRS, _CAMERA_POSES, LINKS)
    return stated or file in (find_trajectory(file.parent), find_reconstruction(file.parent))


def _is_posed_tour(file: Path) -> bool:
    """Whether a file describes a web tour with a poses.json beside it."""
    return is_web_tour_file(file) and (file.parent / _POSES).exists() and find_web_tour(file.parent) is not None


def list_stated_files(folder: Path) -> list[Path]:
    """The files of a folder that state poses, pairs, links or a web tour; those of fixed names need not exist."""
    files = [folder / name for name in (_POSES, _PAIRS, _CAMERA_POSES, LINKS)]
    try:
        others = (
            find_trajectory(folder), find_reconstruction(folder), find_web_tour(folder), *triplet_files(folder)
        )  # fmt: skip
    except (OSError, InputError):
        return files
    return files + [file for file in others if file is not None]


def _read_tour_file(file: Path) -> list[Panorama]:
    if not is_web_tour_file(file):
        raise InputError(
            f"{file}: needed a panorama, a folder of panoramas, its file of poses, or a web tour, got another file; "
            "give the folder."
        )
    return add_links(read_web_tour(file), file.parent)


def _list_unposed(root: Path) -> list[Panorama]:
    """The panoramas of a web tour in a folder, or else the pictures of the folder; a faulty tour gives a warning."""
    source, problem = find_web_tour(root), None
    if source is not None:
        try:
            panoramas = add_links(read_web_tour(source), source.parent)
        except InputError as error:
            problem = error
        else:
            _note_unread_panoramas(root, _list_pictures(panoramas), set(), depth=0)
            return panoramas
    try:
        panoramas = list_photographs(root)
    except InputError:
        if problem is not None:
            raise problem from None
        raise
    if problem is not None:
        if not panoramas:
            raise problem
        warnings.warn(f"the web tour is left out: {problem}", category=InputWarning, stacklevel=3)
    if panoramas:
        _note_unread_panoramas(root, set(), {root})
    return panoramas


def _list_pictures(panoramas: Iterable[Panorama]) -> set[Path]:
    """The files that panoramas are made from, resolved."""
    files = [file for view in panoramas for file in (*list_pictures(view.image), view.mask, view.depth)]
    return {file.resolve() for file in files if file is not None}


def _list_files(collections: Sequence[tuple[Path, Collection]]) -> tuple[set[Path], set[Path]]:
    """The files of collections, and the folders of which all panoramas are in them."""
    files = _list_pictures(view for _, found in collections for view in (*found.panoramas, *found.unposed))
    return files, {folder for _, found in collections for folder in found.folders}


def _note_unread_panoramas(folder: Path, known: set[Path], read: set[Path], depth: int = _MAX_DEPTH) -> None:
    """Warn about the panoramas in a folder and those below it that are not read.

    Args:
        folder: at the path that the user gave, or below.
        known: resolved files that are read.
        read: folders of which all panoramas are read.
        depth: levels of folders below.
    """
    unread = [] if folder in read else list_unread_panoramas(folder, known)
    if unread:
        warnings.warn(
            f"{folder}: panoramas are left out, because the tour or the poses in another folder do not name them: "
            f"{list_names(unread)}; open them by their own path, or add their poses.",
            category=InputWarning,
            stacklevel=3,
        )
    for sub in _list_subfolders(folder, depth):
        tour = None if sub in read else find_web_tour(sub)
        if tour is None:
            _note_unread_panoramas(sub, known, read, depth - 1)
        else:
            warnings.warn(f"left out: {tour} is another tour; open it by its own path.", InputWarning, stacklevel=3)


def _make_unposed_pairs(folder: Path, panoramas: list[Panorama], near: float | None, far: float | None) -> list[Pair]:
    """The pair of a single panorama; an error for more, whose poses must be estimated."""
    if len(panoramas) > 1:
        raise UnposedPanoramasError(folder, panoramas)
    (pair,) = single_view_pairs(panoramas, folder, near, far)
    return [dataclasses.replace(pair, name=folder.resolve().name)]


def _search(root: Path, find: Callable[[Path, int, bool], list[Any]]) -> list[Any]:
    """What is found at or below a folder; exports of pansplat in subfolders count only if there is nothing else."""
    found = find(root, _MAX_DEPTH, False)
    return found if found or not all(map(is_written, list_panorama_files(root))) else find(root, _MAX_DEPTH, True)


def _find_collections(folder: Path, depth: int, exports: bool, convention: str | None) -> list[tuple[Path, Collection]]:
    """The collections in a folder itself, or else those in its subfolders."""
    if (folder / _POSES).exists():  # the reader refuses what is no file
        return [(folder, read_pose_file_folder(folder, convention))]
    if is_loc360_sequence(folder):
        return [(folder, _with_further(read_loc360_sequence(folder, convention)))]
    if is_matterport3d_scene(folder):
        return [(folder, read_matterport3d_scene(folder, convention))]
    if triplets := triplet_files(folder):
        return [(folder, read_triplet(path, convention)) for path in triplets]
    if find_trajectory(folder) is not None:
        return [(folder, read_trajectory_folder(folder, convention))]
    if (source := find_reconstruction(folder)) is not None:
        given = None if convention is None else parse_convention(convention, "`convention`")
        found = read_reconstruction(source, folder, given)
        is_joined = any(len(list_pictures(view.image)) > 1 for view in found.panoramas)
        return [(folder, found if is_joined else _with_further(found))]
    if find_web_tour(folder) is not None:
        return []
    find = partial(_find_collections, depth=depth - 1, exports=exports, convention=convention)
    return [found for sub in _list_subfolders(folder, depth, exports) for found in find(sub)]


def _leave_out_damaged(collection: Collection) -> Collection:
    """The collection without the panoramas that cannot be used, and without the pairs that need them."""
    problems: dict[int, InputError] = {}
    for number, panorama in enumerate(collection.panoramas):
        try:
            if not panorama.image.is_file():
                raise InputError(
                    f"{collection.source}: needed the image {panorama.image}, got no such file; correct the name or "
                    "add the file."
                )
            require_panorama(panorama.image)
        except InputError as error:
            problems[number] = error
    if not problems:
        return collection
    kept = [number for number in range(len(collection.panoramas)) if number not in problems]
    place = {number: index for index, number in enumerate(kept)}
    groups = None
    if collection.groups is not None:
        left = [[tuple(place[n] for n in part if n in place) for part in group] for group in collection.groups]
        groups = tuple((context, targets) for context, targets in left if len(context) > 1)
    if len(kept) < 2 or groups == ():
        raise next(iter(problems.values()))
    for error in problems.values():
        warnings.warn(f"left out: {error}", category=InputWarning, stacklevel=3)
    return dataclasses.replace(collection, panoramas=tuple(collection.panoramas[n] for n in kept), groups=groups)


def _with_further(sequence: Collection) -> Collection:
    """A sequence or reconstruction with the panoramas beside its frames that have no pose."""
    folders = tuple(dict.fromkeys(view.image.parent for view in sequence.panoramas))
    unposed = tuple(_list_further(sequence.source, folders, sequence.panoramas))
    return dataclasses.replace(sequence, unposed=unposed, folders=folders)


def find_panorama_folders(root: Path) -> list[Path]:
    """The folders at or below a path that hold panoramas or their poses; no file is read, and they may be faulty.

    Raises:
        OSError: a folder cannot be listed.
    """
    return _search(root, _find_panorama_folders)


def _find_panorama_folders(folder: Path, depth: int, exports: bool) -> list[Path]:
    has_poses = (folder / _POSES).exists() or is_loc360_sequence(folder) or is_matterport3d_scene(folder)
    if has_poses or triplet_files(folder) or find_trajectory(folder) is not None or list_panorama_files(folder):
        return [folder]
    if find_reconstruction(folder) is not None or find_web_tour(folder) is not None:
        return [folder]
    find = partial(_find_panorama_folders, depth=depth - 1, exports=exports)
    return [found for sub in _list_subfolders(folder, depth, exports) for found in find(sub)]


def _list_subfolders(folder: Path, depth: int, exports: bool = True) -> list[Path]:
    """Subfolders to search, sorted; none at depth 0."""
    found = sorted(folder.iterdir()) if depth else []
    subfolders = [sub for sub in found if sub.is_dir() and not sub.name.startswith((".", "__"))]
    return [sub for sub in subfolders if exports or not _is_export(sub)]


def _is_export(folder: Path) -> bool:
    """Whether pansplat wrote the folder: a training set, or all pictures of a folder without poses."""
    if (folder / "transforms.json").is_file():
        return is_written(folder / "transforms.json")
    pictures = [] if (folder / _POSES).exists() else list_panorama_files(folder)
    return bool(pictures) and all(map(is_written, pictures))


class UnposedPanoramasError(InputError):
    """A folder or web tour holds two or more panoramas, and no poses in a known format."""

    def __init__(self, folder: Path, panoramas: list[Panorama]) -> None:
        names = _list_first([panorama.image.name for panorama in panoramas])
        super().__init__(
            f"{folder}: needed poses for the panoramas, got images only ({names}); run `pansplat pose {folder} -o "
            f"{folder / _POSES}`, or add a pose file (docs/input.md)."
        )
        self.folder = folder
        self.panoramas = panoramas


def _nothing_found(root: Path) -> InputError:
    inside = [folder for folder in find_panorama_folders(root) if folder != root]
    others = [file for file in sorted(root.iterdir()) if file.suffix.lower() in (*VIDEO_FILES, *_RAW_SUFFIXES)]
    tables = [file for file in sorted(root.iterdir()) if file.suffix.lower() in _TABLE_SUFFIXES and file.is_file()]
    if inside:
        got = f"some without poses in {_list_first([str(folder.relative_to(root)) for folder in inside])}; "
        advice = f"open one of these folders, or run `pansplat pose {inside[0]} -o {inside[0] / _POSES}` for each"
    elif others:
        got, advice = _advise_on_file(others[0]), ""
    else:
        got = (
            "none; " if not tables else f"none, and {_list_first([file.name for file in tables])}, of no known format; "
        )
        advice = "give the folder that holds the pictures; docs/input.md lists the formats of poses"
    return InputError(f"{root}: needed panoramas (JPG, PNG, TIFF, WebP, HEIC or EXR), got {got}{advice}.")


def _advise_on_file(file: Path) -> str:
    """What a video or a file of a camera is, and what to do with it."""
    if file.suffix.lower() in VIDEO_FILES:
        return (
            f"the video {file.name}; `pansplat pose {file} -o FOLDER` writes its key frames and their poses, then open "
            "FOLDER"
        )
    return f"{file.name}, which the program of its camera must stitch; export it as a 2:1 JPG or MP4"


def _list_first(names: list[str]) -> str:
    return ", ".join(names[:3]) + (" ..." if len(names) > 3 else "")


def make_names_unique(pairs: list[Pair]) -> list[Pair]:
    """Prefix equal names with the folder's name, then append a number to names that are still equal."""
    counts = Counter(pair.name for pair in pairs)
    names = [p.name if counts[p.name] == 1 else f"{p.folder.resolve().name}_{p.name}" for p in pairs]
    counts, seen = Counter(names), Counter()
    for i, name in enumerate(names):
        seen[name] += 1
        names[i] = name if counts[name] == 1 else f"{name}_{seen[name]}"
    return [dataclasses.replace(pair, name=name) for pair, name in zip(pairs, names, strict=True)]


def _choose_convention(convention: str | None, default: str) -> str:
    return default if convention is None else parse_convention(convention, "`convention`")


# poses.json with an optional pairs.json: the package's own format.


def read_pose_file_folder(folder: Path, convention: str | None = None) -> Collection:
    """The panoramas of poses.json, and the groups of pairs.json. File names in them are relative to the folder.

    Warns about other panoramas of the folder, and of the folders of those in poses.json, which have no pose.
    """
    source = folder / _POSES
    content = read_json(source)
    entries = content.get("poses") if isinstance(content, dict) else None
    if not isinstance(entries, dict):
        raise InputError(
            f'{source}: needed {{"convention": ..., "poses": {{image: pose, ...}}}}, got no object "poses"; '
            "see docs/input.md."
        )
    is_stated = convention is None
    text, origin = (content.get("convention"), source) if is_stated else (convention, "`convention`")
    convention = parse_convention(text, origin)
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
    further = rest if tour else _list_further(source, folders, panoramas, reasons)
    unposed = [_explain_unposed(view, reasons, source) for view in further]
    linked = add_links([*panoramas, *unposed], folder)
    ranges = _read_ranges(content, source)
    near, far = (
        read_field(content, key, float, source, default)
        for key, default in zip(("near", "far"), ranges.pop(0, (NEAR, FAR)), strict=True)
    )
    groups = _read_groups(folder / _PAIRS, list(entries)) if (folder / _PAIRS).is_file() else None
    if groups is not None:
        groups = _drop_groups_of_several_worlds(folder / _PAIRS, groups, panoramas)
    worlds = Counter(panorama.world for panorama in panoramas)
    count = sum(max(size - 1, 1) for size in worlds.values()) if groups is None else len(groups)
    is_single = count == 1 and (len(panoramas) > 1 or not unposed)
    return Collection(
        source,
        tuple(linked[: len(panoramas)]),
        groups,
        near=near,
        far=far,
        ranges=ranges,
        name=folder.resolve().name if is_single else None,
        unposed=tuple(linked[len(panoramas) :]),
        folders=folders,
    )


def _read_tour_of_folder(folder: Path) -> dict[str, Panorama]:
    """The panoramas of the web tour in a folder, by the names that poses.json may have for them.

    Empty without a tour, and for a faulty one, with a warning. The names are those of scenes, and files' paths.
    """
    source = find_web_tour(folder)
    try:
        views = [] if source is None else read_web_tour(source)
    except InputError as error:
        warnings.warn(f"the web tour is left out: {error}", category=InputWarning, stacklevel=4)
        return {}
    paths = {os.path.relpath(view.image, folder).replace(os.sep, "/"): view for view in views}
    return paths | {view.name: view for view in views}


def _judge_entries(content: dict[str, Any], panoramas: Sequence[Panorama], source: Path) -> list[Panorama]:
    """The panoramas of poses.json with their placements."""
    entries = content["poses"]
    by_hand = {name for name, entry in entries.items() if is_by_hand(entry)}
    ties, placements = read_ties(content.get("estimate")), {}
    for world in {panorama.world for panorama in panoramas}:
        names = [name for name, view in zip(entries, panoramas, strict=True) if view.world == world]
        placements |= judge(names, ties, by_hand, source)
    rejected = {name for poses in read_rejected(content) for name in poses}
    return [
        dataclasses.replace(
            panorama, placement=dataclasses.replace(placements[name], is_rejected=name in rejected - by_hand)
        )
        for name, panorama in zip(entries, panoramas, strict=True)
    ]


def _read_reasons(content: dict[str, Any]) -> dict[str, str]:
    """Why panoramas have no pose, by the names of their files, as poses.json states it."""
    estimate = content.get("estimate")
    reasons = estimate.get("unplaced") if isinstance(estimate, dict) else None
    rejected = [name for poses in read_rejected(content) for name in poses]
    return (reasons if isinstance(reasons, dict) else {}) | dict.fromkeys(rejected, _REJECTED)


def _explain_unposed(panorama: Panorama, reasons: dict[str, str], source: Path) -> Panorama:
    """A panorama beside those of poses.json, with the reason that it states."""
    reason = str(reasons.get(panorama.image.name, f"{_POSES} has no pose of it"))
    placement = Placement("not placed", reason, source, is_rejected=reason == _REJECTED)
    return dataclasses.replace(panorama, placement=placement)


def _drop_groups_of_several_worlds(
    source: Path, groups: tuple[ViewGroup, ...], panoramas: Sequence[Panorama]
) -> tuple[ViewGroup, ...] | None:
    """The groups whose panoramas have a common world, with a note if there are others; None if none has one."""
    kept = tuple(group for group in groups if len({panoramas[n].world for part in group for n in part}) == 1)
    if len(kept) < len(groups):
        warnings.warn(
            f"left out of {source}: {len(groups) - len(kept)} of {len(groups)} pairs, whose poses are in different "
            f"worlds of {_POSES}.",
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


def _list_further(
    source: Path, folders: Sequence[Path], panoramas: Sequence[Panorama], stated: Iterable[str] = ()
) -> list[Panorama]:
    """The panoramas of folders that have no pose, with a warning that names them."""
    files = [file for view in panoramas for file in (view.image, view.mask, view.depth) if file is not None]
    unposed = list_further_photographs(folders, files, [view.name for view in panoramas], set(stated))
    if unposed:
        warnings.warn(
            f"{source} has no pose of {list_names([view.image for view in unposed])}; each is a scene of its own.",
            category=InputWarning,
            stacklevel=5,
        )
    return unposed


def _read_pose_entry(
    folder: Path, name: str, entry: Any, convention: str, is_stated: bool, view: Panorama | None
) -> Panorama:
    """One entry of poses.json.

    Args:
        folder: of the file.
        name: of the entry.
        entry: its value.
        convention: of the pose.
        is_stated: whether `convention` comes from the file.
        view: what a web tour states of the panorama; None for a file.
    """
    source = f"{folder / _POSES}, {name!r}"
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


def _read_groups(source: Path, names: list[str]) -> tuple[ViewGroup, ...]:
    """Triplets, then pairs of a pairs.json, as indices into `names`.

    Images without a pose are left out, and pairs that need them, with a note, if a pair remains.
    """
    content = read_json(source)
    if not isinstance(content, dict) or not any(key in content for key in ("pairs", "triplets")):
        raise InputError(
            f'{source}: needed {{"pairs": [{{"context": [a, b], "target": [m]}}]}}, got neither "pairs" nor '
            '"triplets"; see docs/input.md.'
        )
    groups, numbers = [], {name: number for number, name in enumerate(names)}
    unposed: dict[str, str] = {}  # image, and the first entry that names it
    dropped = 0
    for key in ("triplets", "pairs"):
        entries = read_field(content, key, list, source, [])
        for number, entry in enumerate(entries, start=1):
            where = f"{source}, {key} {number}"
            context, target = (entry.get("context"), entry.get("target")) if isinstance(entry, dict) else (None, None)
            context = _as_names(context)
            if context is None or len(set(context)) < max(2, len(context)):
                raise InputError(
                    f'{where}: needed two or more different images as "context", a list of names, '
                    f"got {str(entry)[:60]}; correct it."
                )
            targets = _as_names([target] if isinstance(target, str) else target or [])
            if targets is None:
                raise InputError(f'{where}: needed an image or a list of images as "target", got {target}; correct it.')
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
            else:
                dropped += 1
    if unposed and not groups:
        _find_name(*next((name, numbers, where) for name, where in unposed.items()))
    if unposed:
        pairs = f"; {dropped} of {dropped + len(groups)} pairs need them" if dropped else ""
        warnings.warn(
            f"left out of {source}, without a pose in {_POSES}: {list_names([Path(name) for name in unposed])}{pairs}.",
            category=InputWarning,
            stacklevel=4,
        )
    if not groups:
        raise InputError(f"{source}: needed at least one pair, got none; add one or remove the file.")
    return tuple(groups)


def _as_names(value: Any) -> list[str] | None:
    """The value if it is a list of strings, else None."""
    return value if isinstance(value, list) and all(isinstance(name, str) for name in value) else None


def _find_name(name: str, names: dict[str, int], where: str) -> int:
    if name in names:
        return names[name]
    close = difflib.get_close_matches(name, names, n=1)
    suggestion = f" (did you mean {close[0]!r}?)" if close else ""
    raise InputError(f"{where}: needed images that have a pose in {_POSES}, got {name!r}{suggestion}; add its pose.")


# PanoGRF's rendered Matterport3D scenes (docs/official.md, section 2.1): one folder per view with rgb.png, depth.png
# (uint16, millimetres), rot.txt (3x3) and tran.txt (3), camera to world with Habitat's axes (camera and world y up).


def is_matterport3d_scene(folder: Path) -> bool:
    """Whether subfolders have a rot.txt or tran.txt."""
    return bool(_view_folders(folder))


def read_matterport3d_scene(folder: Path, convention: str | None = None) -> Collection:
    """The views of a scene folder, sorted by name: the first and last are the context, those between are targets.

    The world is rotated to z-up, as in the official code.
    """
    convention = _choose_convention(convention, "cam2world opengl")
    panoramas = tuple(_read_view_folder(view, folder, convention) for view in _view_folders(folder))
    last = len(panoramas) - 1
    groups = (((0, last), tuple(range(1, last))),) if last > 0 else None
    return Collection(folder, panoramas, groups, name=folder.resolve().name)


def _view_folders(folder: Path) -> list[Path]:
    names = ("rot.txt", "tran.txt")
    return [v for v in sorted(folder.iterdir()) if v.is_dir() and any((v / name).is_file() for name in names)]


def _read_view_folder(view: Path, folder: Path, convention: str) -> Panorama:
    image = view / "rgb.png"
    if not image.is_file():
        raise InputError(f"{view}: needed rgb.png next to rot.txt and tran.txt, got none; add it.")
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = _read_numbers(view / "rot.txt", 9).reshape(3, 3)
    matrix[:3, 3] = _read_numbers(view / "tran.txt", 3)
    cam2world = _Z_UP @ to_cam2world(rigid_matrix(matrix.tolist(), str(view / "rot.txt")), convention)
    depth = view / "depth.png"
    mask = find_mask(image, folder)
    return Panorama(view.name, image, cam2world, mask, depth if depth.is_file() else None, is_scan=True)


def _read_numbers(path: Path, count: int) -> Float[Tensor, "count"]:
    """Exactly `count` numbers from a text file."""
    if not path.is_file():
        raise InputError(f"{path}: needed the pose of the view, got no such file; add it.")
    try:
        values = np.array(read_file(path, limit=1 << 20).decode().split(), dtype=np.float64)
    except (ValueError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: needed {count} numbers, got other text ({error}); correct it.") from error
    if values.size != count:
        raise InputError(f"{path}: needed {count} numbers, got {values.size}; correct it.")
    return torch.from_numpy(values)


# Triplets rendered from game maps: NAME.json with NAME_0.png, NAME_1.png, NAME_2.png and their _depth.png (uint16,
# radial, millimetres).


def triplet_files(folder: Path) -> list[Path]:
    """The NAME.json files of a folder that have a NAME_0.png."""
    return [path for path in sorted(folder.glob("*.json")) if path.with_name(f"{path.stem}_0.png").is_file()]


def read_triplet(source: Path, convention: str | None = None) -> Collection:
    """The views of a NAME.json, which has `c2w`, a list of cam2world matrices with OpenCV axes.

    The first and last view are the context, those between are targets.
    """
    convention = _choose_convention(convention, "cam2world opencv")
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
        cam2world = to_cam2world(rigid_matrix(matrix, f"{source}, pose {i}"), convention)
        mask = find_mask(image, source.parent)
        panoramas.append(Panorama(image.stem, image, cam2world, mask, depth if depth.is_file() else None))
    last = len(panoramas) - 1
    return Collection(source, tuple(panoramas), (((0, last), tuple(range(1, last))),), name=source.stem)


# Sequences of frames: a 360Loc camera_pose.json (docs/official.md, section 2.2), or a KITTI or TUM trajectory.


def is_loc360_sequence(folder: Path) -> bool:
    """Whether the folder has a camera_pose.json."""
    return (folder / _CAMERA_POSES).is_file()


def read_loc360_sequence(folder: Path, convention: str | None = None) -> Collection:
    """The frames of a 360Loc sequence in the order of camera_pose.json ({frame: 4x4 matrix}); images are in image/.

    The matrices are cam2world with OpenCV axes, as the official code reads them.
    """
    source = folder / _CAMERA_POSES
    convention = _choose_convention(convention, "cam2world opencv")
    content = read_json(source)
    if not isinstance(content, dict):
        raise InputError(
            f"{source}: needed {{frame: 4x4 matrix, ...}}, got {type(content).__name__}; see docs/input.md."
        )
    panoramas = []
    for frame, matrix in content.items():
        inside = locate_inside(folder, frame, f"{source}, {frame!r}").relative_to(folder)
        places = [folder / sub / inside for sub in _IMAGE_FOLDERS]
        image = next((place for place in places if place.is_file()), places[0])
        cam2world = to_cam2world(rigid_matrix(matrix, f"{source}, {frame!r}"), convention)
        panoramas.append(Panorama(image.stem, image, cam2world, find_mask(image, folder)))
    return Collection(source, tuple(panoramas), ordered=True, far=FAR_SEQUENCE)


def find_trajectory(folder: Path) -> Path | None:
    """The trajectory file of a folder (*.kitti, *.tum, poses.txt, *trajectory*.txt); an error if there are several."""
    found = [
        path
        for path in sorted(folder.iterdir())
        if path.is_file()
        and (
            path.suffix.lower() in (".kitti", ".tum")
            or (path.suffix.lower() == ".txt" and ("trajectory" in path.stem.lower() or path.stem.lower() == "poses"))
        )
    ]
    if len(found) > 1:
        raise InputError(
            f"{folder}: needed one trajectory file, got {', '.join(path.name for path in found)}; keep the right one."
        )
    return found[0] if found else None


def read_trajectory_folder(folder: Path, convention: str | None = None) -> Collection:
    """The images of a folder, sorted by name, with the poses of its trajectory file: image i has line i.

    The number in scale.txt, if there is one, converts the translations to metres.
    """
    source = find_trajectory(folder)
    if source is None:
        raise InputError(f"{folder}: needed a trajectory (*.kitti, *.tum, poses.txt), got none; add it.")
    expected = source.suffix.lower().lstrip(".")
    if expected == "txt":
        expected = next((kind for kind in ("kitti", "tum") if kind in source.stem.lower()), None)
    trajectory = read_trajectory(source, convention, expected)
    images: list[Path] = []
    for sub in _IMAGE_FOLDERS:
        images = images or (list_panorama_files(folder / sub) if (folder / sub).is_dir() else [])
    if len(images) != len(trajectory.poses):
        raise InputError(
            f"{source}: needed one pose per image ({len(images)} images), got {len(trajectory.poses)} "
            f"{trajectory.kind.upper()} poses; keep only the images that were tracked, in order, or "
            "use poses.json."
        )
    scale = read_number(folder / "scale.txt") if (folder / "scale.txt").is_file() else 1.0
    panoramas = tuple(
        Panorama(image.stem, image, pose, find_mask(image, folder))
        for image, pose in zip(images, trajectory.scaled_poses(scale), strict=True)
    )
    return Collection(source, panoramas, ordered=True, far=FAR_SEQUENCE)
