"""The right poses fit best; each wrong convention is detected, unless the images cannot distinguish it."""

import dataclasses
from pathlib import Path

import pytest
import torch
from refusals import expect_error
from synthetic_scenes import place_cameras, turn_camera

from pansplat.evaluation.pose_check import (
    _ADVICE,
    AS_GIVEN,
    PoseCheck,
    _can_judge,
    _describe_mistake,
    check_pair,
    check_views,
)
from pansplat.geometry.equirect import pixel_directions
from pansplat.geometry.pose import invert_pose
from pansplat.inputs.folders import load_sets
from pansplat.inputs.views import Views

_FLIP = torch.diag(torch.tensor((1.0, -1.0, -1.0, 1.0), dtype=torch.float64))
_HEIGHT = 40


def _render_room(cam2world: torch.Tensor) -> torch.Tensor:
    """A textured box room, ray cast."""
    d = pixel_directions(_HEIGHT, 2 * _HEIGHT, dtype=torch.float64) @ cam2world[:3, :3].T
    walls = torch.tensor((2.5, 1.5, 3.0), dtype=torch.float64)
    centre = cam2world[:3, 3]
    distance = ((torch.sign(d) * walls - centre) / torch.where(d.abs() < 1e-9, 1e-9, d)).amin(dim=-1)
    u, v, w = (centre + distance[..., None] * d).unbind(-1)
    face = ((centre + distance[..., None] * d).abs() / walls).argmax(dim=-1)
    red = 0.5 + 0.3 * torch.sin(3.1 * u + 1.3 * v * w) * torch.cos(2.3 * w - u)
    green = 0.5 + 0.3 * torch.sin(2.7 * v + 1.9 * u + face) + 0.1 * torch.cos(4 * w)
    blue = 0.2 + 0.2 * face + 0.1 * torch.sin(5 * (u + v - w))
    return torch.stack((red, green, blue)).clamp(0, 1).float()


def _views(*poses: torch.Tensor, near: float = 0.45, far: float = 10.0) -> Views:
    images, masks = torch.stack([_render_room(pose) for pose in poses]), torch.ones(len(poses), _HEIGHT, 2 * _HEIGHT)
    return Views(images, torch.stack(poses), masks.bool(), near, far, tuple("abc"[: len(poses)]))


_TILTED = (
    turn_camera((0.9, 0.1, 0.3, 0.05), (0.4, 0.2, -0.3)),
    turn_camera((0.6, -0.15, -0.6, 0.1), (-0.5, -0.2, 0.5)),
)


def _make_mistakes(poses: torch.Tensor) -> dict[str, torch.Tensor]:
    """By mistake, the matrices that a user with the mistake states as OpenCV cam2world poses."""
    turned = poses.clone()
    turned[:, :3, :3] = poses[:, :3, :3].transpose(-1, -2)
    robot = torch.eye(4, dtype=torch.float64)  # columns: forward, left and up in OpenCV's axes
    robot[:3, :3] = torch.tensor(((0.0, -1.0, 0.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0)))
    quarter = turn_camera((0.5**0.5, 0.0, 0.5**0.5, 0.0), (0.0, 0.0, 0.0))
    return {
        "inverse": invert_pose(poses),
        "opengl axes": poses @ _FLIP,
        "inverse, opengl axes": invert_pose(poses @ _FLIP),
        "transposed rotation": turned,
        "swapped views": poses.flip(0),
        "x-forward camera": poses @ robot,
        "turned by 90 degrees": poses @ invert_pose(quarter),
    }


def _best(check: PoseCheck) -> str:
    return next(iter(check.errors))


def test_right_poses_fit_best() -> None:
    check = check_views(_views(*_TILTED), "box")
    assert _best(check) == AS_GIVEN
    assert check.likely_mistake is None and check.can_judge and not check.warnings and not check.similar
    assert check.error < 0.8 * sorted(check.errors.values())[1]
    assert check.baseline == pytest.approx(float((_TILTED[0] - _TILTED[1])[:3, 3].norm()))


@pytest.mark.slow
@pytest.mark.parametrize("mistake", _make_mistakes(torch.stack(_TILTED)))
def test_each_wrong_convention_is_named(mistake: str) -> None:
    views = _views(*_TILTED)
    check = check_views(dataclasses.replace(views, cam2world=_make_mistakes(views.cam2world)[mistake]))
    assert _best(check) == mistake
    assert check.likely_mistake is not None
    assert check.likely_mistake.startswith(_ADVICE[mistake])


def test_a_nearly_perfect_fit_or_an_interpretation_that_stands_out_little_is_no_mistake() -> None:
    assert _describe_mistake({"inverse": 0.001, AS_GIVEN: 0.004}) is None
    assert _describe_mistake({"inverse": 0.201, AS_GIVEN: 0.304}) is not None
    errors = {"inverse": 0.435, "opengl axes": 0.470, "swapped views": 0.485, AS_GIVEN: 0.500}
    assert _describe_mistake(errors) is None and not _can_judge(errors)
    assert _describe_mistake(errors | {"opengl axes": 0.490, "swapped views": 0.499}) is not None


def test_interpretations_with_the_same_relative_pose_are_indistinguishable_and_named_together() -> None:
    views = _views(*place_cameras((0, 0, 0), (0.8, 0, 0)))
    check = check_views(views)
    assert _best(check) == AS_GIVEN
    assert {"opengl axes", "mirrored up-down", "transposed rotation"} <= set(check.indistinguishable)
    mistake = check_views(dataclasses.replace(views, cam2world=invert_pose(views.cam2world))).likely_mistake
    assert mistake is not None and _ADVICE["inverse"] in mistake and _ADVICE["swapped views"] in mistake


def test_interpretations_that_fit_about_as_well_are_named() -> None:
    errors = {"inverse": 0.443, AS_GIVEN: 0.445, "mirrored up-down": 0.450, "swapped views": 0.470}
    check = PoseCheck("pair", 1.0, 0.445, errors, (), None, True, ())
    assert check.similar == ("inverse", "mirrored up-down")


def test_implausible_poses_and_unrelated_images_give_a_warning() -> None:
    views = _views(*_TILTED)
    poses = views.cam2world.clone()
    poses[:, :3, 3] *= 1000
    assert "millimetres" in check_views(dataclasses.replace(views, cam2world=poses)).warnings[0]
    assert any("parallax" in warning for warning in check_views(_views(_TILTED[0], _TILTED[0])).warnings)
    noise = torch.rand(views.images.shape, generator=torch.Generator().manual_seed(0))
    check = check_views(dataclasses.replace(views, images=noise))
    assert check.likely_mistake is None and not check.can_judge
    assert any("too little in common" in warning for warning in check.warnings)


@pytest.mark.slow
def test_a_single_view_is_refused() -> None:
    (pair,) = load_sets(Path(__file__).parents[2] / "assets" / "living_room" / "left.jpg")
    expect_error("left: needed two or more views to check their poses, got one", check_pair, pair)


@pytest.mark.shared
@pytest.mark.parametrize(("data", "index"), [("mp3d_sample", 0), ("zind", 1), ("bsp_demo", 7)])
def test_shared_poses_pass(shared: Path, data: str, index: int) -> None:
    check = check_pair(load_sets(shared / "data" / data)[index])
    assert check.likely_mistake is None
