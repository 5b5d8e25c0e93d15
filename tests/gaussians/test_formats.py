"""Scene files of each suffix: values, axes, cameras and labels; damaged files and limits are refused."""

from __future__ import annotations

import dataclasses
import gzip
import io
import json
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from refusals import expect_error

from pansplat.errors import InputWarning
from pansplat.gaussians import formats
from pansplat.gaussians.formats import load_scene, save_scene
from pansplat.gaussians.ply import load_ply
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.system.files import SCENE_SUFFIXES

CODED = (".compressed.ply", ".spz", ".splat", ".sog")
# Largest error of positions (metres), rotations (1 - |cosine|), log scales, opacities, harmonics of degree 0 and above.
ERRORS = {
    ".ply": (1e-6, 1e-6, 1e-5, 1e-6, 1e-6, 1e-6),
    ".glb": (1e-6, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6),
    ".compressed.ply": (0.01, 1e-5, 0.01, 0.003, 0.02, 0.016),
    ".spz": (2e-4, 1e-5, 0.032, 0.003, 0.014, 0.07),
    ".splat": (1e-6, 1e-4, 1e-5, 0.004, 0.015, None),
    ".sog": (1e-3, 1e-4, 0.02, 0.004, 0.02, 0.02),
}


def match(original: Gaussians, found: Gaussians) -> Gaussians:
    """The Gaussians of `original` in the order of `found`, by the nearest mean."""
    distances = torch.cdist(found.means, original.means, compute_mode="donot_use_mm_for_euclid_dist")
    index = distances.argmin(dim=1)
    assert len(index.unique()) == len(original)
    return original.select(index)


