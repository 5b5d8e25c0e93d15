"""Panoramas without poses: pictures, and the links, titles and notes of the links.json of a folder."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import warnings
from collections import Counter
from collections.abc import Callable, Container, Iterable, Sequence
from pathlib import Path
from typing import Any

from pansplat.errors import InputError, InputWarning
from pansplat.geometry.level import wrap_angle
from pansplat.images.cube_faces import group_faces
from pansplat.images.cube_images import CUBE_SUFFIX, CubeImage
from pansplat.images.image_files import is_two_to_one, list_pictures, require_panorama
from pansplat.images.rig_images import RIG_SUFFIX
from pansplat.inputs.panorama_sets import MAX_NAMES, Collection, Link, Note, Panorama, list_panorama_files
from pansplat.inputs.web_tours.entries import (
    Number,
    make_note,
    make_panorama,
    plain_text,
    read_direction,
    resolve_links,
)
from pansplat.system.atomic import replacing
from pansplat.system.descriptions import list_first
from pansplat.system.files import is_written, make_unique_name
from pansplat.system.strict_json import convert, read_field, read_json

LINKS = "links.json"


def find_photographs(folder: Path) -> list[Path]:
    """The folder, if it has pictures."""
    return [folder] if list_panorama_files(folder) else []


def read_photographs(source: Path, folder: Path, convention: str | None = None) -> Collection:
    """The panoramas among the pictures of a folder, sorted by name, or that of a picture.

    Pictures that pansplat rendered count only if there are no other panoramas. Warns about pictures that are left out.
    """
    del convention
    if source != folder:
        require_panorama(source)
        view = make_panorama(source.stem, source, folder)
        return Collection(source, folder, name=view.name, unposed=(view,))
    every = list_panorama_files(folder)
    rendered = [image for image in every if is_written(image)]
    panoramas, problems = _read_pictures([image for image in every if image not in rendered], folder)
    if panoramas:
        problems += [f"{image}: it was rendered by pansplat." for image in rendered]
    elif rendered:
        panoramas, problems = _read_pictures(every, folder)
    if problems and not panoramas:
        raise InputError("; ".join(problem.rstrip(".") for problem in problems[:3]) + ".")
    _warn_left_out(problems)
    name = folder.resolve().name
    return Collection(source, folder, name=name, unposed=tuple(panoramas), folders=(folder,))


def with_further(found: Collection) -> Collection:
    """A sequence or reconstruction with the panoramas beside its pictures that have no pose."""
    if any(len(list_pictures(view.image)) > 1 for view in found.panoramas):  # other pictures are parts of rigs
        return found
    folders = tuple(dict.fromkeys(view.image.parent for view in found.panoramas))
    unposed = tuple(list_further(found.source, folders, found.panoramas))
    return dataclasses.replace(found, unposed=unposed, folders=folders)


def list_further(
    source: Path, folders: Sequence[Path], panoramas: Sequence[Panorama], stated: Container[str] = ()
) -> list[Panorama]:
    """The panoramas of folders that have no pose, with a warning that names them, and about what is no panorama.

    Args:
        source: the file of the poses.
        folders: each once.
        panoramas: those with poses. One of such a name gets the folder's name before its own.
        stated: names of files that are photographs, even if pansplat rendered them.
    """
    known = [file for view in panoramas for file in (view.image, view.mask, view.depth) if file is not None]
    taken = {view.name for view in panoramas}
    further: list[Panorama] = []
    for folder in filter(Path.is_dir, folders):
        found, problems = _read_pictures(_list_others(folder, known, stated), folder)
        _warn_left_out(problems)
        for view in found:
            name = view.name if view.name not in taken else f"{folder.resolve().name}_{view.name}"
            taken.add(name)
            further.append(dataclasses.replace(view, name=name))
    if further:
        warnings.warn(
            f"{source} has no pose of {list_first([view.file_label for view in further], MAX_NAMES)}; "
            "each is a scene of its own.",
            category=InputWarning,
            stacklevel=5,
        )
    return further


def list_unread_panoramas(folder: Path, known: Iterable[Path]) -> list[Path]:
    """The 2:1 pictures of a folder other than the known files, which pansplat has not rendered; no pixels are read."""
    return [image for image in _list_others(folder, known) if is_two_to_one(image)]


def _list_others(folder: Path, known: Iterable[Path], stated: Container[str] = ()) -> list[Path]:
    """The pictures of a folder other than the known files, which are stated, or which pansplat has not rendered."""
    read = {_identify(file) for file in known}
    others = [image for image in list_panorama_files(folder) if _identify(image) not in read]
    return [image for image in others if image.name in stated or not is_written(image)]


def _identify(file: Path) -> object:
    """What a file has in common under all of its names: on Windows and macOS in other capitals, too."""
    try:
        status = file.stat()
    except OSError:
        return file.resolve()
    return (status.st_dev, status.st_ino) if status.st_ino else file.resolve()  # the number is 0 on some network drives


def _warn_left_out(problems: Sequence[str]) -> None:
    for problem in problems:
        warnings.warn(f"left out: {problem}", category=InputWarning, stacklevel=4)


def _read_pictures(images: Sequence[Path], folder: Path) -> tuple[list[Panorama], list[str]]:
    """The panoramas among pictures, and what is wrong with the others."""
    cubes, rest = group_faces(images)
    pictures: dict[str, Path | CubeImage] = dict(cubes)
    repeated = Counter(image.stem for image in rest)
    problems = []
    for image in rest:
        name = image.stem if repeated[image.stem] == 1 and image.stem not in cubes else image.name.replace(".", "_")
        try:
            require_panorama(image)
            pictures[make_unique_name(name, pictures)] = image
        except InputError as error:
            problems.append(str(error))
    return [make_panorama(name, pictures[name], folder) for name in sorted(pictures)], problems


def add_links(panoramas: Sequence[Panorama], folder: Path) -> list[Panorama]:
    """The panoramas with the links, titles, notes and start views of the folder's links.json, if it has one.

    What an entry does not state stays. Warns about entries and links that cannot be used, or about a file that cannot
    be read.
    """
    source, content = folder / LINKS, {}
    try:
        content = _read_links(source)
    except InputError as error:
        warnings.warn(f"links are left out: {error}", category=InputWarning, stacklevel=3)
    counts = Counter(
        key for view in {view.image: view for view in panoramas}.values() for key in _list_keys(view, folder)
    )
    names = {key: view.name for view in panoramas for key in _list_keys(view, folder) if counts[key] == 1}
    for key in content:
        if key not in names:
            what = "the name of several panoramas; give the path" if counts[key] else "no panorama of the folder"
            warnings.warn(f"{source}: {key[:60]!r} is left out: it is {what}.", InputWarning, stacklevel=3)
    result = []
    for panorama in panoramas:
        own = [key for key in _list_keys(panorama, folder) if key in names] or [panorama.name]
        result.append(dataclasses.replace(panorama, links_at=(source, tuple(own), panorama.notes)))
        try:
            result[-1] = _add_entry(result[-1], _find_entry(own, content, source)[1], names, source)
        except InputError as error:
            warnings.warn(f"links of {panorama.name} are left out: {error}", category=InputWarning, stacklevel=3)
    return result


def _list_keys(panorama: Panorama, folder: Path) -> list[str]:
    """The keys of links.json that stand for a panorama; the first is that of a new entry, and of no other panorama."""
    image = panorama.image
    if image.name.endswith((CUBE_SUFFIX, RIG_SUFFIX)):
        return list(dict.fromkeys((panorama.name, image.name)))
    path = os.path.relpath(image, folder).replace(os.sep, "/")
    return list(dict.fromkeys((path, image.name, panorama.name)))


def _find_entry(keys: Sequence[str], content: dict[str, Any], source: Path) -> tuple[str, dict[str, Any]]:
    """The key of a panorama, and its entry, which may be a list of links: {"title", "start", "links", "notes"}."""
    key = next((key for key in keys if key in content), keys[0])
    entry = content.get(key, {})
    return key, convert({"links": entry} if isinstance(entry, list) else entry, dict[str, Any], source)


def _add_entry(panorama: Panorama, content: dict[str, Any], names: dict[str, str], source: Path) -> Panorama:
    """The panorama with the content of its entry."""
    links = [
        Link(str(link.get("to")), *read_direction({"yaw": None, **link}, source), plain_text(link.get("text")))
        for link in read_field(content, "links", list[dict[str, Any]], source, [])
    ]
    notes = [_read_note(note, source) for note in read_field(content, "notes", list[dict[str, Any]], source, [])]
    start = read_field(content, "start", tuple[Number, Number], source)
    return dataclasses.replace(
        panorama,
        title=plain_text(content.get("title")) or panorama.title,
        links=resolve_links(links, names, panorama.name, source) if "links" in content else panorama.links,
        notes=tuple(note for note in notes if note.text or note.addresses) if "notes" in content else panorama.notes,
        start=(wrap_angle(start[0]), start[1]) if start else panorama.start,
    )


def _read_note(note: dict[str, Any], source: Path) -> Note:
    text, addresses = read_field(note, "text", str, source, ""), read_field(note, "addresses", list, source, [])
    return make_note(read_direction(note, source), text, addresses)


def describe_notes(notes: Sequence[Note]) -> list[dict[str, Any]]:
    """Notes as in links.json."""
    return [
        {"yaw": round(note.yaw, 5), "pitch": round(note.pitch, 5), "text": note.text}
        | ({"addresses": note.addresses} if note.addresses else {})
        for note in notes
    ]


def read_notes(panorama: Panorama) -> tuple[Note, ...]:
    """The notes that its links.json states by now; those that were read before if it cannot be read."""
    with contextlib.suppress(InputError, OSError):
        if panorama.links_at is not None:
            source, keys, others = panorama.links_at
            _, entry = _find_entry(keys, _read_links(source), source)
            stated = {key: value for key, value in entry.items() if key == "notes"}
            return _add_entry(dataclasses.replace(panorama, notes=others), stated, {}, source).notes
    return panorama.notes


def write_notes(
    panorama: Panorama, notes: Sequence[Note], is_replaced: Callable[[Note], bool] = lambda note: False
) -> Path:
    """Add notes to a panorama's links.json, in place of some; what else it states by now stays. Returns that file.

    Raises:
        InputError: links.json cannot be read, or the panorama has none.
    """
    if panorama.links_at is None:
        raise InputError(f"{panorama.image}: needed a panorama of a folder for a note, got a file; open its folder.")
    source, keys, others = panorama.links_at
    content = _read_links(source)
    key, entry = _find_entry(keys, content, source)
    stated = read_field(entry, "notes", list[dict[str, Any]], source, describe_notes(others))
    kept = [note for note in stated if not is_replaced(_read_note(note, source))]
    content[key] = entry | {"notes": kept + describe_notes(notes)}
    with replacing(source) as temporary:
        temporary.write_text(json.dumps(content, indent=1, ensure_ascii=False), "utf-8")
    return source


def _read_links(source: Path) -> dict[str, Any]:
    return read_json(source, dict[str, Any]) if source.is_file() else {}
