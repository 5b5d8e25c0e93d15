"""From panorama files to poses: the shipped sample, and input that cannot be used."""

import itertools
import math
from dataclasses import replace
from pathlib import Path
from unittest.mock import MagicMock

import cv2
import numpy as np
import pytest
import torch
from refusals import expect_error

from pansplat.cli import run
from pansplat.inputs.folders import load_sets
from pansplat.poses import estimate as estimate_module
from pansplat.poses.axes import SceneAxes
from pansplat.poses.dense import Surroundings
from pansplat.poses.depth import DepthMap
from pansplat.poses.estimate import (
    PoseGroup,
    _find_file,
    _is_mirrored,
    _match,
    _relate_views,
    _View,
    estimate_poses,
)
from pansplat.poses.features import Features, Matches, detect_features
from pansplat.poses.learned import NO_LEARNED, LearnedFeatures
from pansplat.poses.link_directions import NO_LINKS, LinkDirections
from pansplat.poses.solvers import angle_between, rotation_angle
from pansplat.poses.two_view import RelativePose
from pansplat.system.store import Store

SAMPLE = Path(__file__).resolve().parents[2] / "assets" / "living_room"


def _write_sample(folder: Path, *names: str, height: int = 512) -> list[Path]:
    """Pictures of the sample at a small size."""
    files = [folder / f"{name}.png" for name in names]
    for file in files:
        image = cv2.imread(str(SAMPLE / f"{file.stem}.jpg"))
        cv2.imwrite(str(file), cv2.resize(image, (2 * height, height), interpolation=cv2.INTER_AREA))
    return files


@pytest.mark.slow
def test_the_sample_has_its_poses(tmp_path: Path) -> None:
    """One picture is given twice."""
    files = _write_sample(tmp_path, "left", "right")
    found = estimate_poses([*files, files[0]], camera_height=1.5).poses
    views = {view.name: view.cam2world.numpy() for view in load_sets(SAMPLE)[0].context}
    pairs = [found[file] for file in files], [views[name] for name in ("left", "right")]
    motions = [np.linalg.inv(right) @ left for left, right in pairs]
    assert math.degrees(rotation_angle(motions[0][:3, :3] @ motions[1][:3, :3].T)) < 0.05
    assert math.degrees(angle_between(motions[0][:3, 3], motions[1][:3, 3])) < 0.3
    assert np.linalg.norm(motions[0][:3, 3]) == pytest.approx(np.linalg.norm(motions[1][:3, 3]), rel=0.05)


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


def _relation(log_odds: float, problem: str | None = None) -> RelativePose:
    figures = {"score": 90.0, "places": 40.0, "uncertainty": (0.01, 0.01), "distance": 1.0}
    none = np.empty((0, 2), int)
    return RelativePose(np.eye(3), np.eye(3)[0], none, log_odds=log_odds, problem=problem, **figures)


def _view(features: Features, small: np.ndarray, learned: LearnedFeatures = NO_LEARNED) -> _View:
    """A view with unknown walls and depth."""
    depth = DepthMap(np.zeros((48, 96)), np.full((48, 96), 1.0), np.eye(3))
    axes = SceneAxes(np.eye(3), False, False)
    return _View(features, features, learned, axes, small, Surroundings(np.dstack((small,) * 3), depth))


