"""What all formats of panoramas have in common, whatever is wrong with their files."""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
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

from pansplat.errors import InputError, collect_notes
from pansplat.images.image_files import list_pictures
from pansplat.images.rig_images import Lens, RigImage, RigView, write_rig
from pansplat.inputs.folders import list_stated_files, load_collections, load_pairs, load_panoramas
from pansplat.inputs.formats import FORMATS
from pansplat.inputs.pairs import Note, Panorama
from pansplat.inputs.photographs import write_notes
from pansplat.inputs.stated_files import find_inside, locate_inside

NAMES = ("a.png", "b.png")
OUTSIDE = "needed a file inside .*room, got the path"
JSON = [name for name, example in EXAMPLES.items() if example.stated.endswith((".json", ".js"))]
State = Callable[[Path, list[str]], None]

pytestmark = pytest.mark.filterwarnings("ignore::pansplat.errors.InputWarning")
of_all = pytest.mark.parametrize("example", EXAMPLES.values(), ids=EXAMPLES)
of_files = pytest.mark.parametrize(
    "example", [e for e in EXAMPLES.values() if e.stated != "b_f.png"], ids=[k for k in EXAMPLES if k != "cube faces"]
)


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


def try_to_read(path: Path) -> tuple[dict[Path, Panorama], str]:
    """The panoramas at a path, and all notes and errors."""
    with collect_notes() as notes, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            views = load_panoramas(path)
        except InputError as error:
            return {}, "\n".join([*notes, str(error)])
    return {view.image: view for view in views}, "\n".join(notes)


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
        assert room / example.stated in stated and set(stated) <= set(list_stated_files(room)), "the window watches it"
        opened = [file for file in stated if file.parent == room and file.exists()]
        assert all(read(file)[0].keys() == panoramas.keys() for file in opened)


def test_a_folder_that_is_gone_has_files_to_watch(tmp_path: Path) -> None:
    assert tmp_path / "gone" / "poses.json" in list_stated_files(tmp_path / "gone")


def check_read_or_named(room: Path, example: Example) -> None:
    """Panoramas are read with a note about others, or the file is named."""
    panoramas, text = try_to_read(room / example.opens)
    is_script = example.format == "web tour"  # of equal keys the last one counts
    assert len(panoramas) == 2 or (panoramas and (text or is_script)) or Path(example.stated).name in text


@of_files
def test_a_file_that_is_cut_or_changed_is_read_or_named(room: Path, example: Example) -> None:
    example.state(room, NAMES)
    file = room / example.stated
    content, generator = file.read_bytes(), np.random.default_rng(0)
    for end in (0, 1, len(content) // 3, 2 * len(content) // 3, len(content) - 2):
        file.write_bytes(content[:end])
        check_read_or_named(room, example)
    for _ in range(20):
        changed = bytearray(content)
        for place in generator.integers(0, len(content), 3):
            changed[place] = generator.integers(0, 256)
        file.write_bytes(changed)
        check_read_or_named(room, example)


@pytest.mark.parametrize(
    "content",
    [
        *(b"", b"[]", b"5", b'"a"', b"null", b"true", b"1e999", b"NaN", b"[" * 100_000, b"[" * 100 + b"]" * 100),
        *(b'{"a": ' * 30 + b"1" + b"}" * 30, b'{"\\ud800": 1}', b'{"a\\u0000.png": 1}', b'{"a.png": 1, "a.png": 2}'),
        *("{}".encode("utf-16"), bytes(range(256)), b"{"),
    ],
)
@of_files
def test_a_file_of_other_content_is_named(room: Path, example: Example, content: bytes) -> None:
    example.state(room, NAMES)
    (room / example.stated).write_bytes(content)
    form = next(form for form in FORMATS if form.find(room))
    if form.name == example.format:  # that of Metashape is recognised by its content
        assert Path(example.stated).name in try_to_read(room / example.opens)[1]


def list_fields(content: Any, keys: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """The keys and indices that lead to each value of a JSON document; of lists to the first one."""
    yield keys
    items = (
        content.items() if isinstance(content, dict) else enumerate(content[:1]) if isinstance(content, list) else ()
    )
    for key, value in items:
        yield from list_fields(value, (*keys, key))


def parse(file: Path) -> tuple[str, Any, str]:
    """The JSON document in a file, and what is before and behind it."""
    found = re.fullmatch(r"([^\[{]*)(.*[\]}])(.*)", file.read_text(), re.DOTALL)
    assert found is not None
    return found[1], json.loads(found[2]), found[3]


def write_changed(file: Path, keys: tuple[str | int, ...], value: object, out: Path) -> None:
    """Write a file with another value at some keys."""
    head, content, tail = parse(file)
    top = holder = {"": content}
    for key in ("", *keys)[:-1]:
        holder = holder[key]
    holder[("", *keys)[-1]] = value
    out.write_text(head + json.dumps(top[""]) + tail)


@pytest.mark.parametrize("odd", [{"odd": []}, "odd"])
@pytest.mark.parametrize("name", JSON)
def test_a_value_of_another_type_is_named_with_its_field(room: Path, name: str, odd: object) -> None:
    example, original = EXAMPLES[name], room.parent / "original"
    example.state(room, NAMES)
    shutil.copy(room / example.stated, original)
    for keys in list_fields(parse(original)[1]):
        write_changed(original, keys, odd, room / example.stated)
        panoramas, notes = try_to_read(room / example.opens)
        fields = [key for key in keys if isinstance(key, str)]
        is_named = Path(example.stated).name in notes and (
            not fields or re.search(r"(frame|pose|number) \d|'.*\b[ab]\b", notes)
        )
        assert len(panoramas) == 2 or is_named or any(field in notes for field in fields), (keys, notes)


_SCALARS = (
    *(10**400, 1e300, -1, 0, "../x", "http://x", "a", "a.png", "b.png", "cubemap", "multires", "%s", "{row}", ""),
    *("\ud800", "cam2world opencv", [[1.0, 0, 0, 0]] * 4),
)
_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4) | st.sampled_from(_SCALARS),
    lambda inner: st.lists(inner, max_size=6) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=8,
)


