"""The prediction cache: invalidation, damaged files, folders."""

import dataclasses
import itertools
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from pansplat import pipeline
from pansplat.cache import list_cache_folders, write_cache_file
from pansplat.errors import InputError
from pansplat.gaussians.scene import Scene
from pansplat.pipeline import load_pairs, predict

HEIGHT = 16


def have_equal_gaussians(a: Scene, b: Scene) -> bool:
    fields = ("means", "scales", "quats", "opacities", "harmonics", "levels", "views")
    return all(torch.equal(getattr(a.gaussians, f), getattr(b.gaussians, f)) for f in fields)


def test_a_second_prediction_is_read_from_the_cache_bit_for_bit(pair_folder: Path, sphere_predictor) -> None:
    predictor = sphere_predictor()
    messages: list[str] = []
    first = predict(pair_folder, predictor, height=HEIGHT)
    second = predict(pair_folder, predictor, height=HEIGHT, progress=lambda what, _: messages.append(what))
    assert predictor.calls == 1
    assert have_equal_gaussians(first, second)
    assert all(getattr(second, name) == getattr(first, name) for name in ("names", "near", "far", "model"))
    assert torch.equal(first.cam2world, second.cam2world)
    assert messages == ["read from the cache"]
    assert [p.suffix for p in (pair_folder / ".pansplat").iterdir()] == [".scene"]


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
def test_any_change_of_the_pair_causes_a_new_prediction(
    pair_folder: Path, change: Callable[[Path], None], sphere_predictor
) -> None:
    predictor = sphere_predictor()
    predict(pair_folder, predictor, height=HEIGHT)
    change(pair_folder)
    predict(pair_folder, predictor, height=HEIGHT)
    assert predictor.calls == 2
    assert len(list((pair_folder / ".pansplat").iterdir())) == 1  # the outdated file is deleted


def test_another_predictor_or_height_causes_a_new_prediction(pair_folder: Path, sphere_predictor) -> None:
    old, new = sphere_predictor("1"), sphere_predictor("2")
    predict(pair_folder, old, height=HEIGHT)
    predict(pair_folder, new, height=HEIGHT)
    predict(pair_folder, new, height=2 * HEIGHT)
    assert new.calls == 2


def test_renamed_images_do_not_invalidate_the_cache(pair_folder: Path, sphere_predictor) -> None:
    predictor = sphere_predictor()
    predict(pair_folder, predictor, height=HEIGHT)
    (pair_folder / "right.png").rename(pair_folder / "other.png")
    poses = (pair_folder / "poses.json").read_text().replace("right.png", "other.png")
    (pair_folder / "poses.json").write_text(poses)
    assert predict(pair_folder, predictor, height=HEIGHT).names == ("left", "other")


@pytest.mark.parametrize("damage", ["truncate", "flip", "empty", "other"])
def test_a_damaged_cache_file_is_replaced(pair_folder: Path, damage: str, sphere_predictor) -> None:
    predictor = sphere_predictor()
    first = predict(pair_folder, predictor, height=HEIGHT)
    (file,) = (pair_folder / ".pansplat").iterdir()
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 4
    damaged = {"truncate": file.read_bytes()[:-9], "flip": bytes(content), "empty": b"", "other": b"x" * 99}
    file.write_bytes(damaged[damage])
    assert have_equal_gaussians(predict(pair_folder, predictor, height=HEIGHT), first)
    predict(pair_folder, predictor, height=HEIGHT)
    assert predictor.calls == 2


def test_cache_false_reads_and_writes_no_file(pair_folder: Path, sphere_predictor) -> None:
    predictor = sphere_predictor()
    for _ in range(2):
        predict(pair_folder, predictor, height=HEIGHT, cache=False)
    assert predictor.calls == 2 and not (pair_folder / ".pansplat").exists()


def test_a_read_only_pair_is_cached_in_the_users_cache_folder(
    pair_folder: Path, tmp_path: Path, sphere_predictor
) -> None:
    # A file in place of the folder makes it unwritable, for root too.
    (pair_folder / ".pansplat").write_text("")
    predictor = sphere_predictor()
    first = predict(pair_folder, predictor, height=HEIGHT)
    assert have_equal_gaussians(predict(pair_folder, predictor, height=HEIGHT), first)
    assert predictor.calls == 1
    assert len(list((tmp_path / "cache" / "pansplat").rglob("*.scene"))) == 1


def test_predict_works_without_a_writable_cache_folder(pair_folder, tmp_path, sphere_predictor) -> None:
    (pair_folder / ".pansplat").write_text("")
    (tmp_path / "cache").write_text("")
    assert len(predict(pair_folder, sphere_predictor(), height=HEIGHT).gaussians)


def test_loaded_views_are_not_cached(pair_folder: Path, sphere_predictor) -> None:
    predictor = sphere_predictor()
    pair = load_pairs(pair_folder)[0]
    views = pair.load_context(HEIGHT)
    assert have_equal_gaussians(predict(views, predictor), predict(pair, predictor, height=HEIGHT, cache=False))
    assert not any(folder.exists() for folder in list_cache_folders(pair))


