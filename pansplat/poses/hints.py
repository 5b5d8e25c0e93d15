"""What a panorama's metadata states about its projection and the camera's attitude: the GPano tags of its XMP packet.

Cameras and stitching programs fill these tags carelessly, so that they are hints: gravity of the metadata is used where
the picture has no vertical edges, and the compass changes the score of a pose by little.

Source: Google, Photo Sphere XMP Metadata, https://developers.google.com/streetview/spherical-metadata
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from pansplat.images.image_files import read_crop
from pansplat.images.panorama_metadata import gpano_number, parse_gpano, read_xmp


@dataclass(frozen=True, eq=False)
class Hints:
    """Statements of the metadata; None where there is none.

    Attributes:
        down: gravity in the camera's frame, by pitch and roll.
        heading: compass direction of the picture's centre, radians clockwise from north.
        problem: why the picture is not a full equirectangular panorama.
    """

    down: Float[Array, "3"] | None = None
    heading: float | None = None
    problem: str | None = None


def read_hints(path: Path) -> Hints:
    """The hints of a file; none if it is unreadable or has no such tags."""
    tags = parse_gpano(read_xmp(path))
    pitch, roll = _radians(tags, "PosePitchDegrees"), _radians(tags, "PoseRollDegrees")
    down = None
    if pitch is not None or roll is not None:
        p, r = pitch or 0.0, roll or 0.0
        down = np.array((math.cos(p) * math.sin(r), math.cos(p) * math.cos(r), -math.sin(p)))
    return Hints(down, _radians(tags, "PoseHeadingDegrees"), _find_problem(tags, path))


def _radians(tags: dict[str, str], name: str) -> float | None:
    value = gpano_number(tags, name)
    return None if value is None else math.radians(value)


def _find_problem(tags: dict[str, str], path: Path) -> str | None:
    projection = tags.get("ProjectionType", "equirectangular").strip()
    if projection.lower() != "equirectangular":
        return f"its projection is {projection!r} (GPano:ProjectionType); convert it to equirectangular"
    spans = []
    for side, whole in (("Width", 360), ("Height", 180)):
        full, part = gpano_number(tags, f"FullPano{side}Pixels"), gpano_number(tags, f"CroppedAreaImage{side}Pixels")
        spans.append(whole if not full or part is None else round(whole * part / full))
    is_padded = spans[0] == 360 and read_crop(path) is not None  # the rest is masked when it is read
    if spans != [360, 180] and not is_padded:
        return (
            f"it covers {spans[0]} x {spans[1]} degrees of 360 x 180 (GPano:CroppedArea); give the full panorama, or "
            "pad it to 2:1 with a mask"
        )
    return None
