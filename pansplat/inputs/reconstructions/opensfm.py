"""The reconstruction.json of OpenSfM (and OpenDroneMap) with spherical cameras.

A shot has a rotation (angle-axis vector) and a translation from the world to the camera, whose axes are OpenCV's. With
GPS the unit is the metre, otherwise it is arbitrary.

Source: https://opensfm.org/docs/geometry.html, https://opensfm.org/docs/dataset.html
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scipy
from msgspec import Struct

from pansplat.errors import InputError
from pansplat.inputs.reconstructions.shots import Reconstruction, Vector, find_picture, note_smaller
from pansplat.system.strict_json import convert, read_json

FILE = "reconstruction.json"

_SPHERICAL = ("spherical", "equirectangular")


class _Camera(Struct):
    projection_type: str = ""


class _Shot(Struct):
    camera: str
    rotation: Vector
    translation: Vector


class _Point(Struct):
    coordinates: Vector


class _Reference(Struct):
    latitude: float = 0
    longitude: float = 0


class _Part(Struct):
    cameras: dict[str, _Camera]
    shots: dict[str, _Shot]
    points: dict[str, _Point] = {}
    reference_lla: _Reference | None = None


def read_opensfm(source: Path, folder: Path, convention: str | None = None) -> Reconstruction:
    """The spherical shots of a reconstruction.json; of several reconstructions, those of the largest, with a note."""
    content = read_json(source)
    parts = convert(content if isinstance(content, list) else [content], list[_Part], source)
    part = max(parts, key=lambda part: len(part.shots), default=_Part({}, {}))
    cameras = {name for name, camera in part.cameras.items() if camera.projection_type in _SPHERICAL}
    chosen = {name: shot for name, shot in part.shots.items() if shot.camera in cameras}
    if not chosen:
        raise InputError(
            f"{source}: needed shots of a spherical camera, got none of {len(part.shots)}; state "
            '"projection_type": "equirectangular" and reconstruct again, or move the file away to estimate poses.'
        )
    note_smaller(source, len(parts) - 1)
    found = Reconstruction(source, folder, convention or "world2cam opencv")
    for name, shot in chosen.items():
        rotation = scipy.spatial.transform.Rotation.from_rotvec(shot.rotation).as_matrix()
        found.add(name, find_picture(folder, name), np.column_stack((rotation, shot.translation)))
    found.points = np.array([point.coordinates for point in part.points.values()], np.float64).reshape(-1, 3)
    reference = part.reference_lla
    found.is_metric = reference is not None and bool(reference.latitude or reference.longitude)
    return found
