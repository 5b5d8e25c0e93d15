"""The photographs of a page, without a browser: their pixels, size, masks and exposure."""

import base64
import dataclasses
import io
import math
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from pansplat.evaluation.metrics import psnr
from pansplat.export import photographs as module
from pansplat.export.page import write_page
from pansplat.export.photographs import PackedPhotograph, label_files, pack_photographs, read_photograph
from pansplat.gaussians.scene import Scene
from pansplat.images.cube_images import CubeImage, CubeLevel, equirect_from_faces, write_cube
from pansplat.images.image_files import read_panorama
from pansplat.inputs.panorama_sets import PanoramaSet
from pansplat.system.files import SOFTWARE, is_written

PURPLE = (200, 0, 200)  # of what masks hide; nothing else has so little green


def count_purple(pixels: np.ndarray) -> int:
    """Pixels (H W 3) that are more purple than grey."""
    values = np.asarray(pixels).astype(int)
    return int((values[..., [0, 2]].min(-1) - values[..., 1] > 40).sum())


@pytest.fixture
def grey(scene: Scene) -> Scene:
    """The scene without colours."""
    harmonics = scene.gaussians.harmonics.mean(dim=2, keepdim=True).expand(-1, -1, 3).contiguous()
    return dataclasses.replace(scene, gaussians=dataclasses.replace(scene.gaussians, harmonics=harmonics))


