"""Images and films carry the metadata of 360-degree panoramas, and films are decoded as before."""

import re
from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
import pytest
from av.sidedata.sidedata import Type
from PIL import Image
from refusals import expect_error

from pansplat.images.image_files import read_depth, read_panorama, write_depth, write_image
from pansplat.images.panorama_metadata import mark_spherical_video
from pansplat.images.video import write_video


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
def test_panoramas_have_gpano_properties(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    write_image(path, np.zeros((16, 32, 3), np.uint8), panorama=True)
    with Image.open(path) as image:
        xmp = image.info.get("xmp") or image.info["XML:com.adobe.xmp"].encode()
    properties = dict(re.findall(r'GPano:(\w+)="([^"]*)"', xmp.decode()))
    assert properties["ProjectionType"] == "equirectangular" and properties["UsePanoramaViewer"] == "True"
    assert properties["FullPanoWidthPixels"] == properties["CroppedAreaImageWidthPixels"] == "32"
    assert properties["FullPanoHeightPixels"] == properties["CroppedAreaImageHeightPixels"] == "16"
    assert read_panorama(path, 16)[0].shape == (3, 16, 32)
    write_image(path, np.zeros((16, 32, 3), np.uint8), panorama="photograph")
    tags = dict(re.findall(r'GPano:(\w+)="([^"]*)"', path.read_bytes().decode("latin-1")))
    assert not {"StitchingSoftware", "PoseHeadingDegrees"} & {*tags} and {*tags} < {*properties}
    write_image(path, np.zeros((16, 32, 3), np.uint8), panorama=False)
    assert b"GPano" not in path.read_bytes()
    write_image(path, np.zeros((16, 30, 3), np.uint8))
    assert b"GPano" not in path.read_bytes()


def frames() -> Iterator[np.ndarray]:
    for number in range(30):
        yield np.full((32, 64, 3), 8 * number, np.uint8)


def test_films_are_spherical_and_decode_as_before(tmp_path: Path) -> None:
    """FFmpeg reads version 2, and equal frames show that the chunk offsets are right."""
    decoded = {}
    for name, panorama in {"plain": False, "sphere": True}.items():
        path = tmp_path / f"{name}.mp4"
        assert write_video(path, frames(), 10, panorama=panorama) == 30
        with av.open(str(path)) as container:
            shown = list(container.decode(video=0))
        decoded[name] = [frame.to_ndarray(format="rgb24") for frame in shown]
        kinds = {data.type for data in shown[0].side_data}
        assert (Type.SPHERICAL in kinds) == panorama
    assert all(np.array_equal(decoded["plain"][i], decoded["sphere"][i]) for i in range(30))
    data = (tmp_path / "sphere.mp4").read_bytes()
    at = data.index(bytes.fromhex("ffcc8263f8554a938814587a02521fdd"))
    size = int.from_bytes(data[at - 8 : at - 4], "big")
    assert data[at - 4 : at] == b"uuid" and data[: at - 8 + size].endswith(b"</rdf:SphericalVideo>")
    assert b"<GSpherical:Spherical>true<" in data and b"ProjectionType>equirectangular<" in data
    assert sorted(path.name for path in tmp_path.iterdir()) == ["plain.mp4", "sphere.mp4"]


@pytest.mark.parametrize("stereo, kind", [("mono", 0), ("top-bottom", 2)])
def test_films_state_the_arrangement_of_the_eyes(tmp_path: Path, stereo: str, kind: int) -> None:
    """FFmpeg reads the metadata of version 2."""
    path = tmp_path / "film.mp4"
    write_video(path, frames(), 10, panorama=True, stereo=stereo)
    with av.open(str(path)) as container:
        data = {data.type: bytes(data) for data in next(container.decode(video=0)).side_data}
    assert int.from_bytes(data[Type.SPHERICAL][:4], "little") == 0  # AV_SPHERICAL_EQUIRECTANGULAR
    assert int.from_bytes(data[Type.STEREO3D][:4], "little") == kind  # AVStereo3DType
    mode = re.search(rb"StereoMode>([a-z-]*)<", path.read_bytes())
    assert mode and mode[1] == stereo.encode()


def test_a_file_without_a_movie_is_refused_and_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    path.write_bytes(b"\0\0\0\x0cftypabcd")
    with pytest.raises(ValueError, match="no `moov`"):
        mark_spherical_video(path)
    assert path.read_bytes() == b"\0\0\0\x0cftypabcd" and len(list(tmp_path.iterdir())) == 1


def test_depth_is_in_millimetres_and_saturates(tmp_path: Path) -> None:
    depth = np.array([[0.0, 1.2346, 65.534, 100.0], [2, 3, 4, 5]], np.float32)
    write_depth(tmp_path / "d.png", depth)
    with Image.open(tmp_path / "d.png") as image:
        assert np.array_equal(np.asarray(image)[0], [0, 1235, 65534, 65535])
        assert "millimetres" in image.info["Description"]
    back = read_depth(tmp_path / "d.png", 2).numpy()
    np.testing.assert_allclose(back[1], [2, 3, 4, 5], atol=1e-6)
    expect_error(r"ending in \.png", write_depth, tmp_path / "d.jpg", depth)
    expect_error("NaN", write_depth, tmp_path / "d.png", depth * np.nan)
