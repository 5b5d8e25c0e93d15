"""The panoramas of a tour as its file states them, and what all formats have in common: paths, names, links."""

from __future__ import annotations

import posixpath
import re
import unicodedata
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Annotated, Any, TypeVar
from urllib.parse import unquote, urlsplit

import torch
from msgspec import Meta

from pansplat.errors import InputError, InputWarning
from pansplat.geometry.level import wrap_angle
from pansplat.images.cube_images import MAX_SIZE, CubeImage, CubeLevel, write_cube
from pansplat.inputs.panorama_sets import Link, Note, Panorama, find_mask
from pansplat.inputs.stated_files import locate_inside
from pansplat.system.files import make_portable_name, make_unique_name, read_file
from pansplat.system.strict_json import convert

_T = TypeVar("_T")
Number = Annotated[float, Meta(ge=-1e9, le=1e9)]
Pixels = Annotated[int, Meta(ge=1, le=1 << 20)]

MAX_BYTES = 1 << 24  # bytes of the largest file that describes a tour
_MAX_TEXT = 200  # characters of a title or a label
_MAX_NAME = 60  # characters of the name of a panorama's file
_MAX_NOTE, _MAX_HTML = 2_000, 20_000  # characters of a note's text, and of its HTML
_MAX_ADDRESSES = 10  # addresses that a note may have
_MAX_TILES = 64  # tiles along one side of a face
_HIDDEN = ("script", "style", "template")  # elements whose text is not shown
_BREAKS = ("br", "p", "div", "li", "ul", "ol", "tr", "h1", "h2", "h3", "h4")  # elements on lines of their own
_ON_THE_WEB = re.compile(r"[A-Za-z][A-Za-z0-9+.\-]*:|//")


@dataclass(frozen=True)
class Entry:
    """One panorama of a tour.

    Attributes:
        key: by which links name it.
        picture: a 2:1 image, or cube faces.
        title: for people.
        links: their targets are keys.
        notes: hot spots with information.
        start: yaw and pitch of the first view, as of a link.
    """

    key: str
    picture: Path | CubeImage
    title: str = ""
    links: tuple[Link, ...] = ()
    notes: tuple[Note, ...] = ()
    start: tuple[float, float] | None = None


def read_text(source: Path) -> str:
    """The text of a file in UTF-8; other bytes become U+FFFD, as in browsers."""
    return read_file(source, limit=MAX_BYTES).decode("utf-8-sig", "replace")


def read_entries(
    source: Path, scenes: Iterator[tuple[str, Any]], read: Callable[[str, Mapping[str, Any]], Entry]
) -> list[Entry]:
    """The entries of all scenes that can be used; a warning names each of the others with the reason."""
    entries = []
    for key, content in scenes:
        try:
            if not isinstance(content, dict):
                raise InputError(f"needed an object, got {str(content)[:40]!r}")
            entries.append(read(key, content))
        except InputError as error:
            warnings.warn(f"{source}: scene {key!r} is left out: {error}", category=InputWarning, stacklevel=3)
    return entries


def optional(what: str, read: Callable[[], _T]) -> _T | None:
    """What `read` returns; after an InputError None, with a warning that `what` is left out."""
    try:
        return read()
    except InputError as error:
        warnings.warn(f"{what} is left out: {error}", category=InputWarning, stacklevel=3)
        return None


def read_spots(what: str, spots: Any, read: Callable[[dict[str, Any]], _T]) -> tuple[_T, ...]:
    """What `read` returns for each hot spot of a list, without those that cannot be used (`optional`)."""
    found = (optional(what, lambda spot=spot: read(spot)) for spot in list_objects(spots))
    return tuple(each for each in found if each is not None)


def list_objects(value: Any) -> list[dict[str, Any]]:
    """The objects in a list; none if the value is no list."""
    return [item for item in value if isinstance(item, dict)] if isinstance(value, list) else []


def locate(folder: Path, *parts: Any, suffix: str = "") -> str:
    """The path of a file relative to the tour's folder, from the parts of a URL. It need not exist.

    A path from the root of a web site counts from the folder.
    """
    for part in parts:
        if not isinstance(part, str) or not part or "\0" in part:
            raise InputError(f"needed the path of a file, got {str(part)[:40]!r}")
        if _ON_THE_WEB.match(part):
            raise InputError(f"needed a file of the tour, got the address {part[:80]}; download it into the folder")
    path = "/".join(part.replace("\\", "/") for part in parts) + suffix
    plain = posixpath.normpath(path.lstrip("/"))
    decoded = posixpath.normpath(unquote(re.sub(r"[?#].*", "", path, flags=re.DOTALL)).lstrip("/"))
    for name in (plain, decoded):
        locate_inside(folder, name)
    return plain if plain == decoded or (folder / plain).exists() else decoded


def read_direction(content: Any, source: object = "direction", unit: float = 1.0) -> tuple[float, float]:
    """The angles yaw and pitch of an object, radians, 0 by default; an InputError names the source."""
    content = convert(content, dict[str, Any], source)
    yaw, pitch = (convert(content.get(key, 0), Number, f"{source}, {key}", strict=False) for key in ("yaw", "pitch"))
    return wrap_angle(unit * yaw), unit * pitch


def require_tiles(face: int, tile: int) -> None:
    """Check that the tiles of a face are not too many to look for; sizes in pixels."""
    if face > _MAX_TILES * tile:
        raise InputError(
            f"needed at most {_MAX_TILES} x {_MAX_TILES} tiles a face, got {face} pixels in tiles of {tile}"
        )


