"""Tours of Pannellum: a configuration in JSON, or as an object literal in HTML or JavaScript.

Angles are degrees: yaw to the right of the centre, pitch above the horizon. Faces are in the order front, right, back,
left, up, down, and have the letters f r b l u d. Levels of tiles count from 1, the smallest; each is twice as large as
the one before.

Source: https://pannellum.org/documentation/reference/; https://github.com/mpetroff/pannellum:
doc/json-config-parameters.md, utils/multires/generate.py (levels and tiles), src/js/libpannellum.js (faces).
"""

from __future__ import annotations

import html
import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from pansplat.errors import InputError
from pansplat.images.cube_faces import keep_complete, require_faces
from pansplat.images.cube_images import COLUMN, MAX_SIZE, ROW, CubeImage, CubeLevel
from pansplat.images.image_files import require_panorama
from pansplat.inputs.panorama_sets import Link, Note
from pansplat.inputs.web_tours.entries import (
    MAX_BYTES,
    Entry,
    Number,
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

SUFFIXES = (".json", ".html", ".htm", ".js")
_FIRST_NAMES = ("tour.json", "pannellum.json", "config.json")  # these files are read before others
_OURS = ("poses.json", "pairs.json", "links.json", "camera_pose.json")  # files of pansplat, which are no tours
_PICTURES = ("panorama", "cubeMap", "multiRes")
_FACES = "frblud"
_MAX_LEVEL = 20  # levels of tiles that a picture may have
_CALL = re.compile(r"pannellum\s*\.\s*viewer\s*\(")


def find_pannellum(folder: Path) -> Path | None:
    """A file of the folder that holds a configuration; a tour.json also if it holds none.

    Raises:
        OSError: the folder cannot be listed.
    """
    files = [path for path in sorted(folder.iterdir()) if path.suffix.lower() in SUFFIXES and path.name not in _OURS]
    rank = {name: place for place, name in enumerate(_FIRST_NAMES)}
    files.sort(key=lambda path: (rank.get(path.name, len(rank)), SUFFIXES.index(path.suffix.lower())))
    for path in files:
        if not path.is_file() or path.stat().st_size > MAX_BYTES:
            continue
        try:
            if path.name == _FIRST_NAMES[0] or _find_configuration(path) is not None:
                return path
        except InputError:
            continue
    return None


def read_pannellum(source: Path) -> tuple[str, list[Entry]]:
    """The title of a tour and its scenes, or its only panorama; the first scene of the tour is the first."""
    content = _find_configuration(source)
    if content is None:
        got = "an HTML page" if read_text(source).lstrip().startswith("<") else "other text"
        raise InputError(
            f'{source}: needed a tour of Pannellum or of the Marzipano Tool, got {got} without "scenes", "panorama", '
            '"cubeMap" or "multiRes"; give the folder of the tour, or download it again.'
        )
    stated = content.get("default")
    common: dict[str, Any] = stated if isinstance(stated, dict) else {}
    scenes = content.get("scenes")
    if isinstance(scenes, dict):
        outside = {key: value for key, value in content.items() if key not in ("default", "scenes", "title")}
        first = str(common.get("firstScene", content.get("firstScene", "")))
        merged = {
            key: {**outside, **common, **scene} if isinstance(scene, dict) else scene for key, scene in scenes.items()
        }
        ordered = sorted(merged.items(), key=lambda item: item[0] != first)
    else:
        ordered = [(source.resolve().parent.name if source.stem in ("index", "tour") else source.stem, content)]
    entries = read_entries(source, iter(ordered), lambda key, scene: _read_scene(key, scene, source))
    return plain_text(common.get("title", content.get("title") if isinstance(scenes, dict) else "")), entries


def _find_configuration(source: Path) -> dict[str, Any] | None:
    """The configuration in a file; None if there is none."""
    text = read_text(source)
    if source.suffix.lower() == ".json":
        if not text.lstrip().startswith("{") or not any(key in text for key in ("scenes", *_PICTURES)):
            return None
        return _accept(parse_literal(text, 0, source)[0])
    return next((literal for literal in _list_arguments(text, source) if _accept(literal) is not None), None)


def _list_arguments(text: str, source: Path) -> Iterator[Any]:
    """The second arguments of the calls of a page; calls in arguments of others are no calls."""
    position = 0
    while (call := _CALL.search(text, position)) is not None:
        _, position = parse_literal(text, call.end(), source)
        if text.startswith(",", position):
            value, position = parse_literal(text, position + 1, source)
            yield value


def _accept(content: Any) -> dict[str, Any] | None:
    if not isinstance(content, dict):
        return None
    scenes = content.get("scenes")
    is_tour = isinstance(scenes, dict) and any(isinstance(scene, dict) for scene in scenes.values())
    return content if is_tour or any(content.get(key) for key in _PICTURES) else None


def _read_scene(key: str, scene: Mapping[str, Any], source: Path) -> Entry:
    kind = scene.get("type", "equirectangular")
    readers = {"equirectangular": _read_equirect, "cubemap": _read_cube_map, "multires": _read_tiles}
    if not isinstance(kind, str) or kind not in readers:
        raise InputError(f"needed the type {', '.join(readers)}, got {str(kind)[:40]!r}")
    if scene.get("dynamic"):
        raise InputError("needed a picture, got a video")
    picture = readers[kind](scene, source.parent)
    has_start = "yaw" in scene or "pitch" in scene
    start = optional(f"{source}: the start view of {key}", lambda: _read_direction(scene)) if has_start else None
    spots = list_objects(scene.get("hotSpots"))
    ways, others = ([spot for spot in spots if bool(spot.get("sceneId")) == is_way] for is_way in (True, False))
    links = read_spots(f"{source}: a link of {key}", ways, _read_link)
    notes = read_spots(f"{source}: a hot spot of {key}", others, _read_note)
    return Entry(key, picture, plain_text(scene.get("title")), links, notes, start)


def _read_link(spot: Mapping[str, Any]) -> Link:
    return Link(str(spot["sceneId"]), *_read_direction(spot), plain_text(spot.get("text")))


def _read_note(spot: Mapping[str, Any]) -> Note:
    text = spot.get("text")
    picture = [f"[{str(spot['image']).rpartition('/')[2]}]"] if spot.get("image") else []
    shown = [html.escape(each) for each in (text, *picture) if isinstance(each, str)]  # Pannellum shows HTML as text
    return read_note(_read_direction(spot), shown, [spot.get(name) for name in ("URL", "image", "video")])


def _read_direction(content: Mapping[str, Any]) -> tuple[float, float]:
    yaw, pitch = read_direction(content, unit=math.radians(1))
    return yaw, 0.0 - pitch  # 0.0 instead of the -0.0 of a negation


def _base(scene: Mapping[str, Any]) -> list[Any]:
    return [scene["basePath"]] if scene.get("basePath") else []


def _read_equirect(scene: Mapping[str, Any], folder: Path) -> Path:
    image = folder / locate(folder, *_base(scene), scene.get("panorama"))
    spans = [
        convert(scene.get(name, whole), Number, name, strict=False) for name, whole in (("haov", 360), ("vaov", 180))
    ]
    if spans != [360, 180]:
        raise InputError(f"needed a picture of 360 x 180 degrees, got {spans[0]:g} x {spans[1]:g} (haov, vaov)")
    require_panorama(image)
    return image


def _read_cube_map(scene: Mapping[str, Any], folder: Path) -> CubeImage:
    files = scene.get("cubeMap")
    if not isinstance(files, list) or len(files) != 6:
        raise InputError('needed six files as "cubeMap", got another value')
    faces = tuple(locate(folder, *_base(scene), file) for file in files)
    pixels = require_faces([folder / face for face in faces])
    return CubeImage(folder, (CubeLevel(pixels, pixels, faces),))


def _read_tiles(scene: Mapping[str, Any], folder: Path) -> CubeImage:
    stated = scene.get("multiRes")
    if not isinstance(stated, dict):
        raise InputError('needed an object as "multiRes", got another value')
    base = _base(scene) + ([stated["basePath"]] if stated.get("basePath") else [])
    suffix = f".{stated.get('extension') or 'jpg'}"
    kinds = {"tileResolution": Pixels, "cubeResolution": Pixels, "maxLevel": Annotated[int, Meta(ge=1, le=_MAX_LEVEL)]}
    tile, full, highest = (convert(stated.get(name), kind, name, strict=False) for name, kind in kinds.items())
    require_tiles(min(full, MAX_SIZE), tile)
    sizes = {number: full >> (highest - number) for number in range(1, highest + 1)}
    faces = {n: _fill(folder, base, stated.get("path"), suffix, {"%l": str(n), "%y": ROW, "%x": COLUMN}) for n in sizes}
    levels, gap = keep_complete((CubeLevel(sizes[number], tile, faces[number]) for number in sizes), folder)
    if stated.get("fallbackPath") and not levels:
        files = _fill(folder, base, stated["fallbackPath"], suffix, {})
        if all((folder / file).is_file() for file in files):
            pixels = require_faces([folder / file for file in files])
            levels.append(CubeLevel(pixels, pixels, files))
    return CubeImage(folder, require_levels(f"{folder}: the panorama", levels, gap, full))


def _fill(folder: Path, base: list[Any], pattern: Any, suffix: str, values: Mapping[str, str]) -> tuple[str, ...]:
    """The paths of the six faces from a format string of tiles."""
    if not isinstance(pattern, str) or "%s" not in pattern:
        raise InputError(f"needed a path with %s for the face, got {str(pattern)[:40]!r}")
    faces = []
    for face in _FACES:
        path = pattern.replace("%s", face)
        for sign, value in values.items():
            path = path.replace(sign, value)
        faces.append(locate(folder, *base, path, suffix=suffix))
    return tuple(faces)
