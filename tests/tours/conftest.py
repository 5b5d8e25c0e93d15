"""Tours of panoramas without images."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from pansplat.inputs.panorama_sets import Link, Panorama, PanoramaSet
from pansplat.tours.graph import TourGraph, find_tours


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


@pytest.fixture
def home(make_tour) -> TourGraph:
    """A tour of four worlds: p0 to p2 in a row, p4 and p5 in one with z up, and p3 and p6 alone.

    A link leads from p2 to p3 on the left, one back behind p3, and one from p3 to p6 ahead.
    """
    places, worlds = ((0, 0), (0, 1), (0, 2), (0, 0), (5, 5), (5, 6), (0, 0)), (1, 1, 1, 2, 3, 3, 4)
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = torch.tensor(((1.0, 0, 0), (0, 0, 1), (0, -1, 0)))
    links = {2: (Link("p3", -math.pi / 2, 0.4, "to the hall"),), 3: (Link("p2", math.pi, 0.3), Link("p6", 0.0))}
    panoramas = [
        dataclasses.replace(panorama, world=world, links=links.get(node, ()), cam2world=pose)
        for node, (panorama, world) in enumerate(zip(make_tour(places, ()).panoramas, worlds, strict=True))
        for pose in [turn @ panorama.cam2world if world == 3 else panorama.cam2world]
    ]
    siblings = tuple(panorama.image for panorama in panoramas)
    groups = ((0, 1), (1, 2), (3,), (4, 5), (6,))
    contexts = [tuple(panoramas[node] for node in group) for group in groups]
    (tour,) = find_tours([PanoramaSet("", Path("home"), context, (), 0.45, 10.0, siblings) for context in contexts])
    return tour
