"""The sfm_data.json of openMVG with spherical cameras.

An extrinsic is a rotation from the world to the camera, and the camera's centre. The axes are OpenCV's (y down), as in
Camera_Spherical.hpp since `lat = -uv.y() * 2 * M_PI`; builds of 2017 had y up. The unit is arbitrary.

Source: https://github.com/openMVG/openMVG/blob/develop/src/openMVG/cameras/Camera_Spherical.hpp,
https://openmvg.readthedocs.io/en/latest/openMVG/sfm/sfm/
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from pansplat.errors import InputError
from pansplat.inputs.poses import rigid_matrix, to_cam2world
from pansplat.inputs.reconstructions.shots import Reconstruction, Shot, find_picture
from pansplat.inputs.stated_files import find_inside
from pansplat.system.descriptions import describe_count
from pansplat.system.strict_json import read_field, read_json

FILE = "sfm_data.json"

_Items = list[dict[str, Any]]
_FIRST = 1 << 31  # flag of a type's number where its name is stated


def read_openmvg(source: Path, folder: Path, convention: str | None = None) -> Reconstruction:
    """The spherical views of a sfm_data.json that have a pose.

    Args:
        source: the file.
        folder: of the file.
        convention: of the poses; by default "world2cam opencv".
    """
    content = read_json(source, dict[str, Any])
    try:
        spherical = _find_spherical(content, source)
        poses = {item["key"]: item["value"] for item in read_field(content, "extrinsics", _Items, source, [])}
        views = [item["value"]["ptr_wrapper"]["data"] for item in read_field(content, "views", _Items, source, [])]
        points = [item["value"]["X"] for item in read_field(content, "structure", _Items, source, [])]
        root, shots, missing = str(content.get("root_path", "")), [], []
        posed = [view for view in views if view["id_pose"] in poses and view["id_intrinsic"] in spherical]
        for view in posed:
            name = "/".join(part for part in (view.get("local_path"), view["filename"]) if part)
            where = f"{source}, {name!r}"
            image = find_inside(folder, f"{root}/{name}" if root else name) or find_picture(folder, name)
            if image is None:
                missing.append(f"{root}/{name}" if root else name)
                continue
            pose, matrix = poses[view["id_pose"]], torch.eye(4, dtype=torch.float64)
            matrix[:3, :3] = torch.tensor(pose["rotation"], dtype=torch.float64)
            matrix[:3, 3] = -matrix[:3, :3] @ torch.tensor(pose["center"], dtype=torch.float64)
            cam2world = to_cam2world(rigid_matrix(matrix.tolist(), where), convention or "world2cam opencv")
            shots.append(Shot(name, image, cam2world))
        table = np.array(points, np.float64).reshape(-1, 3)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{source}: needed views, intrinsics and extrinsics of openMVG, got another content ({error!r:.60}); "
            "export it again (openMVG_main_ConvertSfM_DataFormat -V -I -E -S)."
        ) from error
    if not posed:
        raise InputError(
            f"{source}: needed spherical views with poses, got {describe_count(len(views), 'view')}, "
            f"{describe_count(len(poses), 'pose')} and {describe_count(len(spherical), 'spherical camera')}; "
            "reconstruct with --camera_model 7, or move the file away to estimate poses."
        )
    return Reconstruction(source, folder, shots, table, missing=missing)


def _find_spherical(content: dict[str, Any], source: Path) -> set[int]:
    """Numbers of the spherical cameras. The name of a type is stated once; then its number stands for it."""
    names: dict[int, str] = {}
    spherical = set()
    for item in read_field(content, "intrinsics", _Items, source, []):
        value = item["value"]
        kind = int(value["polymorphic_id"]) % _FIRST
        names.setdefault(kind, str(value.get("polymorphic_name", "")))
        if names[kind] == "spherical":
            spherical.add(item["key"])
    return spherical
