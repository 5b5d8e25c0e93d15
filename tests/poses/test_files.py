"""Panoramas without poses: placed ones are a part, each other one is a scene of its own, and the outcome is cached."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from refusals import expect_error

import pansplat
from pansplat.poses.estimate import NoPosesError, PoseEstimate, PoseGroup


def _write(folder: Path, *names: str) -> None:
    for number, name in enumerate(names):
        noise = np.random.default_rng(number).integers(0, 255, (8, 16, 3), np.uint8)
        ramp = cv2.resize(noise, (128, 64), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(folder / name), ramp)


def _place(*groups: tuple[str, ...]):
    """An estimate that places the files of these names, in metres along x; each group in its own world."""

    def estimate(images, **options) -> PoseEstimate:
        unplaced = {image: f"no door in {image.stem}" for image in images if image.name not in sum(groups, ())}
        if not groups:
            raise NoPosesError(unplaced)
        found = []
        for number, names in enumerate(groups):
            poses = {image: np.eye(4) for image in images if image.name in names}
            for step, pose in enumerate(poses.values()):
                pose[0, 3] = step
            found.append(PoseGroup(poses, 0.3 + number / 10, 7.0 + number, 0.0, "a test"))
        return PoseEstimate(tuple(images), tuple(found), unplaced, {})

    return estimate


def _load(folder: Path) -> list:
    return pansplat.load_sets(folder)


def test_the_panoramas_that_are_not_placed_are_scenes_of_their_own(tmp_path: Path, monkeypatch) -> None:
    _write(tmp_path, "a.png", "b.png", "c.png", "d.png", "e.png")
    (tmp_path / "links.json").write_text(json.dumps({"b.png": {"title": "Bath", "links": [{"to": "c.png", "yaw": 1}]}}))
    monkeypatch.setattr("pansplat.poses.files.estimate_poses", _place(("a.png", "c.png", "d.png")))
    for _ in range(2):
        with pytest.warns(UserWarning) as caught:
            pairs = _load(tmp_path)
        assert [pair.name for pair in pairs] == ["a-c", "c-d", "b", "e"]
        assert [[view.world for view in pair.context] for pair in pairs] == [[0, 0], [0, 0], [1], [2]]
        assert pairs[1].context[1].cam2world[0, 3] == 2 and (pairs[0].near, pairs[0].far) == (0.3, 7.0)
        assert torch.equal(pairs[2].context[0].cam2world, torch.eye(4, dtype=torch.float64))
        assert pairs[2].context[0].title == "Bath" and pairs[2].context[0].links[0].target == "c"
        assert len(pairs[2].siblings) == 5
        messages = [str(warning.message) for warning in caught]
        assert "has no poses; they were estimated: 3 of 5 panoramas have a pose" in messages[0]
        assert "b.png (Bath) has no pose and is a scene of its own: no door in b" in messages[1]
        assert "e.png has no pose" in messages[2]
        monkeypatch.setattr("pansplat.poses.files.estimate_poses", None)  # the second call reads the cache


def test_without_a_folder_to_write_to_estimated_poses_are_used(tmp_path: Path, monkeypatch) -> None:
    _write(tmp_path, "a.png", "b.png", "c.png")
    monkeypatch.setattr("pansplat.poses.files.estimate_poses", _place(("a.png", "b.png")))
    monkeypatch.setattr("pansplat.system.store.write_cache_file", lambda *arguments: None)
    with pytest.warns(UserWarning, match="2 of 3 panoramas"), pytest.warns(UserWarning, match=r"c\.png has no pose"):
        pair, alone = _load(tmp_path)
    assert pair.context[1].cam2world[0, 3] == 1 and alone.context[0].placement.state == "not placed"


def test_groups_are_worlds_of_their_own(tmp_path: Path, monkeypatch) -> None:
    _write(tmp_path, "a.png", "b.png", "c.png", "d.png", "e.png", "f.png")
    place = _place(("b.png", "d.png", "f.png"), ("a.png", "e.png"))
    monkeypatch.setattr("pansplat.poses.files.estimate_poses", place)
    for _ in range(2):
        with pytest.warns(UserWarning) as caught:
            pairs = _load(tmp_path)
        assert [pair.name for pair in pairs][1:] == ["d-f", tmp_path.name, "c"]
        assert [[view.world for view in pair.context] for pair in pairs] == [[0, 0], [0, 0], [1, 1], [2]]
        assert [view.name for view in pairs[2].context] == ["a", "e"] and pairs[2].context[1].cam2world[0, 3] == 1
        assert [(pair.near, pair.far) for pair in pairs[1:3]] == [(0.3, 7), (0.4, 8)]
        assert "5 of 6 panoramas have a pose in 2 groups" in str(caught[0].message) and len(caught) == 2
        monkeypatch.setattr("pansplat.poses.files.estimate_poses", None)  # the second call reads the cache


def _write_links(folder: Path, yaw: float | None) -> None:
    links = [] if yaw is None else [{"to": "b.png", "yaw": yaw}]
    (folder / "links.json").write_text(json.dumps({"a.png": {"title": "Hall", "links": links}}))


@pytest.mark.parametrize(
    ("change", "yaw"),
    [
        (lambda folder: _write_links(folder, -0.5), -0.5),
        (lambda folder: _write_links(folder, None), None),
        (lambda folder: _write(folder, "b.png", "a.png"), 1.5),
        (lambda folder: (folder / "b.png").rename(folder / "c.png"), None),
        (lambda folder: cv2.imwrite(str(folder / "mask.png"), np.full((8, 16), 255, np.uint8)), 1.5),
    ],
    ids=["link", "no link", "picture", "name", "mask"],
)
@pytest.mark.filterwarnings("ignore")
def test_links_are_given_to_the_estimate_and_what_changes_is_estimated_anew(tmp_path, monkeypatch, change, yaw) -> None:
    given = []

    def estimate(images, *, links, **options) -> PoseEstimate:
        given.append({image.name: {target.name: yaw for target, yaw in own.items()} for image, own in links.items()})
        return _place(("a.png", "b.png", "c.png"))(images)

    _write(tmp_path, "a.png", "b.png")
    _write_links(tmp_path, 1.5)
    monkeypatch.setattr("pansplat.poses.files.estimate_poses", estimate)
    for act in (lambda folder: None, lambda folder: None, change):
        act(tmp_path)
        assert len(_load(tmp_path)) == 1
    assert [own["a.png"].get("b.png") for own in given] == [1.5, yaw]


def test_if_none_is_placed_all_are_scenes_of_their_own(tmp_path: Path, monkeypatch) -> None:
    _write(tmp_path, "a.png", "b.png")
    monkeypatch.setattr("pansplat.poses.files.estimate_poses", _place())
    for _ in range(2):
        with pytest.warns(UserWarning) as caught:
            pairs = _load(tmp_path)
        assert [(pair.name, pair.context[0].world) for pair in pairs] == [("a", 0), ("b", 1)]
        assert [f"{name}.png has no pose" in str(w.message) for name, w in zip("ab", caught, strict=True)] == [True] * 2
        monkeypatch.setattr("pansplat.poses.files.estimate_poses", None)


def test_the_mask_of_cube_faces_is_used(tmp_path: Path, monkeypatch) -> None:
    for number, (name, face) in enumerate((name, face) for name in "ab" for face in "frblud"):
        noise = np.random.default_rng(number).integers(0, 255, (8, 8, 3), np.uint8)
        cv2.imwrite(str(tmp_path / f"{name}_{face}.png"), cv2.resize(noise, (128, 128), interpolation=cv2.INTER_CUBIC))
    mask = np.full((16, 32), 255, np.uint8)
    mask[8:] = 0
    cv2.imwrite(str(tmp_path / "b_mask.png"), mask)
    shown = []

    def detect(pixels, scene, **options) -> None:
        shown.append(float(scene.mean()))
        raise InterruptedError

    monkeypatch.setattr("pansplat.poses.estimate.detect_features", detect)
    with pytest.raises(InterruptedError):
        _load(tmp_path)
    assert sorted(shown)[0] == 0.5


def test_a_picture_that_looks_whole_and_cannot_be_decoded_is_left_out(tmp_path: Path) -> None:
    _write(tmp_path, "a.png", "b.jpg", "c.png")
    content = (tmp_path / "b.jpg").read_bytes()
    table = content.index(b"\xff\xc4") + 5  # numbers of codes of each length
    (tmp_path / "b.jpg").write_bytes(content[:table] + bytes([255] * 16) + content[table + 16 :])
    with pytest.warns(UserWarning) as caught:
        pairs = _load(tmp_path)
    assert [pair.name for pair in pairs] == ["a", "c"]
    messages = [str(warning.message) for warning in caught]
    assert any("b.jpg cannot be read and is left out: needed a complete image" in message for message in messages)
    assert any("a.png has no pose and is a scene of its own" in message for message in messages)


def test_if_no_picture_can_be_read_the_reasons_are_an_error(tmp_path: Path) -> None:
    _write(tmp_path, "a.png", "b.png")
    for name in ("a.png", "b.png"):
        (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:-30])
    expect_error(r"a\.png: needed a complete image.*; .*b\.png: needed a complete image", _load, tmp_path)


def test_the_panoramas_of_a_web_tour_keep_titles_links_and_start_views(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "img").mkdir()
    _write(tmp_path / "img", "a.png", "b.png", "c.png")
    spots = [{"type": "scene", "yaw": 90, "pitch": -20, "sceneId": "bath", "text": "to the bath"}]
    scenes = {
        "hall": {"title": "Hall", "panorama": "img/a.png", "hotSpots": spots, "yaw": 10},
        "attic": {"title": "Attic", "panorama": "img/b.png", "hotSpots": spots},
        "bath": {"title": "Bath", "panorama": "img/c.png"},
    }
    (tmp_path / "tour.json").write_text(json.dumps({"scenes": scenes}))
    monkeypatch.setattr("pansplat.poses.files.estimate_poses", _place(("a.png", "c.png")))
    for path in (tmp_path, tmp_path / "tour.json"):
        with (
            pytest.warns(UserWarning, match=r"a test\. `pansplat pose .*poses\.json` writes them to a file\.$"),
            pytest.warns(UserWarning, match=r"b\.png \(Attic\) has no pose"),
        ):
            pair, attic = pansplat.load_sets(path)
        hall, bath = pair.context
        assert [(view.name, view.label, view.world) for view in (hall, bath)] == [
            ("hall", "Hall", 0),
            ("bath", "Bath", 0),
        ]
        assert hall.links[0].target == "bath" and hall.start is not None and bath.cam2world[0, 3] == 1
        assert (attic.name, attic.context[0].world) == ("attic", 1)
        assert (attic.context[0].links[0].target, attic.context[0].links[0].text) == ("bath", "to the bath")
        assert attic.folder == tmp_path
