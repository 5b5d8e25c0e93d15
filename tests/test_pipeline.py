"""The calls a user needs: predict with its cache, render with its blending, save and load."""

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from pansplat.errors import InputError
from pansplat.gaussians.gaussians import Gaussians
from pansplat.gaussians.harmonics_official import as_the_original_draws
from pansplat.gaussians.scene import Scene
from pansplat.geometry.equirect import pixel_directions
from pansplat.pipeline import _cache_folders, load, load_model, load_pairs, predict, render, save
from pansplat.rendering import blend, rasterize

HEIGHT = 16


class Sphere:
    """One Gaussian a pixel, on a sphere of 2 m round each camera; counts its calls."""

    def __init__(self, fingerprint: str = "1") -> None:
        self.name, self.fingerprint, self.calls = "sphere", fingerprint, 0

    def __call__(self, images: Tensor, cam2world: Tensor, near: float, far: float, *, masks=None, progress=None):
        self.calls += 1
        view, _, height, width = images.shape
        directions = pixel_directions(height, width, dtype=torch.float64).reshape(-1, 3)
        count = len(directions)
        return Gaussians(
            means=torch.cat([2 * directions @ p[:3, :3].T + p[:3, 3] for p in cam2world.double()]).float(),
            scales=torch.full((view * count, 3), 2 * 3.2 / height),
            quats=torch.tensor([1.0, 0, 0, 0]).repeat(view * count, 1),
            opacities=torch.full((view * count,), 0.9),
            harmonics=((images.flatten(2).transpose(1, 2).reshape(-1, 1, 3) - 0.5) / 0.28209479).contiguous(),
            levels=torch.zeros(view * count, dtype=torch.int64),
            views=torch.arange(view).repeat_interleave(count),
        )


def write_pair(folder: Path, *, color: int = 0) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(color)
    poses = {}
    for index, name in enumerate(("left.png", "right.png")):
        picture = random.integers(0, 255, (HEIGHT, 2 * HEIGHT, 3), dtype=np.uint8)
        Image.fromarray(picture).save(folder / name)
        pose = np.eye(4)
        pose[0, 3] = 0.5 * index
        poses[name] = {"cam2world": pose.tolist()}
    (folder / "poses.json").write_text(json.dumps({"convention": "cam2world opencv", "poses": poses}))
    return folder


@pytest.fixture
def pair_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return write_pair(tmp_path / "pair")


@pytest.fixture
def scene(pair_folder: Path) -> Scene:
    return predict(pair_folder, Sphere(), height=HEIGHT, cache=False)


def same(a: Scene, b: Scene) -> bool:
    fields = ("means", "scales", "quats", "opacities", "harmonics", "levels", "views")
    return all(torch.equal(getattr(a.gaussians, f), getattr(b.gaussians, f)) for f in fields)


def test_predict_keeps_the_cameras_and_the_maker(scene: Scene) -> None:
    assert len(scene.gaussians) == 2 * HEIGHT * 2 * HEIGHT
    assert scene.cam2world.dtype == torch.float64 and float(scene.cam2world[1, 0, 3]) == 0.5
    assert (scene.model, scene.height, scene.names) == ("sphere", HEIGHT, ("left", "right"))


def test_a_second_prediction_comes_from_the_cache_bit_for_bit(pair_folder: Path) -> None:
    predictor = Sphere()
    told: list[str] = []
    first = predict(pair_folder, predictor, height=HEIGHT)
    second = predict(pair_folder, predictor, height=HEIGHT, progress=lambda what, _: told.append(what))
    assert predictor.calls == 1
    assert same(first, second)
    assert (second.names, second.near, second.far, second.model) == (
        first.names,
        first.near,
        first.far,
        first.model,
    )
    assert torch.equal(first.cam2world, second.cam2world)
    assert told == ["kept from last time"]
    assert [p.suffix for p in (pair_folder / ".pansplat").iterdir()] == [".scene"]


def repaint(folder: Path) -> None:
    """One pixel by one grey level: the smallest change a picture can have."""
    pixels = np.array(Image.open(folder / "right.png"))
    pixels[3, 5, 1] ^= 1
    Image.fromarray(pixels).save(folder / "right.png")


def move(folder: Path) -> None:
    content = json.loads((folder / "poses.json").read_text())
    content["poses"]["right.png"]["cam2world"][0][3] += 1e-9
    (folder / "poses.json").write_text(json.dumps(content))


