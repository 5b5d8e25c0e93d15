"""Metadata by which players recognise a WebM film as a 360-degree film: the element Projection of its video track.

A WebM file is a tree of elements: identifier, size, content. FFmpeg leaves a void before the description of the tracks,
which gives its bytes to the new element, so that no other position in the file changes.

Source: RFC 9559 (Matroska), sections 5.1.1 and 5.1.4.1.28; RFC 8794 (EBML), section 4;
https://github.com/google/spatial-media/blob/master/docs/spherical-video-v2-rfc.md, section "WebM (Matroska)".
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from pansplat.data.panorama_metadata import Projection, Stereo

_SEGMENT, _SEEK_HEAD, _VOID, _INFO, _TRACKS = (
    bytes.fromhex(name) for name in ("18538067", "114d9b74", "ec", "1549a966", "1654ae6b")
)
_SEEK, _SEEK_ID, _SEEK_POSITION = (bytes.fromhex(name) for name in ("4dbb", "53ab", "53ac"))
_TRACK_ENTRY, _VIDEO = (bytes.fromhex(name) for name in ("ae", "e0"))
_PROJECTION, _PROJECTION_TYPE, _PROJECTION_PRIVATE = (bytes.fromhex(name) for name in ("7670", "7671", "7672"))
_STEREO_MODE = bytes.fromhex("53b8")
_STEREO_MODES: dict[Stereo, int] = {"mono": 0, "side-by-side": 1, "top-bottom": 3}  # the left eye comes first
# Type of the projection, and the content of the MP4 box `equi` or `cbmp`: version, flags, and zeros.
_PROJECTIONS: dict[Projection, tuple[int, bytes]] = {"equirect": (1, bytes(20)), "cubemap": (2, bytes(12))}
_MAX_HEAD = 1 << 16  # bytes before the frames
_MIN_VOID = 9  # bytes of an identifier and of a size that has 8 bytes


def mark_spherical_webm(path: Path, projection: Projection = "equirect", stereo: Stereo = "mono") -> None:
    """Add the metadata of a film of all directions to a WebM file of FFmpeg with one video track, in place.

    Args:
        path: the film.
        projection, stereo: see `mark_spherical_video`.

    Raises:
        ValueError: the file has no void before its tracks that is large enough.
    """
    with open(path, "r+b") as file:
        content = file.read(_MAX_HEAD)
        begin = next((body for name, _, body, _ in _list_elements(content, 0) if name == _SEGMENT), len(content))
        parts = {name: content[start:end] for name, start, _, end in _list_elements(content, begin)}
        places = {name: start for name, start, _, _ in _list_elements(content, begin)}
        order = [_SEEK_HEAD, _VOID, _INFO, _TRACKS]
        if [name for name in places if name in order] != order:
            raise ValueError(f"{path}: no void between the index and the tracks")
        tracks = _edit(parts[_TRACKS], _make_projection(projection, stereo), _TRACK_ENTRY, _VIDEO)
        growth = len(tracks) - len(parts[_TRACKS])
        space = len(parts[_VOID]) - growth - _MIN_VOID
        if space < 0:
            raise ValueError(f"{path}: the void before the tracks is too small")
        void = _VOID + (space | 1 << 56).to_bytes(8, "big") + bytes(space)
        file.seek(places[_SEEK_HEAD])
        file.write(_move(parts[_SEEK_HEAD], growth) + void + parts[_INFO] + tracks)


def _list_elements(content: bytes, position: int) -> Iterator[tuple[bytes, int, int, int]]:
    """Identifier, start, start of the content, and end of each complete element from a position on."""
    while position < len(content):
        body = position + _count_bytes(content[position])
        name = content[position:body]
        if body >= len(content):
            return
        width = _count_bytes(content[body])
        size = int.from_bytes(content[body : body + width], "big") - (1 << 7 * width)
        body += width
        end = body + size
        if name == _SEGMENT:  # its end may be unknown
            yield name, position, body, end
            return
        if end > len(content):
            return
        yield name, position, body, end
        position = end


def _count_bytes(first: int) -> int:
    """Length of a variable-length number, by its first byte."""
    return 9 - first.bit_length()


def _format_element(name: bytes, body: bytes) -> bytes:
    width = next(width for width in range(1, 9) if len(body) < (1 << 7 * width) - 1)
    return name + (len(body) | 1 << 7 * width).to_bytes(width, "big") + body


def _edit(element: bytes, added: bytes, *names: bytes) -> bytes:
    """An element with added bytes at the end of the elements at a path of names below it."""
    ((name, _, body, _),) = _list_elements(element, 0)
    if not names:
        return _format_element(name, element[body:] + added)
    parts = [
        _edit(element[start:end], added, *names[1:]) if inner == names[0] else element[start:end]
        for inner, start, _, end in _list_elements(element, body)
    ]
    return _format_element(name, b"".join(parts))


def _make_projection(projection: Projection, stereo: Stereo) -> bytes:
    number, private = _PROJECTIONS[projection]
    content = _format_element(_PROJECTION_TYPE, bytes([number])) + _format_element(_PROJECTION_PRIVATE, private)
    return _format_element(_STEREO_MODE, bytes([_STEREO_MODES[stereo]])) + _format_element(_PROJECTION, content)


def _move(seek_head: bytes, growth: int) -> bytes:
    """The index after the elements before the end of the tracks have moved towards the start."""
    moved = bytearray(seek_head)
    ((_, _, body, _),) = _list_elements(seek_head, 0)
    for name, _, entry, end in _list_elements(seek_head, body):
        fields = {inner: (start, stop) for inner, _, start, stop in _list_elements(seek_head[:end], entry)}
        if name == _SEEK and seek_head[slice(*fields[_SEEK_ID])] in (_INFO, _TRACKS):
            start, stop = fields[_SEEK_POSITION]
            position = int.from_bytes(seek_head[start:stop], "big") - growth
            moved[start:stop] = position.to_bytes(stop - start, "big")
    return bytes(moved)
