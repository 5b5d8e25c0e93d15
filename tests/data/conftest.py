"""Small panorama files with poses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from pansplat.data.images import write_image


@pytest.fixture(scope="session")
def write_panorama() -> Callable[..., None]:
    """Write a grey panorama of 16x32 pixels, with its folder."""

    def write(path: Path, value: float = 0.5) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_image(path, torch.full((3, 16, 32), value))

    return write


@pytest.fixture(scope="session")
def write_depth() -> Callable[..., None]:
    """Write a depth image of 16x32 pixels."""
    return lambda path, millimetres: cv2.imwrite(str(path), np.full((16, 32), millimetres, np.uint16))


@pytest.fixture(scope="session")
def matrix() -> Callable[..., list[list[float]]]:
    """A cam2world matrix at x."""
    return lambda x: [[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