def set_range(folder: Path) -> None:
    content = json.loads((folder / "poses.json").read_text())
    (folder / "poses.json").write_text(json.dumps(content | {"far": 10.5}))


def add_mask(folder: Path) -> None:
    mask = np.full((HEIGHT, 2 * HEIGHT), 255, np.uint8)
    mask[-2:] = 0
    Image.fromarray(mask).save(folder / "left_mask.png")


@pytest.mark.parametrize("change", [repaint, move, set_range, add_mask])
def test_any_change_of_the_pair_makes_a_new_prediction(pair_folder: Path, change: Callable[[Path], None]) -> None:
    predictor = Sphere()
    predict(pair_folder, predictor, height=HEIGHT)
    change(pair_folder)
    predict(pair_folder, predictor, height=HEIGHT)
    assert predictor.calls == 2
    assert len(list((pair_folder / ".pansplat").iterdir())) == 1  # what was before is cleared away


def test_another_predictor_or_height_makes_a_new_prediction(pair_folder: Path) -> None:
    old, new = Sphere("1"), Sphere("2")
    predict(pair_folder, old, height=HEIGHT)
    predict(pair_folder, new, height=HEIGHT)
    predict(pair_folder, new, height=2 * HEIGHT)
    assert new.calls == 2


def test_a_pair_that_was_renamed_keeps_its_prediction_but_not_its_old_names(pair_folder: Path) -> None:
    predictor = Sphere()
    predict(pair_folder, predictor, height=HEIGHT)
    (pair_folder / "right.png").rename(pair_folder / "other.png")
    poses = (pair_folder / "poses.json").read_text().replace("right.png", "other.png")
    (pair_folder / "poses.json").write_text(poses)
    assert predict(pair_folder, predictor, height=HEIGHT).names == ("left", "other")


@pytest.mark.parametrize("damage", ["truncate", "flip", "empty", "nonsense"])
def test_a_damaged_cache_file_is_made_anew(pair_folder: Path, damage: str) -> None:
    predictor = Sphere()
    first = predict(pair_folder, predictor, height=HEIGHT)
    (file,) = (pair_folder / ".pansplat").iterdir()
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 4
    damaged = {
        "truncate": file.read_bytes()[:-9],
        "flip": bytes(content),
        "empty": b"",
        "nonsense": b"x" * 99,
    }
    file.write_bytes(damaged[damage])
    assert same(predict(pair_folder, predictor, height=HEIGHT), first)
    predict(pair_folder, predictor, height=HEIGHT)
    assert predictor.calls == 2


def test_without_cache_nothing_is_read_or_written(pair_folder: Path) -> None:
    predictor = Sphere()
    for _ in range(2):
        predict(pair_folder, predictor, height=HEIGHT, cache=False)
    assert predictor.calls == 2 and not (pair_folder / ".pansplat").exists()


def test_a_pair_in_a_read_only_place_is_kept_in_the_users_cache(pair_folder: Path, tmp_path: Path) -> None:
    # A file in the folder's place stands for a folder that cannot be written: it also stops root.
    (pair_folder / ".pansplat").write_text("")
    predictor = Sphere()
    first = predict(pair_folder, predictor, height=HEIGHT)
    assert same(predict(pair_folder, predictor, height=HEIGHT), first)
    assert predictor.calls == 1
    assert len(list((tmp_path / "cache" / "pansplat").rglob("*.scene"))) == 1


def test_prediction_does_without_any_cache_folder(pair_folder: Path, tmp_path: Path) -> None:
    (pair_folder / ".pansplat").write_text("")
    (tmp_path / "cache").write_text("")
    assert len(predict(pair_folder, Sphere(), height=HEIGHT).gaussians)


def test_loaded_views_are_predicted_without_cache(pair_folder: Path) -> None:
    predictor = Sphere()
    pair = load_pairs(pair_folder)[0]
    views = pair.load_context(HEIGHT)
    assert same(predict(views, predictor), predict(pair, predictor, height=HEIGHT, cache=False))
    assert not any(folder.exists() for folder in _cache_folders(pair))


def test_a_path_of_several_pairs_asks_for_one(tmp_path: Path) -> None:
    for index in range(2):
        write_pair(tmp_path / "pairs" / f"room{index}", color=index)
    with pytest.raises(InputError, match=r"holds 2 pairs \(room0, room1\); choose one"):
        predict(tmp_path / "pairs", Sphere(), height=HEIGHT)


def test_an_unknown_model_names_those_there_are() -> None:
    with pytest.raises(InputError, match=r"must be one of sweep, or a file of weights .*, got 'swepe'"):
        load_model("swepe")


