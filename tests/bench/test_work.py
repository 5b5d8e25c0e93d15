"""The counted work covers what is drawn, and little more."""

from dataclasses import replace

import torch

from pansplat.bench.scenes import full_lattice_room
from pansplat.bench.work import panorama_work
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering import rasterize
from pansplat.rendering.rasterize import RasterOptions

OPTIONS = RasterOptions("ray", "radial", "angular", 0.05, False)
POSE = torch.eye(4, dtype=torch.float64)


def one(gaussians: Gaussians, index: int) -> Gaussians:
    return gaussians.select(torch.tensor([index]))


def test_pairs_are_the_pixels_a_gaussian_shows_on_and_their_box():
    room = full_lattice_room(16, views=1)
    for index in range(0, len(room), 37):
        alpha = rasterize(one(room, index), POSE, size=(16, 32), backend="torch").alpha
        shown = alpha > 0
        pairs = panorama_work(one(room, index), POSE, 16, OPTIONS).pairs
        rows, columns = int(shown.any(dim=1).sum()), int(shown.any(dim=0).sum())
        assert int(shown.sum()) <= pairs
        assert pairs <= (rows + 1) * (columns + 1) or rows * columns == 0 or columns > 16


def test_work_adds_up_over_gaussians():
    room = full_lattice_room(8)
    whole = panorama_work(room, POSE, 16, OPTIONS)
    assert whole.pairs == sum(panorama_work(one(room, i), POSE, 16, OPTIONS).pairs for i in range(len(room)))


def test_traffic_is_the_scene_its_records_and_the_picture():
    room = full_lattice_room(8, degree=2)
    far = room.select(torch.tensor([0]))  # straight down: one tile, since the picture has only that
    scene, record, entry, picture = 4 * (11 + 27), 80, 88, 4 * 5 * 16 * 32
    assert panorama_work(far, POSE, 16, OPTIONS).bytes == scene + record + entry + picture


def test_gaussians_nearer_than_near_ask_for_nothing():
    room = full_lattice_room(8)
    options = RasterOptions("ray", "radial", "angular", 100.0, False)
    assert panorama_work(room, POSE, 16, options).pairs == 0


def test_a_gaussian_all_around_asks_for_every_pixel_once():
    room = full_lattice_room(8)
    around = one(room, 0)
    around = replace(around, scales=torch.full((1, 3), 50.0), opacities=torch.ones(1))
    assert panorama_work(around, POSE, 16, OPTIONS).pairs == 16 * 32
    below = replace(around, means=torch.tensor([[0.0, 1.2, 0.0]]), scales=torch.full((1, 3), 0.15))
    rows = int((rasterize(below, POSE, size=(16, 32), backend="torch").alpha > 0).any(dim=1).sum())
    assert 32 * rows <= panorama_work(below, POSE, 16, OPTIONS).pairs <= 32 * (rows + 1)
