"""Panoramas at a path: `load_pairs` searches folders for those of a known format and reads them (docs/input.md)."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import itertools
import os
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from pansplat.errors import InputError, InputWarning, collect_notes
from pansplat.images.blur_masks import MASK_SUFFIX, fold_name, list_folders_once, locate_panorama, split_mask_name
from pansplat.images.image_files import READABLE_SUFFIXES, list_masks, list_pictures, require_panorama
from pansplat.inputs.folder_formats import (
    CAMERA_POSES,
    PAIRS,
    POSES,
    find_trajectory,
    is_loc360_sequence,
    is_matterport3d_scene,
    read_loc360_sequence,
    read_matterport3d_scene,
    read_pose_file_folder,
    read_trajectory_folder,
    read_triplet,
    triplet_files,
    with_further,
)
from pansplat.inputs.pairs import (
    Collection,
    Pair,
    Panorama,
    list_names,
    list_panorama_files,
    localize_pairs,
    single_view_pairs,
)
from pansplat.inputs.photographs import LINKS, add_links, list_photographs, list_unread_panoramas, read_photograph
from pansplat.inputs.poses import parse_convention
from pansplat.inputs.reconstructions import find_reconstruction, read_reconstruction
from pansplat.inputs.web_tours import find_web_tour, is_web_tour_file, read_web_tour
from pansplat.inputs.web_tours.entries import make_panorama
from pansplat.system.descriptions import list_first
from pansplat.system.files import expand_home, is_scene_file, is_written, require_text
from pansplat.system.options import CAMERA_HEIGHT

VIDEO_FILES = (".mp4", ".mov", ".mkv", ".webm")
_RAW_SUFFIXES = (".insp", ".insv", ".360", ".dng", ".osv")  # of 360-degree cameras, not stitched
_TABLE_SUFFIXES = (".csv", ".txt", ".json", ".xml", ".bin")  # that may hold poses
_PICTURES = (*READABLE_SUFFIXES, ".bmp", ".gif")  # that may be masks

_MAX_DEPTH = 4  # levels of nested folders that are searched


@list_folders_once()
def load_pairs(
    path: Path | str,
    *,
    convention: str | None = None,
    near: float | None = None,
    far: float | None = None,
    camera_height: float = CAMERA_HEIGHT,
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
        camera_height: of the cameras over the floor, metres.

    Raises:
        UnposedPanoramasError: the folder or web tour holds two or more panoramas, and no poses.
    """
    root = expand_home(path)
    if not root.is_dir():
        require_text(root)
    convention = None if convention is None else parse_convention(convention, "`convention`")
    try:
        pairs = _load_pairs(root, convention, near, far)
    except UnposedPanoramasError as error:
        require_known_masks(root, error.panoramas)
        raise
    require_known_masks(root, [view for pair in pairs for view in pair.context + pair.targets])
    return localize_pairs(pairs, camera_height)


def load_panoramas(path: Path | str) -> list[Panorama]:
    """All panoramas at a path (see `load_pairs`), with titles, links and start views, with or without poses."""
    try:
        pairs = load_pairs(path)
    except UnposedPanoramasError as error:
        return error.panoramas
    return list({view.image: view for pair in pairs for view in pair.context + pair.targets}.values())


@list_folders_once()
def list_unposed(paths: Sequence[Path]) -> list[Panorama]:
    """The panoramas of folders, files of web tours, and pictures, with links and titles; no poses are read.

    Those of a folder are the scenes of its web tour, or else its pictures.
    """
    panoramas: list[Panorama] = []
    siblings: dict[Path, dict[Path, Panorama]] = {}
    for path in paths:
        if not path.exists():
            raise InputError(f"{path}: needed a folder of panoramas or a file, got no such path; check it.")
        if path.is_dir() or is_web_tour_file(path):
            found = _list_unposed(path) if path.is_dir() else _read_tour_file(path)
            require_known_masks(path, found if path.is_dir() else ())
        else:
            if path.parent not in siblings:
                siblings[path.parent] = _list_silently(path.parent)
            found = [siblings[path.parent].get(path) or make_panorama(path.stem, path, path.parent)]
            require_known_masks(path)
        panoramas += found
    return panoramas


def _list_silently(folder: Path) -> dict[Path, Panorama]:
    """The panoramas of a folder by their files, without notes about other files."""
    with collect_notes(), contextlib.suppress(InputError):
        return {panorama.image: panorama for panorama in _list_unposed(folder)}
    return {}


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
            collections = _link_collections([read_triplet(root, convention)], root.parent)
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
    stated = file.name in (POSES, PAIRS, CAMERA_POSES, LINKS)
    return stated or file in (find_trajectory(file.parent), find_reconstruction(file.parent))


def _is_posed_tour(file: Path) -> bool:
    """Whether a file describes a web tour with a poses.json beside it."""
    return is_web_tour_file(file) and (file.parent / POSES).exists() and find_web_tour(file.parent) is not None


def list_stated_files(folder: Path) -> list[Path]:
    """The files of a folder that state poses, pairs, links or a web tour; those of fixed names need not exist."""
    files = [folder / name for name in (POSES, PAIRS, CAMERA_POSES, LINKS)]
    try:
        others = (
            find_trajectory(folder), find_reconstruction(folder), find_web_tour(folder), *triplet_files(folder)
        )  # fmt: skip
    except (OSError, InputError):
        return files
    stated = [file for file in others if file is not None]
    return list(dict.fromkeys([*files, *stated, *(place / LINKS for place in _list_link_folders(folder))]))


