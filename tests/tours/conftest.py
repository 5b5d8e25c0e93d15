"""Tours of panoramas without images."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from pansplat.data.pairs import Panorama
from pansplat.tours import TourGraph


def _make_tour(places, edges, folder: Path = Path()) -> TourGraph:
    panoramas = []
    for index, (x, z) in enumerate(places):
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3], pose[2, 3] = x, z
        panoramas.append(Panorama(f"p{index}", folder / f"p{index}.png", pose))
    return TourGraph("tour", folder, tuple(panoramas), 0.45, 10.0, (), dict.fromkeys(edges, 0.3))


@pytest.fixture
def make_tour() -> Callable[..., TourGraph]:
    """A function from places (x, z) and edges to a tour."""
    return _make_tour


@pytest.fixture
def comb() -> TourGraph:
    """Four panoramas in a row, and one beside the second and the third each."""
    places = ((0, 0), (0, 1), (0, 2), (0, 3), (1, 1), (1, 2))
    return _make_tour(places, ((0, 1), (1, 2), (2, 3), (1, 4), (2, 5)))
