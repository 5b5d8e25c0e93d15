"""Line segments give gravity and walls, and state how exact they are."""

import math

import cv2
import numpy as np
import pytest
import torch
from numpy import ndarray as Array

from pansplat.geometry.equirect import pixel_directions
from pansplat.poses.axes import SceneAxes, find_axes
from pansplat.poses.solvers import angle_between, rotation_exp


def _render_cupboards(rotation: Array, distortion: float = 0.0) -> Array:
    """A panorama of a room whose walls have cupboards, with smoothly displaced bearings, 8 bit."""
    rays = pixel_directions(512, 1024, dtype=torch.float64).numpy()
    rays = rays + distortion * np.sin(9 * rays[..., (1, 2, 0)] + 5 * rays)
    rays = rays @ rotation.T
    with np.errstate(divide="ignore"):
        distance = (np.sign(rays) * (2.0, 1.2, 2.6)) / rays
    axis = distance.argmin(axis=-1)
    points = np.floor((rays * distance.min(axis=-1)[..., None] + 3) / 1.0).astype(int)
    shade = (37 * points[..., 0] + 61 * points[..., 1] + 89 * points[..., 2] + 53 * axis) % 160 + 60
    return cv2.GaussianBlur(shade.astype(np.uint8), (0, 0), 0.5)


@pytest.fixture(scope="module")
def axes() -> tuple[SceneAxes, SceneAxes]:
    """Of one camera without and with distortion."""
    rotation = rotation_exp(np.array((0.03, 0.4, -0.02)))
    clean, distorted = (find_axes(_render_cupboards(rotation, size)) for size in (0.0, 0.006))
    return clean, distorted


def test_gravity_is_found_in_a_tilted_camera(axes: tuple[SceneAxes, SceneAxes]) -> None:
    down = rotation_exp(np.array((0.03, 0.4, -0.02))).T @ np.array((0.0, 1, 0))
    assert axes[0].has_down and axes[0].has_walls
    assert math.degrees(angle_between(axes[0].axes[0], down)) < 0.15  # half a pixel


def test_distortion_makes_the_axes_state_a_larger_noise(axes: tuple[SceneAxes, SceneAxes]) -> None:
    clean, distorted = axes
    assert clean.noise < math.radians(0.15) < math.radians(0.2) < distorted.noise
