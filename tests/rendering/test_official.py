"""`OFFICIAL` against a dense version of the official rasteriser, with and without its two cuts."""

import math

import pytest
import torch

from pansplat.gaussians.harmonics import evaluate_harmonics
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.cubemap import face_poses
from pansplat.rendering import rasterize
from pansplat.rendering.image_planes import stitch_faces
from pansplat.rendering.official import OFFICIAL


def _official_face(
    scene: Gaussians, pose: torch.Tensor, num: int, near: float, *, radius_cut: bool, stop: bool
) -> torch.Tensor:
    """RGB of a 90-degree face as docs/official.md, 10.3 describes, every pixel against every Gaussian; float64.

    Args:
        radius_cut: rasterise only in tiles of 16 pixels that the square of ceil(3 sigma) touches.
        stop: end a ray before the transmittance falls below 1e-4.
    """
    means, centre = scene.means / near, pose[:3, 3] / near
    view = (means - centre) @ pose[:3, :3]
    x, y, z = view.unbind(1)
    focal = 0.5 * num
    t = torch.stack(((x / z).clamp(-1.3, 1.3), (y / z).clamp(-1.3, 1.3)), dim=1)
    jacobian = torch.zeros(len(scene), 2, 3, dtype=torch.float64)
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = focal / z
    jacobian[:, :, 2] = -focal * t / z[:, None]
    world = scene.covariances / near**2
    flat = jacobian @ pose[:3, :3].T @ world @ pose[:3, :3] @ jacobian.transpose(1, 2)
    flat = flat + 0.3 * torch.eye(2, dtype=torch.float64)
    conic = torch.linalg.inv(flat)
    middle = ((torch.stack((x / z, y / z), dim=1) + 1) * num - 1) / 2
    colour = evaluate_harmonics(scene.harmonics, torch.nn.functional.normalize(means - centre, dim=1))
    across = torch.arange(num, dtype=torch.float64)
    pixels = torch.stack((across.repeat(num), across.repeat_interleave(num)), dim=1)
    mean_variance = 0.5 * (flat[:, 0, 0] + flat[:, 1, 1])
    largest = mean_variance + torch.sqrt((mean_variance.square() - torch.linalg.det(flat)).clamp_min(0.1))
    radius = torch.ceil(3 * torch.sqrt(largest))[:, None]
    tiles = torch.floor((middle - radius) / 16), torch.floor((middle + radius + 15) / 16)
    pixel_tiles = torch.floor(pixels / 16)
    rgb, transmittance = torch.zeros(num * num, 3, dtype=torch.float64), torch.ones(num * num, dtype=torch.float64)
    live = torch.ones_like(transmittance, dtype=torch.bool)
    for i in torch.argsort(z, stable=True).tolist():
        if z[i] <= 0.2:
            continue
        delta = middle[i] - pixels
        alpha = scene.opacities[i] * torch.exp(-0.5 * ((delta @ conic[i]) * delta).sum(dim=1))
        alpha = alpha.clamp_max(0.99)
        visible = alpha >= 1 / 255
        if radius_cut:
            visible &= ((pixel_tiles >= tiles[0][i]) & (pixel_tiles < tiles[1][i])).all(dim=1)
        if stop:
            live &= ~visible | (transmittance * (1 - alpha) >= 1e-4)
        alpha = torch.where(visible & live, alpha, 0)
        rgb += (alpha * transmittance)[:, None] * colour[i]
        transmittance = transmittance * (1 - alpha)
    return rgb.T.reshape(3, num, num)


def _official(scene: Gaussians, pose: torch.Tensor, height: int, near: float, **cuts: bool) -> torch.Tensor:
    faces = [_official_face(scene, p, height // 2, near, **cuts) for p in face_poses(pose)]
    return stitch_faces(torch.stack(faces), (height, 2 * height), stitching="official")


def _psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    return -10 * math.log10(float((a - b).square().mean()))


@pytest.fixture
def outside(make_scene):
    """Gaussians so far from the camera that `near` removes none of them."""

    def make(count: int, scale: float) -> Gaussians:
        scene = make_scene(count, scale=scale, seed=11, degree=3)
        return scene.select(scene.means.norm(dim=1) > 0.9)

    return make


@pytest.mark.parametrize("scale", [0.02, 0.3])
def test_official_options_equal_the_official_rasteriser_without_its_two_cuts(scale, outside, pose):
    scene = outside(150, scale)
    expected = _official(scene, pose, 32, 0.45, radius_cut=False, stop=False)
    got = rasterize(scene, pose, size=(32, 64), face_size=16, near=0.45, layout="cubemap", options=OFFICIAL)
    assert float(expected.mean()) > 0.05
    assert (got.color - expected).abs().max() < 1e-10


@pytest.mark.parametrize(
    ("cuts", "decibels"),
    [({"radius_cut": True, "stop": False}, 80), ({"radius_cut": False, "stop": True}, 95)],
    ids=["radius", "transmittance"],
)
def test_the_official_rasterisers_two_cuts_change_little(cuts, decibels, outside, pose):
    scene = outside(150, 0.3)
    got = rasterize(scene, pose, size=(64, 128), face_size=32, near=0.45, layout="cubemap", options=OFFICIAL).color
    official = _official(scene, pose, 64, 0.45, **cuts)
    assert decibels < _psnr(official, got) < 200  # below 200: the cut has an effect


def test_only_the_official_rasteriser_rasterises_gaussians_nearer_than_near(make_scene):
    eye = torch.eye(4, dtype=torch.float64)
    near_one = make_scene(1, scale=0.02)
    for mean, is_ours, is_official in (((0.0, 0, 0.3), 0, 1), ((0.0, 0, 0.08), 0, 0), ((0, 0, 0.5), 1, 1)):
        near_one.means.copy_(torch.tensor([mean]))
        got = rasterize(near_one, eye, size=(32, 64), face_size=16, near=0.45, layout="cubemap", options=OFFICIAL).color
        expected = _official(near_one, eye, 32, 0.45, radius_cut=False, stop=False)
        assert (float(got.max()) > 0, float(expected.max()) > 0) == (is_ours, is_official)
