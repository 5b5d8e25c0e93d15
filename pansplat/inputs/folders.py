"""Panoramas at a path: `load_sets` searches folders for those of a known format and reads them (docs/input.md)."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import os
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from pansplat.errors import InputError, InputWarning, NothingFoundError
from pansplat.images.blur_masks import MASK_SUFFIX, fold_name, list_folders_once, locate_panorama, split_mask_name
from pansplat.images.image_files import READABLE_SUFFIXES, list_masks, list_pictures, require_panorama
from pansplat.inputs.folder_formats import PAIRS, POSES
from pansplat.inputs.formats import FORMATS, PHOTOGRAPHS, POSED, TRIPLETS, WEB_TOURS, Format
from pansplat.inputs.panorama_sets import (
    Collection,
    Panorama,
    PanoramaSet,
    list_names,
    list_panorama_files,
    localize_sets,
)
from pansplat.inputs.photographs import LINKS, add_links, list_unread_panoramas
from pansplat.inputs.poses import parse_convention
from pansplat.inputs.web_tours import find_web_tours, is_web_tour_file
from pansplat.system.descriptions import list_first
from pansplat.system.files import expand_home, is_scene_file, is_written, make_unique_name, require_text
from pansplat.system.options import CAMERA_HEIGHT

_VIDEO_SUFFIXES = (".mp4", ".mov", ".mkv", ".webm")
_RAW_SUFFIXES = (".insp", ".insv", ".360", ".dng", ".osv")  # pictures and videos of 360-degree cameras before stitching
_UNREAD_SUFFIXES = (*_VIDEO_SUFFIXES, *_RAW_SUFFIXES, ".heic", ".heif")
_TABLE_SUFFIXES = (".csv", ".txt", ".json", ".xml", ".bin")  # files that may hold poses
_PICTURE_SUFFIXES = (*READABLE_SUFFIXES, ".bmp", ".gif")  # pictures that may be masks or have them

_MAX_DEPTH = 4  # levels of nested folders that are searched


def load_sets(
    path: Path | str,
    *,
    convention: str | None = None,
    near: float | None = None,
    far: float | None = None,
    camera_height: float = CAMERA_HEIGHT,
) -> list[PanoramaSet]:
    """The pairs at a path, those with targets first. Image files are read when a pair is loaded.

    Args:
        path: see `load_collections`.
        convention: pose convention, such as "world2cam opencv"; overrides that of the files.
        near, far: radial depth range in metres; overrides that of the files.
        camera_height: height of the cameras over the floor, metres.

    Raises:
        InputError: the folder or web tour holds two or more panoramas, and no poses.
    """
    return make_sets(load_collections(path, convention=convention), near, far, camera_height)


def make_sets(
    collections: Sequence[Collection],
    near: float | None = None,
    far: float | None = None,
    camera_height: float = CAMERA_HEIGHT,
) -> list[PanoramaSet]:
    """The pairs of collections, of unique names, those with targets first.

    Poses are in a world of metres around its origin; `Panorama.frame` states where it is in the world of the files.
    """
    pairs = [pair for found in collections for pair in found.sets(near, far)]
    return localize_sets(make_names_unique(sorted(pairs, key=lambda pair: not pair.targets)), camera_height)


@list_folders_once()
def load_collections(path: Path | str, *, convention: str | None = None, posed: bool = True) -> list[Collection]:
    """The panoramas at a path, with poses in the world of the files, or else one collection without poses.

    Args:
        path: a panorama; a pair folder, a folder of many panoramas, or a folder of such folders, in one of `FORMATS`;
            or one of their files with poses, or the file of a web tour.
        convention: pose convention; overrides that of the files.
        posed: whether poses are read; else a folder is its web tour or its pictures.
    """
    root = expand_home(path)
    if not root.is_dir():
        require_text(root)
    convention = None if convention is None else parse_convention(convention, "`convention`")
    try:
        collections = _read_file(root, convention, posed) if root.is_file() else _read_folder(root, convention, posed)
    except OSError as error:
        raise InputError(
            f"{error.filename or root}: needed a readable folder, got '{error.strerror}'; check its permissions."
        ) from error
    require_known_masks(root, [view for found in collections for view in found.views])
    if not collections:
        raise _nothing_found(root)
    return collections


def load_panoramas(path: Path | str, *, posed: bool = True) -> list[Panorama]:
    """All panoramas at a path, with titles, links and start views; see `load_collections`."""
    return [view for found in load_collections(path, posed=posed) for view in found.views]


def require_known_masks(root: Path, panoramas: Iterable[Panorama] = ()) -> None:
    """Check that every mask is applied: another one would show what it should hide.

    Args:
        root: a file, or a folder that is searched as by `load_sets`.
        panoramas: that were read there.
    """
    views = {view.image: view for view in panoramas}
    for image in (*views, *([root] if root.is_file() else ())):
        if split_mask_name(image) is not None:
            raise InputError(f"{image}: needed a panorama, got the mask of another by its name; rename or remove it.")
    folders = dict.fromkeys(_list_folders(root, _MAX_DEPTH) if root.is_dir() else [root.parent])
    read: set[Path] = set()  # pictures that are read as panoramas or parts of them
    parts: set[Path] = set()  # pictures that panoramas are joined from; a part of `read`
    used: set[Path] = set()
    names: dict[str, Path] = {}
    for image, view in views.items():
        pictures, place = list_pictures(image), locate_panorama(image)
        parts |= {picture.resolve() for picture in pictures} - {image.resolve()}
        places = *pictures, place
        read |= {picture.resolve() for picture in places}
        folders |= dict.fromkeys(folder for file in places for folder in (file.parent, file.resolve().parent))
        used |= {mask.resolve() for mask in (view.mask, *list_masks(image, check=True)) if mask is not None}
        names[fold_name(view.name)] = place
    used |= parts  # masks of perspective pictures are among them
    listed = ((folder, name) for folder in folders for name in sorted(next(os.walk(folder), ("", [], []))[2]))
    files = [folder / name for folder, name in listed if not (name.startswith(".") or is_scene_file(name))]
    masks = {file: name for file in files if (name := split_mask_name(file)) and file.resolve() not in used}
    pictures = [file for file in files if file.suffix.lower() in _PICTURE_SUFFIXES and not split_mask_name(file)]
    names |= {fold_name(picture.stem): picture for picture in pictures if picture.resolve() not in parts}
    for mask, (stem, kind) in masks.items():
        own = [
            file for file in pictures if file.parent == mask.parent and fold_name(stem) in ("", fold_name(file.stem))
        ]
        is_named = bool(own) or (mask.parent == root and not stem)
        # Pictures that are not read have masks, too, and poses.json may state another mask of the scene.
        shown = parts if kind == MASK_SUFFIX else read
        is_spare = (stem or kind == MASK_SUFFIX) and shown.isdisjoint(file.resolve() for file in own)
        if (is_named and is_spare and mask.suffix.lower() == ".png") or not (
            is_named or mask.suffix.lower() in _PICTURE_SUFFIXES
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


def _read_file(file: Path, convention: str | None, posed: bool) -> list[Collection]:
    """The panorama of a picture, those of a triplet or web tour, or those of the folder of another file with poses."""
    if file.suffix.lower() in _UNREAD_SUFFIXES:
        raise InputError(f"{file}: needed panoramas, got {_advise_on_file(file)}.")
    folder = file.parent
    if file.suffix.lower() in READABLE_SUFFIXES:
        return [PHOTOGRAPHS.read(file, folder, convention)]
    if file in TRIPLETS.find(folder):
        return _link([TRIPLETS.read(file, folder, convention)])
    is_posed_tour = is_web_tour_file(file) and (folder / POSES).exists() and bool(WEB_TOURS.find(folder))
    stated = (each for form in POSED for source in form.find(folder) for each in form.files(source))
    if posed and (file.name in (PAIRS, LINKS) or is_posed_tour or file in stated):
        return _read_folder(folder, convention, posed)
    if not is_web_tour_file(file):
        raise InputError(
            f"{file}: needed a panorama, a folder of panoramas, its file of poses, or a web tour, got another file; "
            "give the folder."
        )
    return _link([WEB_TOURS.read(file, folder, convention)])


def _read_folder(root: Path, convention: str | None, posed: bool) -> list[Collection]:
    """The collections in a folder and those below it, or else the panoramas of the folder itself without poses."""
    if not root.exists():
        raise InputError(f"{root}: needed a panorama, or a folder of panoramas, got no such path; check it.")
    collections: list[Collection] = []
    for folder, form in _search(root, POSED) if posed else ():
        collections += _link([form.read(source, folder, convention) for source in form.find(folder)])
    if not collections:
        return _read_unposed(root)
    _note_unread_panoramas(root, collections)
    return [_leave_out_damaged(collection) for collection in collections]


def _read_unposed(folder: Path) -> list[Collection]:
    """The panoramas of a web tour in a folder, or else the pictures of the folder; a faulty tour gives a warning."""
    problems: list[InputError] = []
    for form in (WEB_TOURS, PHOTOGRAPHS):
        for source in form.find(folder):
            try:
                collections = _link([form.read(source, folder, None)])
            except InputError as error:
                problems.append(error)
                continue
            for problem in problems:
                warnings.warn(f"the web tour is left out: {problem}", category=InputWarning, stacklevel=3)
            _note_unread_panoramas(folder, collections, _MAX_DEPTH if form is PHOTOGRAPHS else 0)
            return collections
    if problems:
        raise problems[0]
    return []


def _search(root: Path, wanted: Sequence[Format]) -> list[tuple[Path, Format]]:
    """What is found at or below a folder; exports of pansplat in subfolders count only if there is nothing else."""
    found = _find(root, wanted, _MAX_DEPTH, exports=False)
    is_export = not found and all(map(is_written, list_panorama_files(root)))
    return _find(root, wanted, _MAX_DEPTH, exports=True) if is_export else found


def _find(folder: Path, wanted: Sequence[Format], depth: int, exports: bool) -> list[tuple[Path, Format]]:
    """The first format of a folder itself, if it is wanted, or else what is found in its subfolders."""
    for form in FORMATS:
        if (form in wanted or form is WEB_TOURS) and form.find(folder):
            return [(folder, form)] if form in wanted else []
    return [
        found for sub in _list_subfolders(folder, depth, exports) for found in _find(sub, wanted, depth - 1, exports)
    ]


def _link(collections: Sequence[Collection]) -> list[Collection]:
    """The collections of one folder with what its links.json states."""
    views = linked = [view for found in collections for view in found.views]
    folder = collections[0].folder
    for place in dict.fromkeys((folder, *(source.parent for source in find_web_tours(folder)))):  # folders of tours
        linked = add_links(linked, place)
    of = dict(zip(views, linked, strict=True))
    return [
        dataclasses.replace(
            found,
            panoramas=tuple(of[view] for view in found.panoramas),
            unposed=tuple(of[view] for view in found.unposed),
        )
        for found in collections
    ]


def _note_unread_panoramas(root: Path, collections: Sequence[Collection], depth: int = _MAX_DEPTH) -> None:
    """Warn about the panoramas in a folder and those below it that are in no collection."""
    views = [view for found in collections for view in found.views]
    files = [file for view in views for file in (*list_pictures(view.image), view.mask, view.depth)]
    known = {file.resolve() for file in files if file is not None}
    _note_unread(root, known, {folder for found in collections for folder in found.folders}, depth)


def _note_unread(folder: Path, known: set[Path], read: set[Path], depth: int) -> None:
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
        tours = [] if sub in read else find_web_tours(sub)
        if not tours:
            _note_unread(sub, known, read, depth - 1)
        for tour in tours:
            warnings.warn(f"left out: {tour} is another tour; open it by its own path.", InputWarning, stacklevel=3)


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
    return [folder for folder, _ in _search(root, FORMATS)]


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


def _nothing_found(root: Path) -> InputError:
    inside = [folder for folder in find_panorama_folders(root) if folder != root]
    others = [file for file in sorted(root.iterdir()) if file.suffix.lower() in _UNREAD_SUFFIXES]
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
    kind = InputError if inside or others else NothingFoundError
    return kind(f"{root}: needed panoramas (JPG, PNG, TIFF, WebP or EXR), got {got}{advice}.")


def _advise_on_file(file: Path) -> str:
    """What a video or a file of a camera or phone is, and what to do with it."""
    if file.suffix.lower() in _VIDEO_SUFFIXES:
        return (
            f"the video {file.name}; write frames of it into a folder (mkdir FOLDER; ffmpeg -i {file} -vf fps=1 "
            "FOLDER/%03d.png), and open FOLDER"
        )
    if file.suffix.lower() not in _RAW_SUFFIXES:
        return f"{file.name}; convert it to JPG"
    return f"{file.name}, which the program of its camera must stitch; export it as a 2:1 JPG"


def make_names_unique(pairs: list[PanoramaSet]) -> list[PanoramaSet]:
    """Prefix equal names with the folder's name, then append a number to names that are still equal."""
    counts = Counter(pair.name for pair in pairs)
    names = [p.name if counts[p.name] == 1 else f"{p.folder.resolve().name}_{p.name}" for p in pairs]
    counts, seen = Counter(names), Counter()
    for i, name in enumerate(names):
        seen[name] += 1
        names[i] = name if counts[name] == 1 else make_unique_name(f"{name}_{seen[name]}", names)
    return [dataclasses.replace(pair, name=name) for pair, name in zip(pairs, names, strict=True)]
