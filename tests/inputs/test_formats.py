"""What all formats of panoramas have in common (tests/test_input_files.py has their damaged files)."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from panorama_formats import (
    EXAMPLES,
    Example,
    state_archive,
    state_colmap,
    state_loc360,
    state_metashape,
    state_nerfstudio,
    state_openmvg,
    state_openmvg_root,
    state_opensfm,
    state_poses,
    write_picture,
    write_room,
)
from refusals import expect_error

from pansplat.images.image_files import list_pictures
from pansplat.images.rig_images import Lens, RigImage, RigView, write_rig
from pansplat.inputs.folders import load_collections, load_panoramas, load_sets
from pansplat.inputs.formats import FORMATS
from pansplat.inputs.panorama_sets import Note, Panorama
from pansplat.inputs.photographs import write_notes
from pansplat.inputs.stated_files import find_inside, locate_inside

NAMES = ("a.png", "b.png")
OUTSIDE = "needed a file inside .*room, got the path"
State = Callable[[Path, list[str]], None]

pytestmark = pytest.mark.filterwarnings("ignore::pansplat.errors.InputWarning")
of_all = pytest.mark.parametrize("example", EXAMPLES.values(), ids=EXAMPLES)


@pytest.fixture
def room(tmp_path: Path) -> Path:
    """A folder of two panoramas beside a picture that is not in it."""
    write_picture(tmp_path / "secret.png")
    return write_room(tmp_path / "room", NAMES)


def read(path: Path) -> tuple[dict[Path, Panorama], set[str], str]:
    """The panoramas at a path by their images, the names of the files that they are made from, and the notes."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        views = load_panoramas(path)
    files = [file for view in views for file in (*list_pictures(view.image), view.mask, view.depth) if file]
    notes = " ".join(str(warning.message) for warning in caught)
    return {view.image: view for view in views}, {file.resolve().name for file in files}, notes


def test_each_format_has_an_example() -> None:
    assert {example.format for example in EXAMPLES.values()} == {form.name for form in FORMATS}


@of_all
def test_a_format_is_found_first_and_its_files_open_its_panoramas(room: Path, example: Example) -> None:
    example.state(room, NAMES)
    form = next(form for form in FORMATS if form.find(room))
    assert form.name == example.format
    panoramas = read(room / example.opens)[0]
    assert len(panoramas) == 2
    if example.format != "photographs":
        stated = [file for source in form.find(room) for file in form.files(source)]
        assert room / example.stated in stated
        opened = [file for file in stated if file.parent == room and file.exists()]
        assert all(read(file)[0].keys() == panoramas.keys() for file in opened)


@pytest.mark.parametrize("example", [e for e in EXAMPLES.values() if e.missing is not None])
def test_a_picture_that_is_missing_is_named(room: Path, example: Example) -> None:
    example.state(room, (*NAMES, "gone.png"))
    if example.missing:
        panoramas, _, notes = read(room / example.opens)
        assert len(panoramas) == 2 and "gone" in notes
    else:
        expect_error("2 images|rgb.png|the image map", read, room / example.opens)


@of_all
def test_a_note_that_is_written_is_read_again(room: Path, example: Example) -> None:
    example.state(room, NAMES)
    path = room / example.opens
    notes: dict[Path, tuple[Note, ...]] = {image: () for image in read(path)[0]}
    for text in ("first", "second"):  # without entries, and with them
        for number, image in enumerate(notes):
            notes[image] += (Note(0.5, -0.25, f"{text} {number}"),)
            write_notes(read(path)[0][image], notes[image][-1:])
        assert {image: view.notes for image, view in read(path)[0].items()} == notes


@pytest.mark.parametrize("example", [e for e in EXAMPLES.values() if not e.is_joined])
def test_masks_of_panoramas_are_applied_and_those_of_none_are_refused(room: Path, example: Example) -> None:
    example.state(room, NAMES)
    image = min(read(room)[0])
    write_picture(image.with_name(f"{image.stem}_mask.png"))
    panoramas = read(room)[0]
    assert len(panoramas) == 2 and panoramas[image].mask == image.with_name(f"{image.stem}_mask.png")
    write_picture(image.with_name("nobody_mask.png"))
    expect_error(r"nobody_mask\.png: needed the name of a panorama before _mask\.png", read, room)


