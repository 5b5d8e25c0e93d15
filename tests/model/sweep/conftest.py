"""What one picture says of a room's floor, for the tests of the floor and of the walls on it."""

import math

import numpy as np
import pytest

from pansplat.model.sweep.cost import MatchingConfig, View
from pansplat.model.sweep.floor import FloorClues, find_floor
from pansplat.model.sweep.frame import main_directions
from pansplat.model.sweep.planes import no_support

_AXES = np.array(((0.0, 1, 0), (1, 0, 0), (0, 0, 1)))
_HEIGHT = 96


@pytest.fixture(scope="session")
def room_axes() -> np.ndarray:
    """Down and the room's two wall normals."""
    return _AXES


@pytest.fixture(scope="session")
def find_clues():
    """What pictures of posed views say of a floor at an offset, metres, and the rays along the room's axes."""
    return _find_clues


def _find_clues(posed, images, floor: float) -> tuple[list[FloorClues] | None, list[np.ndarray]]:
    """Clues of pictures and their rays along the room's axes; the floor at an offset, metres."""
    rays = [main_directions(_AXES, pose[:3, :3], images.shape[1]) for pose in posed.cam2world]
    views = [
        View(np.ascontiguousarray(image, np.float32), mask, np.ascontiguousarray(ray[0], np.float32))
        for image, mask, ray in zip(images, posed.masks, rays, strict=True)
    ]
    nothing = no_support(posed.cam2world, _AXES, posed.near, posed.far)
    support = type(nothing)(**{**vars(nothing), "floor_ceiling": (floor - nothing.origin[1], -math.inf)})
    return find_floor(views, rays, posed.cam2world, support, MatchingConfig()), rays


@pytest.fixture(scope="session")
def two_coloured(empty_room):
    """The room with a dappled brown floor and dappled white walls, its clues, and its rays."""
    posed, floor = empty_room.posed, empty_room.room.high[1]
    images = []
    for pose, depth, image in zip(posed.cam2world, empty_room.depths, posed.images, strict=True):
        rays = main_directions(_AXES, pose[:3, :3], _HEIGHT)[0]
        on_floor = np.abs(rays * depth + pose[1, 3] - floor) < 1e-3
        paint = np.where(on_floor[..., None], (0.45, 0.3, 0.15), (0.85, 0.85, 0.85))
        images.append(paint * (0.8 + 0.4 * image.mean(axis=2, keepdims=True)))
    clues, rays = _find_clues(posed, np.stack(images).clip(0, 1).astype(np.float32), floor)
    assert clues is not None
    return clues, rays
