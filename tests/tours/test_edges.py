"""Edges whose flights would be poor, and walls between panoramas."""

import dataclasses

import numpy as np
import pytest
import torch

from pansplat.bench.scenes import full_lattice_room, make_room_cameras
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.tours.edges import find_poor_edges, find_walls, measure_doubled
from pansplat.tours.surfaces import Surfaces, find_surfaces


@pytest.fixture(scope="module")
def room() -> Scene:
    """Two exact views of the room of boxes, a metre apart."""
    return Scene(full_lattice_room(128), make_room_cameras(2), 0.1, 10.0)


def bend(room: Scene, factor: float) -> Scene:
    """The room whose second view shows all surfaces at other distances."""
    gaussians, center = room.gaussians, room.cam2world[1, :3, 3].float()
    moved = center + factor * (gaussians.means - center)
    means = moved.where((gaussians.views == 1)[:, None], gaussians.means)
    return dataclasses.replace(room, gaussians=dataclasses.replace(gaussians, means=means))


def name(scene: Scene, *nodes: int) -> dict[int, Surfaces]:
    return dict(zip(nodes, find_surfaces(scene, np.eye(3)), strict=True))


def measure(scene: Scene) -> float:
    return measure_doubled(*find_surfaces(scene, np.eye(3)))


def test_surfaces_of_one_room_are_seen_once_and_bent_ones_twice(room: Scene) -> None:
    agreeing = measure(room)
    assert agreeing < 0.05
    shares = [measure(bend(room, factor)) for factor in (1.05, 1.3)]
    assert agreeing <= shares[0] < 0.5 * shares[1]
    first, second = find_surfaces(room, np.eye(3))
    larger = [dataclasses.replace(own, center=3 * own.center, places=3 * own.places) for own in (first, second)]
    assert measure_doubled(*larger) == pytest.approx(agreeing, abs=0.02), "any unit"
    assert measure_doubled(second, first) == pytest.approx(agreeing, abs=0.02), "either way"
    bent = find_surfaces(bend(room, 1.3), np.eye(3))
    plain = [dataclasses.replace(own, base=torch.zeros_like(own.base)) for own in bent]
    assert measure_doubled(*plain) == 0, "what has one colour is not seen twice"
    none = Surfaces(first.center, first.places[:0], first.is_opaque[:0], first.base[:0])
    assert measure_doubled(none, second) == 1


def test_only_the_directions_of_a_flight_count(room: Scene) -> None:
    first, second = find_surfaces(room, np.eye(3))
    places = second.places
    aside = np.abs(places[:, 0] + 0.5) < np.abs(places[:, 2])  # beyond 45 degrees of the way, from its middle
    for is_moved, low, high in ((aside, 0, 0.1), (~aside, 0.2, 1)):
        moved = dataclasses.replace(second, places=np.where(is_moved[:, None], 3 * places, places))
        assert low <= measure_doubled(first, moved) < high


def test_an_edge_is_poor_if_its_surfaces_disagree(room: Scene) -> None:
    edges = [(4, 7), (4, 4), (4, 9)]
    agreeing, bent = (name(scene, 4, 7) for scene in (room, bend(room, 0.35)))
    assert find_poor_edges(agreeing, edges) == () and find_poor_edges(bent, edges) == ((4, 7),)


@pytest.mark.parametrize(
    ("sizes", "is_wall"), [((0.3, 0.3), True), ((0.3, 2.0), False), ((2.0, 0.3), False), ((2.0, 2.0), False)]
)
def test_a_wall_is_what_both_cameras_see_in_front_of_the_other(sizes, is_wall):
    """Each camera is in a room of boxes, which ends before the other camera or contains it."""
    poses, parts = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1), []
    room, center = full_lattice_room(64, views=1), make_room_cameras(1)[0, :3, 3].float()
    for view, size in enumerate(sizes):
        poses[view, 0, 3] = 2.0 * view
        own = room.scaled(size, center)
        means = own.means - center + poses[view, :3, 3].float()
        parts.append(dataclasses.replace(own, means=means, views=torch.full_like(own.views, view)))
    scene = Scene(Gaussians.cat(parts), poses, 0.1, 10.0)
    edges = ((3, 5), (5, 7), (3, 3))
    assert find_walls(name(scene, 3, 5), edges) == ([(3, 5)] if is_wall else [])
