"""The prediction cache: invalidation, damaged files, folders."""

import dataclasses
import itertools
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from refusals import expect_error

from pansplat.gaussians.scene import Scene
from pansplat.inputs.panorama_sets import Note, PanoramaSet
from pansplat.pipeline import load_sets, predict
from pansplat.prediction_options import PredictOptions
from pansplat.system.progress import show_progress
from pansplat.system.store import cache_folders

HEIGHT = 16


def have_equal_gaussians(a: Scene, b: Scene) -> bool:
    fields = ("means", "scales", "quats", "opacities", "harmonics", "levels", "views")
    return all(torch.equal(getattr(a.gaussians, f), getattr(b.gaussians, f)) for f in fields)


def test_a_second_prediction_is_read_from_the_cache_bit_for_bit(pair_folder: Path, sphere_predictor) -> None:
    predictor = sphere_predictor()
    messages: list[str] = []
    first = predict(pair_folder, predictor, height=HEIGHT)
    with show_progress(lambda what, _: messages.append(what)):
        second = predict(pair_folder, predictor, height=HEIGHT)
    assert predictor.calls == 1
    assert have_equal_gaussians(first, second)
    assert all(getattr(second, name) == getattr(first, name) for name in ("names", "near", "far", "model"))
    assert torch.equal(first.cam2world, second.cam2world)
    assert messages == ["read from the cache"]
    assert [p.name.split("-")[0] for p in (pair_folder / ".pansplat").iterdir()] == ["prediction"]


def change_one_pixel(folder: Path) -> None:
    pixels = np.array(Image.open(folder / "right.png"))
    pixels[3, 5, 1] ^= 1
    Image.fromarray(pixels).save(folder / "right.png")


def change_pose(folder: Path) -> None:
    content = json.loads((folder / "poses.json").read_text())
    content["poses"]["right.png"]["cam2world"][0][3] += 1e-9
    (folder / "poses.json").write_text(json.dumps(content))


def change_far(folder: Path) -> None:
    content = json.loads((folder / "poses.json").read_text())
    (folder / "poses.json").write_text(json.dumps(content | {"far": 10.5}))


def add_mask(folder: Path) -> None:
    mask = np.full((HEIGHT, 2 * HEIGHT), 255, np.uint8)
    mask[-2:] = 0
    Image.fromarray(mask).save(folder / "left_mask.png")


@pytest.mark.parametrize("change", [change_one_pixel, change_pose, change_far, add_mask])
def test_any_change_of_the_pair_causes_a_new_prediction(pair_folder, change, sphere_predictor) -> None:
    predictor = sphere_predictor()
    predict(pair_folder, predictor, height=HEIGHT)
    change(pair_folder)
    predict(pair_folder, predictor, height=HEIGHT)
    assert predictor.calls == 2


def test_another_predictor_or_height_causes_a_new_prediction(pair_folder: Path, sphere_predictor) -> None:
    old, new = sphere_predictor("1"), sphere_predictor("2")
    for predictor, height in ((old, HEIGHT), (new, HEIGHT), (new, 2 * HEIGHT)):
        predict(pair_folder, predictor, height=height)
    assert new.calls == 2


def test_loaded_views_and_predictions_without_a_cache_leave_no_file(pair_folder: Path, sphere_predictor) -> None:
    predictor = sphere_predictor()
    pair = load_sets(pair_folder)[0]
    views = pair.load_context(HEIGHT)
    assert have_equal_gaussians(predict(views, predictor), predict(pair, predictor, height=HEIGHT, cache=False))
    assert not any(folder.exists() for folder in cache_folders(pair.folder))


@pytest.fixture
def gray_pair(pair_folder: Path) -> Path:
    """Photographs of different exposure, which a refinement finds."""
    pattern = np.random.default_rng(0).uniform(0.5, 1, (4, 8))
    for name, brightest in (("left.png", 150), ("right.png", 240)):
        small = Image.fromarray((brightest * pattern).astype(np.uint8)).convert("RGB")
        small.resize((2 * HEIGHT, HEIGHT), Image.Resampling.BICUBIC).save(pair_folder / name)
    return pair_folder


@pytest.mark.usefixtures("any_state")
def test_a_refined_scene_is_cached_apart_from_its_prediction(gray_pair, sphere_predictor, monkeypatch) -> None:
    predictor, shown = sphere_predictor(), []
    first = predict(gray_pair, predictor, height=HEIGHT, refine_steps=8, on_predicted=shown.append)
    again = predict(gray_pair, predictor, height=HEIGHT, refine_steps=8, on_predicted=shown.append)
    assert have_equal_gaussians(first, again) and predictor.calls == 1
    assert len(first.gains) == 2 and again.gains == first.gains
    prediction = predict(gray_pair, predictor, height=HEIGHT)
    assert not have_equal_gaussians(first, prediction) and predictor.calls == 1
    assert len(shown) == 2 and all(have_equal_gaussians(scene, prediction) for scene in shown)
    assert len(list((gray_pair / ".pansplat").iterdir())) == 2


