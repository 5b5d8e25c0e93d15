"""Displays of a property: both renderers draw them as the torch reference defines them."""

import os
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch
from PIL import Image

from pansplat.images.image_files import write_image
from pansplat.rendering import rasterize
from pansplat_viewer.core.settings import SCALAR_MAPS, Display, DrawSettings, Mode
from pansplat_viewer.draw.color_maps import color_by_label, map_values
from pansplat_viewer.draw.frame_renderer import render_image

pytestmark = pytest.mark.gl

SIZE = (64, 48)
RENDERERS = ("gl", "cpu")


def draw(renderer, pose, settings) -> np.ndarray:
    renderer.render(pose, SIZE, settings)
    return renderer.read_color()


@pytest.mark.parametrize("name", RENDERERS)
def test_depth_and_opacity_are_the_mapped_numbers_of_the_image(make_renderer, small_scene, pose, name):
    gaussians = small_scene.gaussians.to(dtype=torch.float64)
    image = rasterize(gaussians, torch.from_numpy(pose), size=SIZE[::-1], layout="pinhole")
    for display, values, largest in (("depth", image.depth, 6.0), ("opacity", image.alpha, 1.0)):
        color = draw(make_renderer(small_scene, name), pose, DrawSettings(display=display, display_max=largest))
        expected = map_values(values.numpy(), largest, SCALAR_MAPS[display]) / 255
        expected[image.alpha.numpy() == 0] = 0
        assert (np.abs(color[..., :3] - expected).max(axis=2) > 0.03).mean() < 0.01


def test_labels_have_ten_different_colors():
    colors = color_by_label(np.arange(11, dtype=np.int32))
    assert len(np.unique(colors, axis=0)) == 10 and np.array_equal(colors[10], colors[0])


GOLDEN = Path(__file__).parents[2] / "assets" / "viewer.png"  # PANSPLAT_WRITE_GOLDEN=1 writes it


@pytest.mark.parametrize("name", ["cpu", "gl"])
def test_each_display_and_mode_looks_as_in_the_golden_image(make_renderer, small_scene, pose, name):
    renderer, images = make_renderer(small_scene, name), {}
    for display in get_args(Display):
        settings = DrawSettings(display=display, display_max=6.0 if display == "depth" else 1.0)
        images[display] = render_image(renderer, pose, SIZE, settings)[0]
    for mode in get_args(Mode)[1:]:
        images[mode] = render_image(renderer, pose, SIZE, DrawSettings(mode=mode))[0]
    image = np.concatenate(list(images.values()), axis=1)
    if name == "cpu" and os.environ.get("PANSPLAT_WRITE_GOLDEN"):
        write_image(GOLDEN, image)
    with Image.open(GOLDEN) as file:
        expected = np.asarray(file.convert("RGB")) / 255
    left = 0
    for key, part in images.items():
        error = np.abs(part - expected[:, left : left + part.shape[1]])
        assert (error.max(axis=2) > 0.03).mean() < 0.02 and error.mean() < 4e-3, key
        left += part.shape[1]
    assert left == expected.shape[1]