def test_load_model_gives_a_predictor() -> None:
    predictor = load_model("sweep")
    assert predictor.name == "sweep" and predictor.fingerprint


def test_at_an_input_deferred_blending_draws_that_view_only(scene: Scene) -> None:
    for view in range(2):
        alone = render(scene, scene.cam2world[view], blend=view)
        deferred = render(scene, scene.cam2world[view])
        torch.testing.assert_close(deferred.color, alone.color)


def test_deferred_is_the_blend_of_the_views(scene: Scene) -> None:
    pose = scene.pose_between(0.25)
    pictures = [render(scene, pose, blend=view) for view in range(2)]
    weights = torch.tensor([0.75, 0.25])
    torch.testing.assert_close(
        render(scene, pose).color,
        blend(pictures, weights).color,
    )


def test_joint_draws_all_at_once(scene: Scene) -> None:
    pose = scene.pose_between(0.5)
    size = (HEIGHT, 2 * HEIGHT)
    joint = render(scene, pose, blend="joint")
    torch.testing.assert_close(joint.color, rasterize(scene.gaussians, pose, size=size).color)
    assert not torch.allclose(joint.color, render(scene, pose).color, atol=1e-3)


def test_a_scene_without_cameras_is_drawn_jointly(scene: Scene) -> None:
    foreign = Scene(scene.gaussians, scene.cam2world[:0], 0.1, 100.0, height=HEIGHT)
    pose = scene.pose_between(0.5)
    torch.testing.assert_close(render(foreign, pose).color, render(scene, pose, blend="joint").color)


def test_render_takes_sizes_layouts_and_numpy_poses(scene: Scene) -> None:
    pose = scene.pose_between(0.5).numpy()
    assert render(scene, pose).color.shape == (3, HEIGHT, 2 * HEIGHT)
    assert render(scene, pose, layout="pinhole", size=(8, 12)).color.shape == (3, 8, 12)
    assert render(scene, pose, layout="cubemap", size=(8, 16)).depth.shape == (8, 16)


def test_drawing_as_the_original_is_its_kernel_its_stitching_and_its_harmonics(scene: Scene) -> None:
    pose = scene.pose_between(0.5)
    drawn = render(scene, pose, blend="joint", size=(32, 64), drawing="original").color
    bent = replace(scene.gaussians, harmonics=as_the_original_draws(scene.gaussians.harmonics))
    choices = {"kernel": "ewa", "order": "z", "lowpass": "3dgs", "stitching": "official", "face_size": 16}
    expected = rasterize(bent, pose, size=(32, 64), layout="cubemap", near=0.2 * scene.near, **choices).color
    assert torch.equal(drawn, expected)
    assert not torch.allclose(drawn, render(scene, pose, blend="joint", size=(32, 64)).color, atol=1e-3)


@pytest.mark.parametrize(
    "options",
    [{"drawing": "fast"}, {"drawing": "original", "kernel": "ray"}, {"drawing": "original", "layout": "pinhole"}],
)
def test_a_drawing_that_cannot_be_is_refused(scene: Scene, options: dict[str, Any], unchecked: None) -> None:
    with pytest.raises(InputError, match=r"`drawing` must be|chooses all but size"):
        render(scene, scene.pose_between(0.5), size=(32, 64), **options)


@pytest.mark.parametrize("blend", [2, -1, "view0", "mixed"])
def test_an_unknown_blend_is_refused(scene: Scene, blend: str | int) -> None:
    with pytest.raises(InputError, match="`blend` must be"):
        render(scene, scene.pose_between(0.5), blend=blend)


def test_a_saved_scene_renders_the_same(scene: Scene, tmp_path: Path) -> None:
    save(scene, tmp_path / "scene.ply")
    back = load(tmp_path / "scene.ply")
    pose = scene.pose_between(0.3)
    before, after = render(scene, pose), render(back, pose)
    torch.testing.assert_close(after.color, before.color, atol=1e-5, rtol=0)
    torch.testing.assert_close(after.depth, before.depth, atol=1e-4, rtol=0)


def test_other_suffixes_are_refused(scene: Scene, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"must end in \.ply, got '\.splat'"):
        save(scene, tmp_path / "scene.splat")
    with pytest.raises(InputError, match=r"must end in \.ply, got 'no suffix'"):
        load(tmp_path / "scene")
    assert os.listdir(tmp_path) == ["pair"]