def _read_tour_file(file: Path) -> list[Panorama]:
    if not is_web_tour_file(file):
        raise InputError(
            f"{file}: needed a panorama, a folder of panoramas, its file of poses, or a web tour, got another file; "
            "give the folder."
        )
    return _add_links(read_web_tour(file), file.parent)


def _list_link_folders(folder: Path) -> list[Path]:
    """The folders whose links.json is read: a folder, and that of the data of its web tour."""
    tour = find_web_tour(folder)
    return list(dict.fromkeys((folder, *([] if tour is None else [tour.parent]))))


def _add_links(panoramas: Sequence[Panorama], folder: Path) -> list[Panorama]:
    """The panoramas of a folder with what each links.json of it states; the notes go to the last one."""
    for place in _list_link_folders(folder):
        panoramas = add_links(panoramas, place)
    return list(panoramas)


def _link_collections(collections: Sequence[Collection], folder: Path) -> list[tuple[Path, Collection]]:
    """The collections of a folder with what its links.json states."""
    linked = iter(_add_links([view for found in collections for view in (*found.panoramas, *found.unposed)], folder))
    return [
        (
            folder,
            dataclasses.replace(
                found,
                panoramas=tuple(itertools.islice(linked, len(found.panoramas))),
                unposed=tuple(itertools.islice(linked, len(found.unposed))),
            ),
        )
        for found in collections
    ]


def _list_unposed(root: Path) -> list[Panorama]:
    """The panoramas of a web tour in a folder, or else the pictures of the folder; a faulty tour gives a warning."""
    source, problem = find_web_tour(root), None
    if source is not None:
        try:
            panoramas = _add_links(read_web_tour(source), root)
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
    if collections := _read_collections(folder, convention):
        return _link_collections(collections, folder)
    if find_web_tour(folder) is not None:
        return []
    find = partial(_find_collections, depth=depth - 1, exports=exports, convention=convention)
    return [found for sub in _list_subfolders(folder, depth, exports) for found in find(sub)]


def _read_collections(folder: Path, convention: str | None) -> list[Collection]:
    """The collections in a folder, without its links.json."""
    if (folder / POSES).exists():  # the reader refuses what is no file
        return [read_pose_file_folder(folder, convention)]
    if is_loc360_sequence(folder):
        return [with_further(read_loc360_sequence(folder, convention))]
    if is_matterport3d_scene(folder):
        return [read_matterport3d_scene(folder, convention)]
    if triplets := triplet_files(folder):
        return [read_triplet(path, convention) for path in triplets]
    if find_trajectory(folder) is not None:
        return [read_trajectory_folder(folder, convention)]
    if (source := find_reconstruction(folder)) is not None:
        found = read_reconstruction(source, folder, convention)
        is_joined = any(len(list_pictures(view.image)) > 1 for view in found.panoramas)
        return [found if is_joined else with_further(found)]
    return []


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


def find_panorama_folders(root: Path) -> list[Path]:
    """The folders at or below a path that hold panoramas or their poses; no file is read, and they may be faulty.

    Raises:
        OSError: a folder cannot be listed.
    """
    return _search(root, _find_panorama_folders)


def _find_panorama_folders(folder: Path, depth: int, exports: bool) -> list[Path]:
    has_poses = (folder / POSES).exists() or is_loc360_sequence(folder) or is_matterport3d_scene(folder)
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
    pictures = [] if (folder / POSES).exists() else list_panorama_files(folder)
    return bool(pictures) and all(map(is_written, pictures))


class UnposedPanoramasError(InputError):
    """A folder or web tour holds two or more panoramas, and no poses in a known format."""

    def __init__(self, folder: Path, panoramas: list[Panorama]) -> None:
        names = list_first([panorama.file_label for panorama in panoramas])
        super().__init__(
            f"{folder}: needed poses for the panoramas, got images only ({names}); run `pansplat pose {folder} -o "
            f"{folder / POSES}`, or add a pose file (docs/input.md)."
        )
        self.folder = folder
        self.panoramas = panoramas


def _nothing_found(root: Path) -> InputError:
    inside = [folder for folder in find_panorama_folders(root) if folder != root]
    others = [file for file in sorted(root.iterdir()) if file.suffix.lower() in (*VIDEO_FILES, *_RAW_SUFFIXES)]
    tables = [file for file in sorted(root.iterdir()) if file.suffix.lower() in _TABLE_SUFFIXES and file.is_file()]
    if inside:
        got = f"some without poses in {list_first([str(folder.relative_to(root)) for folder in inside])}; "
        advice = f"open one of these folders, or run `pansplat pose {inside[0]} -o {inside[0] / POSES}` for each"
    elif others:
        got, advice = _advise_on_file(others[0]), ""
    else:
        got = (
            "none; " if not tables else f"none, and {list_first([file.name for file in tables])}, of no known format; "
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


def make_names_unique(pairs: list[Pair]) -> list[Pair]:
    """Prefix equal names with the folder's name, then append a number to names that are still equal."""
    counts = Counter(pair.name for pair in pairs)
    names = [p.name if counts[p.name] == 1 else f"{p.folder.resolve().name}_{p.name}" for p in pairs]
    counts, seen = Counter(names), Counter()
    for i, name in enumerate(names):
        seen[name] += 1
        names[i] = name if counts[name] == 1 else f"{name}_{seen[name]}"
    return [dataclasses.replace(pair, name=name) for pair, name in zip(pairs, names, strict=True)]
