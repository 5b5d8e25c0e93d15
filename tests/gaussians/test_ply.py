"""Written, read and refused .ply files; a file written part by part equals a file written at once."""

from __future__ import annotations

import dataclasses
import json
import struct
import weakref
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from refusals import expect_error

from pansplat.errors import InputError
from pansplat.gaussians import ply
from pansplat.gaussians.ply import OPACITY_EPSILON, SCALE_EPSILON, load_ply, save_ply, save_ply_parts
from pansplat.gaussians.scene import Gaussians, Scene

FIELDS = ("means", "scales", "quats", "opacities", "harmonics")


def binary_ply(columns: dict[str, np.ndarray], *, order: str = "<", before: bytes = b"") -> bytes:
    """A .ply file by one struct.pack per value, independent of the code under test."""
    names = list(columns)
    word = "little" if order == "<" else "big"
    header = f"ply\nformat binary_{word}_endian 1.0\ncomment from elsewhere\n"
    if before:
        header += f"element extra {len(before)}\nproperty uchar tag\n"
    header += f"element vertex {len(columns[names[0]])}\n"
    kinds = {name: "d" if values.dtype == np.float64 else "f" for name, values in columns.items()}
    header += "".join(f"property {'double' if kinds[n] == 'd' else 'float'} {n}\n" for n in names) + "end_header\n"
    rows = zip(*(columns[name] for name in names), strict=True)
    body = b"".join(struct.pack(order + kinds[n], v) for row in rows for n, v in zip(names, row, strict=True))
    return header.encode() + before + body


def foreign_columns(degree: int = 1, count: int = 3) -> dict[str, np.ndarray]:
    random = np.random.default_rng(1)
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    return {name: random.normal(size=count).astype(np.float32) for name in names}


def _split_file(path: Path) -> list[bytes]:
    """The header and the vertices."""
    return path.read_bytes().split(b"end_header\n", 1)


def test_the_file_has_the_3dgs_layout(tmp_path: Path, make_scene) -> None:
    """The property order of 3DGS, all floats, channel-major f_rest, and one JSON comment."""
    scene = make_scene(count=4, degree=1)
    save_ply(scene, tmp_path / "scene.ply")
    header, body = _split_file(tmp_path / "scene.ply")
    lines = header.decode("ascii").splitlines()
    properties = [line.split()[-1] for line in lines if line.startswith("property")]
    rest = [f"f_rest_{i}" for i in range(9)]
    rotation = ["rot_0", "rot_1", "rot_2", "rot_3"]
    first = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert properties == [*first, *rest, "opacity", "scale_0", "scale_1", "scale_2", *rotation]
    assert all(line.split()[1] == "float" for line in lines if line.startswith("property"))
    (comment,) = (line for line in lines if line.startswith("comment"))
    extras = json.loads(comment.removeprefix("comment pansplat "))
    assert sum(count for *_, count in extras["runs"]) == 4
    table = np.frombuffer(body, "<f4").reshape(4, len(properties))
    row = dict(zip(properties, table[2], strict=True))
    g = scene.gaussians
    assert row["opacity"] == pytest.approx(float(torch.logit(g.opacities[2].double())), rel=1e-6)
    assert row["scale_1"] == pytest.approx(float(g.scales[2, 1].log()), rel=1e-6)
    assert row["rot_0"] == pytest.approx(float(g.quats[2, 0]))
    # coefficient 2 of green: the second of green's three
    assert row["f_rest_4"] == pytest.approx(float(g.harmonics[2, 2, 1]))


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("degree", [0, 3])
def test_files_of_other_tools_are_read(tmp_path: Path, order: str, degree: int) -> None:
    columns = foreign_columns(degree)
    columns = {"confidence": np.ones(3), **columns, "label": np.ones(3, np.float32)}  # two unknown properties
    (tmp_path / "a.ply").write_bytes(binary_ply(columns, order=order, before=b"12345"))
    scene = load_ply(tmp_path / "a.ply")
    g = scene.gaussians
    assert g.degree == degree
    np.testing.assert_array_equal(g.means[:, 1], columns["y"])
    np.testing.assert_allclose(g.opacities, 1 / (1 + np.exp(-columns["opacity"])), rtol=1e-6)
    np.testing.assert_allclose(g.scales[:, 2], np.exp(columns["scale_2"]), rtol=1e-6)
    if degree:
        np.testing.assert_array_equal(g.harmonics[:, 1, 2], columns["f_rest_30"])
    assert len(scene.cam2world) == 0
    assert not g.levels.any() and not g.views.any()
    expect_error("no input cameras", scene.pose_between, 0.5)


def test_extreme_opacities_and_scales_stay_finite(tmp_path: Path, make_scene) -> None:
    scene = make_scene(count=4)
    g = scene.gaussians
    g.opacities[0], g.opacities[1], g.scales[2, 0] = 0.0, 1.0, 0.0
    save_ply(scene, tmp_path / "scene.ply")
    back = load_ply(tmp_path / "scene.ply").gaussians
    assert len(back) == 4
    assert float(back.opacities[0]) == pytest.approx(OPACITY_EPSILON, rel=1e-3)
    assert float(1 - back.opacities[1]) == pytest.approx(OPACITY_EPSILON, rel=0.1)  # float32 near 1
    assert float(back.scales[2, 0]) == pytest.approx(SCALE_EPSILON, rel=1e-3)