@pytest.mark.parametrize("name", JSON)
@settings(max_examples=40, suppress_health_check=list(HealthCheck))
@given(value=_JSON, seed=st.integers(0, 10**6))
def test_any_value_is_read_or_named(room: Path, name: str, value: object, seed: int) -> None:
    example, original = EXAMPLES[name], room.parent / "original"
    if not original.exists():
        example.state(room, NAMES)
        shutil.copy(room / example.stated, original)
    random.Random(seed).shuffle(fields := list(list_fields(parse(original)[1])))
    write_changed(original, fields[0], value, room / example.stated)
    check_read_or_named(room, example)
    panoramas = try_to_read(room / example.opens)[0]
    names = {view.name for view in panoramas.values()}
    assert all(image.is_file() for image in panoramas)
    assert all(link.target in names for view in panoramas.values() for link in view.links)


@of_files
def test_a_file_that_is_too_large_is_named_and_not_read(room: Path, example: Example) -> None:
    example.state(room, NAMES)
    os.truncate(room / example.stated, 1 << 32)  # without blocks on the disk
    text = try_to_read(room)[1]
    if example.format not in ("web tour", "photographs"):  # as if it were none
        assert re.search(rf"{Path(example.stated).name}.* of at most [\d,]+ bytes, got 4,294", text)


@pytest.mark.parametrize("example", [e for e in EXAMPLES.values() if e.missing is not None])
def test_a_picture_that_is_missing_is_named(room: Path, example: Example) -> None:
    example.state(room, (*NAMES, "gone.png"))
    if example.missing:
        panoramas, _, notes = read(room / example.opens)
        assert len(panoramas) == 2 and "gone" in notes
    else:
        with pytest.raises(InputError, match=r"needed (one pose per image \(2 images\), got 3|rgb\.png|the image map)"):
            read(room / example.opens)


@of_all
def test_a_note_that_is_written_is_read_again(room: Path, example: Example) -> None:
    example.state(room, NAMES)
    path = room / example.opens
    notes: dict[Path, tuple[Note, ...]] = {image: () for image in read(path)[0]}
    for text in ("first", "second"):  # without entries, and with them
        for number, image in enumerate(notes):
            notes[image] += (Note(0.5, -0.25, f"{text} {number}"),)
            file = write_notes(read(path)[0][image], notes[image])
            assert file in list_stated_files(room), "the window watches it"
        assert {image: view.notes for image, view in read(path)[0].items()} == notes


@pytest.mark.parametrize("example", [e for e in EXAMPLES.values() if not e.is_joined])
def test_masks_of_panoramas_are_applied_and_those_of_none_are_refused(room: Path, example: Example) -> None:
    example.state(room, NAMES)
    image = min(read(room)[0])
    write_picture(image.with_name(f"{image.stem}_mask.png"))
    panoramas = read(room)[0]
    assert len(panoramas) == 2 and panoramas[image].mask == image.with_name(f"{image.stem}_mask.png")
    write_picture(image.with_name("nobody_mask.png"))
    with pytest.raises(InputError, match=r"nobody_mask\.png: needed the name of a panorama before _mask\.png"):
        read(room)


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
        with pytest.raises(InputError, match=r"scale\.txt: needed one positive number"):
            load_collections(room)


