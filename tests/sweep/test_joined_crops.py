import math

import numpy as np
import pytest
import torch
from onnx_files import FakeSession
from refusals import expect_error

from pansplat.geometry.equirect import pixel_directions
from pansplat.networks.depth_network import DepthEstimate
from pansplat.networks.relative_depth import RelativeDepthNetwork
from pansplat.sweep.joined_crops import crop_panorama, join_crops
from pansplat.system.threads import one_thread


@pytest.fixture(autouse=True)
def on_one_thread():
    with one_thread():
        yield


_LOW, _HIGH = np.array((-2.4, -1.3, -1.9)), np.array((2.1, 1.2, 2.6))  # of a room around the camera
_COLUMN = 0.8, 0.2, 1.1  # direction of a thin column, half of its width in radians, and its depth
_MEAN, _DEVIATION = np.array((0.485, 0.456, 0.406)), np.array((0.229, 0.224, 0.225))


def _inverse_depth(rays):
    """Inverse radial depth of unit rays (..., 3) in a room with a column in it."""
    walls = np.maximum(rays / _LOW, rays / _HIGH).max(axis=-1)
    longitude = np.arctan2(rays[..., 0], rays[..., 2])
    is_column = (np.abs(longitude - _COLUMN[0]) < _COLUMN[1]) & (np.abs(rays[..., 1]) < 0.8)
    return np.where(is_column, np.maximum(walls, 1 / _COLUMN[2]), walls)


def _colors(height):
    """A panorama (3, h, 2h) whose colours are the directions of its pixels."""
    return (pixel_directions(height, 2 * height).permute(2, 0, 1) + 1) / 2


def _see(normalised):
    """Directions (h, w, 3) that a normalised crop of `_colors` shows, of unit length, and its optical axis."""
    rays = (normalised[0].transpose(1, 2, 0) * _DEVIATION + _MEAN) * 2 - 1
    axis = rays.mean(axis=(0, 1))
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True), axis / np.linalg.norm(axis)


class IdealNetwork:
    """A session with the true inverse depth, of another scale and shift in each image, and relative noise."""

    def __init__(self, noise=0.0):
        self.noise, self.generator = noise, np.random.default_rng(0)

    def __call__(self, image):
        rays, axis = _see(image)
        inverse = _inverse_depth(rays) / (rays @ axis)
        inverse *= np.exp(self.noise * self.generator.normal(size=inverse.shape))
        scale, shift = 10 ** self.generator.uniform(-2, 2), self.generator.uniform(-0.5, 2)
        return [(scale * (inverse + shift)).astype(np.float32)[None]]


def _make_network(noise=0.0, size=140):
    session = FakeSession(IdealNetwork(noise), [("image", "tensor(float)", (1, 3, size, size))])
    return RelativeDepthNetwork(session, "ideal", "")


def _true_log_depth(height):
    return -np.log(_inverse_depth(pixel_directions(height, 2 * height, dtype=torch.float64).numpy()))


def _make_estimate(error=0.0, height=32):
    """The room without the column, with a smooth error; the scale is its deviation."""
    rays = pixel_directions(height, 2 * height, dtype=torch.float64)
    log_depth = -torch.from_numpy(np.maximum(rays.numpy() / _LOW, rays.numpy() / _HIGH).max(axis=-1)).log()
    wave = error * torch.sin(3 * torch.atan2(rays[..., 0], rays[..., 2]) + 4 * rays[..., 1])
    return DepthEstimate((log_depth + wave).float()[None], torch.full_like(log_depth, math.log(0.1)).float()[None])


def _join(network, estimate, height=128):
    return join_crops(network.estimate(crop_panorama(_colors(256), network.size)), estimate, height).numpy()


def test_crops_of_unknown_scale_and_shift_join_to_the_true_depth():
    """The estimate lacks the column, and is wrong by up to 15 %; its error in the mean remains."""
    joined, truth = _join(_make_network(), _make_estimate(0.15)), _true_log_depth(128)
    error = np.abs(joined - truth - np.median(joined - truth))
    assert abs(np.median(joined - truth)) < 0.05
    assert np.median(error) < 0.01 and np.quantile(error, 0.95) < 0.03


def test_joined_depth_has_no_seams_and_is_right_at_the_poles():
    joined, truth = _join(_make_network(), _make_estimate()), _true_log_depth(128)
    assert np.abs(joined - truth)[[0, 1, 2, -3, -2, -1]].max() < 0.02
    away = np.abs(np.roll(joined, -1, axis=1) - joined - np.roll(truth, -1, axis=1) + truth)
    assert np.quantile(away, 0.95) < 0.003  # the rest are pixels at the edges of the column


def test_crop_of_one_distance_keeps_a_finite_depth():
    network, estimate = _make_network(), _make_estimate()
    crops = network.estimate(crop_panorama(_colors(256), network.size))
    crops[-2] = torch.full_like(crops[-2], 3.0)
    joined, truth = join_crops(crops, estimate, 64).numpy(), _true_log_depth(64)
    assert np.isfinite(joined).all() and np.median(np.abs(joined - truth)) < 0.02


def test_network_of_depth_in_place_of_inverse_depth_is_refused():
    network = _make_network()
    crops = [-crop for crop in network.estimate(crop_panorama(_colors(256), network.size))]
    expect_error("grow with the distance", lambda: join_crops(crops, _make_estimate(0.15), 64))
