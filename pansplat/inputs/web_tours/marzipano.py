"""Exports of the Marzipano Tool: data.js, and tiles/SCENE/LEVEL/FACE/ROW/COLUMN.jpg.

Angles are radians: yaw to the right of the front face's centre, pitch below the horizon. The reference states the
opposite sign of pitch; the code and all exports have this one. A level's number is its place in the list. The first,
smallest level has number 0; it is in preview.jpg only, and is not read.

Source: https://www.marzipano.net/docs.html; https://www.marzipano.net/reference/CubeGeometry.html;
https://github.com/google/marzipano: src/geometries/Cube.js (faces), src/sources/ImageUrl.js (tiles),
src/views/Rectilinear.js (angles), demos/sample-tour/index.js.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pansplat.errors import InputError
from pansplat.images.cube_faces import keep_complete
from pansplat.images.cube_images import COLUMN, MAX_SIZE, ROW, CubeImage, CubeLevel
from pansplat.inputs.panorama_sets import Link, Note
from pansplat.inputs.web_tours.entries import (
    Entry,
    Pixels,
    list_objects,
    locate,
    optional,
    plain_text,
    read_direction,
    read_entries,
    read_note,
    read_spots,
    read_text,
    require_levels,
    require_tiles,
)
from pansplat.inputs.web_tours.javascript import parse_literal
from pansplat.system.strict_json import convert

_DATA = "data.js"
_ARCHIVE_FOLDER = "app-files"  # folder in the archive that the Marzipano Tool makes
_FACES = "frblud"
_ASSIGNMENT = re.compile(r"(?<![\w$])[A-Za-z_$][\w$]*\s*=\s*(?=\{)")
_QUOTED = 30  # characters of a file that a message quotes
_UNNAMED = "Project Title"  # name of a project whose author gave none


def find_marzipano(folder: Path) -> Path | None:
    """The data.js of an export, in the folder or in its app-files/."""
    found = (folder / _DATA, folder / _ARCHIVE_FOLDER / _DATA)
    return next((path for path in found if path.is_file()), None)


def read_marzipano(source: Path) -> tuple[str, list[Entry]]:
    """The title of an export, and its scenes that have a complete level."""
    content = _read_data(source)
    entries = read_entries(source, _list_scenes(content["scenes"]), lambda key, scene: _read_scene(key, scene, source))
    title = plain_text(content.get("name"))
    return "" if title == _UNNAMED else title, entries


def _read_data(source: Path) -> dict[str, Any]:
    text = read_text(source)
    if text.lstrip().startswith("<"):
        raise InputError(f"{source}: needed `var APP_DATA = {{...}}`, got an HTML page; export or download it again.")
    position = 0
    while (found := _ASSIGNMENT.search(text, position)) is not None:
        content, position = parse_literal(text, found.end(), source)
        if isinstance(content.get("scenes"), list):
            return content
    raise InputError(
        f"{source}: needed `var APP_DATA = {{...}}` with a list of scenes, got other text "
        f"({text.strip()[:_QUOTED]!r}); give the folder of an export of the Marzipano Tool."
    )


def _list_scenes(scenes: list[Any]) -> Iterator[tuple[str, Any]]:
    for place, scene in enumerate(scenes, start=1):
        key = scene.get("id") if isinstance(scene, dict) else None
        yield (plain_text(key) or f"number {place}", scene)


def _read_scene(key: str, scene: Mapping[str, Any], source: Path) -> Entry:
    if not plain_text(scene.get("id")):
        raise InputError('needed an "id", the name of the folder of its tiles, got none')
    levels = _find_levels(key, scene, source)
    view = scene.get("initialViewParameters")
    start = optional(f"{source}: the start view of {key}", lambda: read_direction(view)) if view else None
    links = read_spots(f"{source}: a link of {key}", scene.get("linkHotspots"), _read_link)
    notes = read_spots(f"{source}: a hot spot of {key}", scene.get("infoHotspots"), _read_note)
    return Entry(key, CubeImage(source.parent, levels), plain_text(scene.get("name")), links, notes, start)


def _read_link(spot: Mapping[str, Any]) -> Link:
    return Link(plain_text(spot.get("target")), *read_direction(spot), plain_text(spot.get("text")))


def _read_note(spot: Mapping[str, Any]) -> Note:
    return read_note(read_direction(spot), [spot.get("title"), spot.get("text")])


def _find_levels(key: str, scene: Mapping[str, Any], source: Path) -> tuple[CubeLevel, ...]:
    """The complete levels of a scene.

    The numbers of the folders are those of the list, or one more in exports without a level of preview.
    """
    folder = source.parent
    base = locate(folder, "tiles", plain_text(scene.get("id")))
    stated = [
        tuple(convert(level.get(key), Pixels, key, strict=False) for key in ("size", "tileSize"))
        for level in list_objects(scene.get("levels"))
    ]
    for pixels, tile in stated:
        require_tiles(min(pixels, MAX_SIZE), tile)
    attempts = [keep_complete(_list_levels(base, stated, first, folder), folder) for first in (0, 1)]
    best, gap = max(attempts, key=lambda attempt: len(attempt[0]))
    largest = max((pixels for pixels, _ in stated), default=0)
    return require_levels(f"{source}: scene {key!r}", best, gap or f"{base} is missing", largest)


def _list_levels(base: str, stated: Sequence[tuple[int, int]], first: int, folder: Path) -> Iterator[CubeLevel]:
    """The levels if they count from `first`; a level 0 may have no tiles."""
    for place, (pixels, tile) in enumerate(stated, start=first):
        level = CubeLevel(pixels, tile, tuple(f"{base}/{place}/{face}/{ROW}/{COLUMN}.jpg" for face in _FACES))
        if not _has_more_tiles(level, folder):
            yield level


def _has_more_tiles(level: CubeLevel, folder: Path) -> bool:
    """Whether the folder holds a larger level than the stated one."""
    count = -(-level.size // level.tile)
    return (folder / level.faces[0].replace(ROW, "0").replace(COLUMN, str(count))).is_file()
