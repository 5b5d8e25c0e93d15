"""Metadata by which players and sites recognise 360-degree images and films.

Images carry GPano properties as XMP. Films carry the RDF text of version 1 in a `uuid` box, and the boxes `st3d` and
`sv3d` of version 2. FFmpeg writes the latter only through an interface that PyAV does not offer.
An MP4 is a tree of boxes: size (4 bytes), type (4 bytes), content.

Source: https://developers.google.com/streetview/spherical-metadata;
https://github.com/google/spatial-media/tree/master/docs (spherical-video-rfc, spherical-video-v2-rfc);
ISO/IEC 14496-12, sections 4.2 (boxes) and 8.7.5 (chunk offsets).
"""

from __future__ import annotations

import os
import re
import shutil
import struct
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from PIL import Image

Stereo = Literal["mono", "top-bottom"]

_PACKETS = "xmp", "XML:com.adobe.xmp"  # where Pillow stores the packet, by the file's format
_TAG = re.compile(r"(?<!/)GPano:(\w+)\s*(?:=\s*[\"']([^\"']*)[\"']|>([^<]*)<)")
_SHAPE_TOLERANCE = 0.01  # largest relative error of the proportions that the tags state
_SPHERICAL_V1 = uuid.UUID("ffcc8263-f855-4a93-8814-587a02521fdd").bytes
_STEREO_V2 = {"mono": b"\0", "top-bottom": b"\1"}
_RDF = (
    '<?xml version="1.0"?><rdf:SphericalVideo xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#" '
    'xmlns:GSpherical="http://ns.google.com/videos/1.0/spherical/">'
    "<GSpherical:Spherical>true</GSpherical:Spherical><GSpherical:Stitched>true</GSpherical:Stitched>"
    "<GSpherical:StitchingSoftware>pansplat</GSpherical:StitchingSoftware>"
    "<GSpherical:ProjectionType>equirectangular</GSpherical:ProjectionType>"
    "<GSpherical:StereoMode>{stereo}</GSpherical:StereoMode></rdf:SphericalVideo>"
)


SOFTWARE_XMP = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    b'<rdf:Description rdf:about="" xmlns:tiff="http://ns.adobe.com/tiff/1.0/" tiff:Software="pansplat"/>'
    b"</rdf:RDF></x:xmpmeta>"
)


def make_gpano_xmp(width: int, height: int, *, is_photograph: bool = False) -> bytes:
    """XMP of a full equirectangular panorama of a size in pixels; a rendering names pansplat as its software."""
    properties = {
        "UsePanoramaViewer": "True",
        "ProjectionType": "equirectangular",
        "FullPanoWidthPixels": width,
        "FullPanoHeightPixels": height,
        "CroppedAreaImageWidthPixels": width,
        "CroppedAreaImageHeightPixels": height,
        "CroppedAreaLeftPixels": 0,
        "CroppedAreaTopPixels": 0,
    }
    if not is_photograph:  # the heading of a photograph is unknown
        properties |= {"StitchingSoftware": "pansplat", "PoseHeadingDegrees": 0}
    attributes = " ".join(f'GPano:{name}="{value}"' for name, value in properties.items())
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>'
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description rdf:about="" xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" '
        f'xmlns:xmp="http://ns.adobe.com/xap/1.0/" xmp:CreatorTool="pansplat" {attributes}/>'
        '</rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
    ).encode()


def find_xmp(image: Image.Image) -> bytes:
    """The XMP packet in the header of an image; empty if there is none."""
    packet = next((image.info[name] for name in _PACKETS if name in image.info), b"")
    return packet if isinstance(packet, bytes) else str(packet).encode()


