"""The kernels of the peaks do the counted arithmetic, and the counted work covers the rendered pixels."""

from dataclasses import replace

import numpy as np
import torch

from pansplat.bench import roofline
from pansplat.bench.roofline import count_panorama_work, describe_machine
from pansplat.bench.scenes import full_lattice_room
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering import rasterize
from pansplat.rendering.rasterize import RasterOptions

OPTIONS = RasterOptions("ray", "radial", "angular", 0.05, False)
POSE = torch.eye(4, dtype=torch.float64)


def test_chains_compute_every_multiply_add():
    # Twelve chains of v = v / 2 + 1 from v = 0 .. 11, the same in each lane.
    values = np.arange(roofline._CHAINS, dtype=np.float64)
    for _ in range(5):
        values = values / 2 + 1
    assert roofline._multiply_add_chains(np.float32(0.5), 5) == np.float32(roofline._vector_lanes() * values.sum())


def test_chains_use_no_memory():
    roofline._multiply_add_chains(np.float32(0.5), 1)
    (code,) = roofline._multiply_add_chains.inspect_asm().values()
    lines = [line for line in code.splitlines() if "fmadd" in line or "fmla" in line]
    assert len(lines) >= roofline._CHAINS
    assert not [line for line in lines if "(%r" in line]


def test_triad_adds_three_times_the_second_array():
    a, b, c = (np.full(16, value, np.float32) for value in (0, 1, 2))
    roofline._triad(a, b, c)
    assert (a == 7).all()


def test_the_machine_is_described(fast_peaks):
    machine = describe_machine(2)
    assert set(machine) >= {"cpu", "cores", "threads", "versions", "gpu", "fma_gflops", "bandwidth_gb_s"}
    for name in ("fma_gflops", "bandwidth_gb_s"):
        assert set(machine[name]) == {"1", "2"}
        assert all(value > 0 for value in machine[name].values())
    assert machine["versions"]["torch"]


def select_one(gaussians: Gaussians, index: int) -> Gaussians:
    return gaussians.select(torch.tensor([index]))


def test_pairs_are_the_pixels_of_a_tight_box():
    room = full_lattice_room(16, views=1)
    for index in range(0, len(room), 37):
        alpha = rasterize(select_one(room, index), POSE, size=(16, 32), backend="torch").alpha
        shown = alpha > 0
        pairs = count_panorama_work(select_one(room, index), POSE, 16, OPTIONS).pairs
        rows, columns = int(shown.any(dim=1).sum()), int(shown.any(dim=0).sum())
        assert int(shown.sum()) <= pairs
        assert pairs <= (rows + 1) * (columns + 1) or rows * columns == 0 or columns > 16


def test_work_is_a_sum_over_gaussians():
    room = full_lattice_room(8)
    whole = count_panorama_work(room, POSE, 16, OPTIONS)
    assert whole.pairs == sum(
        count_panorama_work(select_one(room, i), POSE, 16, OPTIONS).pairs for i in range(len(room))
    )


def test_traffic_is_that_of_the_scene_its_records_and_the_image():
    room = full_lattice_room(8, degree=2)
    far = room.select(torch.tensor([0]))  # straight down; the image has one tile
    scene, record, intersection, image = 4 * (11 + 27), 80, 88, 4 * 5 * 16 * 32
    assert count_panorama_work(far, POSE, 16, OPTIONS).bytes == scene + record + intersection + image


def test_gaussians_nearer_than_near_have_no_work():
    room = full_lattice_room(8)
    options = RasterOptions("ray", "radial", "angular", 100.0, False)
    assert count_panorama_work(room, POSE, 16, options).pairs == 0


def test_a_gaussian_around_the_camera_counts_every_pixel_once():
    room = full_lattice_room(8)
    around = select_one(room, 0)
    around = replace(around, scales=torch.full((1, 3), 50.0), opacities=torch.ones(1))
    assert count_panorama_work(around, POSE, 16, OPTIONS).pairs == 16 * 32
    below = replace(around, means=torch.tensor([[0.0, 1.2, 0.0]]), scales=torch.full((1, 3), 0.15))
    rows = int((rasterize(below, POSE, size=(16, 32), backend="torch").alpha > 0).any(dim=1).sum())
    assert 32 * rows <= count_panorama_work(below, POSE, 16, OPTIONS).pairs <= 32 * (rows + 1)
