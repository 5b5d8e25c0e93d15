"""Omni-directional stereo: each column of a panorama has its own eye, and its rays touch the viewing circle."""

import dataclasses
import math

import pytest
import torch
from dense_renderer import POSE, draw_dense, make_scene, make_spheres

from pansplat.geometry.pose import rotations_from_quats
from pansplat.rendering import rasterize
from pansplat.rendering.cpu import columns
from pansplat.rendering.image_planes import ImagePlane

ORIGIN = torch.eye(4, dtype=torch.float64)


def make_images(scene, pose, size, **options):
    rendering = rasterize(scene, pose, size=size, **options)
    return torch.cat((rendering.color, rendering.alpha[None], (rendering.depth * rendering.alpha)[None]))


def test_the_rays_of_a_column_touch_the_viewing_circle():
    plane = ImagePlane((4, 8), ORIGIN[:3, :3], 0.0, 0.3)
    eyes, rays = plane.column_eyes(), plane.directions()
    horizontal = rays * torch.tensor((1.0, 0, 1))
    torch.testing.assert_close(eyes.norm(dim=1), torch.full((8,), 0.3, dtype=torch.float64))
    assert (horizontal * eyes).sum(dim=-1).abs().max() < 1e-15
    # The eye is to the right of its rays: right x down = forward in OpenCV axes.
    down = torch.tensor((0.0, 1, 0), dtype=torch.float64).expand(8, 3)
    forward = torch.linalg.cross(eyes, down)
    assert ((forward * horizontal[1]).sum(dim=-1) > 0).all()


@pytest.mark.parametrize("eye_offset", [0.25, -0.25])
def test_each_column_is_that_of_a_panorama_from_its_own_eye(eye_offset):
    scene, size = make_scene(7, scale=0.4), (9, 18)
    got = make_images(scene, POSE, size, eye_offset=eye_offset)
    for column, eye in enumerate(ImagePlane(size, ORIGIN[:3, :3], 0.0, eye_offset).column_eyes()):
        moved = POSE.clone()
        moved[:3, 3] += POSE[:3, :3] @ eye
        expected = draw_dense(scene, moved, size)[:-1, :, column]
        assert (got[:, :, column] - expected).abs().max() < 1e-10


@pytest.mark.parametrize("pairs", [columns._MAX_PAIRS, 1])
def test_numba_equals_the_reference(monkeypatch, pairs):
    # The Gaussians surround the camera: some are inside the viewing circle, above it, or around it.
    monkeypatch.setattr(columns, "_MAX_PAIRS", pairs)
    scene, pose = make_scene(60, scale=0.08, extent=0.6), ORIGIN.clone()
    pose[:3, :3] = rotations_from_quats(torch.tensor((0.9, 0.2, -0.3, 0.4), dtype=torch.float64))
    scene.means[:4] = torch.tensor(((0, -1.0, 0), (0, 0.8, 0), (0.1, 0, 0), (0, 0, 0.12)), dtype=torch.float64)
    size, options = (35, 70), {"eye_offset": -0.2, "near": 0.02, "background": (0.1, 0.2, 0.3)}
    expected = make_images(scene, pose, size, **options)
    got = make_images(scene.to(dtype=torch.float32), pose, size, backend="numba", **options)
    assert (got - expected).abs().max() < 2e-5


def test_gradients_are_those_of_the_reference():
    scene = make_spheres([(0.5, 0.1, 1.0), (-0.8, -0.3, 0.7)])

    def total(means, **options):
        moved = dataclasses.replace(scene, means=means).to(dtype=means.dtype)
        return rasterize(moved, ORIGIN, size=(8, 16), eye_offset=0.1, **options).alpha.sum()

    means = scene.means.float().requires_grad_()
    total(means, backend="numba").backward()
    step = torch.tensor(((1e-4, 0, 0), (0, 0, 0)), dtype=torch.float64)
    expected = (total(scene.means + step) - total(scene.means - step)) / 2e-4
    assert means.grad is not None
    assert float(means.grad[0, 0]) == pytest.approx(float(expected), rel=0.01)


def test_unusable_gaussians_are_left_out():
    scene = make_scene(30).to(dtype=torch.float32)
    scene.means[5] = torch.tensor((-0.06, 0.0, 0.0))  # nearer than 0.05 m to the eye of the last column only
    broken = dataclasses.replace(scene, means=scene.means.clone(), harmonics=scene.harmonics.clone())
    broken.means[3, 0], broken.harmonics[7, 1, 2] = math.nan, math.inf
    kept = torch.tensor([i not in (3, 7) for i in range(30)])
    for backend in ("numba", "torch"):
        rendering = rasterize(broken, ORIGIN, size=(12, 24), eye_offset=0.1, backend=backend)
        expected = rasterize(scene.select(kept), ORIGIN, size=(12, 24), eye_offset=0.1, backend=backend)
        assert torch.equal(rendering.color, expected.color)
    empty = rasterize(scene.select(kept & False), ORIGIN, size=(12, 24), eye_offset=0.1)
    assert not empty.alpha.any()
