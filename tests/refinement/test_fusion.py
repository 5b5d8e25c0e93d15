"""Each surface once: which Gaussians are kept, and the refinement of the result."""

import dataclasses

import pytest
import torch
from synthetic_scenes import make_balls, place_cameras

from pansplat import pipeline
from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.geometry.fibonacci import fibonacci_directions
from pansplat.refinement import RefineConfig, Refinement, fuse_views
from pansplat.refinement.budget import measure_contributions
from pansplat.rendering import color_fit
from pansplat.rendering.color_fit import fit_colors

HEIGHT = 32
LEFT, RIGHT = torch.tensor((-1.0, 0.0, 0.0)), torch.tensor((1.0, 0.0, 0.0))


def _shell(center: torch.Tensor, view: int, distances: float | torch.Tensor = 3.0, level: int = 0) -> Gaussians:
    """Opaque Gaussians around a camera at a distance from the origin, so that the shells of all cameras are one."""
    rays = fibonacci_directions(1200).float()
    if not isinstance(distances, torch.Tensor):  # where the rays meet the sphere about the origin
        along = (rays @ center)[:, None]
        distances = (-along + (along.square() - center.square().sum() + distances**2).sqrt())[:, 0]
    far = distances[:, None]
    return make_balls(center + rays * far, 0.05 * far, 0.95, levels=level, views=view)


def _scene(*parts: Gaussians, near: float = 0.5) -> Scene:
    poses = place_cameras(LEFT.tolist(), RIGHT.tolist())
    return Scene(Gaussians.cat(parts), poses, near=near, far=10.0, height=HEIGHT)


def test_each_place_keeps_the_gaussians_of_the_nearest_camera() -> None:
    scene = _scene(_shell(LEFT, 0), _shell(RIGHT, 1))
    fused = fuse_views(scene)
    assert fused.joint and not scene.joint
    sides = fused.gaussians.means[:, 0]
    assert bool((sides[fused.gaussians.views == 0] <= 1e-6).all())
    assert bool((sides[fused.gaussians.views == 1] >= -1e-6).all())
    expected = sum(
        int((scene.gaussians.means[scene.gaussians.views == view, 0] * sign < 0).sum())
        for view, sign in ((0, 1), (1, -1))
    )
    assert len(fused.gaussians) == pytest.approx(expected, abs=3), "and all of them"
    assert fuse_views(fused) is fused


def test_what_the_nearer_camera_does_not_see_is_kept() -> None:
    """A screen around the right camera hides the shell beyond it from that camera."""
    screen = _shell(RIGHT, 1, torch.full((1200,), 0.5))
    fused = fuse_views(_scene(_shell(LEFT, 0), screen)).gaussians
    assert int((fused.views == 0).sum()) == 1200 and int((fused.views == 1).sum()) == 1200


def test_a_gaussian_in_front_of_a_nearer_cameras_surface_is_dropped() -> None:
    """The left camera has a wrong surface just beside the right one, which sees the shell behind it."""
    rays = fibonacci_directions(1200).float()
    distances = torch.full((1200,), 3.0)
    is_wrong = rays[:, 0] > 0.98
    distances[is_wrong] = 1.7  # 0.3 m in front of the right camera
    fused = fuse_views(_scene(_shell(LEFT, 0, distances), _shell(RIGHT, 1))).gaussians
    kept = fused.means[fused.views == 0]
    assert int(is_wrong.sum()) > 5 and not bool(((kept - LEFT).norm(dim=1) < 2).any())


def test_background_levels_are_kept_only_where_no_other_camera_sees() -> None:
    behind = _shell(LEFT, 0, 3.1, level=2)
    fused = fuse_views(_scene(_shell(LEFT, 0), behind, _shell(RIGHT, 1))).gaussians
    assert not bool((fused.levels == 2).any()), "the right camera's surface is at most 10 % in front"
    far = _shell(LEFT, 0, 4.5, level=2)
    fused = fuse_views(_scene(_shell(LEFT, 0), far, _shell(RIGHT, 1))).gaussians
    assert int((fused.levels == 2).sum()) == 1200


