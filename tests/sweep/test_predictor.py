"""The sweep as a predictor: a room of known depth."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from refusals import expect_error
from torch import Tensor

from pansplat.gaussians.scene import Gaussians
from pansplat.sweep import Sweep
from pansplat.sweep.search import SearchConfig
from pansplat.system.progress import show_progress


def _tensors(observed) -> tuple[Tensor, Tensor]:
    images = torch.from_numpy(observed.posed.images).permute(0, 3, 1, 2)
    return images, torch.from_numpy(observed.posed.cam2world)


def _same(a: Gaussians, b: Gaussians) -> bool:
    return all(torch.equal(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(Gaussians))


@pytest.fixture(scope="module")
def small(make_room):
    room = make_room()
    return _tensors(room.observe(64))


@pytest.fixture(scope="module")
def predicted(small) -> Gaussians:
    return Sweep()(*small, 0.5, 8.0)


def test_any_height_is_predicted_from(small):
    odd = torch.nn.functional.interpolate(small[0], (67, 134), mode="bilinear")
    masks = torch.ones(2, 67, 134, dtype=torch.bool)
    masks[:, 50:] = False
    gaussians = Sweep()(odd, small[1], 0.5, 8.0, masks=masks)
    assert len(gaussians) > 1000 and gaussians.means.isfinite().all()


def test_the_world_and_the_masks_are_those_that_networks_need(small):
    expect_error("needed depths from", lambda: Sweep()(*small, 500.0, 8000.0))
    masks = torch.ones(2, 32, 64, dtype=torch.bool)
    expect_error(r"`masks` must be \(2, 64, 128\)", lambda: Sweep()(*small, 0.5, 8.0, masks=masks))


def test_full_masks_ranges_by_view_other_types_and_progress_change_no_bit(small, predicted):
    reports: list[tuple[str, float]] = []
    images, masks = small[0].double().requires_grad_(), torch.ones(2, 64, 128, dtype=torch.bool)
    near, far = torch.tensor((0.5, 0.7)), torch.tensor((5.0, 8.0))  # the range covers both views
    with show_progress(lambda *report: reports.append(report)):
        again = Sweep()(images, small[1], near, far, masks=masks)
    assert _same(again, predicted)
    assert again.means.dtype == torch.float32 and not again.means.requires_grad
    fractions = [fraction for _, fraction in reports]
    assert fractions == sorted(fractions) and fractions[0] == 0 and fractions[-1] == 1
    assert len(reports) >= 4 and all(what for what, _ in reports)


def test_a_batch_gives_a_list_of_its_items(small, monkeypatch):
    """Each with its own images, poses, range and mask."""
    monkeypatch.setattr(Sweep, "_predict", lambda self, *inputs: inputs[:5])
    images, poses, masks = (torch.stack((t, t.flip(0))) for t in (*small, small[0][:, 0] > 0.5))
    batch = Sweep()(images, poses, 0.5, torch.tensor((8.0, 6.0)), masks=masks)
    assert isinstance(batch, list) and len(batch) == 2
    for n, item in enumerate(batch):
        expected = images[n], poses[n], torch.tensor(0.5), torch.tensor((8.0, 6.0))[n], masks[n]
        assert all(torch.equal(torch.as_tensor(a), b) for a, b in zip(item, expected, strict=True))


def test_swapping_the_views_swaps_their_labels(small, predicted):
    swapped = Sweep()(small[0].flip(0), small[1].flip(0), 0.5, 8.0)
    for view in (0, 1):
        before, after = predicted.select(predicted.views == view), swapped.select(swapped.views == 1 - view)
        assert len(after) == pytest.approx(len(before), rel=1e-3)
        distance = torch.cdist(after.means[::16], before.means).amin(dim=1)
        assert distance.median() < 1e-4  # metres; the order of sums differs


@pytest.mark.slow
def test_holes_are_masked_but_fitted_and_the_input_is_not_changed(small):
    images, poses = small[0].clone(), small[1].clone()
    holes = torch.zeros(2, 64, 128, dtype=torch.bool)
    holes[0, 18:32, 38:62] = True
    images[holes[:, None].expand_as(images)] = 0
    inputs = images.clone(), poses.clone(), holes.clone()
    holed, masked = (Sweep()(images, poses, 0.5, 8.0, **mask) for mask in ({"holes": holes}, {"masks": ~holes}))
    assert _same(dataclasses.replace(holed, harmonics=masked.harmonics), masked)
    assert not torch.equal(holed.harmonics, masked.harmonics)
    assert all(torch.equal(a, b) for a, b in zip(inputs, (images, poses, holes), strict=True))


@pytest.mark.parametrize(
    ("change", "min_count"),
    (
        (lambda images, poses: (images, torch.stack((poses[0], poses[0]))), 1000),
        (lambda images, poses: (torch.ones_like(images), poses), 100),
    ),
    ids=("coincident cameras", "blank panoramas"),
)
def test_inputs_without_depth_cues_give_finite_gaussians(small, change, min_count):
    gaussians = Sweep()(*change(*small), 0.5, 8.0)
    assert len(gaussians) > min_count
    for values in dataclasses.astuple(gaussians):
        assert torch.isfinite(values.double()).all()


def test_fully_masked_panoramas_give_no_gaussians(small):
    assert len(Sweep()(*small, 0.5, 8.0, masks=torch.zeros(2, 64, 128, dtype=torch.bool))) == 0


@pytest.mark.parametrize("views", (1, 2))
def test_only_a_single_view_is_filled_where_it_is_masked(small, views):
    images, poses = small[0][:views], small[1][:views]
    masks = torch.ones(views, *images.shape[-2:], dtype=torch.bool)
    masks[:, -12:] = False  # 34 degrees around the nadir
    gaussians = Sweep()(images, poses, 0.5, 8.0, masks=masks)
    local = (gaussians.means.double() - poses[0, :3, 3]) @ poses[0, :3, :3]
    below = (local[:, 1] > math.cos(math.radians(25)) * local.norm(dim=-1)) & (gaussians.views == 0)
    assert set(gaussians.levels[below].tolist()) == ({2, 3} if views == 1 else set())


def test_moving_the_world_moves_the_gaussians(make_room):
    """Places and shift are multiples of 2^-24, which float64 subtracts without rounding, and float32 does not."""
    room, shift, fine = make_room(), torch.tensor((8.0, -4.0, 2.0), dtype=torch.float64), 2.0**-24
    places = (3 * fine - 0.375, fine, -0.25), (0.5 - 5 * fine, 0.125, 0.125 + 7 * fine)
    images, poses = _tensors(room.observe(64, [room.pose(place) for place in places]))
    shifted = poses.clone()
    shifted[:, :3, 3] += shift
    there, back = (Sweep()(images, cam2world, 0.5, 8.0) for cam2world in (poses, shifted))
    for name in ("levels", "views", "scales", "quats", "opacities"):
        assert torch.equal(getattr(back, name), getattr(there, name)), name
    # Means are rounded to float32 once, by half the spacing of numbers of their size at most.
    error = (back.means.double() - there.means.double() - shift).abs()
    assert error.max() <= sum(float(np.spacing(np.float32(m.abs().max()))) / 2 for m in (back.means, there.means))


def test_the_fingerprint_depends_on_the_settings():
    assert Sweep().fingerprint == Sweep(SearchConfig()).fingerprint != Sweep(SearchConfig(256)).fingerprint
    assert Sweep().name == "sweep" and Sweep().fingerprint.startswith("sweep-")
