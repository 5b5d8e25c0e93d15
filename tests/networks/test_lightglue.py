"""LightGlue: properties that hold for any weights."""

import pytest
import torch
from torch.nn import functional

from pansplat.networks.lightglue import LightGlue


@pytest.fixture(scope="module")
def network() -> LightGlue:
    torch.manual_seed(0)
    return LightGlue().requires_grad_(False).eval()


def make_keypoints(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    points = 2 * torch.rand(count, 2, generator=generator) - 1
    return points, functional.normalize(torch.randn(count, 128, generator=generator), dim=1)


def test_exchanging_the_images_exchanges_the_matches(network: LightGlue) -> None:
    first, second = make_keypoints(30, 1), make_keypoints(40, 2)
    found = (network(*pair, adaptive=False) for pair in ((first, second), (second, first)))
    there, back = (dict(zip(map(tuple, pairs.tolist()), scores.tolist(), strict=True)) for pairs, scores in found)
    assert there and there.keys() == {(a, b) for b, a in back}
    assert all(back[b, a] == pytest.approx(score, rel=1e-3) for (a, b), score in there.items())


def test_dropped_keypoints_leave_the_others_numbers(network: LightGlue) -> None:
    with torch.no_grad():
        for layer in network.confidence:
            layer.bias += 9  # all are sure
        for layer in network.matchable:
            layer.bias -= 9  # to have no partner
    first, second = make_keypoints(30, 1), make_keypoints(40, 2)
    indices, scores = network(first, second)
    assert (scores < 1e-3).all() and (indices < torch.tensor((30, 40))).all()