@pytest.mark.usefixtures("any_state")
def test_a_refinement_is_the_same_however_busy_the_machine_is(gray_pair, sphere_predictor, monkeypatch) -> None:
    scenes = []
    for delay in (0.0, 100.0):  # seconds between two readings of the clock
        ticks = itertools.count(step=delay)
        clock = SimpleNamespace(perf_counter=lambda ticks=ticks: next(ticks))
        monkeypatch.setattr("pansplat.refinement.refinement.time", clock)
        scenes.append(predict(gray_pair, sphere_predictor(), options=PredictOptions(height=HEIGHT, cache=False)))
    assert scenes[0].gains and have_equal_gaussians(*scenes)


def test_an_interrupted_refinement_is_not_cached(pair_folder: Path, sphere_predictor) -> None:
    def interrupt(what: str, fraction: float) -> None:
        if what == "refining" and fraction > 0.2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), show_progress(interrupt):
        predict(pair_folder, sphere_predictor(), height=HEIGHT, refine_steps=8)
    assert len(list((pair_folder / ".pansplat").iterdir())) == 1  # the prediction


@pytest.mark.parametrize("steps", [-1, 2.5, float("nan"), True])
def test_invalid_numbers_of_a_refinement_are_refused_before_a_prediction(pair_folder, sphere_predictor, steps) -> None:
    predictor = sphere_predictor()
    expect_error("`refine_steps`", predict, pair_folder, predictor, height=HEIGHT, refine_steps=steps)
    expect_error("`gaussians`", predict, pair_folder, predictor, height=HEIGHT, refine_steps=8, gaussians=0)
    assert predictor.calls == 0


def test_one_content_has_one_entry_whatever_names_and_paths_are(pair_folder: Path, sphere_predictor) -> None:
    predictor, other = sphere_predictor(), sphere_predictor()
    other.name = "a copy of the weights"
    (pair,) = load_sets(pair_folder)
    view = dataclasses.replace(pair.context[0], title="客厅", notes=(Note(0.0, 0.0, "old"),))
    scenes = [predict(pair, model, height=HEIGHT) for model in (predictor, other)]
    (pair_folder / "right.png").rename(pair_folder / "other.png")
    poses = (pair_folder / "poses.json").read_text().replace("right.png", "other.png")
    (pair_folder / "poses.json").write_text(poses)
    named = dataclasses.replace(pair, name="x" * 300, context=(view, load_sets(pair_folder)[0].context[1]))
    named = dataclasses.replace(named, siblings=tuple(each.image for each in named.context))
    scenes += [predict(named, model, height=HEIGHT) for model in (predictor, other)]
    assert predictor.calls + other.calls == 1 and len(list((pair_folder / ".pansplat").iterdir())) == 1
    assert scenes[3].names == ("客厅", "other") and scenes[3].model == other.name


@pytest.mark.usefixtures("any_state")
def test_a_cached_scene_is_opened_without_its_photographs(gray_pair, sphere_predictor, monkeypatch) -> None:
    first = [predict(gray_pair, sphere_predictor(), height=HEIGHT, refine_steps=s) for s in (0, 8)]
    monkeypatch.setattr(PanoramaSet, "load_context", lambda *_: pytest.fail("it is decoded"))
    again = [predict(gray_pair, sphere_predictor(), height=HEIGHT, refine_steps=s) for s in (0, 8)]
    for before, after in zip(first, again, strict=True):
        assert have_equal_gaussians(before, after) and torch.equal(before.cam2world, after.cam2world)
        fields = ("near", "far", "names", "model", "height", "gains", "starts", "joint", "frame")
        assert all(getattr(before, name) == getattr(after, name) for name in fields)


def test_a_photograph_that_changes_during_its_prediction_leaves_no_entry(pair_folder, sphere_predictor, monkeypatch):
    predict_sphere = sphere_predictor.__call__

    def change(*arguments: Any, **named: Any) -> Any:
        change_one_pixel(pair_folder)
        return predict_sphere(*arguments, **named)

    monkeypatch.setattr(sphere_predictor, "__call__", change)
    predict(pair_folder, sphere_predictor(), height=HEIGHT)
    assert not (pair_folder / ".pansplat").exists()