def test_a_file_with_another_count_loses_its_labels_but_not_its_cameras(tmp_path: Path, make_scene) -> None:
    path = tmp_path / "scene.ply"
    save_ply(make_scene(count=40, degree=0), path)
    header, body = _split_file(path)
    row = len(body) // 40
    path.write_bytes(header.replace(b"vertex 40", b"vertex 39") + b"end_header\n" + body[row:])
    with pytest.warns(UserWarning, match="do not fit its 39 Gaussians"):
        scene = load_ply(path)
    assert len(scene.gaussians) == 39 and not scene.gaussians.levels.any()
    assert len(scene.cam2world) == 2


def test_non_finite_gaussians_are_counted_and_left_out(tmp_path: Path, make_scene) -> None:
    columns = foreign_columns(0)
    columns["scale_0"][1] = 1e4  # exp overflows
    columns["x"][2] = np.nan
    (tmp_path / "a.ply").write_bytes(binary_ply(columns))
    with pytest.warns(UserWarning, match="left out 2 of 3"):
        assert len(load_ply(tmp_path / "a.ply").gaussians) == 1
    columns["x"][0] = np.inf
    (tmp_path / "a.ply").write_bytes(binary_ply(columns))
    with pytest.warns(UserWarning, match="left out 3 of 3"), pytest.raises(InputError, match="none of its 3"):
        load_ply(tmp_path / "a.ply")
    scene = make_scene()
    for number, name in enumerate(FIELDS):
        getattr(scene.gaussians, name)[number].view(-1)[-1] = np.nan
    with pytest.warns(UserWarning, match="left out 5 of 40"):
        save_ply(scene, tmp_path / "b.ply")
    assert len(load_ply(tmp_path / "b.ply").gaussians) == 35


@pytest.mark.parametrize("piece", [1, 7, 40])
def test_the_size_of_the_pieces_does_not_change_the_scene(piece, tmp_path, monkeypatch, make_scene):
    save_ply(make_scene(degree=2), tmp_path / "scene.ply")
    whole = load_ply(tmp_path / "scene.ply").gaussians
    monkeypatch.setattr(ply, "_READ_VERTICES", piece)
    again = load_ply(tmp_path / "scene.ply").gaussians
    assert all(torch.equal(getattr(whole, name), getattr(again, name)) for name in (*FIELDS, "levels", "views"))


@pytest.fixture
def scene(make_scene) -> Scene:
    """60 Gaussians with labels of one byte, as predictors make them."""
    scene = make_scene(60, 2)
    labels = {name: getattr(scene.gaussians, name).to(torch.uint8) for name in ("levels", "views")}
    return dataclasses.replace(scene, gaussians=dataclasses.replace(scene.gaussians, **labels))


def _in_parts(scene: Scene, *bounds: int) -> Iterator[Gaussians]:
    for start, end in zip((0, *bounds), (*bounds, len(scene.gaussians)), strict=True):
        yield scene.gaussians.select(torch.arange(start, end))


@pytest.mark.parametrize("bounds", [(), (20,), (7, 7, 33), (1, 59)])
def test_parts_give_the_same_file_as_the_whole(tmp_path: Path, scene, bounds) -> None:
    save_ply(scene, tmp_path / "whole.ply")
    assert save_ply_parts(scene, _in_parts(scene, *bounds), tmp_path / "parts.ply") == 60
    assert (tmp_path / "parts.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["parts.ply", "whole.ply"]


def test_a_part_is_released_before_the_next_is_made(tmp_path: Path, scene: Scene) -> None:
    made = []

    def part(start: int) -> Gaussians:
        assert all(reference() is None for reference in made)
        gaussians = scene.gaussians.select(torch.arange(start, start + 20))
        made.append(weakref.ref(gaussians))
        return gaussians

    save_ply_parts(scene, (part(start) for start in (0, 20, 40)), tmp_path / "a.ply")
    assert len(made) == 3


def test_non_finite_gaussians_of_parts_are_left_out_with_one_warning(tmp_path: Path, scene: Scene) -> None:
    means = scene.gaussians.means.clone()
    means[[3, 50]] = float("nan")
    broken = dataclasses.replace(scene, gaussians=dataclasses.replace(scene.gaussians, means=means))
    with pytest.warns(UserWarning, match="left out 2 of 60 Gaussians that are not finite"):
        assert save_ply_parts(broken, _in_parts(broken, 20, 40), tmp_path / "a.ply") == 58
    kept = torch.ones(60, dtype=torch.bool)
    kept[[3, 50]] = False
    assert torch.equal(load_ply(tmp_path / "a.ply").gaussians.means, means[kept])


def test_an_interrupted_save_leaves_the_old_file(tmp_path: Path, scene: Scene, make_scene) -> None:
    (tmp_path / "a.ply").write_text("before")

    def parts() -> Iterator[Gaussians]:
        yield scene.gaussians
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        save_ply_parts(scene, parts(), tmp_path / "a.ply")
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("a.ply", "before")]
    with pytest.raises(ValueError, match="9 harmonics each, got 4"):
        save_ply_parts(scene, [scene.gaussians, make_scene(60, 1).gaussians], tmp_path / "a.ply")
    expect_error("needed an existing folder", save_ply_parts, scene, [scene.gaussians], tmp_path / "none" / "a.ply")
