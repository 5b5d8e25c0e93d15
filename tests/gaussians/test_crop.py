"""Parts of scenes keep Gaussians, views and cameras consistent."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from refusals import expect_error
from synthetic_scenes import make_balls, place_cameras

from pansplat.gaussians.crop import crop, keep_gaussians
from pansplat.gaussians.scene import Scene, SceneTour


def _make_row(*, joint: bool = False) -> Scene:
    """Three cameras in a row, 4 m apart along x, each with Gaussians at distances of 1 and 3 m before and behind it."""
    poses = place_cameras((0, 0, 0), (4, 0, 0), (8, 0, 0))
    offsets = torch.tensor((-3.0, -1.0, 1.0, 3.0))
    means = torch.zeros(12, 3)
    means[:, 0] = (poses[:, 0, 3, None] + offsets).flatten()
    levels, views = torch.tensor(0, dtype=torch.uint8), torch.arange(3).repeat_interleave(4).to(torch.uint8)
    gaussians = make_balls(means, 0.1, torch.linspace(0.1, 1, 12), levels=levels, views=views)
    gains, starts = ((1.0, 1.0, 1.0), (2.0, 2.0, 2.0), (3.0, 3.0, 3.0)), (None, (0.5, 0.0), (1.0, 0.0))
    links = ((0, 1, 0.1, 0.0, "on"), (1, 2, 0.2, 0.0, "on"), (2, 1, 0.3, 0.0, "back"))
    edges = ((0, 1, 0.4), (1, 2, 0.3))
    names = ("a", "b", "c")
    return Scene(
        gaussians, poses, 0.5, 9.0, names, gains=gains, starts=starts, tour=SceneTour(edges, links), joint=joint
    )


@pytest.mark.parametrize("order", [(2.0, -1, -1, 12, 1, 1), (12.0, 1, -1, 2, -1, 1)])
def test_a_crop_keeps_the_cameras_in_the_box_and_numbers_them_anew(order: tuple[float, ...]) -> None:
    cropped = crop(_make_row(), order)
    assert cropped.names == ("b", "c") and cropped.cam2world[:, 0, 3].tolist() == [4, 8]
    assert cropped.gaussians.means[:, 0].tolist() == [3, 5, 7, 5, 7, 9, 11], "1 and 3 m around b and c, from x = 2 on"
    assert cropped.gaussians.views.tolist() == [0, 0, 0, 1, 1, 1, 1]
    assert cropped.gaussians.views.dtype == torch.uint8
    assert cropped.gains == ((2.0, 2.0, 2.0), (3.0, 3.0, 3.0)) and cropped.starts == ((0.5, 0.0), (1.0, 0.0))
    assert cropped.tour and cropped.tour.overlaps == ((0, 1, 0.3),)
    assert cropped.tour.links == ((0, 1, 0.2, 0.0, "on"), (1, 0, 0.3, 0.0, "back"))


def test_a_joint_crop_keeps_what_cameras_outside_have_seen() -> None:
    cropped = crop(_make_row(joint=True), (2.0, -1, -1, 12, 1, 1))
    assert sorted(cropped.gaussians.means[:, 0].tolist()) == [3, 3, 5, 5, 7, 7, 9, 11]
    assert cropped.gaussians.views[cropped.gaussians.means[:, 0] == 3].tolist() == [0, 0]


def test_a_box_without_cameras_keeps_those_that_have_gaussians_in_it() -> None:
    cropped = crop(_make_row(), (4.5, -1, -1, 6, 1, 1))
    assert cropped.names == ("b", "c") and cropped.gaussians.means[:, 0].tolist() == [5, 5]


def test_a_panorama_without_neighbours_has_an_edge_to_itself() -> None:
    scene = _make_row()
    part = keep_gaussians(scene, torch.ones(12, dtype=torch.bool), (0, 2))
    assert part.tour and part.tour.overlaps == ((0, 0, 1.0), (1, 1, 1.0)) and part.tour.links == ()


def test_a_scene_without_cameras_is_cropped(make_scene: Callable[..., Scene]) -> None:
    scene = make_scene()
    foreign = replace(scene, cam2world=scene.cam2world[:0], names=(), gains=(), starts=(), tour=None)
    cropped = crop(foreign, (0, -9, -9, 9, 9, 9))
    assert 0 < len(cropped.gaussians) < 40 and bool((cropped.gaussians.means[:, 0] >= 0).all())
    assert torch.equal(cropped.gaussians.views, scene.gaussians.views[scene.gaussians.means[:, 0] >= 0])


def test_an_empty_box_is_refused_with_the_size_of_the_scene() -> None:
    message = r"needed a box with Gaussians, got \(20\.00, .* and a scene from \(-3\.00, 0\.00, 0\.00\) to \(11\.00, "
    expect_error(message, lambda: crop(_make_row(), (20, 0, 0, 30, 1, 1)))