def find_stated_problem(xmp: bytes, width: int, height: int) -> str | None:
    """What a picture is instead of a full equirectangular panorama, by the GPano properties of its XMP packet, and what
    to do; None if they state nothing else, or contradict the picture.

    Args:
        width, height: the picture's, pixels; it may have been resized.
    """
    tags = {name: attribute or element for name, attribute, element in _TAG.findall(xmp.decode("utf-8", "replace"))}
    projection = tags.get("ProjectionType", "equirectangular").strip()
    if projection.lower() != "equirectangular":
        return f"the projection {projection!r} (GPano:ProjectionType); convert it"
    try:
        full, part = (
            [float(tags[f"{kind}{side}Pixels"]) for side in ("Width", "Height")]
            for kind in ("FullPano", "CroppedAreaImage")
        )
        degrees = round(360 * part[0] / full[0]), round(180 * part[1] / full[1])
        is_right = abs(width * part[1] / (height * part[0]) - 1) < _SHAPE_TOLERANCE
    except (KeyError, ValueError, ArithmeticError):
        return None
    if degrees == (360, 180) or not is_right:
        return None
    return f"{degrees[0]} x {degrees[1]} degrees of 360 x 180 (GPano); pad it to 2:1, and mask the rest"


def mark_spherical_video(path: Path, stereo: Stereo = "mono") -> None:
    """Add the metadata of a film of panoramas to an MP4 file with one track, and with `moov` before `mdat`.

    Args:
        path: the film.
        stereo: arrangement of the eyes in a frame; the left eye is at the top.

    Raises:
        ValueError: there is no `moov` box.
    """
    marked = path.with_name(f"{path.name}.marked")
    try:
        with open(path, "rb") as file, open(marked, "wb") as target:
            header = file.read(8)
            while header[4:] != b"moov":
                if len(header) < 8:
                    raise ValueError(f"{path}: no `moov` box before the frames")
                target.write(header + file.read(int.from_bytes(header[:4], "big") - 8))
                header = file.read(8)
            movie = file.read(int.from_bytes(header[:4], "big") - 8)
            growth = len(_mark_movie(movie, 0, stereo)) - len(movie)
            target.write(_box(b"moov", _mark_movie(movie, growth, stereo)))
            shutil.copyfileobj(file, target, 1 << 24)
        os.replace(marked, path)
    finally:
        marked.unlink(missing_ok=True)


def _mark_movie(content: bytes, shift: int, stereo: Stereo) -> bytes:
    """The content of the `moov` box with the metadata; chunk offsets grow by `shift`."""

    def mark_track(track: bytes) -> bytes:
        track = _edit(track, b"mdia", b"minf", b"stbl", change=mark_samples)
        return track + _box(b"uuid", _SPHERICAL_V1 + _RDF.format(stereo=stereo).encode())

    def mark_samples(table: bytes) -> bytes:
        table = _edit(table, b"stsd", change=mark_entry)
        for name, kind in ((b"stco", "I"), (b"co64", "Q")):
            table = _edit(table, name, change=lambda offsets, kind=kind: move_chunks(offsets, kind))
        return table

    def move_chunks(offsets: bytes, kind: str) -> bytes:
        (count,) = struct.unpack_from(">I", offsets, 4)
        moved = (offset + shift for offset in struct.unpack_from(f">{count}{kind}", offsets, 8))
        return offsets[:8] + struct.pack(f">{count}{kind}", *moved)

    def mark_entry(description: bytes) -> bytes:
        size, kind = struct.unpack_from(">I4s", description, 8)
        entry = description[16 : 8 + size]
        boxes = _box(b"st3d", bytes(4) + _STEREO_V2[stereo]) + _SPHERICAL_V2
        return description[:8] + _box(kind, entry + boxes) + description[8 + size :]

    return _edit(content, b"trak", change=mark_track)


def _box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I4s", 8 + len(content), kind) + content


def _edit(content: bytes, *kinds: bytes, change: Callable[[bytes], bytes]) -> bytes:
    """The content of a box after a change of the boxes at a path of types below it."""
    parts, position = [], 0
    while position < len(content):
        size, kind = struct.unpack_from(">I4s", content, position)
        inner = content[position + 8 : position + size]
        if kind == kinds[0]:
            inner = change(inner) if len(kinds) == 1 else _edit(inner, *kinds[1:], change=change)
        parts.append(_box(kind, inner))
        position += size
    return b"".join(parts)


_PROJECTION = _box(b"prhd", bytes(16)) + _box(b"equi", bytes(20))  # it is not turned, and the panorama is not cropped
_SPHERICAL_V2 = _box(b"sv3d", _box(b"svhd", bytes(4) + b"pansplat\0") + _box(b"proj", _PROJECTION))
