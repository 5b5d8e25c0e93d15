"""Images of every format are read alike, and defects of files are reported."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
import torch
from PIL import Image
from refusals import expect_error

from pansplat.errors import InputError
from pansplat.images.image_files import read_depth, read_height, read_mask, read_panorama, read_size, write_image


def _panorama(height: int = 16) -> torch.Tensor:
    """A smooth panorama, (3 height 2 height), whose columns meet at +-180 degrees."""
    v, u = torch.meshgrid(torch.linspace(0, 1, height), torch.arange(2 * height) / (2 * height), indexing="ij")
    return torch.stack((0.5 + 0.4 * torch.sin(6.2832 * u), v, 0.5 + 0.3 * torch.cos(6.2832 * u) * v))


def _entries(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize(("suffix", "tolerance"), [(".png", 2e-3), (".webp", 2e-3), (".jpg", 0.05), (".exr", 1e-5)])
def test_read_images_equal_written_images(tmp_path: Path, suffix: str, tolerance: float) -> None:
    image = _panorama()
    write_image(tmp_path / f"a{suffix}", image)
    read, opaque = read_panorama(tmp_path / f"a{suffix}", 16)
    assert read.dtype == torch.float32
    assert (read - image).abs().max() < tolerance
    assert read_height(tmp_path / f"a{suffix}") == 16
    assert opaque.all()
    assert _entries(tmp_path) == [f"a{suffix}"]


def test_the_format_is_detected_from_the_content(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", _panorama())
    (tmp_path / "a.png").rename(tmp_path / "a.jpg")
    assert (read_panorama(tmp_path / "a.jpg", 16)[0] - _panorama()).abs().max() < 2e-3


def test_exr_holds_linear_light_and_depth(tmp_path: Path) -> None:
    depth = torch.rand(16, 32) + 1
    write_image(tmp_path / "a.exr", torch.full((3, 16, 32), 0.5), depth=depth)
    with OpenEXR.File(str(tmp_path / "a.exr")) as file:
        assert np.allclose(file.channels()["RGB"].pixels, 0.21404, atol=1e-4)
        assert file.header()["envmap"] == OpenEXR.ENVMAP_LATLONG
    assert torch.equal(read_depth(tmp_path / "a.exr", 16), depth)


@pytest.mark.parametrize("height", [8, 16, 31])
def test_resizing_commutes_with_rolling(tmp_path: Path, height: int) -> None:
    image = _panorama(62)
    write_image(tmp_path / "a.png", image)
    write_image(tmp_path / "b.png", torch.roll(image, 62, dims=2))
    a, b = (read_panorama(tmp_path / name, height)[0] for name in ("a.png", "b.png"))
    assert a.shape == (3, height, 2 * height)
    if 62 % height == 0:
        assert (torch.roll(a, height, dims=2) - b).abs().max() < 0.005
    assert (
        a - torch.nn.functional.interpolate(image[None], size=(height, 2 * height), mode="area")[0]
    ).abs().max() < 0.05


def test_transparent_pixels_are_masked_with_a_warning(tmp_path: Path) -> None:
    rgba = np.full((16, 32, 4), 255, np.uint8)
    Image.fromarray(rgba).save(tmp_path / "a.png")
    assert read_panorama(tmp_path / "a.png", 16)[1].all()  # warnings are errors
    rgba[12:, :, 3] = 0
    Image.fromarray(rgba).save(tmp_path / "a.png")
    with pytest.warns(UserWarning, match=r"a\.png: 25\.0% .* transparent"):
        _, opaque = read_panorama(tmp_path / "a.png", 16)
    assert opaque[:12].all() and not opaque[12:].any()


def test_a_mask_is_true_where_white(tmp_path: Path) -> None:
    mask = np.full((16, 32), 255, np.uint8)
    mask[:4] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    read = read_mask(tmp_path / "mask.png", 8)
    assert read.shape == (8, 16)
    assert not read[:2].any()
    assert read[2:].all()


def test_depth_is_in_metres_and_not_interpolated(tmp_path: Path) -> None:
    depth = np.full((16, 32), 1500, np.uint16)
    depth[:, 16:] = 4000
    depth[0] = 0
    cv2.imwrite(str(tmp_path / "depth.png"), depth)
    assert set(read_depth(tmp_path / "depth.png", 16).unique().tolist()) == {0.0, 1.5, 4.0}
    assert set(read_depth(tmp_path / "depth.png", 5).unique().tolist()) == {1.5, 4.0}
    write_image(tmp_path / "depth.png", _panorama())
    expect_error(r"depth\.png: .* got .* type RGB", read_depth, tmp_path / "depth.png", 16)


def test_an_exr_without_colours_is_refused(tmp_path: Path) -> None:
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"beauty.R": np.zeros((8, 16), np.float32)}) as file:
        file.write(str(tmp_path / "a.exr"))
    expect_error(r"a\.exr: needed the channels R, G and B", read_panorama, tmp_path / "a.exr", 8)


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.exr"])
def test_nan_is_never_written(tmp_path: Path, name: str) -> None:
    image = _panorama()
    write_image(tmp_path / name, image)
    before = (tmp_path / name).read_bytes()
    image[0, 0, 0] = torch.nan
    expect_error("got 1 NaN or infinite values; nothing was written", write_image, tmp_path / name, image)
    assert (tmp_path / name).read_bytes() == before
    assert _entries(tmp_path) == [name]


def test_unsupported_content_is_not_written(tmp_path: Path) -> None:
    expect_error(r"needed a name ending in", lambda: write_image(tmp_path / "a.gif", _panorama()))
    expect_error(r"a\.png.*needed an \.exr", write_image, tmp_path / "a.png", _panorama(), depth=torch.ones(16, 32))
    with pytest.raises(InputError, match=r"\(16, 32\), got shape \(8, 8\)"):
        write_image(tmp_path / "a.exr", _panorama(), depth=torch.ones(8, 8))
    expect_error("got shape", lambda: write_image(tmp_path / "a.png", torch.zeros(16, 32)))
    expect_error("needed an existing folder", lambda: write_image(tmp_path / "none" / "a.png", _panorama()))
    assert _entries(tmp_path) == []


def test_the_size_of_an_image_is_read_without_its_pixels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for suffix in (".png", ".jpg", ".webp", ".exr"):
        write_image(tmp_path / f"a{suffix}", torch.rand(3, 20, 30))
    turned = Image.Exif()
    turned[0x0112] = 6
    Image.new("RGB", (30, 20)).save(tmp_path / "turned.jpg", exif=turned)
    monkeypatch.setattr("PIL.ImageFile.ImageFile.load", None)
    monkeypatch.setattr("pansplat.images.image_files._decode_exr", None)
    assert [read_size(tmp_path / f"a{suffix}") for suffix in (".png", ".jpg", ".webp", ".exr")] == [(30, 20)] * 4
    assert read_size(tmp_path / "turned.jpg") == (20, 30)


@pytest.mark.parametrize(("rows", "is_refused"), [(9459, False), (9460, True)])
def test_the_largest_image_is_the_largest_that_pillow_opens(tmp_path: Path, rows: int, is_refused: bool) -> None:
    chunk = b"IHDR" + struct.pack(">IIBBBBB", 18918, rows, 8, 2, 0, 0, 0)
    content = struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk)) + b"\0\0\0\0IDAT"
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + content)
    if not is_refused:
        assert read_size(tmp_path / "a.png") == (18918, rows)
        return
    expect_error(r"a\.png: .*18918x9459", read_size, tmp_path / "a.png")
