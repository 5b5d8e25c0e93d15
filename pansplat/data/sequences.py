"""Sequences of frames: a 360Loc camera_pose.json, or a KITTI or TUM trajectory beside pictures."""

from __future__ import annotations

from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from pansplat.data.collection import FAR_SEQUENCE, Collection, mask_beside, pictures_in
from pansplat.data.pair import Panorama
from pansplat.data.poses import (
    parse_convention,
    read_json,
    read_number,
    read_trajectory,
    rigid_matrix,
    to_cam2world,
)
from pansplat.errors import InputError

LOC360 = "camera_pose.json"
_PICTURE_FOLDERS = ("image", "images", "panos", "frames", ".")


def is_loc360_sequence(folder: Path) -> bool:
    """Whether the folder has a camera_pose.json."""
    return (folder / LOC360).is_file()


def read_loc360_sequence(folder: Path, convention: str | None = None) -> Collection:
    """The frames of a 360Loc sequence, in the order of camera_pose.json (frame: 4x4); pictures are in image/.

    The matrices are cam2world with OpenCV axes, as the original system reads them, unless `convention` says
    otherwise. Source: OFFICIAL.md 2.2.

    Raises:
        InputError: a frame without a picture, or a pose that is none.
    """
    source = folder / LOC360
    convention = "cam2world opencv" if convention is None else parse_convention(convention, "`convention`")
    content = read_json(source)
    if not isinstance(content, dict):
        raise InputError(
            f"{source}: needed {{frame: 4x4 matrix, ...}}, got {type(content).__name__}; see docs/input.md."
        )
    panoramas = []
    for frame, matrix in content.items():
        image = next((folder / sub / frame for sub in _PICTURE_FOLDERS if (folder / sub / frame).is_file()), None)
        if image is None:
            raise InputError(f"{source}: needed the picture {folder / 'image' / frame}, got no such file; add it.")
        cam2world = to_cam2world(rigid_matrix(matrix, f"{source}, {frame!r}"), convention)
        panoramas.append(Panorama(image.stem, image, cam2world, mask_beside(image, folder)))
    return Collection(source, tuple(panoramas), ordered=True, far=FAR_SEQUENCE)


def trajectory_file(folder: Path) -> Path | None:
    """The trajectory of a folder: *.kitti, *.tum, poses.txt or *trajectory*.txt.

    Raises:
        InputError: there are several.
    """
    found = [
        path
        for path in sorted(folder.iterdir())
        if path.is_file()
        and (
            path.suffix.lower() in (".kitti", ".tum")
            or (path.suffix.lower() == ".txt" and ("trajectory" in path.stem.lower() or path.stem.lower() == "poses"))
        )
    ]
    if len(found) > 1:
        raise InputError(
            f"{folder}: needed one trajectory, got {', '.join(path.name for path in found)}; keep the right one."
        )
    return found[0] if found else None


def read_trajectory_folder(folder: Path, convention: str | None = None) -> Collection:
    """Pictures by name with the lines of the folder's trajectory: picture i has line i.

    A scale.txt with one number multiplies all translations (the original system's way to metres).

    Raises:
        InputError: no pictures, another number of poses than of pictures, a wrong file.
    """
    source = trajectory_file(folder)
    if source is None:
        raise InputError(f"{folder}: needed a trajectory (*.kitti, *.tum, poses.txt), got none; add it.")
    expected = source.suffix.lower().lstrip(".")
    if expected == "txt":
        expected = next((kind for kind in ("kitti", "tum") if kind in source.stem.lower()), None)
    trajectory = read_trajectory(source, convention, expected)
    images: list[Path] = []
    for sub in _PICTURE_FOLDERS:
        images = images or (pictures_in(folder / sub) if (folder / sub).is_dir() else [])
    if len(images) != len(trajectory.poses):
        raise InputError(
            f"{source}: needed one pose a picture ({len(images)} pictures), got {len(trajectory.poses)} "
            f"{trajectory.kind.upper()} poses; keep only the pictures that were tracked, in order, or "
            "use poses.json."
        )
    scale = read_number(folder / "scale.txt") if (folder / "scale.txt").is_file() else 1.0
    panoramas = tuple(
        Panorama(image.stem, image, _scaled(pose, scale), mask_beside(image, folder))
        for image, pose in zip(images, trajectory.poses, strict=True)
    )
    return Collection(source, panoramas, ordered=True, far=FAR_SEQUENCE)


def _scaled(pose: Float[Tensor, "4 4"], scale: float) -> Float[Tensor, "4 4"]:
    scaled = pose.clone()
    scaled[:3, 3] = pose[:3, 3] * scale
    return scaled
