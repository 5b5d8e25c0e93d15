"""Images for a screen: selection of the Gaussians in view, layers, bytes, and views from cube faces."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from dense_renderer import POSE, make_scene

from pansplat.constants import FILTER_VARIANCE, NEAR
from pansplat.rendering.blend import blend
from pansplat.rendering.cpu.display import (
    NO_LAYER,
    DisplayScene,
    PixelFaces,
    Selection,
    blend_layers,
    blend_to_pixels,
)
from pansplat.rendering.image_planes import ImagePlane
from pansplat.rendering.rasterize import rasterize

SIZE, FOV = (48, 70), 70.0
FOCAL = 0.5 * SIZE[0] / math.tan(math.radians(FOV) / 2)


@pytest.fixture(scope="module")
def scene():
    """600 Gaussians around the camera with two labels."""
    scene = make_scene(600, scale=0.1, extent=1.3, degree=1).to(dtype=torch.float32)
    return dataclasses.replace(scene, views=torch.arange(600) % 2)


@pytest.fixture(scope="module")
def display(scene):
    reach = np.sqrt(2 * np.log(np.maximum(255 * scene.opacities.numpy(), 1))).astype(np.float32)
    fields = (getattr(scene, name).numpy() for name in ("means", "opacities", "quats", "scales", "harmonics"))
    return DisplayScene(*fields, reach)


def draw(display, pose, labels, layers, selection=None):
    plane = ImagePlane(SIZE, pose[:3, :3], FOCAL)
    position, options = pose[:3, 3].numpy(), {"selection": selection, "min_transmittance": 1e-7}
    return display.rasterize(position, plane, labels.astype(np.int16), layers, NEAR, **options)


def frustum(pose, scale=1.0):
    x, y = scale * 0.5 * SIZE[1] / FOCAL, scale * 0.5 * SIZE[0] / FOCAL
    normals = np.array(((-1, 0, x), (1, 0, x), (0, -1, y), (0, 1, y)))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    deviation = math.sqrt(FILTER_VARIANCE) / FOCAL
    return Selection(normals @ pose[:3, :3].numpy().T, deviation)


def test_layers_are_the_images_of_their_gaussians(scene, display):
    sums = draw(display, POSE, scene.views.numpy(), 2).sums
    for view in (0, 1):
        part = scene.select(scene.views == view)
        expected = rasterize(part, POSE, size=SIZE, layout="pinhole", vertical_fov_degrees=FOV, backend="numba")
        assert np.abs(sums[view, :3] - expected.color.numpy()).max() <= 2e-6
        assert np.abs(sums[view, 4] - expected.alpha.numpy()).max() <= 2e-6


def test_selection_does_not_change_the_image_and_leaves_gaussians_out(scene, display):
    labels = np.zeros(len(scene))
    whole, selected = draw(display, POSE, labels, 1), draw(display, POSE, labels, 1, frustum(POSE))
    assert whole.selected == np.count_nonzero(scene.opacities > 1 / 255) and selected.selected < 0.6 * whole.selected
    assert np.array_equal(whole.sums, selected.sums)
    narrow = draw(display, POSE, labels, 1, frustum(POSE, 0.2))
    assert not np.array_equal(whole.sums, narrow.sums), "the bound is not infinite"


def test_gaussians_without_a_layer_are_not_drawn(display):
    assert not draw(display, POSE, np.full(600, NO_LAYER), 1).sums.any()


def test_blended_layers_equal_those_of_the_definition_and_pixels_are_rounded(scene, display):
    sums = draw(display, POSE, scene.views.numpy(), 2).sums
    background, weights = (0.2, 0.5, 0.9), torch.tensor((0.7, 0.3))
    images = [
        rasterize(
            scene.select(scene.views == view), POSE, size=SIZE, layout="pinhole", vertical_fov_degrees=FOV,
            background=background, backend="numba",
        )
        for view in (0, 1)
    ]  # fmt: skip
    expected = blend(images, weights)
    color, depth = blend_layers(sums, weights.numpy(), background)
    assert np.abs(color[..., :3] - expected.color.permute(1, 2, 0).numpy()).max() <= 1e-5
    assert np.abs(color[..., 3] - expected.alpha.numpy()).max() <= 1e-5
    assert np.abs(depth - expected.depth.numpy()).max() <= 1e-4
    for bottom_up in (False, True):
        pixels = np.empty(SIZE, np.uint32)
        blend_to_pixels(sums, weights.numpy(), background, pixels, bottom_up=bottom_up)
        bytes_ = pixels.view(np.uint8).reshape(*SIZE, 4)[:: -1 if bottom_up else 1]
        assert np.abs(bytes_[..., :3] - 255 * np.clip(color[..., :3], 0, 1)).max() <= 0.51
        assert (bytes_[..., 3] == 255).all()


def test_sampled_faces_show_smooth_functions_of_the_direction_without_seams():
    faces = PixelFaces.allocate(40.5)
    for face in range(6):
        write_directions(faces.plane(face).directions().numpy(), faces.pixels[face])
    for rotation in (POSE[:3, :3], torch.eye(3, dtype=torch.float64), POSE[:3, :3].T):
        for bottom_up in (False, True):
            found, expected = np.empty((60, 90), np.uint32), np.empty((60, 90), np.uint32)
            faces.sample(rotation.numpy(), 30.0, found, bottom_up=bottom_up)
            write_directions(ImagePlane((60, 90), rotation, 30.0).directions().numpy(), expected)
            found = found[::-1] if bottom_up else found
            error = np.ascontiguousarray(found).view(np.uint8).astype(int) - expected.view(np.uint8)
            assert np.abs(error).max() <= 2


def write_directions(directions: np.ndarray, pixels: np.ndarray) -> None:
    """Write directions as colours."""
    words = np.full((*pixels.shape, 4), 255, np.uint8)
    words[..., :3] = np.round(127.5 + 127 * directions)
    pixels[:] = words.view(np.uint32)[..., 0]
