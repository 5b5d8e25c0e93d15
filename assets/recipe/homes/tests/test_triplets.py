"""Generated triplets are exact, reproducible and different; their cameras are in free space."""

from pathlib import Path

import pytest
import torch

from pansplat.geometry.equirect import pixel_directions
from pansplat.geometry.warp import relative_pose, warp_panorama
from pansplat.training.config import DataConfig
from pansplat.training.sources import load_sources
from pansplat_homes.triplets import GeneratedTriplets, write_triplet

HEIGHT = 64


@pytest.fixture(scope="module")
def scenes() -> GeneratedTriplets:
    return GeneratedTriplets(seed=3, samples=1)


def test_triplets_are_determined_by_seed_and_index(scenes: GeneratedTriplets) -> None:
    first, again, other = scenes.sample(4, 16), scenes.sample(4, 16), scenes.sample(5, 16)
    assert torch.equal(first.context.images, again.context.images)
    assert torch.equal(first.targets.cam2world, again.targets.cam2world)
    assert not torch.equal(first.context.images, other.context.images)
    assert not torch.equal(first.context.images, GeneratedTriplets(seed=4, samples=1).sample(4, 16).context.images)


def test_samples_are_triplets_with_depth_and_free_cameras(scenes: GeneratedTriplets) -> None:
    baselines = []
    for index in range(5):
        sample = scenes.sample(index, 16)
        views, target = sample.context, sample.targets
        assert views.images.shape == (2, 3, 16, 32) and target.images.shape == (1, 3, 16, 32)
        assert float(views.images.min()) >= 0 and float(views.images.max()) <= 1
        assert 0.2 < float(views.images.median()) < 0.8
        assert views.depths is not None and torch.isfinite(views.depths).all()
        known = views.depths > 0  # but for mirrors
        assert float(known.float().mean()) > 0.8 and float(views.depths[known].min()) > 0.44
        centres = views.cam2world[:, :3, 3]
        baselines.append(float((centres[0] - centres[1]).norm()))
        ways = [float((target.cam2world[0, :3, 3] - centre).norm()) for centre in centres]
        assert max(ways) < baselines[-1]
    assert all(0.3 <= baseline <= 2.0 for baseline in baselines)
    assert max(baselines) - min(baselines) > 0.3


def test_depth_warps_one_view_into_the_other(scenes: GeneratedTriplets) -> None:
    """Depths and colours agree except behind objects, but not with a reversed baseline."""
    for index in range(3):
        views = scenes.sample(index, HEIGHT).context
        assert views.depths is not None
        poses = views.cam2world.clone()
        seen, difference = _agreement(views.images, views.depths, poses)
        assert seen > 0.4
        assert difference < 0.05
        poses[:, :3, 3] = poses[:, :3, 3].flip(0)
        assert _agreement(views.images, views.depths, poses)[0] < 0.5 * seen


def _agreement(images: torch.Tensor, depths: torch.Tensor, cam2world: torch.Tensor) -> tuple[float, float]:
    """Fraction of view 0 where the depth of view 1 agrees, and the mean difference of colours there."""
    pose = relative_pose(cam2world[:1], cam2world[1:])
    inverse = 1 / depths[:1, None].clamp(min=0.1)
    warped = warp_panorama(images[1:], inverse, pose.float())[0, :, 0]
    seen = warp_panorama(depths[1:, None], inverse, pose.float())[0, 0, 0]
    points = pixel_directions(HEIGHT, 2 * HEIGHT) * depths[0][..., None]
    there = (points @ pose[0, :3, :3].T.float() + pose[0, :3, 3].float()).norm(dim=-1)
    visible = (seen - there).abs() < 0.02 * there
    return float(visible.float().mean()), float((warped - images[0]).abs().mean(dim=0)[visible].mean())


def test_more_rays_per_pixel_change_only_the_antialiasing() -> None:
    coarse, fine = (GeneratedTriplets(seed=3, samples=samples).sample(1, 32) for samples in (1, 3))
    assert coarse.context.depths is not None and fine.context.depths is not None
    assert torch.equal(coarse.context.depths, fine.context.depths)
    difference = (coarse.context.images - fine.context.images).abs().mean()
    assert 1e-4 < float(difference) < 0.06


@pytest.mark.slow
def test_written_triplets_are_a_training_source(tmp_path: Path, scenes: GeneratedTriplets) -> None:
    for _ in range(2):
        write_triplet(tmp_path, 3, 1, 32)
    training, _ = load_sources(DataConfig("triplets", tmp_path), 32, 0)
    assert len(training) == 1
    read, made = training.sample(0, 32, 0), GeneratedTriplets(3).sample(1, 32)
    for views, expected in ((read.context, made.context), (read.targets, made.targets)):
        assert float((views.images - expected.images).abs().max()) <= 0.5 / 255 + 1e-6
        assert views.depths is not None and expected.depths is not None
        assert float((views.depths - expected.depths).abs().max()) < 1e-3
        assert torch.allclose(views.cam2world, expected.cam2world)
        assert (views.near, views.far) == (expected.near, expected.far)
