"""Cube faces become the equirectangular panorama of the same scene, without seams, from the smallest good level."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from refusals import expect_error

from pansplat.images.cube_images import COLUMN, ROW, CubeImage, CubeLevel, equirect_from_faces, write_cube
from pansplat.images.image_files import read_height, read_panorama, read_pixels, read_thumbnail


@pytest.fixture
def cube(tmp_path: Path, write_tiles) -> CubeImage:
    """A cube of two levels; the larger one has partial tiles."""
    levels = []
    for size, tile in ((16, 16), (40, 16)):
        write_tiles(size, tile, lambda face, row, column, s=size: tmp_path / f"{s}/{face}/{row}_{column}.jpg")
        faces = tuple(f"{size}/{face}/{ROW}_{COLUMN}.jpg" for face in "frblud")
        levels.append(CubeLevel(size, tile, faces))
    return CubeImage(tmp_path, tuple(levels))


@pytest.mark.parametrize(("size", "height"), [(64, 128), (256, 64), (20, 33), (16, 90), (9, 4)])
def test_a_panorama_of_faces_shows_every_direction_at_its_place(size, height, color_face, check_colors) -> None:
    panorama = equirect_from_faces([color_face(face, size) for face in "frblud"], height)
    assert panorama.shape == (height, 2 * height, 3)
    check_colors(torch.from_numpy(panorama).permute(2, 0, 1) / 255, tolerance=3 if height > 4 else 15)


@pytest.mark.parametrize("height", [1, 2, 3])
def test_tiny_panoramas_have_right_and_left_at_their_sides(height: int, color_face) -> None:
    panorama = equirect_from_faces([color_face(face, 8) for face in "frblud"], height)
    left, right = np.array_split(panorama[..., 0].astype(float), 2, axis=1)
    assert panorama.shape == (height, 2 * height, 3) and right.mean() > left.mean() + 30


@pytest.mark.parametrize("size", [16, 24])
def test_there_is_no_seam_between_faces(size: int, color_face) -> None:
    """Second differences along rows and columns, which rounding makes, are 5 where the edge of a face is repeated."""
    panorama = equirect_from_faces([color_face(face, size) for face in "frblud"], 8 * size).astype(np.float32)
    for axis in (0, 1):
        assert np.abs(np.diff(panorama, n=2, axis=axis)).max() <= 3


def test_fine_stripes_do_not_alias_when_a_cube_is_reduced() -> None:
    stripes = np.tile(np.array((0, 255), np.uint8), (512, 256))
    faces = [np.repeat(stripes[..., None], 3, axis=2)] * 6
    assert np.abs(equirect_from_faces(faces, 64).astype(float) - 127.5).max() < 12


def test_the_smallest_level_that_is_enough_is_read(cube: CubeImage, check_colors) -> None:
    read = []

    def decode(path: Path) -> np.ndarray:
        read.append(path.relative_to(cube.folder).parts[0])
        return read_pixels(path)

    for height, level in ((8, "16"), (25, "16"), (26, "40"), (200, "40")):
        read.clear()
        panorama, _ = cube.read(height, decode)
        assert set(read) == {level}
        check_colors(torch.from_numpy(panorama).permute(2, 0, 1) / 255)


def test_a_file_stands_for_the_cube(cube: CubeImage, tmp_path: Path, check_colors) -> None:
    path = write_cube(cube, tmp_path, "hall")
    assert read_height(path) == 80
    image, opaque = read_panorama(path, 80)
    check_colors(image)
    assert opaque.all()
    check_colors(read_thumbnail(path, 16))


def test_the_file_changes_with_the_pictures_only(cube: CubeImage, tmp_path: Path) -> None:
    path = write_cube(cube, tmp_path, "hall")
    os.utime(path, ns=(1, 1))
    assert write_cube(cube, tmp_path, "hall").stat().st_mtime_ns == 1
    os.utime(tmp_path / "40/d/2_2.jpg", ns=(5, 5))
    assert write_cube(cube, tmp_path, "hall").stat().st_mtime_ns != 1


def test_cubes_of_one_name_and_folder_have_files_of_their_own(cube: CubeImage, tmp_path: Path, check_colors) -> None:
    file = write_cube(cube, tmp_path, "room")
    faces = tuple(face.replace("f/", "b/") for face in cube.levels[0].faces)
    other = write_cube(CubeImage(tmp_path, (CubeLevel(16, 16, faces),)), tmp_path, "room")
    assert other.name == file.name == "room.cube.json" and other != file
    check_colors(read_panorama(file, 64)[0], tolerance=6)
    assert write_cube(cube, tmp_path, "room") == file


def test_missing_pictures_are_named(cube: CubeImage, tmp_path: Path) -> None:
    path = write_cube(cube, tmp_path, "hall")
    (tmp_path / "40/l/1_2.jpg").unlink()
    expect_error(r"l/1_2\.jpg: needed a readable image file", read_panorama, path, 80)
