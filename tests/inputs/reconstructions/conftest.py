"""A world of points and directions of known colour, and cameras in it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy import ndarray as Array
from panorama_fixtures import color_directions
from PIL import Image
from scipy.spatial.transform import Rotation

from pansplat.geometry.equirect import pixel_directions, uv_from_directions
from pansplat.inputs.panorama_sets import Panorama

HEIGHT = 64


@pytest.fixture(scope="session")
def cameras() -> list[Array]:
    """cam2world of three cameras, OpenCV axes, with tilts."""
    random = np.random.default_rng(5)
    poses = []
    for place in ((0.1, -0.2, 0.4), (1.3, -0.1, 0.2), (0.4, 0.1, 1.9)):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(random.normal(size=3)).as_matrix()
        pose[:3, 3] = place
        poses.append(pose)
    return poses


@pytest.fixture(scope="session")
def points() -> Array:
    return np.random.default_rng(6).normal(size=(200, 3)) * 3


@pytest.fixture(scope="session")
def write_panorama() -> Callable[[Path, Array], None]:
    """Write the panorama of a camera in a world whose directions have known colours."""

    def write(path: Path, cam2world: Array) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        rays = pixel_directions(HEIGHT, 2 * HEIGHT, dtype=torch.float64).numpy() @ cam2world[:3, :3].T
        Image.fromarray(color_directions(rays)).save(path)

    return write


@pytest.fixture(scope="session")
def write_view() -> Callable[..., None]:
    """Write the picture of a pinhole camera (fx fy cx cy, pixel centres at half-integers) in the same world."""

    def write(path: Path, cam2world: Array, lens: tuple[float, float, float, float], width: int, height: int) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        fx, fy, cx, cy = lens
        y, x = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
        rays = np.stack(((x - cx) / fx, (y - cy) / fy, np.ones_like(x)), axis=-1) @ cam2world[:3, :3].T
        Image.fromarray(color_directions(rays)).save(path)

    return write


@pytest.fixture(scope="session")
def check_pixels(points: Array) -> Callable[..., None]:
    """Check the pixels at which a panorama shows the points: u and v in [0, 1] by the formula of the format."""

    def check(panorama: Panorama, uv: Array, tolerance: float = 1e-6) -> None:
        pose = panorama.cam2world
        local = (torch.from_numpy(points) - pose[:3, 3]) @ pose[:3, :3]
        difference = uv_from_directions(local).numpy() - uv
        difference[:, 0] -= np.rint(difference[:, 0])
        assert np.abs(difference).max() < tolerance

    return check


@pytest.fixture(scope="session")
def check_colors() -> Callable[..., None]:
    """Check that the picture of a panorama has the colours of the world under its pose."""

    def check(image: torch.Tensor, cam2world: torch.Tensor, tolerance: float = 4) -> None:
        height = image.shape[1]
        rays = pixel_directions(height, 2 * height, dtype=torch.float64) @ cam2world[:3, :3].T
        assert np.nanmax(np.abs(image.permute(1, 2, 0).numpy() * 255 - color_directions(rays.numpy()))) < tolerance

    return check


FACE_TURNS = {
    "front": (0, 0), "right": (90, 0), "back": (180, 0), "left": (270, 0), "up": (0, 90), "down": (0, -90),
}  # fmt: skip
"""Turns of the faces to the right, and then up, degrees; written down apart from pansplat.geometry.cubemap."""


@pytest.fixture(scope="session")
def face_cameras() -> Callable[[Array], dict[str, Array]]:
    """cam2world of the six faces of a panorama camera."""

    def turn(pose: Array) -> dict[str, Array]:
        faces = {}
        for name, (right, up) in FACE_TURNS.items():
            face = pose.copy()
            face[:3, :3] = pose[:3, :3] @ Rotation.from_euler("YX", (right, up), degrees=True).as_matrix()
            faces[name] = face
        return faces

    return turn
