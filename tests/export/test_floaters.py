"""Floaters go, and surfaces and thin things stay."""

import math
from dataclasses import replace

import pytest
import torch
from synthetic_scenes import make_balls, place_cameras, see_box

from pansplat.errors import InputError
from pansplat.export.floaters import find_floaters, remove_floaters
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.refinement import fuse_views

_COUNT = 12000  # Gaussians of a camera


def _make(means: torch.Tensor, scale: float, view: int) -> Gaussians:
    return make_balls(means, scale, 0.95, harmonics=torch.sin(3 * means.float())[:, None], views=view)


def _make_room() -> tuple[Scene, torch.Tensor]:
    """A room of 6 x 3 x 4 m with a lamp on a wire, seen by two cameras; and which Gaussians are those of the wire."""
    low, high = torch.tensor((-3.0, -1.5, -2.0)).double(), torch.tensor((3.0, 1.5, 2.0)).double()
    poses = place_cameras((-0.8, 0, 0), (0.8, 0, 0))
    wire = torch.tensor((0.1, -1.5, 1.0)).double() + torch.arange(40)[:, None] * torch.tensor((0.0, 0.02, 0.0)).double()
    parts, is_wire = [], []
    for view, pose in enumerate(poses):
        parts += [_make(see_box(low, high, pose[:3, 3], _COUNT), 0.05, view), _make(wire, 0.01, view)]
        is_wire += [torch.zeros(_COUNT, dtype=torch.bool), torch.ones(40, dtype=torch.bool)]
    scene = Scene(Gaussians.cat(parts), poses, 0.3, 8.0, ("left", "right"), "synthetic", 64)
    return scene, torch.cat(is_wire)


def _add_floaters(scene: Scene) -> tuple[Scene, torch.Tensor]:
    """The scene with eleven Gaussians in its free space: single ones, two together, and one 30 m behind a wall."""
    places = torch.tensor(
        (
            *((0.0, 0.0, 0.5), (-1.5, 0.3, -0.6), (1.9, -0.4, 0.9), (0.3, 0.8, -1.0), (-2.2, -0.7, 0.4)),
            *((-0.6, -0.5, -1.2), (1.4, 0.6, 0.2), (0.9, 0.5, 1.2)),
            *((-1.8, 0.5, 1.0), (-1.79, 0.51, 1.0), (30.0, 0.0, 0.0)),
        )
    )
    views = torch.arange(len(places)) % 2
    added = replace(_make(places, 0.03, 0), views=views)
    dirty = replace(scene, gaussians=Gaussians.cat([scene.gaussians, added]))
    return dirty, torch.arange(len(dirty.gaussians)) >= len(scene.gaussians)


@pytest.mark.parametrize("joint", [False, True])
def test_floaters_go_and_everything_else_stays(joint: bool) -> None:
    scene, is_wire = _make_room()
    assert not find_floaters(scene).any()
    scene = fuse_views(scene) if joint else scene
    dirty, is_added = _add_floaters(scene)
    found = find_floaters(dirty)
    assert torch.equal(found.nonzero()[:, 0], is_added.nonzero()[:-1, 0]), "the one behind the wall is kept"
    assert joint or not found[: len(is_wire)][is_wire].any()
    cleaned = remove_floaters(dirty)
    assert len(cleaned.gaussians) == len(dirty.gaussians) - 10 and torch.equal(cleaned.cam2world, dirty.cam2world)


def test_the_unit_of_the_world_and_values_that_are_not_finite_have_no_influence() -> None:
    dirty, _ = _add_floaters(_make_room()[0])
    expected = find_floaters(dirty)
    assert torch.equal(find_floaters(dirty.scaled(1000.0)), expected)
    means = dirty.gaussians.means.clone()
    means[5, 1] = math.nan
    broken = replace(dirty, gaussians=replace(dirty.gaussians, means=means))
    assert torch.equal(find_floaters(broken), expected)


def test_without_cameras_floaters_are_refused() -> None:
    scene, _ = _make_room()
    with pytest.raises(InputError, match="floaters are found with input cameras"):
        remove_floaters(replace(scene, cam2world=scene.cam2world[:0], names=()))
