"""Predict, render, save and load."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from pansplat.errors import InputError
from pansplat.gaussians.harmonics import official_harmonics
from pansplat.gaussians.scene import Scene
from pansplat.pipeline import load, load_model, predict, render, save
from pansplat.rendering import blend, rasterize

HEIGHT = 16


@pytest.fixture
def scene(pair_folder: Path, sphere_predictor) -> Scene:
    return predict(pair_folder, sphere_predictor(), height=HEIGHT, cache=False)


def test_a_predicted_scene_holds_its_cameras_and_predictor_name(scene: Scene) -> None:
    assert len(scene.gaussians) == 2 * HEIGHT * 2 * HEIGHT
    assert scene.cam2world.dtype == torch.float64 and float(scene.cam2world[1, 0, 3]) == 0.5
    assert (scene.model, scene.height, scene.names) == ("sphere", HEIGHT, ("left", "right"))


def test_predict_refuses_a_folder_of_several_pairs(tmp_path: Path, sphere_predictor, write_pair) -> None:
    for index in range(2):
        write_pair(tmp_path / "pairs" / f"room{index}", seed=index)
    with pytest.raises(InputError, match=r"holds 2 pairs \(room0, room1\); choose one"):
        predict(tmp_path / "pairs", sphere_predictor(), height=HEIGHT)


def test_load_model_lists_the_known_models_when_refusing_one() -> None:
    with pytest.raises(InputError, match=r"must be one of sweep, or a file of weights .*, got 'swepe'"):
        load_model("swepe")


def test_load_model_returns_a_predictor() -> None:
    predictor = load_model("sweep")
    assert predictor.name == "sweep" and predictor.fingerprint


def test_deferred_blending_at_an_input_pose_renders_that_view_only(scene: Scene) -> None:
    for view in range(2):
        alone = render(scene, scene.cam2world[view], blend=view)
        deferred = render(scene, scene.cam2world[view])
        torch.testing.assert_close(deferred.color, alone.color)


def test_deferred_blending_equals_the_blend_of_single_views(scene: Scene) -> None:
    pose = scene.pose_between(0.25)
    renderings = [render(scene, pose, blend=view) for view in range(2)]
    weights = torch.tensor([0.75, 0.25])
    torch.testing.assert_close(
        render(scene, pose).color,
        blend(renderings, weights).color,
    )


def test_joint_rendering_equals_one_rasterisation(scene: Scene) -> None:
    pose = scene.pose_between(0.5)
    size = (HEIGHT, 2 * HEIGHT)
    joint = render(scene, pose, blend="joint")
    torch.testing.assert_close(joint.color, rasterize(scene.gaussians, pose, size=size).color)
    assert not torch.allclose(joint.color, render(scene, pose).color, atol=1e-3)


def test_a_scene_without_cameras_is_rendered_jointly(scene: Scene) -> None:
    foreign = Scene(scene.gaussians, scene.cam2world[:0], 0.1, 100.0, height=HEIGHT)
    pose = scene.pose_between(0.5)
    torch.testing.assert_close(render(foreign, pose).color, render(scene, pose, blend="joint").color)


def test_render_accepts_sizes_layouts_and_numpy_poses(scene: Scene) -> None:
    pose = scene.pose_between(0.5).numpy()
    assert render(scene, pose).color.shape == (3, HEIGHT, 2 * HEIGHT)
    assert render(scene, pose, layout="pinhole", size=(8, 12)).color.shape == (3, 8, 12)
    assert render(scene, pose, layout="cubemap", size=(8, 16)).depth.shape == (8, 16)


def test_original_drawing_uses_the_official_kernel_stitching_and_harmonics(scene: Scene) -> None:
    pose = scene.pose_between(0.5)
    drawn = render(scene, pose, blend="joint", size=(32, 64), drawing="original").color
    bent = replace(scene.gaussians, harmonics=official_harmonics(scene.gaussians.harmonics))
    choices = {"kernel": "ewa", "order": "z", "lowpass": "3dgs", "stitching": "official", "face_size": 16}
    expected = rasterize(bent, pose, size=(32, 64), layout="cubemap", near=0.2 * scene.near, **choices).color
    assert torch.equal(drawn, expected)
    assert not torch.allclose(drawn, render(scene, pose, blend="joint", size=(32, 64)).color, atol=1e-3)


@pytest.mark.parametrize(
    "options",
    [{"drawing": "fast"}, {"drawing": "original", "kernel": "ray"}, {"drawing": "original", "layout": "pinhole"}],
)
def test_render_refuses_conflicting_drawing_options(scene: Scene, options: dict[str, Any], unchecked: None) -> None:
    with pytest.raises(InputError, match=r"`drawing` must be|sets all options but size"):
        render(scene, scene.pose_between(0.5), size=(32, 64), **options)


@pytest.mark.parametrize("blend", [2, -1, "view0", "mixed"])
def test_render_refuses_an_unknown_blend(scene: Scene, blend: str | int) -> None:
    with pytest.raises(InputError, match="`blend` must be"):
        render(scene, scene.pose_between(0.5), blend=blend)


def test_a_saved_scene_renders_the_same_image(scene: Scene, tmp_path: Path) -> None:
    save(scene, tmp_path / "scene.ply")
    back = load(tmp_path / "scene.ply")
    pose = scene.pose_between(0.3)
    before, after = render(scene, pose), render(back, pose)
    torch.testing.assert_close(after.color, before.color, atol=1e-5, rtol=0)
    torch.testing.assert_close(after.depth, before.depth, atol=1e-4, rtol=0)


def test_save_and_load_refuse_other_suffixes(scene: Scene, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"must end in \.ply, got '\.splat'"):
        save(scene, tmp_path / "scene.splat")
    with pytest.raises(InputError, match=r"must end in \.ply, got 'no suffix'"):
        load(tmp_path / "scene")
    assert os.listdir(tmp_path) == ["pair"]