def test_approximate_places_are_sought_from_places_in_camera_heights(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two panoramas in a world of 1.6 m a camera height, the second is 3.2 m ahead and looks to the right."""
    given, files = MagicMock(return_value={}), (Path("a"), Path("b"), Path("c"))
    monkeypatch.setattr(estimate_module, "place_linked", given)
    poses = {Path("a"): np.eye(4), Path("b"): np.eye(4)}
    poses[Path("b")][:3] = ((0, 0, 1, 0), (0, 1, 0, 0), (-1, 0, 0, 3.2))
    views, links = [_view(_no_features(1), np.zeros((4, 8), np.float32))] * 3, {Path("a"): {Path("c"): 0.3}}
    estimate_module._place_linked(views, files, links, [PoseGroup(poses, 0.4, 8.0, 0.0, "a test", 1.6)])
    pieces, passed, (world,) = given.call_args.args
    assert tuple(pieces) == files and passed is links
    assert world[Path("a")] == pytest.approx((0, 0, 0)) and world[Path("b")] == pytest.approx((0, 2, math.pi / 2))


def _no_features(count: int) -> Features:
    return Features(
        np.tile((0.0, 0, 1), (count, 1)), np.zeros((count, 128), np.float32), np.ones(count), np.ones(count)
    )


def test_the_learned_matcher_is_asked_where_sift_hardly_suffices(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    bearings = rng.normal(size=(400, 3))
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    descriptors = rng.uniform(size=(400, 128)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    every = Features(bearings, descriptors, np.ones(400), np.full(400, 1e-3))
    learned = LearnedFeatures(-bearings[:3], torch.zeros(3, 128), torch.zeros(3, 2), (0, 3, 3, 3, 3))
    found = Matches(np.array(((2, 1), (0, 2))), np.array((0.99, 0.4)))
    asked: list[int] = []
    monkeypatch.setattr(
        "pansplat.poses.estimate.match_learned", lambda *_, least_common: asked.append(least_common) or found
    )
    few, many = (_view(every.strongest(count), np.zeros((64, 128), np.float32), learned) for count in (20, 400))
    joined = _match(few, few, object())
    assert len(joined) == 22 and (np.diff(joined.prior) <= 0).all()
    own = joined.indices.min(axis=1) >= 20  # learned features follow those of SIFT
    assert joined.indices[own].tolist() == [[22, 21], [20, 22]] and joined.prior[own].tolist() == [0.7, 0.4]
    assert np.allclose(few.matched.bearings[20:], -bearings[:3]) and len(few.joined) == 43
    assert _match(many, many, object()).indices.max() < 400
    _match(few, few, object(), is_linked=True)
    assert len(asked) == 2 and asked[0] > asked[1] == 0  # a link states that two panoramas have something in common


def test_pairs_are_left_out_within_a_group_that_certain_pairs_connect(monkeypatch: pytest.MonkeyPatch) -> None:
    """Panoramas 0 to 7 are one home and 8 to 10 another one, in which no pair is certain."""
    views = [replace(_view(_no_features(1), np.zeros((4, 8), np.float32)), key=str(n)) for n in range(11)]
    numbers = {id(view.features): n for n, view in enumerate(views)}

    def quick(first: Features, second: Features) -> float:
        i, j = numbers[id(first)], numbers[id(second)]
        return 10.0 + (i > 7) if j > 7 or (i, j) == (0, 7) else 100.0 - i - j

    def relate(first: _View, second: _View, *_: object) -> RelativePose:
        return _relation(math.inf) if int(second.key) < 8 else _relation(0.0, "nothing in common")

    monkeypatch.setattr("pansplat.poses.estimate._quick_overlap", quick)
    monkeypatch.setattr("pansplat.poses.estimate._estimate_pair", relate)
    monkeypatch.setattr("pansplat.poses.estimate._is_mirrored", lambda *_: False)
    monkeypatch.setattr("pansplat.poses.estimate.polish_relative_pose", lambda relation, *_: relation)
    monkeypatch.setattr("pansplat.poses.estimate.match_features", lambda *_: MagicMock())
    monkeypatch.setattr("pansplat.poses.estimate._match", lambda *_, **__: MagicMock())
    links = {pair: NO_LINKS for pair in itertools.combinations(range(11), 2)}
    relations = _relate_views(views, links, MagicMock(), Store(None))
    home = {pair for pair in relations if pair[1] < 8}
    assert (0, 7) not in home and 12 <= len(home) < 23, "of 28"
    assert all(sum(n in pair for pair in home) >= 4 for n in range(8))
    assert len([pair for pair in relations if pair[0] > 7]) == 3, "nothing is left out without certain pairs"
    linked = links | {(0, 7): LinkDirections(back=0.5)}
    assert (0, 7) in _relate_views(views, linked, MagicMock(), Store(None))


def test_a_mirror_image_of_symmetric_things_is_recognised(few_samples: None) -> None:
    """Symmetric furniture gives a mirrored picture a pose with many matches."""
    views = {}
    for name in ("left", "right", "mirrored"):
        image = cv2.imread(str(SAMPLE / f"{name.replace('mirrored', 'right')}.jpg"), cv2.IMREAD_GRAYSCALE)
        image = cv2.resize(image, (768, 384), interpolation=cv2.INTER_AREA)
        image = image[:, ::-1].copy() if name == "mirrored" else image
        features = detect_features(image).strongest(2500)
        views[name] = _view(features, image.astype(np.float32) / 255)
    assert _is_mirrored(views["left"], views["mirrored"])
    assert not _is_mirrored(views["left"], views["right"])
    assert not _is_mirrored(views["left"], views["left"])


def test_poses_of_pictures_outside_of_their_folder_are_refused_before_the_estimate(tmp_path, capsys, monkeypatch):
    (tmp_path / "room").mkdir()
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(tmp_path / "room" / name), np.full((64, 128, 3), 90, np.uint8))
    monkeypatch.setattr("pansplat.poses.estimate.estimate_poses", lambda *_, **__: pytest.fail("estimated"))
    (tmp_path / "other").mkdir()
    message = _message(capsys, "pose", str(tmp_path / "room"), "-o", str(tmp_path / "other" / "poses.json"))
    assert "poses.json: needed a file inside" in message and "copy the picture into the folder" in message


@pytest.mark.usefixtures("few_samples")
def test_a_further_panorama_costs_its_own_features_and_pairs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files, calls = _write_sample(tmp_path, "left", "middle", "right", height=256), []
    for name in ("find_axes", "_estimate_pair"):
        function = getattr(estimate_module, name)
        monkeypatch.setattr(
            estimate_module, name, lambda *a, _f=function, _n=name, **k: calls.append(_n) or _f(*a, **k)
        )
    first = estimate_poses(files[:2], cache_folder=tmp_path)
    assert calls.count("find_axes") == 2
    calls.clear()
    every = estimate_poses(files, cache_folder=tmp_path)
    assert calls.count("find_axes") == 1 and calls.count("_estimate_pair") <= 2 + 1, "one may be of a mirror image"
    calls.clear()
    again = estimate_poses(files, cache_folder=tmp_path)
    assert calls == [] and all(np.array_equal(again.poses[file], every.poses[file]) for file in files)
    assert set(first.poses) < set(again.poses)


def test_a_baseline_by_a_name_of_two_files_is_refused(tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("left.jpg", "left.png", "right.png")]
    names = dict.fromkeys(files, "")
    assert [_find_file(name, files, names, "the images") for name in ("left.png", files[0], "right")] == [1, 0, 2]
    expect_error(r"left\.jpg, .*left\.png", _find_file, "left", files, names, "the images")
