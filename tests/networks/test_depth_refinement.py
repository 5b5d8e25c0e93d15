import numpy as np
import pytest
import torch

from pansplat.geometry.equirect import pixel_directions
from pansplat.geometry.warp import relative_pose
from pansplat.networks.depth_network import DepthEstimate, DepthNetworkConfig
from pansplat.networks.depth_refinement import DepthRefinement, RefinementConfig

_MONO = DepthNetworkConfig(room_channels=24, attention_layers=1, attention_heads=3, decoder_channels=(16, 12, 8, 8))
_CONFIG = RefinementConfig(mono=_MONO, candidates=9, matching_channels=4, channels=(8, 12, 16))
_ROOM = torch.tensor(((-2.0, -1.2, -1.7), (1.8, 1.4, 2.3)))  # low and high corners, metres
_MIDDLE = 4  # index of the candidate at the present depth


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    network = DepthRefinement(_CONFIG)
    for head in (network.head, network.mono.head):
        torch.nn.init.normal_(head.weight, std=0.3)
    network.train()
    with torch.no_grad():
        for _ in range(3):
            estimate, observed = network.observe(torch.rand(4, 3, 64, 128))
            network.refine(observed, estimate, _poses(4), [(0, 1), (1, 0), (2, 3), (3, 2)])
    return network.eval()


def _poses(count, baseline=0.4):
    poses = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    poses[:, 0, 3] = baseline * torch.arange(count)
    return poses


def _room_depth(position, height=32):
    """Radial depth (h 2h) of the walls of a box from a position in it."""
    rays = pixel_directions(height, 2 * height, dtype=torch.float64)
    low, high = (_ROOM.double() - position).unbind()
    return torch.where(rays > 0, high / rays, low / rays).abs().amin(dim=-1)


@torch.no_grad()
def test_patches_match_at_the_true_depth(network):
    generator = torch.Generator().manual_seed(3)
    waves = 4 * torch.randn(24, 3, generator=generator, dtype=torch.float64)
    images, depths, poses = [], [], _poses(2, 1.2)
    for pose in poses:
        depth = _room_depth(pose[:3, 3], 64)
        points = depth[..., None] * pixel_directions(64, 128, dtype=torch.float64) + pose[:3, 3]
        images.append((0.5 + 0.1 * torch.sin(points @ waves.T).sum(dim=-1)).clamp(0, 1).expand(3, -1, -1))
        depths.append(_room_depth(pose[:3, 3]).log())
    _, observed = network.observe(torch.stack(images).float())
    log_depth = torch.stack(depths).float()
    estimate = DepthEstimate(log_depth, torch.zeros_like(log_depth))
    candidates = log_depth[:, None] + network.candidates[:, None, None]
    relative = relative_pose(poses[[0, 1]], poses[[1, 0]])
    patches, _ = network._compare(observed, estimate, candidates, (-candidates).exp(), relative, [0, 1], [1, 0])
    mean = patches.mean(dim=(0, 2, 3))
    assert mean.argmax() == _MIDDLE and mean[_MIDDLE] > mean[[0, 1, -2, -1]].max() + 0.1


@torch.no_grad()
def test_unit_of_the_poses_has_no_influence(network):
    estimate, observed = network.observe(torch.rand(2, 3, 64, 128))
    poses, scaled = _poses(2), _poses(2)
    scaled[:, :3, 3] *= 100
    far = DepthEstimate(estimate.log_depth + np.log(100), estimate.log_scale)
    first = network.refine(observed, estimate, poses, [(0, 1), (1, 0)])
    second = network.refine(observed, far, scaled, [(0, 1), (1, 0)])
    assert (first.log_depth - estimate.log_depth).abs().max() > 1e-2
    torch.testing.assert_close(first.log_depth, second.log_depth - np.log(100), atol=2e-3, rtol=1e-3)


@torch.no_grad()
def test_exchanged_views_have_exchanged_estimates(network):
    images, poses, swap = torch.rand(2, 3, 64, 128), _poses(2), [1, 0]
    estimate, observed = network.observe(images)
    first = network.refine(observed, estimate, poses, [(0, 1), (1, 0)])
    estimate, observed = network.observe(images[swap])
    second = network.refine(observed, estimate, poses[swap], [(0, 1), (1, 0)])
    torch.testing.assert_close(first.log_depth[swap], second.log_depth, atol=1e-5, rtol=1e-5)


@torch.no_grad()
def test_volumes_of_several_other_views_are_averaged(network):
    images, poses = torch.rand(2, 3, 64, 128), _poses(2)
    estimate, observed = network.observe(images)
    once = network.refine(observed, estimate, poses, [(0, 1), (1, 0)])
    images, poses = images[[0, 1, 1]], poses[[0, 1, 1]]
    estimate, observed = network.observe(images)
    twice = network.refine(observed, estimate, poses, [(0, 1), (0, 2), (1, 0), (2, 0)])
    torch.testing.assert_close(once.log_depth[0], twice.log_depth[0], atol=1e-5, rtol=1e-5)


def test_gradients_reach_the_encoder(network):
    estimate, observed = network.observe(torch.rand(2, 3, 64, 128))
    refined = network.refine(observed, estimate, _poses(2), [(0, 1), (1, 0)])
    refined.log_depth.sum().backward()
    assert network.mono.encoder.stem.weight.grad.abs().sum() > 0
    network.zero_grad()
