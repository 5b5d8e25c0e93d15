"""The PanoGRF layout of rendered Matterport3D triplets.

Source: OFFICIAL.md 2.1. A scene folder has one folder a view with rgb.png, depth.png (uint16, millimetres),
rot.txt (3x3) and tran.txt (3): camera to world in Habitat's axes (camera and world y up). The first and the
last view are the context, those between the targets. The world becomes z-up, as the original code makes it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.data.collection import FAR, NEAR, Collection, mask_beside
from pansplat.data.pair import Panorama
from pansplat.data.poses import parse_convention, rigid_matrix, to_cam2world
from pansplat.errors import InputError

_HABITAT = "cam2world opengl"
_Z_UP = torch.tensor(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)), dtype=torch.float64)


def is_matterport3d_scene(folder: Path) -> bool:
    """Whether the folder's folders are views with rot.txt or tran.txt."""
    return bool(_view_folders(folder))


def read_matterport3d_scene(folder: Path, convention: str | None = None) -> Collection:
    """The views of one scene folder, in sorted order; `convention` goes before Habitat's.

    Raises:
        InputError: a file of a view is missing or wrong, or there is one view only.
    """
    convention = _HABITAT if convention is None else parse_convention(convention, "`convention`")
    panoramas = tuple(_panorama(view, folder, convention) for view in _view_folders(folder))
    last = len(panoramas) - 1
    cases = (((0, last), tuple(range(1, last))),) if last > 0 else None
    return Collection(folder, panoramas, cases, near=NEAR, far=FAR, name=folder.resolve().name)


def _view_folders(folder: Path) -> list[Path]:
    names = ("rot.txt", "tran.txt")
    return [v for v in sorted(folder.iterdir()) if v.is_dir() and any((v / name).is_file() for name in names)]


def _panorama(view: Path, folder: Path, convention: str) -> Panorama:
    image = view / "rgb.png"
    if not image.is_file():
        raise InputError(f"{view}: needed rgb.png beside rot.txt and tran.txt, got none; add it.")
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = _numbers(view / "rot.txt", 9).reshape(3, 3)
    matrix[:3, 3] = _numbers(view / "tran.txt", 3)
    cam2world = _Z_UP @ to_cam2world(rigid_matrix(matrix.tolist(), str(view / "rot.txt")), convention)
    depth = view / "depth.png"
    return Panorama(view.name, image, cam2world, mask_beside(image, folder), depth if depth.is_file() else None)


def _numbers(path: Path, count: int) -> Float[Tensor, count]:
    """That many numbers from a text file."""
    if not path.is_file():
        raise InputError(f"{path}: needed the view's pose there, got no such file; add it.")
    try:
        values = np.array(path.read_text().split(), dtype=np.float64)
    except (ValueError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: needed {count} numbers, got other text ({error}); correct it.") from error
    if values.size != count:
        raise InputError(f"{path}: needed {count} numbers, got {values.size}; correct it.")
    return torch.from_numpy(values)