def _vary(scene: Scene, seed: int) -> Scene:
    """The scene with random labels in any order, and the extremes of opacities."""
    random = torch.Generator().manual_seed(seed)
    gaussians, count = scene.gaussians, len(scene.gaussians)
    labels = {name: torch.randint(2, (count,), generator=random) for name in ("levels", "views")}
    gaussians.harmonics.clamp_(-0.9, 0.9)  # .spz holds -1 to 1
    gaussians.opacities[: count // 20], gaussians.opacities[count // 20 : count // 10] = 0.0, 1.0
    return dataclasses.replace(scene, gaussians=dataclasses.replace(gaussians, **labels), joint=seed > 0)


@pytest.mark.parametrize(("count", "seed"), [(1, 0), (40, 1), (700, 2)])
@pytest.mark.parametrize("suffix", SCENE_SUFFIXES)
def test_any_scene_survives_each_format_within_its_error(tmp_path, suffix, count, seed, make_scene) -> None:
    scene = _vary(make_scene(count, 0 if suffix == ".splat" else (3, 0, 2)[seed], seed=seed), seed)
    save_scene(scene, tmp_path / f"scene{suffix}")
    back = load_scene(tmp_path / f"scene{suffix}")
    found = back.gaussians
    original = match(scene.gaussians, found)
    position, rotation, scale, opacity, color, rest = ERRORS[suffix]
    assert len(found) == count and found.degree == scene.gaussians.degree
    assert float((found.means - original.means).abs().max()) <= position
    cosines = (torch.nn.functional.normalize(found.quats, dim=1) * original.quats).sum(dim=1).abs()
    assert float(1 - cosines.min()) <= rotation
    assert float((found.scales.log() - original.scales.log()).abs().max()) <= scale
    assert float((found.opacities - original.opacities).abs().max()) <= opacity
    errors = (found.harmonics - original.harmonics).abs()
    assert float(errors[:, 0].max()) <= color
    assert rest is None or not errors[:, 1:].numel() or float(errors[:, 1:].max()) <= rest
    if suffix == ".splat":
        assert not len(back.cam2world) and not found.views.any()
        return
    assert torch.equal(found.levels, original.levels) and torch.equal(found.views, original.views)
    assert torch.equal(back.cam2world, scene.cam2world)  # bit-exact
    kept = {field.name for field in dataclasses.fields(Scene)} - {"gaussians", "cam2world"}
    assert {name: getattr(back, name) for name in kept} == {name: getattr(scene, name) for name in kept}


def test_an_spz_has_y_up(tmp_path: Path, make_scene) -> None:
    """24-bit positions with 12 fractional bits after a header of 16 bytes, axes right, up, back."""
    scene = make_scene(count=5)
    save_scene(scene, tmp_path / "a.spz")
    data = gzip.decompress((tmp_path / "a.spz").read_bytes())
    assert struct.unpack_from("<III", data) == (0x5053474E, 3, 5)
    numbers = [int.from_bytes(data[i : i + 3], "little", signed=True) / 4096 for i in range(16, 16 + 45, 3)]
    expected = scene.gaussians.means.numpy() * [1, -1, -1]
    np.testing.assert_allclose(np.reshape(numbers, (5, 3)), expected, atol=1 / 4096)


def test_a_splat_has_32_bytes_a_gaussian(tmp_path: Path, make_scene) -> None:
    scene = make_scene(count=5, degree=0)
    save_scene(scene, tmp_path / "a.splat")
    rows = np.frombuffer(
        (tmp_path / "a.splat").read_bytes(),
        [("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("quat", "u1", 4)],
    )
    g = scene.gaussians
    np.testing.assert_array_equal(rows["mean"], g.means.numpy())
    np.testing.assert_allclose(rows["scale"], g.scales.numpy(), rtol=1e-5)
    color = torch.cat((g.harmonics[:, 0] * 0.28209479 + 0.5, g.opacities[:, None]), dim=1)
    assert np.abs(rows["color"] / 255 - color.clamp(0, 1).numpy()).max() <= 1 / 255 + 1e-6
    assert np.abs((rows["quat"].astype(float) - 128) / 128 - g.quats.numpy()).max() <= 1 / 128  # wxyz


def test_a_compressed_ply_holds_harmonics_channel_by_channel(tmp_path: Path, make_scene) -> None:
    """As in a plain .ply; gaussforge alone would write them coefficient by coefficient."""
    scene = make_scene(count=1, degree=3)
    save_scene(scene, tmp_path / "a.compressed.ply")
    data = (tmp_path / "a.compressed.ply").read_bytes()
    assert b"\nelement sh 1\nproperty uchar f_rest_0\n" in data
    stored = np.frombuffer(data[-45:], np.uint8) / 256 * 8 - 4
    expected = scene.gaussians.harmonics[0, 1:].T.flatten()
    np.testing.assert_allclose(stored, expected, atol=8 / 256)


def test_a_sog_is_an_archive_of_images(tmp_path: Path, make_scene) -> None:
    scene = make_scene(count=9, degree=0)
    save_scene(scene, tmp_path / "a.sog")
    means = load_scene(tmp_path / "a.sog").gaussians.means.numpy()
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        meta = json.loads(archive.read("meta.json"))
        low, high = (
            np.array(Image.open(io.BytesIO(archive.read(f"means_{part}.webp"))).convert("RGB"), int).reshape(-1, 3)[:9]
            for part in "lu"
        )
    assert meta["version"] == 2 and meta["count"] == 9
    lows, highs = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
    logs = lows + (low + 256 * high) / 65535 * (highs - lows)
    np.testing.assert_allclose(np.sign(logs) * np.expm1(np.abs(logs)), means, atol=1e-5)


def test_the_name_of_a_compressed_ply_may_be_short(tmp_path: Path, make_scene) -> None:
    save_scene(make_scene(), tmp_path / "a.compressed.ply")
    (tmp_path / "a.compressed.ply").rename(tmp_path / "b.PLY")
    assert len(load_scene(tmp_path / "b.PLY").gaussians) == 40


@pytest.mark.parametrize("suffix", [".spz", ".glb", ".sog", ".compressed.ply"])
def test_harmonics_of_degree_4_are_left_out_with_a_warning(tmp_path: Path, suffix: str, make_scene) -> None:
    with pytest.warns(InputWarning, match="up to degree 3, those up to 4"):
        save_scene(make_scene(count=3, degree=4), tmp_path / f"a{suffix}")
    assert load_scene(tmp_path / f"a{suffix}").gaussians.degree == 3


@pytest.mark.parametrize("suffix", [s for s in SCENE_SUFFIXES if s != ".ply"])
def test_an_empty_scene_is_refused(tmp_path: Path, suffix: str, make_scene) -> None:
    scene = make_scene()
    scene = dataclasses.replace(scene, gaussians=scene.gaussians.select(torch.zeros(40, dtype=torch.bool)))
    expect_error("holds 1", save_scene, scene, tmp_path / f"a{suffix}")
    assert not list(tmp_path.iterdir())


def test_a_scene_beyond_the_limits_of_spz_is_refused(tmp_path, monkeypatch, make_scene) -> None:
    expect_error("positions below 2048 m, got", lambda: save_scene(make_scene(spread=5000), tmp_path / "a.spz"))
    assert formats._CODED[".spz"].max_gaussians == 10_000_000
    monkeypatch.setitem(formats._CODED, ".spz", dataclasses.replace(formats._CODED[".spz"], max_gaussians=39))
    expect_error("1 to 39 Gaussians, got 40", lambda: save_scene(make_scene(), tmp_path / "a.spz"))


def test_unknown_suffixes_are_refused_with_the_known_ones(tmp_path: Path, make_scene) -> None:
    for name, got in (("a.obj", r"'\.obj'"), ("a", "'no suffix'")):
        for call in (load_scene, lambda path: save_scene(make_scene(), path)):
            expect_error(rf"must end in .*\.spz.*\.sog.*\.glb.*got {got}", call, tmp_path / name)
    assert not list(tmp_path.iterdir())


HEADER = "ply\nformat binary_little_endian 1.0\nelement "


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("ply\nformat ascii 1.0\nelement vertex 0", "'ascii'"),
        (HEADER + "vertex 1\nproperty quad x", "quad"),
        (HEADER + "face 0\nproperty list uchar int vertex_indices", "list property"),
        (HEADER + "face 0", "no `vertex`"),
        (HEADER + "vertex 0\nproperty float x\nproperty float y", "lack z, f_dc_0"),
        (HEADER + "vertex 0\nproperty float f_rest_0", "1 f_rest"),
    ],
)
def test_ply_files_of_other_content_are_refused(tmp_path: Path, header: str, message: str) -> None:
    (tmp_path / "a.ply").write_bytes(f"{header}\nend_header\n".encode())
    expect_error(rf"a\.ply.*{message}", load_scene, tmp_path / "a.ply")


def test_an_spz_of_more_gaussians_than_its_bytes_can_hold_is_not_decoded(tmp_path, monkeypatch) -> None:
    """2 million Gaussians of zeros are a file of 37 KB, and half a gigabyte when decoded."""
    head = struct.pack("<III4B", 0x5053474E, 2, 2_000_000, 0, 12, 0, 0)
    monkeypatch.setattr(formats, "_convert", lambda *_, **__: pytest.fail("the file was decoded"))
    for content in (gzip.compress(head + bytes(19 * 2_000_000)), head + bytes(40_000)):
        (tmp_path / "a.spz").write_bytes(content)
        expect_error(r"a\.spz: needed .* decodes to more than \d\d,\d{3},\d{3} bytes", load_scene, tmp_path / "a.spz")


@pytest.mark.parametrize("suffix", CODED)
def test_more_bytes_than_a_file_may_decode_to_do_not_reach_this_process(tmp_path, suffix, monkeypatch, make_scene):
    save_scene(make_scene(degree=0), tmp_path / f"a{suffix}")
    monkeypatch.setattr(formats, "_EXPANSION", 0)
    monkeypatch.setattr(formats, "_FREE_BYTES", 100)
    monkeypatch.setattr(formats, "_CODER", formats._CODER.replace("8 * limit", "(1 << 30)"))  # memory suffices
    monkeypatch.setattr(formats, "_DECODED_BYTES", 0)  # whatever the header states
    expect_error("decodes to more than 100 bytes", load_scene, tmp_path / f"a{suffix}")


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="the memory of a process is limited on Linux only")
def test_a_decoder_has_memory_in_proportion_to_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An .spz whose header states one Gaussian, and whose stream holds 128 MB."""
    head = struct.pack("<III4B", 0x5053474E, 2, 1, 0, 12, 0, 0)
    (tmp_path / "a.spz").write_bytes(gzip.compress(head + bytes(1 << 27), 1))
    monkeypatch.setattr(formats, "_EXPANSION", 0)
    monkeypatch.setattr(formats, "_FREE_BYTES", 1 << 23)
    expect_error("damaged data", load_scene, tmp_path / "a.spz")


def test_a_crash_of_the_decoder_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make_scene) -> None:
    save_scene(make_scene(), tmp_path / "a.sog")
    monkeypatch.setattr(formats, "_CODER", "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    expect_error("gaussforge stopped by signal 11", load_scene, tmp_path / "a.sog")
    monkeypatch.setattr(formats, "_CODER", "while True: pass")
    monkeypatch.setattr(formats, "_DECODE_SECONDS", 0.2)
    expect_error(r"no result after 0\.2 s", load_scene, tmp_path / "a.sog")


def test_a_file_of_gaussforge_alone_is_read_without_cameras(tmp_path: Path, make_scene) -> None:
    """As of another tool: no pansplat entry."""
    scene = make_scene(degree=0)
    save_scene(scene, tmp_path / "a.ply")
    plain = formats.format_plain_ply(load_ply(tmp_path / "a.ply").gaussians)
    (tmp_path / "b.sog").write_bytes(formats._convert(plain, "ply", "sog"))
    back = load_scene(tmp_path / "b.sog")
    assert len(back.gaussians) == 40 and not len(back.cam2world) and not back.gaussians.views.any()