POSED = [name for name, e in EXAMPLES.items() if e.format not in ("web tour", "photographs")]


@pytest.mark.parametrize("name", [name for name in POSED if name not in ("PanoGRF", "rigs")])  # whose axes are others
def test_a_convention_overrides_that_of_the_format(room: Path, name: str) -> None:
    EXAMPLES[name].state(room, NAMES)
    first, second = (
        load_collections(room, convention=f"{direction} opencv")[0].panoramas[1].cam2world
        for direction in ("cam2world", "world2cam")
    )
    assert torch.allclose(first @ second, torch.eye(4, dtype=torch.float64))


@pytest.mark.parametrize(
    "name", [n for n in POSED if EXAMPLES[n].format not in ("poses.json", "360Loc", "PanoGRF", "game maps")]
)
def test_a_number_in_scale_txt_is_metres_per_unit(room: Path, name: str) -> None:
    EXAMPLES[name].state(room, NAMES)
    places = []
    for text in ("1", "2.5\n"):
        (room / "scale.txt").write_text(text)
        places.append(load_collections(room)[0].panoramas[1].cam2world[:3, 3])
    assert torch.allclose(places[1], 2.5 * places[0]) and places[0].any()
    for text in ("0", "-1", "nan", "inf", "x", "", "1" * 400):
        (room / "scale.txt").write_text(text)
        expect_error(r"scale\.txt: needed one positive number", load_collections, room)


RECONSTRUCTIONS = [
    state_nerfstudio, state_colmap, state_openmvg, state_openmvg_root, state_opensfm, state_metashape,
]  # fmt: skip


@pytest.mark.parametrize("outside", ["{}/secret.png", "..\\secret.png"])
@pytest.mark.parametrize("state", RECONSTRUCTIONS)
def test_pictures_that_lead_out_of_a_reconstruction_are_left_out_with_a_note(room, state, outside) -> None:
    state(room, [*NAMES, outside.format(room.parent).replace("\\", "/")])
    _, files, notes = read(room)
    assert files == set(NAMES)
    assert "secret.png" in notes and "out of which no path is followed" in notes


def state_mask(folder: Path, names: list[str], key: str = "mask") -> None:
    state_poses(folder, names[:2])
    content = json.loads((folder / "poses.json").read_text())
    content["poses"][names[0]] = {"cam2world": content["poses"][names[0]], key: names[-1]}
    (folder / "poses.json").write_text(json.dumps(content))


def state_frame_mask(folder: Path, names: list[str]) -> None:
    state_nerfstudio(folder, names[:2])
    content = json.loads((folder / "transforms.json").read_text())
    content["frames"][0]["mask_path"] = names[-1]
    (folder / "transforms.json").write_text(json.dumps(content))


STATES = state_poses, state_mask, partial(state_mask, key="depth"), state_loc360, state_frame_mask


@pytest.mark.parametrize("outside", ["../secret.png", "{}/secret.png"])
@pytest.mark.parametrize("state", STATES)
def test_lists_that_lead_out_of_their_folder_are_refused(room: Path, state: State, outside: str) -> None:
    state(room, [*NAMES, outside.format(room.parent)])
    expect_error(OUTSIDE, read, room)


def test_whole_paths_inside_of_the_folder_are_read(room: Path) -> None:
    write_picture(room / "c" / "c.png")
    names = [str(room / "a.png"), str(room / "c" / ".." / "b.png"), "c/c.png"]
    for state in (state_poses, *RECONSTRUCTIONS[:3]):
        state(room, names)
        assert read(room)[1] == {"a.png", "b.png", "c.png"}
        next(room.glob("*.json"), room / "sparse").rename(room.parent / state.__name__)


