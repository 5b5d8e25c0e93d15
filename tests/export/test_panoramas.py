"""Photographs of a tour as files: all of them, under distinct names, with what links.json holds."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pansplat.cli import run
from pansplat.images.image_files import read_panorama
from pansplat.inputs.folders import load_panoramas


def _write_folder(folder: Path, names: dict[str, int], links: dict[str, object] | None = None) -> None:
    """Grey panoramas with poses."""
    folder.mkdir()
    for name, grey in names.items():
        Image.fromarray(np.full((64, 128, 3), grey, np.uint8)).save(folder / name)
    poses = {name: [[1, 0, 0, k], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]] for k, name in enumerate(names)}
    (folder / "poses.json").write_text(json.dumps({"convention": "cam2world opencv", "poses": poses}))
    if links:
        (folder / "links.json").write_text(json.dumps(links))


def _read_greys(folder: Path) -> dict[str, int]:
    return {file.name: round(255 * float(read_panorama(file, 64)[0].mean())) for file in folder.glob("*.jpg")}


def test_photographs_of_one_name_are_distinct_files_with_their_own_links(tmp_path: Path, capsys) -> None:
    tour = tmp_path / "tour"
    tour.mkdir()
    for number, name in enumerate(("a", "b")):
        entry = {"links": [{"to": "y", "yaw": 0.5}], "notes": [{"yaw": number, "pitch": 0, "text": name}]}
        _write_folder(tour / name, {"x.jpg": 50 + 100 * number, "y.jpg": 80 + 100 * number}, {"x": entry})
    assert run(["export", str(tour), "-o", str(tmp_path / "out"), "--photos"]) == 0
    shown = capsys.readouterr()
    assert "4 photographs" in shown.out and "left out" not in shown.err
    assert _read_greys(tmp_path / "out") == {"x.jpg": 50, "y.jpg": 80, "b_x.jpg": 150, "b_y.jpg": 180}
    written = {panorama.name: panorama for panorama in load_panoramas(tmp_path / "out")}
    assert [note.text for note in written["x"].notes + written["b_x"].notes] == ["a", "b"]
    assert [link.target for link in written["x"].links + written["b_x"].links] == ["y", "b_y"]


@pytest.mark.parametrize("second", ["left.png", "LEFT.png"])
def test_photographs_whose_names_differ_by_suffix_or_capitals_are_distinct_files(tmp_path: Path, second: str) -> None:
    _write_folder(tmp_path / "room", {"left.jpg": 50, second: 150})
    assert run(["export", str(tmp_path / "room"), "-o", str(tmp_path / "out"), "--photos"]) == 0
    assert _read_greys(tmp_path / "out") == {"left.jpg": 50, f"room_{Path(second).stem}.jpg": 150}
