"""The transforms.json of nerfstudio: equirectangular cameras, and perspective ones without distortion.

`transform_matrix` is cam2world with OpenGL axes. `applied_transform` and `applied_scale` lead from the original world
to that of the file, and are undone. Pixel centres are at half-integers.

Source: https://docs.nerf.studio/quickstart/data_conventions.html;
nerfstudio.data.dataparsers.nerfstudio_dataparser, nerfstudio.cameras.cameras (`_generate_rays_from_coords`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from jaxtyping import Float
from msgspec import Meta
from numpy import ndarray as Array
from torch import Tensor

from pansplat.errors import InputError
from pansplat.geometry.pose import invert_pose
from pansplat.images.image_files import read_size
from pansplat.images.rig_images import Lens
from pansplat.inputs.poses import from_cam2world, rigid_matrix
from pansplat.inputs.reconstructions.shots import Reconstruction, find_picture
from pansplat.inputs.stated_files import locate_inside
from pansplat.system.atomic import replacing
from pansplat.system.files import PLY_TYPES, read_file
from pansplat.system.strict_json import read_field, read_json

FILE = "transforms.json"
CONVENTION = "cam2world opengl"
Z_UP = torch.tensor(((1, 0, 0, 0), (0, 0, 1, 0), (0, -1, 0, 0), (0, 0, 0, 1)), dtype=torch.float64)
"""From a world with y down to nerfstudio's, with z up; the points of a file that is written are in the latter."""

_EQUIRECT = "EQUIRECTANGULAR"
_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE")
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_SIDE, _FOCAL = Annotated[float, Meta(ge=1, le=1 << 20)], Annotated[float, Meta(ge=1e-6, le=1e9)]
_LENS = {
    "w": _SIDE, "h": _SIDE, "fl_x": _FOCAL, "fl_y": _FOCAL, **dict.fromkeys(("cx", "cy", *_DISTORTION), float),
}  # fmt: skip
_MAX_PLY = 1 << 30  # bytes of the largest point cloud that is read


def read_nerfstudio(source: Path, folder: Path, convention: str | None = None) -> Reconstruction:
    """The frames of a transforms.json."""
    content = read_json(source, dict[str, Any])
    frames = read_field(content, "frames", list[dict[str, Any]], source, [])
    if not frames:
        raise InputError(f'{source}: needed posed pictures as "frames", got none; export the poses again.')
    scale = read_field(content, "applied_scale", Annotated[float, Meta(ge=1e-12, le=1e12)], source, 1.0)
    applied = content.get("applied_transform")
    undo = torch.eye(4, dtype=torch.float64)
    if applied is not None:
        undo = invert_pose(rigid_matrix(applied, f"{source}, applied_transform"))
    found = Reconstruction(source, folder, convention or CONVENTION, undo, 1 / scale)
    for number, frame in enumerate(frames):
        where = f"{source}, frame {number}"
        name = read_field(frame, "file_path", str, where, "")
        image = find_picture(folder, name)
        stated = None if image is None else read_field(frame, "mask_path", str, where)
        mask = None if stated is None else find_picture(folder, stated)
        if stated is not None and mask is None:
            locate_inside(folder, stated, where)
            raise InputError(f'{where}: needed the mask {stated}, got no such file; correct or remove "mask_path".')
        lens = None if image is None else _read_lens({**content, **frame}, image, where)
        found.add(name, image, frame.get("transform_matrix"), lens, mask)
    found.points = (_read_points(content, source) / scale) @ undo[:3, :3].T.numpy() + undo[:3, 3].numpy()
    return found


def _read_lens(fields: Mapping[str, Any], image: Path, where: str) -> Lens | None:
    model = str(fields.get("camera_model", "OPENCV")).upper()
    if model == _EQUIRECT:
        return None
    if model not in _PERSPECTIVE:
        raise InputError(
            f"{where}: needed the camera model {_EQUIRECT} or {', '.join(_PERSPECTIVE)}, got {model[:40]}; undistort "
            "the pictures, or give equirectangular ones."
        )
    numbers = {key: read_field(fields, key, kind, where) for key, kind in _LENS.items()}
    distortion = [key for key in _DISTORTION if numbers[key]]
    if distortion:
        raise InputError(
            f"{where}: needed pictures without distortion, got {', '.join(distortion)}; undistort them first "
            "(colmap image_undistorter)."
        )
    width, height = (int(numbers[key] or size) for key, size in zip(("w", "h"), read_size(image), strict=True))
    if (fx := numbers["fl_x"]) is None:
        raise InputError(f'{where}: needed a focal length as "fl_x", pixels, got none; add it.')
    cx, cy = (size / 2 if numbers[key] is None else numbers[key] for key, size in (("cx", width), ("cy", height)))
    return Lens(fx, numbers["fl_y"] or fx, cx, cy, width, height)


def _read_points(content: Mapping[str, Any], source: Path) -> Float[Array, "point 3"]:
    """The points of the .ply that the file names; none if there is none, or it cannot be read: they are optional."""
    name = content.get("ply_file_path")
    path = locate_inside(source.parent, name, source) if isinstance(name, str) else None
    if path is None or not path.is_file():
        return np.empty((0, 3))
    head, _, body = read_file(path, limit=_MAX_PLY).partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    order = ">" if ["format", "binary_big_endian", "1.0"] in lines else "<"
    properties = [line for line in lines if line[:1] == ["property"] and len(line) == 3]  # not the lists of faces
    columns = [(line[2], order + PLY_TYPES.get(line[1], "")) for line in properties]
    try:
        count = next(int(line[2]) for line in lines if line[:2] == ["element", "vertex"])
        if ["format", "ascii", "1.0"] in lines:
            rows = np.array([row.split() for row in body.decode("ascii").split("\n")[:count]], np.float64)
            table: Any = dict(zip([name for name, _ in columns], rows.T, strict=True))
        else:
            table = np.frombuffer(body, np.dtype(columns), count)
        points = np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)
    except (ValueError, TypeError, IndexError, KeyError, StopIteration):
        return np.empty((0, 3))
    return points[np.isfinite(points).all(axis=1)]


def write_nerfstudio(
    path: Path, shots: Sequence[tuple[str, Float[Tensor, "4 4"], Lens, str | None]], points: str | None
) -> None:
    """Write a transforms.json of perspective pictures, in a world with z up; `applied_transform` leads to it.

    Args:
        path: the file.
        shots: path of the picture relative to the file, cam2world (OpenCV axes, world with y down), lens, and path of
            the mask. nerfstudio needs masks of all pictures, or of none.
        points: path of a .ply in the world with z up; None if there is none.
    """
    frames = []
    for name, cam2world, lens, mask in shots:
        matrix = from_cam2world(Z_UP @ cam2world.double(), CONVENTION)
        frame = {
            "file_path": name,
            "fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy, "w": lens.width, "h": lens.height,
            "transform_matrix": matrix.tolist(),
        }  # fmt: skip
        frames.append(frame | ({} if mask is None else {"mask_path": mask}))
    content: dict[str, Any] = {"software": "pansplat", "camera_model": "OPENCV", "applied_transform": Z_UP[:3].tolist()}
    content |= {} if points is None else {"ply_file_path": points}
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(content | {"frames": frames}, indent=1) + "\n", encoding="utf-8")