def test_points_outside_of_the_folder_are_not_read(room: Path) -> None:
    lines = "\n".join(f"{x} 0 0" for x in range(200))
    (room.parent / "points.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex 200\n{''.join(f'property float {a}' + chr(10) for a in 'xyz')}"
        f"end_header\n{lines}\n"
    )
    state_nerfstudio(room, NAMES)
    content = json.loads((room / "transforms.json").read_text())
    (room / "transforms.json").write_text(json.dumps(content | {"ply_file_path": "../points.ply"}))
    expect_error(OUTSIDE, read, room)


def test_pairs_and_links_open_no_files(room: Path) -> None:
    """Their names are those of panoramas that have been read."""
    state_poses(room, NAMES)
    (room / "links.json").write_text(json.dumps({"../secret.png": [], "a.png": [{"to": "../secret.png", "yaw": 0}]}))
    _, files, notes = read(room)
    assert files == set(NAMES) and notes.count("../secret.png") == 2
    pairs = [{"context": NAMES}, {"context": ["a.png", "../secret.png"]}]
    (room / "pairs.json").write_text(json.dumps({"pairs": pairs}))
    expect_error(r"needed images that have a pose in poses\.json, got '\.\./secret\.png'", read, room)


@pytest.mark.parametrize("state", [state_poses, state_loc360])
def test_descriptions_of_assembled_panoramas_are_no_pictures_of_lists(room: Path, state: State) -> None:
    """Such a file names pictures by whole paths; only those that pansplat writes into its cache are read."""
    view = RigView(room.parent / "secret.png", tuple(map(tuple, np.eye(3).tolist())), Lens(64, 64, 64, 32, 128, 64))
    write_rig(RigImage((view,)), room, "x").rename(room / "x.rig.json")
    state(room, [*NAMES, "x.rig.json"])
    expect_error(OUTSIDE, read, room)


def test_a_path_inside_is_normal_and_one_outside_is_none(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("")
    assert locate_inside(tmp_path, "b/../a") == tmp_path / "a" == find_inside(tmp_path, "b/../a")
    assert find_inside(tmp_path, "b") is None  # no such file
    for name in ("..", "../x", "/", "a/../../x", "x\0", str(tmp_path.parent / "a")):
        assert find_inside(tmp_path, name) is None
        expect_error("needed a file inside", locate_inside, tmp_path, name)


def test_notes_of_a_marzipano_tour_are_the_same_however_it_is_opened(room: Path) -> None:
    state_archive(room, NAMES)
    first, second = load_panoramas(room)
    (room / "links.json").write_text(json.dumps({"a": {"title": "Ours", "notes": [{"yaw": 1, "text": "lost"}]}}))
    write_notes(second, [Note(0.5, 0, "sofa")])
    for path in (room / "app-files", room / "app-files" / "data.js", room / "app-files" / "index.html"):
        assert [panorama.notes for panorama in load_panoramas(path)] == [(), (Note(0.5, 0, "sofa"),)]
    assert [panorama.notes for panorama in load_panoramas(room)] == [(Note(1, 0, "lost"),), (Note(0.5, 0, "sofa"),)]
    assert load_panoramas(room)[0].label == "Ours" and first.notes == ()


def test_a_name_of_several_panoramas_is_refused_in_links(room: Path) -> None:
    EXAMPLES["equal names"].state(room, NAMES)
    links = {"hall": {"title": "both"}, "up/hall.png": {"title": "one", "links": [{"to": "hall", "yaw": 0}]}}
    (room / "links.json").write_text(json.dumps(links))
    panoramas, _, notes = read(room)
    assert "'hall' is left out: it is the name of several panoramas; give the path" in notes
    assert sorted(panorama.label for panorama in panoramas.values()) == ["hall", "one"]


def test_a_panorama_opened_alone_has_no_file_for_notes(room: Path) -> None:
    (pair,) = load_sets(room / "a.png")
    expect_error(r"a\.png: needed", lambda: write_notes(pair.context[0], [Note(0, 0, "sofa")]))
