"""From panorama files to poses: the shipped sample, and input that cannot be used."""

import json
import math
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

import pansplat
from pansplat.cli import run
from pansplat.data.poses import read_trajectory
from pansplat.poses.axes import SceneAxes
from pansplat.poses.estimate import PoseEstimate, _is_mirrored, _View, estimate_poses
from pansplat.poses.features import detect_features
from pansplat.poses.files import write_poses
from pansplat.poses.solvers import angle_between, rotation_angle

SAMPLE = Path(__file__).resolve().parents[2] / "assets" / "living_room"


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample's pictures at a small size, without poses."""
    folder = tmp_path_factory.mktemp("photographs")
    for name in ("left", "right"):
        image = cv2.imread(str(SAMPLE / f"{name}.jpg"))
        cv2.imwrite(str(folder / f"{name}.png"), cv2.resize(image, (1024, 512), interpolation=cv2.INTER_AREA))
    return folder


@pytest.fixture(scope="module")
def estimate(photographs: Path) -> PoseEstimate:
    """The estimate of the sample; one picture is given twice."""
    images = sorted(photographs.glob("*.png"))
    return estimate_poses([*images, images[0]], camera_height=1.5)


@pytest.mark.slow
def test_the_sample_has_its_poses(estimate: PoseEstimate) -> None:
    content = json.loads((SAMPLE / "poses.json").read_text())["poses"]
    truth = {}
    for name in ("left", "right"):
        entry = content[f"{name}.jpg"]
        truth[name] = np.array(entry["cam2world"] if isinstance(entry, dict) else entry)
    found = {path.stem: pose for path, pose in estimate.poses.items()}
    motions = [np.linalg.inv(poses["right"]) @ poses["left"] for poses in (found, truth)]
    assert math.degrees(rotation_angle(motions[0][:3, :3] @ motions[1][:3, :3].T)) < 0.05
    assert math.degrees(angle_between(motions[0][:3, 3], motions[1][:3, 3])) < 0.3
    assert np.linalg.norm(motions[0][:3, 3]) == pytest.approx(np.linalg.norm(motions[1][:3, 3]), rel=0.05)


@pytest.mark.slow
def test_written_poses_are_read_back(estimate: PoseEstimate, photographs: Path, tmp_path: Path) -> None:
    shutil.copytree(photographs, tmp_path / "photographs")
    write_poses(estimate, photographs / "poses.json")
    (pair,) = pansplat.load_pairs(photographs)
    (photographs / "poses.json").unlink()
    for panorama in pair.context:
        assert np.allclose(panorama.cam2world.numpy(), estimate.poses[panorama.image], atol=1e-8)
    assert (pair.near, pair.far) == pytest.approx((estimate.near, estimate.far), abs=1e-3)
    for suffix in ("tum", "kitti"):
        write_poses(estimate, tmp_path / f"poses.{suffix}")
        trajectory = read_trajectory(tmp_path / f"poses.{suffix}")
        assert trajectory.kind == suffix
        for read, pose in zip(trajectory.poses, estimate.poses.values(), strict=True):
            assert np.allclose(read.numpy(), pose, atol=1e-6)


@pytest.mark.slow
def test_a_folder_without_poses_is_loaded_with_estimated_ones(
    photographs: Path, estimate: PoseEstimate, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pansplat.poses.files.estimate_poses", lambda images, **options: estimate)
    message = "has no poses; they were estimated: 2 of 2 panoramas"
    with pytest.warns(UserWarning, match=message):
        (pair,) = pansplat.load_pairs(photographs)
    assert sorted(panorama.name for panorama in pair.context) == ["left", "right"]
    assert not (photographs / "poses.json").exists()
    monkeypatch.setattr("pansplat.poses.files.estimate_poses", None)  # the second call reads the cache
    with pytest.warns(UserWarning, match=message):
        (again,) = pansplat.load_pairs(photographs)
    assert all((a.cam2world == b.cam2world).all() for a, b in zip(pair.context, again.context, strict=True))


def _message(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """What a refused `pansplat` command prints, in one line."""
    assert run(list(arguments)) == 2
    return " ".join(capsys.readouterr().err.split())


def test_pictures_without_texture_have_no_poses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, grey in (("a", 90), ("b", 160)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.full((64, 128, 3), grey, np.uint8))
    message = _message(capsys, "pose", str(tmp_path), "-o", str(tmp_path / "poses.json"))
    assert "no poses were found" in message and "a.png" in message and "b.png" in message
    assert not (tmp_path / "poses.json").exists()


def test_an_ordinary_picture_is_not_taken_for_a_panorama(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ramp = np.tile(np.linspace(20, 230, 128), (64, 1))
    shades = 20 * np.sin(np.arange(64) / 5)[:, None]
    for n in range(2):
        cv2.imwrite(str(tmp_path / f"{n}.png"), (ramp[:, :: 1 - 2 * n] + shades).clip(0, 255).astype(np.uint8))
    assert _message(capsys, "pose", str(tmp_path)).count("its left and right edges do not join") == 2


def test_one_picture_and_unknown_formats_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((64, 128, 3), np.uint8))
    assert "needed two or more panoramas, got 1" in _message(capsys, "pose", str(tmp_path))
    assert "--out must end in .json, .tum, .kitti" in _message(capsys, "pose", str(tmp_path), "-o", "poses.xml")
    assert "got no such path" in _message(capsys, "pose", str(tmp_path / "none"))


def test_a_name_that_is_not_utf8_is_refused_before_the_estimate(tmp_path: Path, capsys) -> None:
    for name in (b"left.png", b"\xff.png"):
        cv2.imwrite(str(tmp_path / "image.png"), np.full((64, 128, 3), 90, np.uint8))
        (tmp_path / "image.png").rename(tmp_path / os.fsdecode(name))
    for command in ("pose", "check"):
        assert "needed a name in UTF-8, got '\\udcff.png'; rename it" in _message(capsys, command, str(tmp_path))


def test_a_mirror_image_of_symmetric_things_is_recognised() -> None:
    """Symmetric furniture gives a mirrored picture a pose with many matches."""
    views = {}
    for name in ("left", "right", "mirrored"):
        image = cv2.imread(str(SAMPLE / f"{name.replace('mirrored', 'right')}.jpg"), cv2.IMREAD_GRAYSCALE)
        image = cv2.resize(image, (768, 384), interpolation=cv2.INTER_AREA)
        image = image[:, ::-1].copy() if name == "mirrored" else image
        features = detect_features(image, count=2500)
        views[name] = _View(features, features, SceneAxes(np.eye(3), False, False), image)
    assert _is_mirrored(views["left"], views["mirrored"])
    assert not _is_mirrored(views["left"], views["right"])
    assert not _is_mirrored(views["left"], views["left"])
