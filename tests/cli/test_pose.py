"""`pansplat pose` replaces nothing that it did not write, and key frames without a pose are not lost."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pansplat.cli import run
from pansplat.images.image_files import write_image
from pansplat.images.video import write_video
from pansplat.inputs.folders import load_pairs
from pansplat.inputs.photographs import list_photographs
from pansplat.poses.estimate import NoPosesError, PoseEstimate, PoseGroup

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


def _photograph(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (64, 128, 3), np.uint8)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for number, name in enumerate("ab"):
        Image.fromarray(_photograph(number)).save(tmp_path / f"{name}.png")
    return tmp_path


def _refuse(*args, **options) -> PoseEstimate:
    raise AssertionError("nothing may be estimated")


def _place_two(images, **options) -> PoseEstimate:
    poses = {image: np.eye(4) for image in images[:2]}
    poses[images[1]][0, 3] = 1
    rest = dict.fromkeys(images[2:], "no door")
    return PoseEstimate(tuple(images), (PoseGroup(poses, 0.4, 8.0, 0.0, "a test"),), rest, {})


@pytest.fixture
def estimator(monkeypatch):
    """Sets the function that estimates poses."""
    return lambda function: monkeypatch.setattr("pansplat.poses.files.estimate_poses", function)


def test_measured_poses_of_all_panoramas_are_an_error_before_the_estimate(folder: Path, estimator, capsys) -> None:
    file = folder / "poses.json"
    poses = {f"{name}.png": np.eye(4).tolist() for name in "ab"}
    file.write_text(json.dumps({"convention": "cam2world opencv", "poses": poses}))
    before = file.read_bytes()
    estimator(_refuse)
    assert run(["pose", str(folder), "-o", str(file)]) == 2
    error = capsys.readouterr().err
    assert "poses.json" in error and "--overwrite" in error
    assert file.read_bytes() == before
    estimator(_place_two)
    assert run(["pose", str(folder), "-o", str(file), "--overwrite"]) == 0
    assert json.loads(file.read_text())["poses"]["b.png"][0][3] == 1
    assert (folder / "poses.json.bak").read_bytes() == before


def test_a_faulty_file_of_poses_is_an_error_before_the_estimate(folder: Path, estimator, capsys) -> None:
    (folder / "poses.json").write_text("[")
    estimator(_refuse)
    assert run(["pose", str(folder), "-o", str(folder / "poses.json"), "--overwrite"]) == 2
    assert "poses.json: needed JSON" in capsys.readouterr().err
    assert (folder / "poses.json").read_text() == "["


@pytest.mark.parametrize("suffix", ["tum", "kitti"])
def test_a_trajectory_is_replaced_with_overwrite_only(folder: Path, estimator, capsys, suffix: str) -> None:
    file = folder / f"walk.{suffix}"
    file.write_text("measured")
    estimator(_refuse)
    assert run(["pose", str(folder), "-o", str(file)]) == 2
    assert "--overwrite" in capsys.readouterr().err and file.read_text() == "measured"
    estimator(_place_two)
    assert run(["pose", str(folder), "-o", str(file), "--overwrite"]) == 0
    assert len(file.read_text().splitlines()) == 2


def test_renderings_beside_photographs_are_given_no_poses(folder: Path, estimator, capsys) -> None:
    write_image(folder / "0_view.png", np.zeros((16, 32, 3), np.uint8))
    estimator(_place_two)
    assert run(["pose", str(folder), "-o", str(folder / "poses.json")]) == 0
    assert list(json.loads((folder / "poses.json").read_text())["poses"]) == ["a.png", "b.png"]
    assert "0_view.png: it was rendered by pansplat" in capsys.readouterr().err


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """A film of noise, of which each frame differs."""
    write_video(tmp_path / "film.mp4", [_photograph(number) for number in range(12)], 12)
    return tmp_path / "film.mp4"


def test_key_frames_that_cannot_be_placed_are_scenes_of_their_own(video: Path, tmp_path: Path, estimator) -> None:
    estimator(_place_two)
    walk = tmp_path / "walk"
    assert run(["pose", str(video), "-o", str(walk), "--frames", "3"]) == 0
    frames = sorted(file.stem for file in walk.glob("*.png"))
    pairs = load_pairs(walk)
    assert len(frames) == 3
    assert [[view.name for view in pair.context] for pair in pairs] == [frames[:2], frames[2:]]
    assert pairs[1].context[0].placement.reason == "no door"


def test_key_frames_without_poses_are_photographs_beside_others(video: Path, tmp_path: Path, estimator) -> None:
    def fail(images, **options) -> PoseEstimate:
        raise NoPosesError(dict.fromkeys(images, "no door"))

    estimator(fail)
    walk = tmp_path / "walk"
    assert run(["pose", str(video), "-o", str(walk), "--frames", "3"]) == 2
    assert len(list_photographs(walk)) == 3
    Image.fromarray(_photograph(99)).save(walk / "hall.jpg")
    assert len(list_photographs(walk)) == 4


def test_key_frames_replace_no_picture_of_the_user(video: Path, tmp_path: Path, estimator, capsys) -> None:
    estimator(_place_two)
    walk = tmp_path / "walk"
    arguments = ["pose", str(video), "-o", str(walk), "--frames", "3"]
    for _ in range(2):  # its own are replaced
        assert run(arguments) == 0
    own = sorted(walk.glob("*.png"))
    Image.fromarray(np.zeros((64, 128, 3), np.uint8)).save(own[-1])
    states = {file: file.read_bytes() for file in walk.iterdir()}
    assert run(arguments) == 2
    error = capsys.readouterr().err
    assert own[-1].name in error and "--overwrite" in error
    assert {file: file.read_bytes() for file in walk.iterdir()} == states
    assert run([*arguments, "--overwrite"]) == 0
    assert own[-1].read_bytes() != states[own[-1]]


def test_key_frames_of_two_films_are_different_files(video: Path, tmp_path: Path, estimator) -> None:
    estimator(_place_two)
    (tmp_path / "stairs.mp4").write_bytes(video.read_bytes())
    for film in (video, tmp_path / "stairs.mp4"):
        assert run(["pose", str(film), "-o", str(tmp_path / "walk"), "--frames", "3"]) == 0
    assert len(list((tmp_path / "walk").glob("*.png"))) == 6
    assert sorted(len(pair.context) for pair in load_pairs(tmp_path / "walk")) == [1, 1, 2, 2]
