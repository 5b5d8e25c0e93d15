"""The training data without files: exact, reproducible, different; cameras are in free space."""

import pytest
import torch

from pansplat.geometry.equirect import pixel_directions
from pansplat.geometry.warp import relative_pose, warp_panorama
from pansplat.inputs.views import Views
from pansplat.training.config import DataConfig
from pansplat.training.room import RoomTriplets
from pansplat.training.sources import load_sources


def test_triplets_are_determined_by_seed_and_index() -> None:
    first, again = RoomTriplets(3).sample(4, 16), RoomTriplets(3).sample(4, 16, 99)
    assert torch.equal(first.context.images, again.context.images)
    assert torch.equal(first.targets.cam2world, again.targets.cam2world)
    for other in (RoomTriplets(3).sample(5, 16), RoomTriplets(4).sample(4, 16)):
        assert not torch.equal(first.context.images, other.context.images)


def test_rooms_for_validation_differ_from_those_of_training() -> None:
    training, validation = load_sources(DataConfig(), 16, 0)
    names = [{source.sample(index, 16, 0).name for index in range(3)} for source in (training, validation)]
    assert len(names[0] | names[1]) == 6


def test_cameras_are_in_free_space_and_the_target_is_between_the_inputs() -> None:
    for index in range(8):
        sample = RoomTriplets(3).sample(index, 32)
        for views in (sample.context, sample.targets):
            assert views.depths is not None and views.near < float(views.depths.min())
            assert float(views.depths.max()) < views.far
            assert float(views.images.min()) >= 0 and float(views.images.max()) <= 1
        (start, end), (middle,) = (views.cam2world[:, :3, 3] for views in (sample.context, sample.targets))
        baseline = float((end - start).norm())
        assert 0.3 <= baseline <= 2.0
        assert max(float((middle - place).norm()) for place in (start, end)) < baseline


@pytest.mark.parametrize("index", range(3))
def test_depth_warps_one_view_into_the_other(index: int) -> None:
    """Depths and colours agree except behind objects, but not with a reversed baseline."""
    views = RoomTriplets(3).sample(index, 64).context
    seen, difference = _compare(views, views.cam2world)
    assert seen > 0.6 and difference < 0.05
    poses = views.cam2world.clone()
    poses[:, :3, 3] = poses[:, :3, 3].flip(0)
    assert _compare(views, poses)[0] < 0.8 * seen


def _compare(views: Views, cam2world: torch.Tensor) -> tuple[float, float]:
    """Fraction of view 0 where the depth of view 1 agrees, and the mean difference of colours there."""
    assert views.depths is not None
    pose, inverse = relative_pose(cam2world[:1], cam2world[1:]).float(), 1 / views.depths[:1, None]
    warped = warp_panorama(views.images[1:], inverse, pose)[0, :, 0]
    depth = warp_panorama(views.depths[1:, None], inverse, pose)[0, 0, 0]
    points = pixel_directions(64, 128) * views.depths[0][..., None]
    expected = (points @ pose[0, :3, :3].T + pose[0, :3, 3]).norm(dim=-1)
    visible = (depth - expected).abs() < 0.02 * expected
    return float(visible.float().mean()), float((warped - views.images[0]).abs().mean(dim=0)[visible].mean())
