"""ALIKED: deformable convolution, keypoints, features of pixels."""

import pytest
import torch
from torch.nn import functional

from pansplat.networks.aliked import Aliked, _pixel_features, find_keypoints


@pytest.fixture(scope="module")
def network() -> Aliked:
    torch.manual_seed(0)
    network = Aliked().requires_grad_(False).eval()
    network.aggregate.normal_(0, 0.1)
    return network


def test_features_of_pixels_are_those_of_the_full_map(network: Aliked) -> None:
    levels = network.extract(torch.rand(3, 64, 96))
    maps = [functional.interpolate(level, (64, 96), mode="bilinear", align_corners=True) for level in levels]
    full = functional.normalize(torch.cat(maps, dim=1), dim=1)[0]
    y, x = torch.meshgrid(torch.arange(64), torch.arange(96), indexing="ij")
    found = _pixel_features(levels, torch.stack((x, y), dim=-1).flatten(0, 1))
    torch.testing.assert_close(found.T.unflatten(1, (64, 96)), full, rtol=0, atol=1e-5)
    assert not _pixel_features(levels, torch.tensor(((-1, 0), (0, 64), (96, 3)))).any()


def test_keypoints_are_the_allowed_peaks_below_a_pixel() -> None:
    x, y = torch.meshgrid(torch.arange(40.0), torch.arange(30.0), indexing="xy")

    def peak(at_x: float, at_y: float, height: float) -> torch.Tensor:
        return height * torch.exp(-((x - at_x) ** 2 + (y - at_y) ** 2) / 4)

    scores = peak(10.0, 8.0, 0.9) + peak(30.25, 20.0, 0.8) + peak(10.0, 22.0, 0.7)
    allowed = torch.ones(30, 40, dtype=torch.bool)
    allowed[:, :15] = y[:, :15] < 15
    points = find_keypoints(scores, allowed, 2)
    torch.testing.assert_close(points, torch.tensor(((10.0, 8.0), (30.25, 20.0))), rtol=0, atol=0.15)
    assert len(find_keypoints(torch.zeros(30, 40), allowed, 5)) == 0


def test_equal_peaks_are_taken_in_the_order_of_their_places() -> None:
    scores = torch.zeros(100, 100)
    scores[5:95:6, 5:95:6] = 0.5
    points = find_keypoints(scores, torch.ones(100, 100, dtype=torch.bool), 40)
    grid = torch.cartesian_prod(torch.arange(5.0, 95, 6), torch.arange(5.0, 95, 6)).flip(1)
    torch.testing.assert_close(points, grid[:40])
