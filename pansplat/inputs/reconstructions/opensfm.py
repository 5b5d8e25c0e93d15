"""The reconstruction.json of OpenSfM (and OpenDroneMap) with spherical cameras.

A shot has a rotation (angle-axis vector) and a translation from the world to the camera, whose axes are OpenCV's. With
GPS the unit is the metre, otherwise it is arbitrary.

Source: https://opensfm.org/docs/geometry.html, https://opensfm.org/docs/dataset.html
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import scipy
import torch

from pansplat.errors import InputError
from pansplat.inputs.poses import rigid_matrix, to_cam2world
from pansplat.inputs.reconstructions.shots import Reconstruction, Shot, find_picture, note_smaller
from pansplat.system.strict_json import convert, read_json

FILE = "reconstruction.json"

_SPHERICAL = ("spherical", "equirectangular")


def read_opensfm(source: Path, folder: Path, convention: str | None = None) -> Reconstruction:
    """The spherical shots of a reconstruction.json; of several reconstructions, those of the largest, with a note.

    Args:
        source: the file.
        folder: of the file.
        convention: of the poses; by default "world2cam opencv".
    """
    content = read_json(source)
    parts = convert(content if isinstance(content, list) else [content], list[dict[str, Any]], source)
    try:
        part = max(parts, key=lambda part: len(part["shots"]))
        cameras = {name for name, camera in part["cameras"].items() if camera.get("projection_type") in _SPHERICAL}
        chosen = {name: shot for name, shot in part["shots"].items() if shot["camera"] in cameras}
        shots, missing = [], []
        for name, shot in chosen.items():
            where = f"{source}, {name!r}"
            image = find_picture(folder, name)
            if image is None:
                missing.append(name)
                continue
            matrix = torch.eye(4, dtype=torch.float64)
            rotation = scipy.spatial.transform.Rotation.from_rotvec(np.array(shot["rotation"], float))
            matrix[:3, :3] = torch.from_numpy(rotation.as_matrix())
            matrix[:3, 3] = torch.tensor(shot["translation"], dtype=torch.float64)
            pose = to_cam2world(rigid_matrix(matrix.tolist(), where), convention or "world2cam opencv")
            shots.append(Shot(name, image, pose))
        points = [point["coordinates"] for point in part.get("points", {}).values()]
        table = np.array(points, np.float64).reshape(-1, 3)
        reference = part.get("reference_lla") or {}
        is_metric = any(reference.get(key) for key in ("latitude", "longitude"))
        others = len(parts) - 1
    except (KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{source}: needed cameras and shots of OpenSfM, got another content ({error!r:.60}); export it again."
        ) from error
    if not chosen:
        raise InputError(
            f"{source}: needed shots of a spherical camera, got none of {len(part['shots'])}; state "
            '"projection_type": "equirectangular" and reconstruct again, or move the file away to estimate poses.'
        )
    note_smaller(source, others)
    return Reconstruction(source, folder, shots, table, is_metric, missing)
