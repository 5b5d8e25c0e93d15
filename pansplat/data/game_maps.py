"""Triplets rendered from game maps: NAME.json with NAME_0.png, NAME_1.png, NAME_2.png and their _depth.png.

The JSON has `c2w`, three cam2world matrices in OpenCV axes; views 0 and 2 are the context, 1 is the target.
Depth is uint16 millimetres along the ray.
"""

from __future__ import annotations

from pathlib import Path

from pansplat.data.collection import Collection, mask_beside
from pansplat.data.pair import Panorama
from pansplat.data.poses import parse_convention, read_json, rigid_matrix, to_cam2world
from pansplat.errors import InputError


def triplet_files(folder: Path) -> list[Path]:
    """The NAME.json files of a folder that have a NAME_0.png beside them."""
    return [path for path in sorted(folder.glob("*.json")) if path.with_name(f"{path.stem}_0.png").is_file()]


def read_triplet(source: Path, convention: str | None = None) -> Collection:
    """The triplet of one NAME.json; `convention` goes before cam2world opencv.

    Raises:
        InputError: poses or pictures are missing or wrong.
    """
    convention = "cam2world opencv" if convention is None else parse_convention(convention, "`convention`")
    content = read_json(source)
    matrices = content.get("c2w") if isinstance(content, dict) else None
    if not isinstance(matrices, list) or len(matrices) < 2:
        raise InputError(f'{source}: needed a list of two or more 4x4 matrices as "c2w", got none; see docs/input.md.')
    panoramas = []
    for i, matrix in enumerate(matrices):
        image = source.with_name(f"{source.stem}_{i}.png")
        if not image.is_file():
            raise InputError(f"{source}: needed the picture {image.name} for pose {i}, got no such file; add it.")
        depth = source.with_name(f"{source.stem}_{i}_depth.png")
        cam2world = to_cam2world(rigid_matrix(matrix, f"{source}, pose {i}"), convention)
        mask = mask_beside(image, source.parent)
        panoramas.append(Panorama(image.stem, image, cam2world, mask, depth if depth.is_file() else None))
    last = len(panoramas) - 1
    return Collection(source, tuple(panoramas), (((0, last), tuple(range(1, last))),), name=source.stem)
