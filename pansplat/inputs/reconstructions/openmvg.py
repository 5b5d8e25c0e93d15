"""The sfm_data.json of openMVG with spherical cameras.

An extrinsic is a rotation from the world to the camera, and the camera's centre. The axes are OpenCV's (y down), as in
Camera_Spherical.hpp since `lat = -uv.y() * 2 * M_PI`; builds of 2017 had y up. The unit is arbitrary.

Source: https://github.com/openMVG/openMVG/blob/develop/src/openMVG/cameras/Camera_Spherical.hpp,
https://openmvg.readthedocs.io/en/latest/openMVG/sfm/sfm/
"""

from __future__ import annotations

from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
from msgspec import Struct

from pansplat.errors import InputError
from pansplat.inputs.reconstructions.shots import Reconstruction, Vector, find_picture
from pansplat.inputs.stated_files import find_inside
from pansplat.system.descriptions import describe_count
from pansplat.system.strict_json import read_json

FILE = "sfm_data.json"

_T = TypeVar("_T")
_NAMED = 1 << 31  # bit in a type's number that its name follows


class _Item(Struct, Generic[_T]):
    value: _T
    key: int = 0


class _View(Struct):
    filename: str
    id_pose: int
    id_intrinsic: int
    local_path: str = ""


class _Data(Struct):
    data: _View


class _Pointer(Struct):
    ptr_wrapper: _Data


class _Camera(Struct):
    polymorphic_id: int
    polymorphic_name: str = ""


class _Pose(Struct):
    rotation: tuple[Vector, Vector, Vector]
    center: Vector


class _Point(Struct):
    X: Vector


class _Content(Struct):
    views: list[_Item[_Pointer]] = []
    intrinsics: list[_Item[_Camera]] = []
    extrinsics: list[_Item[_Pose]] = []
    structure: list[_Item[_Point]] = []
    root_path: str = ""


def read_openmvg(source: Path, folder: Path, convention: str | None = None) -> Reconstruction:
    """The spherical views of a sfm_data.json that have a pose."""
    content = read_json(source, _Content)
    kinds: dict[int, str] = {}  # names of types by number; a file states a name once
    for item in content.intrinsics:
        kinds.setdefault(item.value.polymorphic_id % _NAMED, item.value.polymorphic_name)
    spherical = {item.key for item in content.intrinsics if kinds[item.value.polymorphic_id % _NAMED] == "spherical"}
    poses = {item.key: item.value for item in content.extrinsics}
    views = [item.value.ptr_wrapper.data for item in content.views]
    posed = [view for view in views if view.id_pose in poses and view.id_intrinsic in spherical]
    if not posed:
        raise InputError(
            f"{source}: needed spherical views with poses, got {describe_count(len(views), 'view')}, "
            f"{describe_count(len(poses), 'pose')} and {describe_count(len(spherical), 'spherical camera')}; "
            "reconstruct with --camera_model 7 and export all (openMVG_main_ConvertSfM_DataFormat -V -I -E -S), or "
            "move the file away to estimate poses."
        )
    found = Reconstruction(source, folder, convention or "world2cam opencv")
    for view in posed:
        name = "/".join(part for part in (view.local_path, view.filename) if part)
        whole = f"{content.root_path}/{name}" if content.root_path else name
        rotation, center = (np.array(part) for part in (poses[view.id_pose].rotation, poses[view.id_pose].center))
        image = find_inside(folder, whole) or find_picture(folder, name)
        found.add(name if image else whole, image, np.column_stack((rotation, -rotation @ center)))
    found.points = np.array([item.value.X for item in content.structure], np.float64).reshape(-1, 3)
    return found