def test_holes_of_the_nearer_camera_are_filled_by_the_other_one() -> None:
    right = _shell(RIGHT, 1)
    hole = (right.means - RIGHT)[:, 2] / (right.means - RIGHT).norm(dim=1) > 0.5
    fused = fuse_views(_scene(_shell(LEFT, 0), right.select(~hole)))
    alpha = pipeline.render(fused, fused.cam2world[1], size=(HEIGHT, 2 * HEIGHT)).alpha
    assert float(alpha[HEIGHT // 2 - 4 : HEIGHT // 2 + 4, HEIGHT - 4 : HEIGHT + 4].min()) > 0.8, "in the hole"


def test_scenes_of_one_camera_or_none_stay_as_they_are() -> None:
    scene = _scene(_shell(LEFT, 0))
    for cameras in (0, 1):
        given = dataclasses.replace(scene, cam2world=scene.cam2world[:cameras])
        assert fuse_views(given) is given


def _joint_error(scene: Scene, views) -> float:
    errors = [
        (pipeline.render(scene, pose, blend="joint", size=image.shape[-2:]).color - image).abs().mean()
        for pose, image in zip(scene.cam2world, views.images, strict=True)
    ]
    return float(torch.stack(errors).mean())


def test_a_fused_scene_is_refined_in_joint_drawing(room) -> None:
    fused = fuse_views(room.predicted)
    refinement = Refinement(fused, room.views)
    report = refinement.run(steps=60)
    refined = refinement.scene()
    assert refined.joint and report.stopped == "done" and report.steps == 60
    assert _joint_error(refined, room.views) < 0.3 * _joint_error(fused, room.views)
    assert report.after < report.before
    middle = room.truth.pose_between(0.5)
    true, *others = (
        pipeline.render(scene, middle, blend=blend, size=(HEIGHT, 2 * HEIGHT)).color
        for scene, blend in ((room.truth, 0), (fused, "joint"), (refined, "joint"))
    )
    before, after = ((image - true).abs().mean() for image in others)
    assert after < 0.7 * before, "also between the cameras"


def test_the_exposures_of_photographs_in_joint_drawing_are_relative_to_their_mean(room) -> None:
    images = room.views.images.clone()
    images[1] = 0.8 * images[1]
    refinement = Refinement(fuse_views(room.predicted), dataclasses.replace(room.views, images=images))
    refinement.run(steps=120)
    assert [a * b for a, b in zip(*refinement.gains, strict=True)] == pytest.approx([1.0] * 3, abs=0.01)
    assert [b / a for a, b in zip(*refinement.gains, strict=True)] == pytest.approx([0.8] * 3, abs=0.06)


def test_poses_of_a_fused_scene_are_refused(room) -> None:
    with pytest.raises(InputError, match="--layers --poses"):
        Refinement(fuse_views(room.predicted), room.views, RefineConfig(poses=True))


def test_colors_of_all_views_are_fitted_to_all_photographs(room, monkeypatch) -> None:
    fused = fuse_views(room.truth)
    random = torch.rand(len(fused.gaussians), 1, 3, generator=torch.Generator().manual_seed(1)) - 0.5
    grey = dataclasses.replace(fused, gaussians=dataclasses.replace(fused.gaussians, harmonics=random))
    monkeypatch.setattr(color_fit, "_STEPS", 20)
    views = room.views
    colors = fit_colors(grey.gaussians, views.images, views.cam2world, views.masks, joint=True)
    fitted = dataclasses.replace(grey, gaussians=colors)
    assert _joint_error(fitted, views) < 0.1 * _joint_error(grey, views)


def test_contributions_of_a_fused_scene_are_those_of_joint_images(room) -> None:
    """A Gaussian that the other view hides is dropped; drawn by views it contributes."""
    fused = fuse_views(room.predicted)
    inner = _shell(torch.zeros(3), 1, torch.full((1200,), 1.2))
    covered = dataclasses.replace(fused, gaussians=Gaussians.cat([fused.gaussians, inner]))
    hidden = slice(0, len(fused.gaussians))
    size = (HEIGHT, 2 * HEIGHT)
    joint = measure_contributions(covered, size)[hidden].sum()
    layered = measure_contributions(dataclasses.replace(covered, joint=False), size)[hidden].sum()
    assert joint < 0.3 * layered


def test_a_fused_scene_of_which_one_view_is_left_is_compared_with_all_photographs(room) -> None:
    kept = room.predicted.gaussians.select(room.predicted.gaussians.views == 1)
    scene = dataclasses.replace(room.predicted, gaussians=kept, joint=True)
    refinement = Refinement(scene, room.views)
    report = refinement.run(steps=40)
    assert report.after < report.before
    assert _joint_error(refinement.scene(), room.views) < 0.5 * _joint_error(scene, room.views)
