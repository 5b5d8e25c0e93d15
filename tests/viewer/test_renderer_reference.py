"""The GL pictures are the torch reference's (docs/rendering.md)."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from pansplat.geometry.cubemap import face_poses
from pansplat.geometry.equirect import pixel_directions
from pansplat.rendering import rasterize
from pansplat_viewer.renderer import DrawSettings

pytestmark = pytest.mark.gl

BACKGROUND = (0.2, 0.5, 0.9)
TIERS = pytest.mark.parametrize("tier", ["gl33", "gl43"])
KERNELS = pytest.mark.parametrize("kernel", ["ray", "ewa"])


@TIERS
@KERNELS
@pytest.mark.parametrize("lowpass", ["angular", "3dgs"])
@pytest.mark.parametrize("order", ["radial", "z"])
def test_pinhole_picture_is_the_reference(
    renderer, random_scene, pose, reference, assert_same, tier, kernel, lowpass, order
):
    scene = random_scene()
    settings = DrawSettings(kernel=kernel, lowpass=lowpass, order=order, background=BACKGROUND, vertical_fov_degrees=65)
    drawn = renderer(scene, tier)
    drawn.render(pose, (97, 64), settings)
    assert_same(drawn, reference(scene, pose, (97, 64), settings))


@TIERS
@KERNELS
def test_each_of_six_faces_is_the_reference(renderer, random_scene, pose, reference, assert_same, tier, kernel):
    scene = random_scene(seed=1)
    settings = DrawSettings(kernel=kernel, background=BACKGROUND)
    drawn = renderer(scene, tier)
    for face in face_poses(torch.from_numpy(pose)).numpy():
        drawn.render(face, (48, 48), settings)
        assert_same(drawn, reference(scene, face, (48, 48), settings))


@TIERS
@KERNELS
@pytest.mark.parametrize("order", ["radial", "z"])
@pytest.mark.parametrize("face_size", [None, 21])
def test_stitched_panorama_is_the_reference(
    renderer, random_scene, pose, reference, assert_same, tier, kernel, order, face_size
):
    scene = random_scene(seed=2)
    settings = DrawSettings(kernel=kernel, order=order, background=BACKGROUND, layout="equirect", face_size=face_size)
    drawn = renderer(scene, tier)
    drawn.render(pose, (96, 48), settings)
    assert_same(drawn, reference(scene, pose, (96, 48), settings))


@TIERS
@KERNELS
def test_camera_among_large_gaussians_sees_the_reference(
    renderer, random_scene, pose, reference, assert_same, tier, kernel
):
    scene = random_scene(150, size=0.5, seed=3)
    for order in ("radial", "z"):
        settings = DrawSettings(kernel=kernel, order=order, background=BACKGROUND, vertical_fov_degrees=110)
        drawn = renderer(scene, tier)
        drawn.render(pose, (64, 48), settings)
        assert_same(drawn, reference(scene, pose, (64, 48), settings))


@TIERS
@KERNELS
def test_subpixel_needle_and_disc_gaussians_are_the_reference(
    renderer, random_scene, pose, reference, assert_same, tier, kernel
):
    scene = random_scene(400, seed=4)
    scales = scene.gaussians.scales.clone()
    scales[:100] *= 0.01
    scales[100:200, 0] *= 30
    scales[200:300, 1] = 0
    scene = replace(scene, gaussians=replace(scene.gaussians, scales=scales))
    settings = DrawSettings(kernel=kernel, background=BACKGROUND)
    drawn = renderer(scene, tier)
    drawn.render(pose, (80, 60), settings)
    assert_same(drawn, reference(scene, pose, (80, 60), settings))


@pytest.mark.parametrize("degree", [0, 2, 4])
def test_colours_of_any_degree_follow_the_position(renderer, random_scene, pose, reference, assert_same, degree):
    scene = random_scene(degree=degree, seed=5)
    drawn = renderer(scene)
    for shift in (0.0, 0.5):
        pose[0, 3] += shift
        drawn.render(pose, (64, 48), DrawSettings())
        assert_same(drawn, reference(scene, pose, (64, 48), DrawSettings()))


def test_ties_are_drawn_in_the_order_of_indices(renderer, random_scene, pose, reference, assert_same):
    scene = random_scene(60, degree=0, size=0.15, seed=6)
    gaussians = scene.gaussians
    means = gaussians.means[torch.arange(60) // 6 * 6]  # six of different colour at each place
    scene = replace(scene, gaussians=replace(gaussians, means=means))
    drawn = renderer(scene)
    for order in ("radial", "z"):
        settings = DrawSettings(order=order)
        drawn.render(pose, (64, 48), settings)
        assert_same(drawn, reference(scene, pose, (64, 48), settings))


@pytest.mark.parametrize("unit", [1e-3, 1e4])
def test_picture_is_free_of_the_unit(renderer, random_scene, pose, unit):
    scene = random_scene(seed=7)
    drawn = renderer(scene)
    drawn.render(pose, (64, 48), DrawSettings())
    expected = drawn.read_color()
    gaussians = replace(scene.gaussians, means=scene.gaussians.means * unit, scales=scene.gaussians.scales * unit)
    scene.cam2world[:, :3, 3] *= unit
    drawn.upload(replace(scene, gaussians=gaussians))
    pose[:3, 3] *= unit
    drawn.render(pose, (64, 48), DrawSettings(near=0.05 * unit))
    assert np.abs(drawn.read_color() - expected).max() <= 5e-3
    assert np.abs(drawn.read_color() - expected).mean() <= 1e-5


def test_scene_far_from_the_origin_looks_the_same(renderer, random_scene, pose):
    scene = random_scene(seed=8)
    drawn = renderer(scene)
    drawn.render(pose, (64, 48), DrawSettings())
    expected = drawn.read_color()
    offset = torch.tensor((4e5, -2e5, 1e5), dtype=torch.float64)
    gaussians = replace(scene.gaussians.to(dtype=torch.float64), means=scene.gaussians.means.double() + offset)
    scene.cam2world[:, :3, 3] += offset
    drawn.upload(replace(scene, gaussians=gaussians))
    pose[:3, 3] += offset.numpy()
    drawn.render(pose, (64, 48), DrawSettings())
    assert np.abs(drawn.read_color() - expected).mean() <= 1e-5


@pytest.mark.parametrize("near", [1.5, 2.5])
def test_near_leaves_out_what_the_reference_leaves_out(renderer, random_scene, pose, reference, assert_same, near):
    scene = random_scene(seed=9)
    settings = DrawSettings(near=near)
    drawn = renderer(scene)
    drawn.render(pose, (64, 48), settings)
    assert_same(drawn, reference(scene, pose, (64, 48), settings))


def test_opacities_beyond_one_and_below_the_cut_are_the_reference(renderer, random_scene, pose, reference, assert_same):
    scene = random_scene(seed=10)
    opacities = scene.gaussians.opacities * 4 - 1
    opacities[::7] = 0.99 / 255
    scene = replace(scene, gaussians=replace(scene.gaussians, opacities=opacities))
    drawn = renderer(scene)
    drawn.render(pose, (64, 48), DrawSettings())
    assert_same(drawn, reference(scene, pose, (64, 48), DrawSettings()))


@pytest.mark.parametrize("size", [(1, 1), (2, 1), (31, 7), (7, 31)])
def test_odd_sizes_are_the_reference(renderer, random_scene, pose, reference, assert_same, size):
    scene = random_scene(seed=11)
    drawn = renderer(scene)
    drawn.render(pose, size, DrawSettings())
    assert_same(drawn, reference(scene, pose, size, DrawSettings()))


def test_panorama_has_no_more_error_at_seams_than_inside_faces(renderer, random_scene, pose):
    """Against direct rays, which know no faces: what stitching adds must not gather where faces meet."""
    scene = random_scene(200, degree=0, size=0.12, seed=12)
    height, width = 64, 128
    drawn = renderer(scene)
    drawn.render(pose, (width, height), DrawSettings(layout="equirect", face_size=64))
    direct = rasterize(scene.gaussians, torch.from_numpy(pose), size=(height, width), layout="equirect")
    error = np.abs(drawn.read_color()[..., :3] - direct.color.permute(1, 2, 0).numpy()).mean(axis=-1)
    largest = np.sort(np.abs(pixel_directions(height, width).numpy()), axis=-1)
    seam = largest[..., 2] - largest[..., 1] < 3 * math.pi / height
    assert error[seam].mean() <= 1.5 * error[~seam].mean() + 1e-4
