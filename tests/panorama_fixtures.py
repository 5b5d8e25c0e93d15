"""Small panorama files with poses, and a scene in which every direction has its own colour."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from pansplat.geometry.equirect import pixel_directions
from pansplat.images.image_files import write_image


def write_grey(path: Path, value: float = 0.5) -> None:
    """Write a grey panorama of 16x32 pixels, with its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, torch.full((3, 16, 32), value))


def write_depth_image(path: Path, millimetres: int) -> None:
    """Write a depth image of 16x32 pixels."""
    cv2.imwrite(str(path), np.full((16, 32), millimetres, np.uint16))


def color_directions(rays: np.ndarray) -> np.ndarray:
    """8-bit colours of directions (... 3): right, up, forward."""
    unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return np.rint(127.5 + 100 * unit).astype(np.uint8)


@pytest.fixture(scope="session")
def color_face() -> Callable[[str, int], np.ndarray]:
    """The picture of a cube face, by its letter and size, as Marzipano and Pannellum define the faces.

    Marzipano turns the front face by 90 degrees around x for the upper face, and by -90 degrees for the lower one, and
    around y for the others (right-handed axes: right, up, backward).
    """

    def color(face: str, size: int) -> np.ndarray:
        position = (np.arange(size) + 0.5) / size * 2 - 1
        down, right = np.meshgrid(position, position, indexing="ij")
        one = np.ones_like(right)
        rays = {
            "f": (right, -down, one),
            "r": (one, -down, -right),
            "b": (-right, -down, -one),
            "l": (-one, -down, right),
            "u": (right, one, down),
            "d": (right, -one, -down),
        }[face]
        return color_directions(np.stack(rays, axis=-1))

    return color


@pytest.fixture(scope="session")
def check_colors() -> Callable[..., None]:
    """Check that a panorama (3 H W) in [0, 1] has the scene's colours; a JPEG has small errors."""

    def check(image: torch.Tensor, tolerance: float = 5) -> None:
        height = image.shape[1]
        rays = pixel_directions(height, 2 * height, dtype=torch.float64).numpy() * (1, -1, 1)
        assert np.abs(image.permute(1, 2, 0).numpy() * 255 - color_directions(rays)).max() < tolerance

    return check


@pytest.fixture(scope="session")
def write_tiles(color_face: Callable[[str, int], np.ndarray]) -> Callable[..., None]:
    """Write the tiles of a level of the scene; `name` makes a path from face, row and column."""

    def write(size: int, tile: int, name: Callable[[str, int, int], Path]) -> None:
        for face in "frblud":
            pixels = color_face(face, size)
            for row in range(-(-size // tile)):
                for column in range(-(-size // tile)):
                    path = name(face, row, column)
                    path.parent.mkdir(parents=True, exist_ok=True)
                    part = pixels[row * tile : (row + 1) * tile, column * tile : (column + 1) * tile]
                    Image.fromarray(part).save(path, quality=97, subsampling=0)

    return write


@pytest.fixture(scope="session")
def write_scene() -> Callable[..., None]:
    """Write the scene as a 2:1 panorama; `turn` rolls it by columns, so that pictures differ."""

    def write(path: Path, height: int = 32, turn: int = 0) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        rays = pixel_directions(height, 2 * height, dtype=torch.float64).numpy() * (1, -1, 1)
        Image.fromarray(np.roll(color_directions(rays), turn, axis=1)).save(path, quality=97, subsampling=0)

    return write
