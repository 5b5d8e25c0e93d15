"""A file written part by part is the file written at once, whatever the parts."""

from __future__ import annotations

import dataclasses
import weakref
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from pansplat.errors import InputError
from pansplat.gaussians import ply_stream
from pansplat.gaussians.gaussians import Gaussians
from pansplat.gaussians.ply import load_ply, save_ply
from pansplat.gaussians.ply_stream import save_ply_parts
from pansplat.gaussians.scene import Scene


def _scene(count: int = 60, degree: int = 2) -> Scene:
    generator = torch.Generator().manual_seed(3)
    gaussians = Gaussians(
        means=torch.randn(count, 3, generator=generator),
        scales=torch.rand(count, 3, generator=generator) + 1e-3,
        quats=torch.randn(count, 4, generator=generator),
        opacities=torch.rand(count, generator=generator),
        harmonics=torch.randn(count, (degree + 1) ** 2, 3, generator=generator),
        levels=(torch.arange(count) // 5 % 4).to(torch.uint8),
        views=(torch.arange(count) // 20 % 2).to(torch.uint8),
    )
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    return Scene(gaussians, poses, 0.5, 8.0, ("a.png", "b.png"), "network", 64)


def _body(path: Path) -> bytes:
    return path.read_bytes().split(b"end_header\n", 1)[1]


def _in_parts(scene: Scene, *bounds: int) -> Iterator[Gaussians]:
    for start, end in zip((0, *bounds), (*bounds, len(scene.gaussians)), strict=True):
        yield scene.gaussians.select(torch.arange(start, end))


@pytest.mark.parametrize("bounds", [(), (20,), (7, 7, 33), (1, 59)])
@pytest.mark.parametrize("room", [4096, 3])
def test_parts_make_the_file_that_the_whole_makes(tmp_path: Path, monkeypatch, bounds, room) -> None:
    monkeypatch.setattr(ply_stream, "_ROOM", room)  # 3 bytes hold no run: the vertices have to be moved
    scene = _scene()
    save_ply(scene, tmp_path / "whole.ply")
    assert save_ply_parts(scene, _in_parts(scene, *bounds), tmp_path / "parts.ply") == 60
    assert _body(tmp_path / "parts.ply") == _body(tmp_path / "whole.ply")
    whole, parts = load_ply(tmp_path / "whole.ply"), load_ply(tmp_path / "parts.ply")
    assert torch.equal(whole.gaussians.levels, parts.gaussians.levels)
    assert torch.equal(whole.gaussians.views, parts.gaussians.views)
    assert torch.equal(whole.cam2world, parts.cam2world)
    assert (parts.near, parts.far, parts.names, parts.model, parts.height) == (
        *(0.5, 8.0, ("a.png", "b.png"), "network", 64),
    )
    assert sorted(p.name for p in tmp_path.iterdir()) == ["parts.ply", "whole.ply"]


def test_lines_of_the_header_are_those_of_the_whole(tmp_path: Path) -> None:
    scene = _scene()
    save_ply(scene, tmp_path / "whole.ply")
    save_ply_parts(scene, _in_parts(scene, 30), tmp_path / "parts.ply")
    whole, parts = ((tmp_path / name).read_bytes().split(b"end_header\n")[0] for name in ("whole.ply", "parts.ply"))
    assert [line.rstrip() for line in parts.splitlines()] == whole.splitlines()
    assert len(parts) < 10_000  # what some viewers read of a file to find its header's end


def test_a_part_is_let_go_before_the_next_is_made(tmp_path: Path) -> None:
    scene, made = _scene(), []

    def part(start: int) -> Gaussians:
        assert all(reference() is None for reference in made)
        gaussians = scene.gaussians.select(torch.arange(start, start + 20))
        made.append(weakref.ref(gaussians))
        return gaussians

    save_ply_parts(scene, (part(start) for start in (0, 20, 40)), tmp_path / "a.ply")
    assert len(made) == 3


def test_what_is_not_finite_is_left_out_with_one_warning(tmp_path: Path) -> None:
    scene = _scene()
    means = scene.gaussians.means.clone()
    means[[3, 50]] = float("nan")
    broken = dataclasses.replace(scene, gaussians=dataclasses.replace(scene.gaussians, means=means))
    with pytest.warns(UserWarning, match="left out 2 of 60 Gaussians that are not finite"):
        assert save_ply_parts(broken, _in_parts(broken, 20, 40), tmp_path / "a.ply") == 58
    kept = torch.ones(60, dtype=torch.bool)
    kept[[3, 50]] = False
    assert torch.equal(load_ply(tmp_path / "a.ply").gaussians.means, means[kept])


def test_no_parts_make_an_empty_scene(tmp_path: Path) -> None:
    assert save_ply_parts(_scene(), [], tmp_path / "a.ply") == 0
    assert len(load_ply(tmp_path / "a.ply").gaussians) == 0


def test_a_stream_that_breaks_off_leaves_what_was_there(tmp_path: Path) -> None:
    scene = _scene()
    (tmp_path / "a.ply").write_text("before")

    def parts() -> Iterator[Gaussians]:
        yield scene.gaussians
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        save_ply_parts(scene, parts(), tmp_path / "a.ply")
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("a.ply", "before")]
    with pytest.raises(ValueError, match="9 harmonics each, got 4"):
        save_ply_parts(scene, [scene.gaussians, _scene(degree=1).gaussians], tmp_path / "a.ply")
    with pytest.raises(InputError, match="needed an existing folder"):
        save_ply_parts(scene, [scene.gaussians], tmp_path / "none" / "a.ply")
