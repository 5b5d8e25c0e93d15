"""Photographs of a tour as files: all of them, under distinct names, with what links.json holds."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from panorama_formats import write_posed
from PIL import Image

from pansplat.cli import run
from pansplat.export.panoramas import write_panoramas
from pansplat.export.training_set import write_dataset
from pansplat.images.image_files import read_mask, read_panorama
from pansplat.inputs.folders import load_panoramas


def _write_folder(folder: Path, names: dict[str, int], links: dict[str, object] | None = None) -> None:
    """Grey panoramas with poses."""
    pictures = {name: np.full((64, 128, 3), grey, np.uint8) for name, grey in names.items()}
    write_posed(folder, pictures, range(len(names)))
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


def _count_magenta(file: Path) -> int:
    pixels = np.asarray(Image.open(file).convert("RGB")).astype(int)
    return int((pixels[..., [0, 2]].min(axis=-1) - pixels[..., 1] > 20).sum())


def _write_hidden_magenta(folder: Path) -> None:
    """A grey panorama with magenta under alpha 0, and another one beside it."""
    _write_folder(folder, {"a.png": 100, "b.png": 100})
    pixels = np.full((64, 128, 4), (100, 100, 100, 255), np.uint8)
    pixels[20:40, 30:70] = (255, 0, 255, 0)
    Image.fromarray(pixels).save(folder / "a.png")
    assert _count_magenta(folder / "a.png") > 0


def test_what_alpha_hides_is_in_no_photograph_and_stays_masked(tmp_path: Path) -> None:
    _write_hidden_magenta(tmp_path / "tour")
    assert run(["export", str(tmp_path / "tour"), "-o", str(tmp_path / "out"), "--photos"]) == 0
    files = sorted(file.name for file in (tmp_path / "out").iterdir())
    assert files == ["a.jpg", "a_mask.png", "b.jpg"] and _count_magenta(tmp_path / "out" / "a.jpg") == 0
    first, second = load_panoramas(tmp_path / "out")
    assert first.mask is not None and second.mask is None
    hidden = ~read_mask(first.mask, 64).numpy()
    assert hidden[20:40, 30:70].all() and hidden.sum() == 20 * 40


@pytest.mark.filterwarnings("ignore:.*is transparent")
def test_what_alpha_hides_is_in_no_cube_face_of_a_training_set(tmp_path: Path) -> None:
    _write_hidden_magenta(tmp_path / "tour")
    (tmp_path / "out").mkdir()
    no_points = np.zeros((0, 3))
    write_dataset(tmp_path / "out", load_panoramas(tmp_path / "tour"), (), no_points, no_points.astype(np.uint8))
    faces = list((tmp_path / "out" / "images").iterdir())
    assert len(faces) == 12 and sum(map(_count_magenta, faces)) == 0


def test_a_folder_reads_every_photograph_whatever_its_name_was(tmp_path: Path) -> None:
    names = ["pool_depth", "Depth", "plant_mask", "sky_blur.v2", ".hidden", "hall"]
    _write_folder(tmp_path / "room", {f"{number}.jpg": 40 + 30 * number for number in range(len(names))})
    found = load_panoramas(tmp_path / "room")
    views = [dataclasses.replace(view, name=name) for view, name in zip(found, names, strict=True)]
    (tmp_path / "out").mkdir()
    write_panoramas(tmp_path / "out", views)
    assert sorted(_read_greys(tmp_path / "out").values()) == [40, 70, 100, 130, 160, 190]
    read = {view.name for view in load_panoramas(tmp_path / "out")}
    assert read == {"pool_depth_photo", "Depth_photo", "plant_mask_photo", "sky_blur_v2_photo", "hidden_photo", "hall"}
