"""Overlap of images."""

import dataclasses

import numpy as np
import torch

from pansplat.geometry.equirect import pixel_directions
from pansplat.images.image_files import write_image
from pansplat.system.progress import show_progress
from pansplat.tours import overlap
from pansplat.tours.overlap import connect


def draw_room(place, low, high, seed) -> torch.Tensor:
    """A panorama in a box-shaped room with a random pattern on its surfaces."""
    directions, here = pixel_directions(96, 192).double().numpy(), np.array(place)
    far = np.where(directions > 0, high - here, low - here) / (directions + 1e-9)
    points = here + far.min(-1, keepdims=True) * directions
    cells = np.floor(points / 0.4 + 1e-6).astype(int)
    values = np.random.default_rng(seed).random((64, 64, 64, 3))
    return torch.from_numpy(values[tuple((cells + 32).transpose(2, 0, 1))]).float()


def test_panoramas_of_one_room_overlap_and_those_of_two_rooms_do_not(tmp_path, make_tour):
    places = ((0.0, 0.0), (0.0, 1.0), (0.7, 0.4), (2.7, 0.0))
    tour = make_tour(places, (), tmp_path)
    for index, (x, z) in enumerate(places):
        room = ((-1.5, -1.3, -2.0), (1.5, 1.2, 2.0)) if index < 3 else ((1.6, -1.3, -2.0), (4.0, 1.2, 2.0))
        image = draw_room((x, 0.0, z), *map(np.array, room), seed=index // 3)
        write_image(tour.panoramas[index].image, image.numpy())
    tasks = []
    given = dataclasses.replace(tour, overlaps={(0, 3): 0.0, (2, 2): 1.0})
    with show_progress(lambda task, done: tasks.append(done)):
        connected = connect(given)
    overlaps = connected.overlaps
    assert set(overlaps) == {(0, 1), (0, 2), (1, 2), (3, 3)}, "self-edges where there is no other"
    assert min(overlaps[0, 1], overlaps[0, 2], overlaps[1, 2]) > 0.25
    assert connected.walls == ((0, 3),) and connected.is_placed(3), "a given edge without anything in common is a wall"
    assert tasks == sorted(tasks) and tasks[-1] < 1
    other_world = dataclasses.replace(tour.panoramas[2], world=1)
    parts = dataclasses.replace(given, panoramas=(*tour.panoramas[:2], other_world, tour.panoramas[3]))
    assert set(connect(parts).overlaps) == {(0, 1), (3, 3), (2, 2)}, "only panoramas of one world are compared"


def test_overlaps_are_measured_again_only_if_an_image_or_a_pose_has_changed(tmp_path, make_tour, monkeypatch):
    tour = make_tour(((0.0, 0.0), (0.0, 1.0)), ((0, 1),), tmp_path)

    def draw(node: int, seed: int) -> None:
        x, z = ((0.0, 0.0), (0.0, 1.0))[node]
        image = draw_room((x, 0.0, z), np.array((-1.5, -1.3, -2.0)), np.array((1.5, 1.2, 2.0)), seed)
        write_image(tour.panoramas[node].image, image.numpy())

    for node in (0, 1):
        draw(node, seed=0)
    measured = []
    measure = overlap._measure_overlaps
    monkeypatch.setattr(overlap, "_measure_overlaps", lambda *rest: measured.append(1) or measure(*rest))
    first = connect(tour)
    assert connect(tour).overlaps == first.overlaps and len(measured) == 1
    draw(1, seed=1)
    assert connect(tour).overlaps != first.overlaps and len(measured) == 2, "the image has changed"
    pose = tour.cam2world[1].clone()
    pose[0, 3] += 0.2
    moved = dataclasses.replace(tour.panoramas[1], cam2world=pose)
    connect(dataclasses.replace(tour, panoramas=(tour.panoramas[0], moved)))
    assert len(measured) == 3, "a pose has changed"
