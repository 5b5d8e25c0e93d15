"""The watch notices every file that a scene is made from."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pansplat.inputs.folders import load_pairs
from pansplat_viewer.scene.file_watch import FileWatch
from pansplat_viewer.scene.loader import SceneEntry


def _write_cube(folder: Path, name: str) -> None:
    for number, face in enumerate("frblud"):
        noise = np.random.default_rng(number).integers(0, 255, (16, 16, 3), np.uint8)
        Image.fromarray(noise).save(folder / f"{name}_{face}.png")


@pytest.mark.parametrize(
    "name", ["hall_u.png", "hall_mask.png", "links.json", "poses.json", ".pansplat/hall.cube.json"]
)
def test_changed_pictures_masks_links_and_poses_are_noticed(tmp_path: Path, name: str) -> None:
    _write_cube(tmp_path, "hall")
    Image.new("L", (32, 16), 255).save(tmp_path / "hall_mask.png")
    (tmp_path / "links.json").write_text("{}")
    (pair,) = load_pairs(tmp_path)
    watch = FileWatch()
    watch.start(SceneEntry("hall", pair=pair).files)
    watch.look(0.0)
    assert not watch.changed
    with open(tmp_path / name, "a") as file:
        file.write(" ")
    watch.look(10.0)
    assert watch.changed


def test_a_changed_web_tour_and_a_new_panorama_are_noticed(tmp_path: Path) -> None:
    (tmp_path / "img").mkdir()
    Image.fromarray(np.full((16, 32, 3), 90, np.uint8)).save(tmp_path / "img" / "a.png")
    (tmp_path / "tour.json").write_text(json.dumps({"panorama": "img/a.png"}))
    (pair,) = load_pairs(tmp_path)
    for change in (
        lambda: (tmp_path / "tour.json").write_text(json.dumps({"panorama": "img/a.png", "title": "Hall"})),
        lambda: os.link(tmp_path / "img" / "a.png", tmp_path / "img" / "b.png"),
    ):
        watch = FileWatch()
        watch.start(SceneEntry("hall", pair=pair).files)
        change()
        watch.look(0.0)
        assert watch.changed


def test_a_file_that_the_window_writes_hides_no_change_of_another(tmp_path: Path) -> None:
    own, other = tmp_path / "links.json", tmp_path / "poses.json"
    for changed in ((own,), (own, other)):
        for file in (own, other):
            file.write_text("{}")
        watch = FileWatch()
        watch.start([own, other])
        for file in changed:
            file.write_text('{"a": []}')
        watch.skip(own)
        watch.look(0.0)
        assert watch.changed == (other in changed)


def test_many_files_are_looked_at_one_part_a_frame(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("pansplat_viewer.scene.file_watch._FILES", 2)
    files = [tmp_path / str(number) for number in range(5)]
    watch = FileWatch()
    watch.start(files)
    files[0].touch()
    looks = []
    for now in (0.0, 0.1, 0.2, 0.3, 3.0, 3.1, 3.2):
        watch.look(now)
        looks.append(watch.changed)
    assert looks == [False, False, True, True, True, True, True]
    files[0].unlink()
    for now in (9.0, 9.1, 9.2):
        watch.look(now)
    assert not watch.changed
