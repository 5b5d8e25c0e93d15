"""What pixels say about a scene's planes before any surface is known."""

import math

import numpy as np
import pytest

from pansplat.sweep.cost import MatchingConfig, View
from pansplat.sweep.frame import main_directions
from pansplat.sweep.planes import PlaneSupport, no_support
from pansplat.sweep.search import PosedImages
from pansplat.sweep.votes import vote_for_planes

_AXES = np.array(((0.0, 1, 0), (1, 0, 0), (0, 0, 1)))  # down and the room's two wall normals


def _vote(posed: PosedImages, images: np.ndarray, masks: np.ndarray) -> PlaneSupport:
    rays = [main_directions(_AXES, pose[:3, :3], images.shape[1]) for pose in posed.cam2world]
    views = [
        View(image, mask, np.ascontiguousarray(down[0], np.float32))
        for image, mask, down in zip(images, masks, rays, strict=True)
    ]
    support = no_support(posed.cam2world, _AXES, posed.near, posed.far)
    return vote_for_planes(views, rays, posed.cam2world, support, (0.125, 2.5), 0.45, MatchingConfig())


@pytest.fixture(scope="module")
def voted(empty_room) -> PlaneSupport:
    return _vote(empty_room.posed, empty_room.posed.images, empty_room.posed.masks)


def test_every_wall_is_the_most_voted_plane_on_its_side(voted, empty_room):
    for axis in range(3):
        for sign, corner in ((1, empty_room.room.high), (-1, empty_room.room.low)):
            true = (np.array(corner) - voted.origin) @ _AXES[axis]
            side = np.where(sign * voted.offsets > 0.5, voted.votes[axis], 0)
            assert voted.offsets[side.argmax()] == pytest.approx(true, abs=1.5 * voted.bin)
            assert side.max() > 0.5


def test_shares_lie_between_nothing_and_everything(voted):
    assert voted.votes.min() >= 0
    assert voted.votes.max() == pytest.approx(1, abs=1e-3)
    assert np.median(voted.votes) < 0.2


def test_the_floor_and_the_ceiling_are_found(voted, empty_room):
    down, up = voted.floor_ceiling
    assert down == pytest.approx(empty_room.room.high[1] - voted.origin[1], abs=1.5 * voted.bin)
    assert up == pytest.approx(empty_room.room.low[1] - voted.origin[1], abs=1.5 * voted.bin)


def test_a_box_standing_on_the_floor_is_not_the_floor(furnished_room):
    down, _ = _vote(furnished_room.posed, furnished_room.posed.images, furnished_room.posed.masks).floor_ceiling
    assert down == pytest.approx(furnished_room.room.high[1], abs=0.1)


def test_blank_pictures_vote_for_nothing(empty_room):
    voted = _vote(empty_room.posed, np.ones_like(empty_room.posed.images), empty_room.posed.masks)
    assert voted.votes.max() < 1e-3
    assert voted.floor_ceiling == (math.inf, -math.inf)


def test_masked_pixels_vote_for_nothing(empty_room):
    voted = _vote(empty_room.posed, empty_room.posed.images, np.zeros_like(empty_room.posed.masks))
    assert voted.votes.max() == 0
    assert voted.floor_ceiling == (math.inf, -math.inf)
