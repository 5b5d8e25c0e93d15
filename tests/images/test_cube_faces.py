"""Cube faces are recognised by the names of files."""

from pathlib import Path

import pytest
from PIL import Image

from pansplat.images.cube_faces import find_gap, group_faces
from pansplat.images.cube_images import CubeLevel, write_cube
from pansplat.images.image_files import read_panorama

NAMES = {
    "letters": ("f", "r", "b", "l", "u", "d"),
    "words": ("front", "right", "back", "left", "up", "down"),
    "top and bottom": ("front", "right", "back", "left", "top", "bottom"),
    "axes": ("pz", "px", "nz", "nx", "py", "ny"),
    "OpenGL": ("posz", "posx", "negz", "negx", "posy", "negy"),
}


@pytest.mark.parametrize("endings", NAMES.values(), ids=NAMES)
@pytest.mark.parametrize("prefix", ["hall_", "hall-", ""])
def test_six_files_of_one_name_are_a_cube(tmp_path: Path, prefix: str, endings, color_face, check_colors) -> None:
    files = []
    for face, ending in zip("frblud", endings, strict=True):
        files.append(tmp_path / f"{prefix}{ending.upper() if prefix == 'hall-' else ending}.png")
        Image.fromarray(color_face(face, 24)).save(files[-1])
    other = tmp_path / "hall_x.png"
    cubes, rest = group_faces(sorted([*files, other]))
    assert rest == [other]
    assert list(cubes) == ["hall" if prefix else tmp_path.name]
    check_colors(read_panorama(write_cube(*cubes.values(), tmp_path, "cube"), 48)[0])


def test_panoramas_with_names_of_faces_are_no_cube(tmp_path: Path, write_scene) -> None:
    files = [tmp_path / f"{name}.png" for name in NAMES["words"]]
    for file in files:
        write_scene(file, 8)
    assert group_faces(files) == ({}, files)


def test_damaged_faces_and_those_of_several_sizes_are_left_out_with_a_warning(tmp_path: Path, color_face) -> None:
    files = [tmp_path / f"hall_{face}.png" for face in "frblud"]
    for face, file in zip("frblud", files, strict=True):
        Image.fromarray(color_face(face, 8 if face == "u" else 16)).save(file)
    with pytest.warns(UserWarning, match=r"hall_u\.png: needed six square cube faces .* got 8x8"):
        assert group_faces(files) == ({}, [])
    files[2].write_bytes(files[2].read_bytes()[:-30])
    with pytest.warns(UserWarning, match=r"left out: .*hall_b\.png: needed a complete image"):
        assert group_faces(files) == ({}, [])


def test_a_gap_of_a_level_is_a_missing_or_damaged_tile(tmp_path: Path, write_tiles) -> None:
    write_tiles(40, 16, lambda face, row, column: tmp_path / f"40/{face}/{row}_{column}.jpg")
    level = CubeLevel(40, 16, tuple(f"40/{face}/{{row}}_{{column}}.jpg" for face in "frblud"))
    assert find_gap(level, tmp_path) is None
    tile = tmp_path / "40/l/1_2.jpg"
    tile.write_bytes(tile.read_bytes()[:-30])
    assert find_gap(level, tmp_path) == "40/l/1_2.jpg is damaged"
    tile.unlink()
    assert find_gap(level, tmp_path) == "40/l/1_2.jpg is missing"
