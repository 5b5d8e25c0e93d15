"""Photographs as cameras and programs write them: formats, orientation, crops, fisheye, sizes, missing files."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy import ndarray as Array
from panorama_formats import write_posed
from PIL import Image
from refusals import expect_error

from pansplat.errors import InputError, InputWarning
from pansplat.geometry.equirect import pixel_directions
from pansplat.images.image_files import read_panorama, read_size, read_thumbnail
from pansplat.inputs.folders import load_sets

SIZE = 64


@pytest.fixture(scope="module")
def pixels() -> Array:
    """A panorama (H W 3) of smooth colours, 8 bit."""
    return _pixels(SIZE)


def _pixels(height: int) -> Array:
    rays = pixel_directions(height, 2 * height, dtype=torch.float64).numpy()
    return np.rint(127.5 + 100 * rays).astype(np.uint8)


def _check(path: Path, pixels: Array, tolerance: float) -> None:
    assert read_size(path) == (2 * SIZE, SIZE)
    image, opaque = read_panorama(path, SIZE)
    assert opaque.all()
    assert np.abs(image.permute(1, 2, 0).numpy() * 255 - pixels).max() <= tolerance
    assert read_thumbnail(path, SIZE // 2).shape == (3, SIZE // 2, SIZE)
    (pair,) = load_sets(path)
    assert pair.image_height == SIZE


@pytest.mark.parametrize("compression", [None, "tiff_lzw", "tiff_adobe_deflate"])
def test_tiff_of_8_bits_is_read(tmp_path: Path, pixels: Array, compression: str | None) -> None:
    Image.fromarray(pixels).save(tmp_path / "a.tif", compression=compression)
    _check(tmp_path / "a.tif", pixels, 0.01)


@pytest.mark.parametrize("name", ["a.tiff", "a.png"])
def test_16_bits_are_read_at_full_precision(tmp_path: Path, pixels: Array, name: str) -> None:
    deep = pixels.astype(np.uint16) * 257 + 3  # no 8-bit value
    cv2.imwrite(str(tmp_path / name), deep[..., ::-1])
    _check(tmp_path / name, pixels, 0.02)
    image = read_panorama(tmp_path / name, SIZE)[0].permute(1, 2, 0).numpy()
    assert np.abs(image * 65535 - deep).max() < 0.1
    (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:-200])
    expect_error("needed a complete image, got damaged or truncated data", read_panorama, tmp_path / name, SIZE)


def test_tiff_of_floating_point_numbers_is_refused(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.tif"), np.full((16, 32, 3), 0.5, np.float32))
    expect_error(r"a\.tif: needed", read_panorama, tmp_path / "a.tif", 16)


KINDS = "jpg", "png", "tif", "webp"  # Pillow turns these
ORIENT: dict[int, Callable[[Array], Array]] = {  # how a picture is stored for each EXIF orientation
    1: lambda a: a,
    3: lambda a: np.rot90(a, 2),
    6: lambda a: np.rot90(a, 1),
    8: lambda a: np.rot90(a, -1),
    2: lambda a: a[:, ::-1],
    5: lambda a: a.swapaxes(0, 1),
}


@pytest.mark.parametrize(
    ("name", "orientation"),
    [*((f"deep.{kind}", each) for kind in ("png", "tif") for each in ORIENT), *((f"a.{k}", 6) for k in KINDS)],
)
def test_exif_orientation_is_applied(tmp_path: Path, pixels: Array, name: str, orientation: int) -> None:
    stored = np.ascontiguousarray(ORIENT[orientation](pixels))
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = tmp_path / name
    if name == "deep.png":
        cv2.imwrite(str(path), stored[..., ::-1].astype(np.uint16) * 257)
        _add_png_exif(path, exif.tobytes())
    elif name == "deep.tif":
        grey = stored[..., 1].astype(np.uint16) * 257
        Image.fromarray(grey).save(path, tiffinfo={0x0112: orientation})
        pixels = pixels[..., 1:2]
    else:
        options = {"a.jpg": {"quality": 98, "subsampling": 0}, "a.webp": {"lossless": True}}.get(name, {})
        Image.fromarray(stored).save(path, exif=exif, **options)
    _check(path, pixels, 6 if name == "a.jpg" else 0.02)


def _add_png_exif(path: Path, exif: bytes) -> None:
    """Insert an eXIf chunk before the pixels."""
    import struct
    import zlib

    data = path.read_bytes()
    payload = exif.removeprefix(b"Exif\0\0")
    chunk = struct.pack(">I", len(payload)) + b"eXIf" + payload + struct.pack(">I", zlib.crc32(b"eXIf" + payload))
    at = data.index(b"IDAT") - 4
    path.write_bytes(data[:at] + chunk + data[at:])


def _gpano(**tags: int | str) -> bytes:
    text = " ".join(f'GPano:{name}="{value}"' for name, value in tags.items())
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" {text}/></rdf:RDF></x:xmpmeta>'
    ).encode()


@pytest.mark.parametrize("resized", [1, 2])
def test_parts_of_panoramas_and_other_projections_are_refused_by_what_they_state(tmp_path: Path, resized: int) -> None:
    tags = {
        "FullPanoWidthPixels": 256, "FullPanoHeightPixels": 128, "CroppedAreaImageWidthPixels": 256,
        "CroppedAreaImageHeightPixels": 80, "CroppedAreaLeftPixels": 0, "CroppedAreaTopPixels": 20,
    }  # fmt: skip
    file, picture = tmp_path / "a.jpg", Image.new("RGB", (256 // resized, 80 // resized))
    picture.save(file, xmp=_gpano(**tags))
    half = tags | {"CroppedAreaImageWidthPixels": 128, "CroppedAreaImageHeightPixels": 64}
    Image.new("RGB", (128, 64)).save(tmp_path / "b.jpg", xmp=_gpano(**half))  # is 2:1, too
    Image.new("RGB", (128, 64)).save(tmp_path / "c.jpg", xmp=_gpano(ProjectionType="cylindrical"))
    for name, problem in (
        ("a", r"360 x 112 degrees of 360 x 180 \(GPano\); pad it to 2:1, and mask the rest"),
        ("b", r"180 x 90 degrees of 360 x 180"),
        ("c", r"the projection 'cylindrical' \(GPano:ProjectionType\); convert it"),
    ):
        for read in (load_sets, lambda path: read_panorama(path, 16), lambda path: read_thumbnail(path, 16)):
            expect_error(rf"{name}\.jpg: .*, got {problem}", read, tmp_path / f"{name}.jpg")


def test_metadata_that_contradict_the_picture_or_are_no_numbers_count_for_nothing(tmp_path: Path) -> None:
    tags = {"FullPanoWidthPixels": 256, "FullPanoHeightPixels": 128, "CroppedAreaImageWidthPixels": 256}
    for height in (80, "many", "nan", 0):
        packet = _gpano(**tags, CroppedAreaImageHeightPixels=height)
        Image.new("RGB", (128, 64)).save(tmp_path / "a.jpg", xmp=packet)
        assert read_panorama(tmp_path / "a.jpg", 16)[0].shape == (3, 16, 32)


def _fisheye(height: int, count: int) -> Array:
    """Bright circles side by side on black, with noise."""
    y, x = np.meshgrid(np.arange(height), np.arange(count * height), indexing="ij")
    distance = np.hypot((x + 0.5) % height - height / 2, y + 0.5 - height / 2) / (height / 2)
    random = np.random.default_rng(0)
    bright = random.integers(60, 255, (height, count * height, 3))
    return np.where((distance < 0.97)[..., None], bright, random.integers(0, 12, bright.shape)).astype(np.uint8)


def test_dual_fisheye_pictures_are_named(tmp_path: Path, pixels: Array) -> None:
    Image.fromarray(_fisheye(64, 2)).save(tmp_path / "R0010001.JPG", quality=90)
    for call in (
        lambda: read_panorama(tmp_path / "R0010001.JPG", 32),
        lambda: load_sets(tmp_path)[0].load_context(32),
    ):
        expect_error(r"R0010001\.JPG: .*got a dual fisheye picture; stitch it.*v360=dfisheye", call)
    Image.fromarray(_fisheye(64, 1)).save(tmp_path / "one.jpg")
    expect_error("stitch a fisheye picture with the program of its camera", load_sets, tmp_path / "one.jpg")
    capped = pixels.copy()  # panoramas with black poles are no fisheye pictures
    capped[:12] = capped[-12:] = 0
    for number, picture in enumerate((capped, pixels // 8, np.zeros_like(pixels))):
        Image.fromarray(picture).save(tmp_path / f"{number}.png")
        read_panorama(tmp_path / f"{number}.png", 32)


def test_files_of_cameras_and_videos_name_what_to_do(tmp_path: Path) -> None:
    for name, message in (
        ("walk.mp4", r"got the video walk\.mp4; .*ffmpeg -i .*walk\.mp4"),
        ("IMG_1.HEIC", r"got IMG_1\.HEIC; convert it to JPG"),
        ("IMG_1.insp", r"got IMG_1\.insp, which the program of its camera must stitch; export it as a 2:1 JPG"),
    ):
        (tmp_path / name).write_bytes(b"x")
        for path in (tmp_path, tmp_path / name):
            expect_error(message, load_sets, path)
        (tmp_path / name).unlink()
    (tmp_path / "poses.csv").write_text("x,y,z")
    expect_error(r"got none, and poses\.csv, of no known format; .*docs/input\.md lists", load_sets, tmp_path)


def test_a_missing_cube_face_is_named(tmp_path: Path, write_tiles) -> None:
    write_tiles(32, 32, lambda face, *_: tmp_path / f"room_{face}.jpg")
    (tmp_path / "room_u.jpg").unlink()
    with (
        pytest.warns(
            InputWarning, match=r"needed six cube faces, got .*room_f\.jpg.*add the picture whose name ends in _u"
        ),
        pytest.raises(InputError, match="name them NAME_f NAME_r NAME_b NAME_l NAME_u NAME_d"),
    ):
        load_sets(tmp_path)


def test_panoramas_of_different_sizes_are_one_pair(tmp_path: Path) -> None:
    (pair,) = load_sets(write_posed(tmp_path / "room", {"a.png": _pixels(48), "b.jpg": _pixels(32)}, (0, 1)))
    assert pair.image_height == 32
    assert pair.load_context(32).images.shape == (2, 3, 32, 64)


def test_a_pose_without_its_picture_and_a_missing_depth_are_notes(tmp_path: Path) -> None:
    folder = write_posed(tmp_path / "room", {f"{name}.png": _pixels(32) for name in ("a", "b", "gone")}, (0, 1, 2))
    (folder / "gone.png").unlink()
    with pytest.warns(InputWarning, match=r"left out: .*poses\.json: needed the image .*gone\.png, got no such file"):
        (pair,) = load_sets(folder)
    assert [view.name for view in pair.context] == ["a", "b"]
    content = json.loads((folder / "poses.json").read_text())
    del content["poses"]["gone.png"]
    content["poses"]["a.png"]["depth"] = "depth/a.exr"
    (folder / "poses.json").write_text(json.dumps(content))
    with pytest.warns(InputWarning, match=r"'a\.png': its depth is left out: there is no file .*a\.exr"):
        (pair,) = load_sets(folder)
    assert pair.context[0].depth is None