@pytest.fixture
def gray_pair(pair_folder: Path) -> Path:
    """Photographs of different exposure, which a refinement finds."""
    for name, gray in (("left.png", 90), ("right.png", 140)):
        Image.new("L", (2 * HEIGHT, HEIGHT), gray).convert("RGB").save(pair_folder / name)
    return pair_folder


@pytest.mark.usefixtures("refinement_clock")
def test_a_refined_scene_is_cached_apart_from_its_prediction(
    gray_pair: Path, sphere_predictor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipeline, "time", SimpleNamespace(process_time=itertools.count(step=100).__next__))
    predictor, shown = sphere_predictor(), []
    first = predict(gray_pair, predictor, height=HEIGHT, refine_seconds=1.0, on_predicted=shown.append)
    again = predict(gray_pair, predictor, height=HEIGHT, refine_seconds=1.0, on_predicted=shown.append)
    assert have_equal_gaussians(first, again) and predictor.calls == 1
    assert len(first.gains) == 2 and again.gains == first.gains
    prediction = predict(gray_pair, predictor, height=HEIGHT)
    assert not have_equal_gaussians(first, prediction) and predictor.calls == 1
    assert len(shown) == 2 and all(have_equal_gaussians(scene, prediction) for scene in shown)
    assert len(list((gray_pair / ".pansplat").iterdir())) == 2


@pytest.mark.usefixtures("refinement_clock")
def test_a_refinement_that_load_has_starved_is_run_once_more(
    gray_pair: Path, sphere_predictor, monkeypatch: pytest.MonkeyPatch
) -> None:
    work: list[str] = []

    def refine(processor_seconds: float, **limit: float) -> Scene:
        clock = SimpleNamespace(process_time=itertools.count(step=processor_seconds).__next__)
        monkeypatch.setattr(pipeline, "time", clock)
        work.clear()
        report = lambda what, _: work.append(what)  # noqa: E731
        return predict(gray_pair, sphere_predictor(), height=HEIGHT, refine_seconds=1.0, progress=report)

    first = refine(0.1)
    second = refine(0.1)  # starved again, and a run of as many steps
    assert "refining" in work and have_equal_gaussians(first, second)
    refine(0.1)
    assert work == ["read from the cache"]
    shutil.rmtree(gray_pair / ".pansplat")
    for _ in range(2):
        refine(100.0)
    assert work == ["read from the cache"], "a run that had the processor is kept"


@pytest.mark.usefixtures("refinement_clock")
def test_an_interrupted_refinement_is_not_cached(pair_folder: Path, sphere_predictor) -> None:
    def interrupt(what: str, fraction: float) -> None:
        if what == "refining" and fraction > 0.6:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        predict(pair_folder, sphere_predictor(), height=HEIGHT, refine_seconds=3.0, progress=interrupt)
    assert len(list((pair_folder / ".pansplat").iterdir())) == 1  # the prediction


@pytest.mark.parametrize("seconds", [-1.0, float("nan"), float("inf")])
def test_an_invalid_time_limit_of_the_refinement_is_refused(pair_folder: Path, sphere_predictor, seconds) -> None:
    with pytest.raises(InputError, match="`refine_seconds` must be at least 0"):
        predict(pair_folder, sphere_predictor(), height=HEIGHT, refine_seconds=seconds)


def test_an_invalid_limit_of_gaussians_is_refused_before_the_prediction(pair_folder: Path, sphere_predictor) -> None:
    predictor = sphere_predictor()
    with pytest.raises(InputError, match="`gaussians` must be at least 1"):
        predict(pair_folder, predictor, height=HEIGHT, refine_seconds=3.0, gaussians=0)
    assert predictor.calls == 0


@pytest.mark.parametrize(
    "names", [("客厅", "卧室"), ("a" * 60 + "b", "a" * 60 + "c"), ("a b", "a_b"), ("\udcff\udcfe", "\udcff_")]
)
def test_pairs_of_similar_names_share_a_cache_folder(pair_folder: Path, sphere_predictor, names) -> None:
    predictor = sphere_predictor()
    (pair,) = load_pairs(pair_folder)
    first, second = (dataclasses.replace(pair, name=name, far=pair.far + k) for k, name in enumerate(names))
    for given in (first, second, first):
        predict(given, predictor, height=HEIGHT)
    assert predictor.calls == 2


def test_unfinished_files_of_killed_processes_are_removed(tmp_path: Path) -> None:
    code = (
        "import os, sys\nfrom pansplat.system.atomic import replacing\n"
        "with replacing(sys.argv[1]) as file:\n    file.write_bytes(b'half')\n    os.kill(os.getpid(), 9)\n"
    )
    for name in ("old.scene", "new.scene"):
        subprocess.run([sys.executable, "-c", code, tmp_path / name], check=False)
    (tmp_path / ".keep").write_text("")
    old, new = (next(tmp_path.glob(f".{name}.*.scene")) for name in ("old", "new"))
    for file in (old, tmp_path / ".keep"):
        os.utime(file, (1e9, 1e9))
    written = write_cache_file([tmp_path], "a.scene", b"whole")
    assert set(tmp_path.iterdir()) == {written, new, tmp_path / ".keep"}
