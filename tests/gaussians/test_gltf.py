"""Binary glTF files: layout, axes, nodes, quantised attributes, and refused files."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from refusals import expect_error

from pansplat.gaussians.gltf import load_glb, save_glb

NAME = "KHR_gaussian_splatting"


def read(path: Path) -> tuple[dict[str, Any], bytes]:
    """The document and the numbers of a file; checks the lengths."""
    data = path.read_bytes()
    magic, version, total, length, kind = struct.unpack_from("<4sII I4s", data)
    assert (magic, version, total, kind) == (b"glTF", 2, len(data), b"JSON") and length % 4 == 0
    size, kind = struct.unpack_from("<I4s", data, 20 + length)
    assert kind == b"BIN\0" and size % 4 == 0 and 28 + length + size == total
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def write(path: Path, document: dict[str, Any], binary: bytes) -> None:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    header = struct.pack("<4sII I4s", b"glTF", 2, 28 + len(text) + len(binary), len(text), b"JSON")
    path.write_bytes(header + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary)


@pytest.fixture
def file(tmp_path: Path, make_scene) -> Path:
    save_glb(make_scene(4), tmp_path / "a.glb")
    return tmp_path / "a.glb"


Edit = Callable[[dict[str, Any]], object]


def edit(path: Path, change: Edit) -> None:
    document, binary = read(path)
    change(document)
    write(path, document, binary)


def test_attributes_are_those_of_the_extension(file: Path, make_scene) -> None:
    document, binary = read(file)
    assert document["extensionsUsed"] == [NAME]
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"][NAME]["colorSpace"] == "srgb_rec709_display"

    def values(name: str) -> np.ndarray:
        accessor = document["accessors"][primitive["attributes"][name]]
        view = document["bufferViews"][accessor["bufferView"]]
        kind = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
        numbers = np.frombuffer(binary[view["byteOffset"] :][: view["byteLength"]], kind)
        return numbers.reshape(accessor["count"], {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]])

    g = make_scene(4).gaussians
    np.testing.assert_allclose(values("POSITION"), g.means.numpy() * [1, -1, -1], rtol=1e-6)  # y up
    np.testing.assert_allclose(values(f"{NAME}:SCALE"), g.scales.numpy())
    np.testing.assert_allclose(values(f"{NAME}:OPACITY")[:, 0], g.opacities.numpy())
    w, x, y, z = g.quats.unbind(1)  # half a turn about x, (0, 1, 0, 0), times the quaternion
    turned = torch.stack((w, -z, y, -x), dim=1).numpy()  # xyzw
    found = values(f"{NAME}:ROTATION")
    np.testing.assert_allclose(np.abs((found * turned).sum(axis=1)), 1, atol=1e-5)
    np.testing.assert_allclose(values(f"{NAME}:SH_DEGREE_0_COEF_0"), g.harmonics[:, 0].numpy())
    # -y, z and -x: y and z change sign, x does not
    for n, sign in enumerate((-1, -1, 1)):
        np.testing.assert_allclose(
            values(f"{NAME}:SH_DEGREE_1_COEF_{n}"), sign * g.harmonics[:, 1 + n].numpy(), atol=1e-6
        )
    assert values("COLOR_0").shape == (4, 4) and primitive["attributes"]["COLOR_0"] == 1
    extremes = document["accessors"][0]
    np.testing.assert_allclose(extremes["min"], values("POSITION").min(axis=0), rtol=1e-6)


def test_nodes_move_the_gaussians(file: Path) -> None:
    """A parent that scales and moves, and a child that turns by a quarter about y."""
    before = load_glb(file).gaussians
    half = 0.5**0.5

    def nest(document: dict[str, Any]) -> None:
        document["nodes"] = [
            {"children": [1], "scale": [2, 2, 2], "translation": [1, 2, 3]},
            {"mesh": 0, "rotation": [0, half, 0, half]},
        ]

    edit(file, nest)
    after = load_glb(file).gaussians
    x, y, z = before.means.unbind(1)
    x, y, z = x, -y, -z  # y up
    expected = torch.stack((2 * z + 1, 2 * y + 2, -2 * x + 3), dim=1) * torch.tensor([1.0, -1, -1])
    torch.testing.assert_close(after.means, expected, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(after.scales, 2 * before.scales)

    def use_a_matrix(document: dict[str, Any]) -> None:
        document["nodes"] = [{"mesh": 0, "matrix": [0, 0, -2, 0, 0, 2, 0, 0, 2, 0, 0, 0, 1, 2, 3, 1]}]

    edit(file, use_a_matrix)
    torch.testing.assert_close(load_glb(file).gaussians.means, expected, rtol=1e-5, atol=1e-5)


def test_quantised_and_interleaved_attributes_are_read(file: Path) -> None:
    document, binary = read(file)
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    opacity = document["accessors"][attributes[f"{NAME}:OPACITY"]]
    document["bufferViews"].append({"buffer": 0, "byteOffset": len(binary), "byteLength": 12, "byteStride": 3})
    opacity |= {"bufferView": len(document["bufferViews"]) - 1, "componentType": 5121, "normalized": True}
    write(file, document, binary + bytes([0, 9, 9, 51, 9, 9, 102, 9, 9, 255, 9, 9]))
    torch.testing.assert_close(load_glb(file).gaussians.opacities, torch.tensor([0, 0.2, 0.4, 1.0]))


REFUSED: dict[str, tuple[Edit, str]] = {
    "required extension": (lambda d: d.update(extensionsRequired=["EXT_meshopt"]), "the extension EXT_meshopt"),
    "compressed": (
        lambda d: d["meshes"][0]["primitives"][0]["extensions"][NAME].update(extensions={"spz": {}}),
        "compressed by an extension",
    ),
    "a cycle": (lambda d: d.update(nodes=[{"children": [0]}]), "or a cycle"),
    "squeezed": (lambda d: d["nodes"][0].update(scale=[1, 1, 2]), "scale all axes alike"),
    "mirrored": (lambda d: d["nodes"][0].update(scale=[1, 1, -1]), "scale all axes alike"),
    "fewer scales": (lambda d: d["accessors"][3].update(count=2), "attributes of one length"),
    "no rotation": (
        lambda d: d["meshes"][0]["primitives"][0]["attributes"].pop(f"{NAME}:ROTATION"),
        "needed the attribute",
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", REFUSED)
def test_unusable_files_are_refused(file: Path, fault: str) -> None:
    change, message = REFUSED[fault]
    edit(file, change)
    expect_error(message, load_glb, file)


def test_a_scene_above_4_gib_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make_scene) -> None:
    monkeypatch.setattr("pansplat.gaussians.gltf._MAX_BYTES", 1000)
    expect_error(r"holds 1,000 bytes, 4 Gaussians of degree 1 need", save_glb, make_scene(4), tmp_path / "a.glb")
    assert not list(tmp_path.iterdir())