# Paths that a file states


RECONSTRUCTIONS = [
    state_nerfstudio, state_colmap, state_openmvg, state_openmvg_root, state_opensfm, state_metashape,
]  # fmt: skip


@pytest.mark.parametrize("outside", ["../secret.png", "x/../../secret.png", "{}/secret.png", "..\\secret.png"])
@pytest.mark.parametrize("state", RECONSTRUCTIONS)
def test_pictures_that_lead_out_of_a_reconstruction_are_left_out_with_a_note(
    room: Path, state: State, outside: str
) -> None:
    state(room, [*NAMES, outside.format(room.parent).replace("\\", "/")])
    _, files, notes = read(room)
    assert files == set(NAMES)
    assert "secret.png" in notes and "out of which no path is followed" in notes


def state_mask(folder: Path, names: list[str], key: str = "mask") -> None:
    state_poses(folder, names[:2])
    content = json.loads((folder / "poses.json").read_text())
    content["poses"][names[0]] = {"cam2world": content["poses"][names[0]], key: names[-1]}
    (folder / "poses.json").write_text(json.dumps(content))


def state_depth(folder: Path, names: list[str]) -> None:
    state_mask(folder, names, "depth")


def state_frame_mask(folder: Path, names: list[str]) -> None:
    state_nerfstudio(folder, names[:2])
    content = json.loads((folder / "transforms.json").read_text())
    content["frames"][0]["mask_path"] = names[-1]
    (folder / "transforms.json").write_text(json.dumps(content))


@pytest.mark.parametrize("outside", ["../secret.png", "x/../../secret.png", "{}/secret.png"])
@pytest.mark.parametrize("state", [state_poses, state_mask, state_depth, state_loc360, state_frame_mask])
def test_lists_that_lead_out_of_their_folder_are_refused(room: Path, state: State, outside: str) -> None:
    state(room, [*NAMES, outside.format(room.parent)])
    with pytest.raises(InputError, match=OUTSIDE):
        read(room)


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
    with pytest.raises(InputError, match=OUTSIDE):
        read(room)


def test_pairs_and_links_open_no_files(room: Path) -> None:
    """Their names are those of panoramas that have been read."""
    state_poses(room, NAMES)
    (room / "links.json").write_text(json.dumps({"../secret.png": [], "a.png": [{"to": "../secret.png", "yaw": 0}]}))
    _, files, notes = read(room)
    assert files == set(NAMES) and notes.count("../secret.png") == 2
    pairs = [{"context": NAMES}, {"context": ["a.png", "../secret.png"]}]
    (room / "pairs.json").write_text(json.dumps({"pairs": pairs}))
    with pytest.raises(InputError, match=r"needed images that have a pose in poses\.json, got '\.\./secret\.png'"):
        read(room)


@pytest.mark.parametrize("state", [state_poses, state_loc360])
def test_descriptions_of_assembled_panoramas_are_no_pictures_of_lists(room: Path, state: State) -> None:
    """Such a file names pictures by whole paths; only those that pansplat writes into its cache are read."""
    view = RigView(room.parent / "secret.png", tuple(map(tuple, np.eye(3).tolist())), Lens(64, 64, 64, 32, 128, 64))
    write_rig(RigImage((view,)), room, "x").rename(room / "x.rig.json")
    state(room, [*NAMES, "x.rig.json"])
    with pytest.raises(InputError, match=OUTSIDE):
        read(room)


def test_a_path_inside_is_normal_and_one_outside_is_none(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("")
    assert locate_inside(tmp_path, "b/../a") == tmp_path / "a" == find_inside(tmp_path, "b/../a")
    assert find_inside(tmp_path, "b") is None  # no such file
    for name in ("..", "../x", "/", "a/../../x", "x\0", str(tmp_path.parent / "a")):
        assert find_inside(tmp_path, name) is None
        with pytest.raises(InputError, match="needed a file inside"):
            locate_inside(tmp_path, name)


# Notes


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
    (pair,) = load_pairs(room / "a.png")
    with pytest.raises(InputError, match=r"a\.png: needed a panorama of a folder .* open its folder"):
        write_notes(pair.context[0], [Note(0, 0, "sofa")])