def hide(photographs: list[PanoramaSet], kind: str) -> list[PanoramaSet]:
    """The photographs with a purple square in the first one, and a mask that hides it; for the kind "none" without."""
    first = photographs[0].context[0]
    pixels = np.asarray(Image.open(first.image)).copy()
    rows = len(pixels)
    pixels[rows // 2 : rows // 2 + rows // 8, rows : rows + rows // 8] = PURPLE
    Image.fromarray(pixels).save(first.image)
    square = np.zeros(pixels.shape[:2], np.uint8)
    square[rows // 2 : rows // 2 + rows // 8, rows : rows + rows // 8] = 255
    mask = first.image.with_name(f"{first.name}_{kind}.png")
    if kind != "none":
        Image.fromarray(255 - square if kind == "mask" else square).save(mask)
    chosen = dataclasses.replace(first, mask=mask if kind == "mask" else None)
    return [dataclasses.replace(photographs[0], context=(chosen,)), *photographs[1:]]


def decode_faces(packed: PackedPhotograph, level: int = -1) -> list[np.ndarray]:
    """The six faces of a level of a photograph."""
    first = 0
    for number, (size, step) in enumerate(packed.levels):
        count = math.ceil(size / step)
        if number == level % len(packed.levels):
            tiles = [np.asarray(Image.open(io.BytesIO(tile))) for tile in packed.tiles[first : first + 6 * count**2]]
            rows = [np.concatenate(tiles[k : k + count], axis=1) for k in range(0, len(tiles), count)]
            return [np.concatenate(rows[k : k + count]) for k in range(0, len(rows), count)]
        first += 6 * count**2
    raise AssertionError(level)


def decode_page(path: Path) -> list[np.ndarray]:
    """The pixels of every picture in the files of a page."""
    pictures = []
    texts = re.findall(rb"[A-Za-z0-9+/]{64,}={0,2}", path.read_bytes())
    files = [file.read_bytes() for file in path.parent.glob(f"{path.stem}_files/*.jpg")]
    for data in [*files, *(base64.b64decode(text + b"=" * (-len(text) % 4)) for text in texts)]:
        if data.startswith(b"\xff\xd8"):
            image = Image.open(io.BytesIO(data))
            comment = image.info.get("comment", SOFTWARE.encode())
            assert not image.getexif() and "xmp" not in image.info and comment == SOFTWARE.encode()
            pictures.append(np.asarray(image.convert("RGB")))
    return pictures


def pack(scene: Scene, photographs: list[PanoramaSet], **options: Any) -> list[PackedPhotograph]:
    arguments = {"num_bytes": math.inf, "height": None} | options
    return pack_photographs(scene, photographs, **arguments)


def test_every_height_of_a_photograph_can_be_packed(scene, take_photographs) -> None:
    photographs = take_photographs(scene, 64)
    for height in (1, 2, 3):
        assert {each.height for each in pack(scene, photographs, height=height)} == {max(height, 2)}


def test_the_poster_shows_the_photograph_where_the_page_begins(scene, take_photographs, tmp_path) -> None:
    photographs = take_photographs(scene, 512)
    Image.new("RGB", (1024, 512), PURPLE).save(photographs[0].context[0].image)
    shares = []
    for height in (None, 0):
        write_page(scene, tmp_path / "page.html", photographs=photographs, photo_height=height)
        poster = next(image for image in decode_page(tmp_path / "page.html") if image.shape == (27, 32, 3))
        shares.append(count_purple(poster) / poster[..., 0].size)
    assert shares[0] == 1 and shares[1] < 0.1


def test_the_tiles_of_the_largest_level_are_the_photograph(scene, take_photographs) -> None:
    photographs = take_photographs(scene, 1024)
    for view, packed in enumerate(pack(scene, photographs)):
        image, _ = read_panorama(photographs[view].context[0].image, 1024)
        assert [size for size, _ in packed.levels] == [384, 640] and packed.height == 1024
        for level, least in ((0, 34), (1, 38)):
            faces = decode_faces(packed, level)
            assert faces[0].shape == (packed.levels[level][0],) * 2 + (3,)
            seen = torch.from_numpy(equirect_from_faces(faces, 1024) / 255).permute(2, 0, 1)
            assert psnr(seen, image) > least
        assert np.allclose(packed.rotation, scene.cam2world[view, :3, :3])


@pytest.mark.parametrize("height", [None, 200])
def test_faces_are_no_larger_than_those_of_their_source(scene, take_photographs, tmp_path, height: int | None) -> None:
    faces = tuple(f"{face}.png" for face in range(6))
    for face in faces:
        Image.new("RGB", (160, 160), PURPLE).save(tmp_path / face)
    cube = write_cube(CubeImage(tmp_path, (CubeLevel(160, 160, faces),)), tmp_path, "room")
    first, second, third = take_photographs(scene, 512)
    first = dataclasses.replace(first, context=(dataclasses.replace(first.context[0], image=cube),))
    sizes = [packed.levels[-1][0] for packed in pack(scene, [first, second, third], height=height)]
    assert sizes == [160, 320, 320] if height is None else [112, 112, 112], "2 / pi of the rows, a multiple of 16"


def test_names_of_files_are_those_of_panoramas_safe_in_addresses_and_different() -> None:
    names = ["Living room", "Küche / 2", "living-room", "客厅", "<b>?&#", "a" * 99]
    assert label_files(names) == ["living-room", "kuche-2", "living-room_2", "panorama", "b", "a" * 40]


@pytest.mark.parametrize(("kind", "split"), [("mask", False), ("blur", True)])
def test_what_masks_hide_is_in_no_file_of_a_page(grey, tmp_path, take_photographs, kind: str, split: bool) -> None:
    for chosen, is_hidden in (("none", False), (kind, True)):
        photographs = hide(take_photographs(grey, 512), chosen)
        written = write_page(grey, tmp_path / "tour.html", photographs=photographs, split=split)
        pictures = decode_page(tmp_path / "tour.html")
        assert written.photo_height == 512 and len(pictures) > 6 * 3
        assert (sum(map(count_purple, pictures)) == 0) == is_hidden, "the test fails if masks are left out"
        (tmp_path / "tour.html").unlink()


def test_a_photograph_shows_the_gaussians_in_what_its_mask_hides_and_itself_elsewhere(grey, take_photographs) -> None:
    (photograph, *_) = hide(take_photographs(grey, 256), "mask")
    image = read_photograph(grey, 0, photograph, 256)
    original, _ = read_panorama(photograph.context[0].image, 256)
    mask = cv2.imread(str(photograph.context[0].mask), cv2.IMREAD_GRAYSCALE)
    near = cv2.dilate(255 - mask, np.ones((13, 13), np.uint8)) > 0
    assert torch.equal(image[:, ~near], original[:, ~near])
    assert count_purple((image.permute(1, 2, 0) * 255).numpy()) == 0 and image[:, mask == 0].std() > 0.01


def test_photographs_have_the_exposure_of_their_gaussians(scene, take_photographs) -> None:
    gains = ((1.25, 1.0, 0.8), (0.8, 1.0, 1.25), (1.0, 1.0, 1.0))
    photographs = take_photographs(scene, 64)
    original, _ = read_panorama(photographs[0].context[0].image, 64)
    for joint, factors in ((False, (1.0, 1.0, 1.0)), (True, gains[0])):
        image = read_photograph(dataclasses.replace(scene, gains=gains, joint=joint), 0, photographs[0], 64)
        assert torch.allclose(image, (original / torch.tensor(factors)[:, None, None]).clamp(0, 1), atol=1e-6)


def test_tiles_are_encoded_again_only_of_another_photograph_or_of_one_with_a_mask(scene, take_photographs, monkeypatch):
    encoded, encode = [], module._encode
    monkeypatch.setattr(module, "_encode", lambda *arguments: encoded.append(1) or encode(*arguments))
    photographs = take_photographs(scene, 64)
    first, again = pack(scene, photographs), pack(scene, photographs)
    assert [each.make_files() for each in first] == [each.make_files() for each in again] and len(encoded) == 6 * 3
    Image.new("RGB", (128, 64), PURPLE).save(photographs[1].context[0].image)
    for number in (5, 6):
        pack(scene, hide(photographs, "mask"))
        assert len(encoded) == 6 * number, "what a mask hides is drawn by the scene"


def test_photographs_fit_into_the_bytes_or_have_the_stated_height(scene, take_photographs, monkeypatch) -> None:
    monkeypatch.setattr(module, "MIN_HEIGHT", 128)
    photographs = take_photographs(scene, 512)
    full = pack(scene, photographs, num_bytes=1e9)
    size = sum(packed.num_bytes for packed in full)
    assert {packed.height for packed in full} == {512}
    fitted = pack(scene, photographs, num_bytes=0.6 * size)
    assert 0.5 * size < sum(packed.num_bytes for packed in fitted) <= 0.6 * size, "little is left"
    assert 128 < fitted[0].height < 512
    assert {packed.height for packed in pack(scene, photographs, num_bytes=10)} == {128}, "as small as allowed"
    assert {packed.height for packed in pack(scene, photographs, num_bytes=10, height=300)} == {300}
    assert sum(packed.num_bytes for packed in pack(scene, photographs)) > size, "a folder has a higher quality"


def test_a_new_page_removes_the_tiles_of_the_old_one(plain_scene, tmp_path, take_photographs) -> None:
    photographs = take_photographs(plain_scene, 64)
    first = write_page(plain_scene, tmp_path / "index.html", split=True, photographs=photographs)
    assert len(first.files) == 1 + 2 + 2 * 6 + 1 and all(is_written(file) for file in first.files)
    second = write_page(plain_scene, tmp_path / "index.html", split=True)
    assert second.photo_height == 0 and set((tmp_path / "index_files").iterdir()) == set(second.files[1:])
