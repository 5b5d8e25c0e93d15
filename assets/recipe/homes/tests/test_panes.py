import numpy as np
import pytest

from pansplat.geometry.equirect import pixel_directions
from pansplat_homes.panes import close_panes

_RAYS = pixel_directions(96, 192).numpy()


def _room(*, turn=0, floor_in_opening=False, inside=20.0):
    """Depth of a box of 2 x 2 camera heights with an opening in the wall in front, and of the closed box."""
    with np.errstate(divide="ignore"):
        walls = 1.5 / np.maximum(np.abs(_RAYS[..., 0]), np.abs(_RAYS[..., 2]))
        floor = np.where(_RAYS[..., 1] > 0, 1 / _RAYS[..., 1], 0.8 / -_RAYS[..., 1])
    closed = np.minimum(walls, floor).astype(np.float32)
    ahead = _RAYS / _RAYS[..., 2:]
    low = 0.9 if floor_in_opening else 0.2
    opening = (_RAYS[..., 2] > 0) & (np.abs(ahead[..., 0]) < 0.4) & (ahead[..., 1] > -0.4) & (ahead[..., 1] < low)
    opened = closed.copy()
    outside = np.where(_RAYS[..., 1] > 0, np.minimum(floor, inside), inside) if floor_in_opening else inside
    opened[opening] = np.broadcast_to(outside, opened.shape)[opening]
    return np.roll(opened, turn, 1), np.roll(closed, turn, 1), np.roll(opening, turn, 1)


@pytest.mark.parametrize("turn", (0, 96), ids=("in the middle", "at the seam"))
@pytest.mark.parametrize("inside", (20.0, 0.0), ids=("window", "mirror of unknown depth"))
def test_panes_have_the_depth_of_the_wall(turn, inside):
    opened, closed, opening = _room(turn=turn, inside=inside)
    assert np.abs(opened - closed)[opening].mean() > 1
    result = close_panes(opened, np.random.default_rng(0))
    np.testing.assert_allclose(result, closed, rtol=0.05)


def test_doorways_stay_open():
    opened, closed, opening = _room(floor_in_opening=True, inside=6.0)
    result = close_panes(opened, np.random.default_rng(0))
    np.testing.assert_array_equal(result, opened)
    assert (opened > 1.4 * closed)[opening].mean() > 0.5


def test_a_room_without_openings_is_not_changed():
    _, closed, _ = _room()
    np.testing.assert_array_equal(close_panes(closed, np.random.default_rng(0)), closed)