def require_levels(what: str, levels: Sequence[CubeLevel], gap: str | None, largest: int) -> tuple[CubeLevel, ...]:
    """The complete levels of a panorama, at least one. Warns if a larger one is stated.

    Args:
        what: the panorama, for messages.
        levels: the smallest first.
        gap: what another level lacks, in words.
        largest: stated size, pixels.
    """
    if not levels:
        raise InputError(f"needed all tiles of a level, but {gap or 'there is none'}; copy or export the tour again")
    largest = min(largest, MAX_SIZE)
    if levels[-1].size < largest:
        size = levels[-1].size
        warnings.warn(
            f"{what} is read at {size} instead of {largest} pixels a face: {gap}.", InputWarning, stacklevel=4
        )
    return tuple(levels)


def plain_text(value: Any) -> str:
    """A label as one line of plain text; tags stay as they are written. Empty if it is no text or number."""
    if not isinstance(value, (str, int, float)) or isinstance(value, bool):
        return ""
    letters = (" " if unicodedata.category(letter) in ("Cc", "Zl", "Zp") else letter for letter in str(value))
    return " ".join("".join(letters).split())[:_MAX_TEXT]


class _HtmlText(HTMLParser):
    """The text of HTML, with the names of its pictures, and the addresses that it leads to."""

    def __init__(self) -> None:
        super().__init__()
        self.parts: list[str] = []
        self.addresses: list[str | None] = []
        self._hidden = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        stated = dict(attrs)
        self._hidden += tag in _HIDDEN
        self.parts += ["\n"] * (tag in _BREAKS)
        if tag == "img":
            self.parts.append(f" [{stated.get('alt') or posixpath.basename(stated.get('src') or '') or 'picture'}] ")
        self.addresses.append(stated.get("href") if tag == "a" else stated.get("src") if tag == "img" else None)

    def handle_endtag(self, tag: str) -> None:
        self._hidden -= tag in _HIDDEN and self._hidden > 0
        self.parts += ["\n"] * (tag in _BREAKS)

    def handle_data(self, data: str) -> None:
        if not self._hidden:
            self.parts.append(data)


def read_note(direction: tuple[float, float], texts: Sequence[Any], addresses: Sequence[Any] = ()) -> Note:
    """A hot spot with information.

    Args:
        direction: yaw and pitch, as of a link.
        texts: HTML of its title and of what follows; of other values nothing is shown.
        addresses: further ones that it leads to; of files of the tour, and of other protocols, none is kept.
    """
    parser = _HtmlText()
    for text in texts:
        parser.feed(f"{text[:_MAX_HTML]}\n" if isinstance(text, str) else "")
    parser.close()
    return make_note(direction, "".join(parser.parts), (*parser.addresses, *addresses))


def make_note(direction: tuple[float, float], text: str, addresses: Sequence[Any] = ()) -> Note:
    """A note of plain text, without empty lines and without what is no address of a web page."""
    lines = (plain_text(line) for line in text.splitlines())
    kept = dict.fromkeys(each for each in addresses if _is_address(each))
    return Note(*direction, "\n".join(line for line in lines if line)[:_MAX_NOTE], tuple(kept)[:_MAX_ADDRESSES])


def _is_address(value: Any) -> bool:
    """Whether a value is the whole address of a web page."""
    if not isinstance(value, str) or len(value) > _MAX_NOTE or not value.isprintable():
        return False
    try:
        parts = urlsplit(value)
    except ValueError:
        return False
    return parts.scheme in ("http", "https") and bool(parts.hostname) and " " not in value


def make_panoramas(entries: Sequence[Entry], source: Path, tour: str) -> list[Panorama]:
    """Panoramas with file-safe, unique names; the same picture counts once. Cube faces get files in the cache folder.

    Warns about links to a panorama that does not exist, and drops them.

    Args:
        tour: its title.
    """
    folder = source.parent
    names: dict[str, str] = {}  # names of panoramas by their keys
    by_picture: dict[Path | CubeImage, str] = {}
    kept = []
    for number, entry in enumerate(entries, start=1):
        if entry.picture in by_picture:
            names.setdefault(entry.key, by_picture[entry.picture])
            continue
        portable = make_portable_name(entry.key)[:_MAX_NAME].rstrip(".")
        name = make_unique_name(portable or f"scene_{number}", by_picture.values())
        names.setdefault(entry.key, name)
        by_picture[entry.picture] = name
        kept.append((name, entry))
    panoramas = []
    for name, entry in kept:
        title = "" if entry.title == name else entry.title
        links = resolve_links(entry.links, names, name, source)
        notes = tuple(note for note in entry.notes if note.text or note.addresses)
        about = {"title": title, "links": links, "notes": notes, "tour": tour, "start": entry.start}
        panoramas.append(replace(make_panorama(name, entry.picture, folder), **about))
    return panoramas


def make_panorama(name: str, picture: Path | CubeImage, folder: Path) -> Panorama:
    """A panorama without a pose; cube faces get a file in the cache folder."""
    image = picture if isinstance(picture, Path) else write_cube(picture, folder, name)
    return Panorama(name, image, torch.eye(4, dtype=torch.float64), find_mask(image, folder))


def resolve_links(links: Sequence[Link], names: Mapping[str, str], own: str, source: Path) -> tuple[Link, ...]:
    """The links with the names of panoramas as targets. Warns about those to nowhere; links to itself are dropped."""
    resolved = []
    for link in links:
        if link.target not in names:
            warnings.warn(
                f"{source}: a link of {own} is left out: it leads to {link.target[:60]!r}, which is no panorama of the "
                "tour.",
                category=InputWarning,
                stacklevel=4,
            )
        elif names[link.target] != own:
            resolved.append(replace(link, target=names[link.target]))
    return tuple(resolved)
