"""The files of a page: one HTML file with all data, or with a folder beside it, written completely or not at all."""

from __future__ import annotations

import base64
import hashlib
import html
import math
import os
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from urllib.parse import quote, urljoin

import msgspec

from pansplat.errors import InputError
from pansplat.export.page_data import PageHeader, PageView
from pansplat.export.page_program import fill_template, to_script
from pansplat.export.photographs import PackedPhotograph, label_files
from pansplat.system.atomic import replacing
from pansplat.system.descriptions import describe_count, list_first
from pansplat.system.files import is_written

MAX_FILE_BYTES = 64_000_000  # largest page in one file
_PART_BYTES = 1_500_000  # bytes of data between two steps of the progress bar; divisible by 3 for base64


@dataclass(frozen=True)
class PageFiles:
    """The files of a page that was written.

    Attributes:
        files: the page, and its parts if it is split.
        num_bytes: of all files.
        num_gaussians: in the page.
        photo_height: of its photographs, pixels; 0 without photographs.
        num_flights: number of edges along which it flies.
        zooms: labels of the two panoramas of each edge along which it zooms.
        num_outside: panoramas without doll's house.
    """

    files: tuple[Path, ...]
    num_bytes: int
    num_gaussians: int
    photo_height: int = 0
    num_flights: int = 0
    zooms: tuple[tuple[str, str], ...] = ()
    num_outside: int = 0


def write_files(
    path: Path,
    header: PageHeader,
    contents: Sequence[bytes],
    pictures: Sequence[PackedPhotograph],
    poster: bytes,
    atlas: bytes,
    split: bool,
    title: str,
    address: str | None,
) -> PageFiles:
    """Write the page, and its parts if it is split.

    Args:
        header: without the names of files.
        contents: of the Gaussians of each view.
        atlas: of the doll's house.
    """
    names = [spot.name for spot in header.spots]
    labels = label_files(names)
    parts: dict[str, bytes] = {}
    tags: dict[int, list[str]] = {}  # HTML elements of the Gaussians of each view
    views: list[PageView] = []
    for view, content in enumerate(contents):
        ends = [len(content)] if split else [*range(_PART_BYTES, len(content), _PART_BYTES), len(content)]
        chunks = [content[start:end] for start, end in pairwise((0, *ends))]
        named = {_name_part(labels[view], chunk, "bin"): chunk for chunk in chunks}
        views.append(msgspec.structs.replace(header.views[view], files=tuple(named)))
        parts |= named
        calls = [f"addChunk({view}, {'true' if chunk is chunks[-1] else 'false'})" for chunk in chunks]
        tags[view] = [
            f'<script type="text/plain">{base64.b64encode(chunk).decode()}</script><script>{call}</script>'
            for call, chunk in zip(calls, chunks, strict=True)
        ]
    folder = path.with_name(f"{path.stem}_files")
    folder_address = quote(os.fsencode(folder.name)) if split else None
    header = msgspec.structs.replace(header, views=tuple(views), folder=folder_address)
    elements: list[str] = []
    texts = {"og:title": title, "og:description": f"{describe_count(len(names), 'panorama')}: {list_first(names)}"}
    if split:
        preview = _name_part("preview", poster, "jpg")
        parts[preview] = poster
        base = address if not address or address.endswith((".html", "/")) else f"{address}/"
        texts["og:image"] = urljoin(base or "", f"{folder_address}/{preview}")
        for picture in pictures:
            parts |= picture.make_files()
    else:
        parts = {}
        first, *others = header.loading
        shown = [picture.make_elements() for picture in pictures] or [[] for _ in tags]
        # The smallest photograph of the first panorama, its Gaussians, and then its photograph.
        elements = [*shown[first][:1], *tags[first], *shown[first][1:]]
        for kind in (tags, shown):
            elements += [element for view in others for element in kind[view]]
    if atlas:
        elements.append(
            f'<img id="atlas" alt="" hidden src="data:image/webp;base64,{base64.b64encode(atlas).decode()}">'
        )
    page = fill_template(
        connections="'self'" if split else "'none'",
        title=html.escape(title),
        description=html.escape(texts["og:description"]),
        properties="\n".join(f'<meta property="{name}" content="{html.escape(text)}">' for name, text in texts.items()),
        poster=base64.b64encode(poster).decode(),
        header=to_script(msgspec.to_builtins(header)),
        parts="\n".join(elements),
    ).encode(errors="replace")  # a title from a file name that is not UTF-8
    if len(page) > MAX_FILE_BYTES and not split:
        fitting = math.floor(0.95 * header.count * MAX_FILE_BYTES / len(page))
        raise InputError(
            f"{path}: needed a page of at most {MAX_FILE_BYTES // 1_000_000} MB in one file, got "
            f"{len(page) / 1e6:.0f} MB; write a folder (--out without a suffix), or keep at most {fitting:,} "
            "Gaussians (--gaussians)"
        )
    files = [folder / name for name in parts]
    if split:
        _make_folder(folder)
    with replacing(path) as temporary_page:  # the page appears last; with it, other exports see which parts it needs
        temporary_page.write_bytes(page)
        for file, part in zip(files, parts.values(), strict=True):
            with replacing(file) as temporary:
                temporary.write_bytes(part)
    _remove_old_parts(folder)
    files.insert(0, path)
    total = len(page) + sum(map(len, parts.values()))
    photo_height = max((picture.height for picture in pictures), default=0)
    zooms = tuple((names[a], names[b]) for a, b in header.poor)
    num_flights = sum(a != b for a, b, _ in header.edges) - len(zooms)
    return PageFiles(tuple(files), total, header.count, photo_height, num_flights, zooms)


def _name_part(label: str, content: bytes, suffix: str) -> str:
    return f"{label}_{hashlib.blake2b(content, digest_size=8).hexdigest()}.{suffix}"


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(
            f"cannot write {folder}: needed a folder for the parts of the page, got '{reason}'; choose another name"
        ) from error


def _remove_old_parts(folder: Path) -> None:
    """Remove the parts that no page beside the folder needs, by their names and content, and the folder if that empties
    it. A page of another export that is being written has a temporary name there (`replacing`)."""
    name = re.compile(r"(?:\w[\w-]*_)?([0-9a-f]{16})(_\d+)?\.(js|bin|jpg)")
    found = [(file, part[1]) for file in folder.glob("*") if (part := name.fullmatch(file.name)) and is_written(file)]
    needed, address = set(), f'"folder": {to_script(quote(os.fsencode(folder.name)))}'.encode()
    for page in folder.parent.glob("*.htm*") if found else ():
        with suppress(IsADirectoryError):
            content = page.read_bytes()
            needed |= {
                digits.decode() for digits in re.findall(rb"[0-9a-f]{16}", content if address in content else b"")
            }
    old = [file for file, digits in found if digits not in needed]
    for file in old:
        with suppress(OSError):
            file.unlink()
    if old:
        with suppress(OSError):
            folder.rmdir()
