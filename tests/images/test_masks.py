"""Only static regions around a pole are masked."""

import functools
import json
import math
from pathlib import Path

import pytest
import torch

from pansplat.geometry.equirect import pixel_directions, row_weights
from pansplat.images.image_files import write_image
from pansplat.images.masks import detect_scene_mask, find_holes, scene_mask_of_files
from pansplat.inputs.folders import load_sets

_HEIGHT = 128


@functools.cache
def _room(x: float, z: float, plain: bool = False) -> torch.Tensor:
    """A box room with smooth textures (or plain faces) seen from (x, z), 1.5 m above its floor."""
    d = pixel_directions(_HEIGHT, 2 * _HEIGHT, dtype=torch.float64)
    walls = torch.tensor((3.0, 1.5, 4.0), dtype=torch.float64)
    origin = torch.tensor((x, 0.0, z), dtype=torch.float64)
    distance = ((torch.sign(d) * walls - origin) / torch.where(d.abs() < 1e-9, 1e-9, d)).amin(dim=-1)
    points = origin + distance[..., None] * d
    if plain:
        face = (points.abs() / walls).argmax(dim=-1)
        return (0.5 + 0.1 * face).float().expand(3, -1, -1)
    phase = torch.tensor((0.0, 1.0, 2.0), dtype=torch.float64)[:, None, None]
    u, v, w = points.unbind(-1)
    return (0.5 + 0.2 * torch.sin(5 * u + phase) * torch.cos(4 * w - phase) + 0.2 * torch.sin(6 * v + 3 * u)).float()


def _cap(image: torch.Tensor, degrees: float, *, top: bool) -> torch.Tensor:
    """The image with a black disc of that radius around a pole."""
    capped = image.clone()
    rows = round(degrees / 180 * _HEIGHT)
    if top:
        capped[:, :rows] = 0
    else:
        capped[:, _HEIGHT - rows :] = 0
    return capped


_PLACES = ((0.0, 0.0), (0.9, 0.3), (-0.5, 1.1), (0.2, -1.3), (1.3, 1.5))


@pytest.mark.parametrize(("count", "top"), [(2, False), (3, True), (5, False)])
def test_a_cap_fixed_to_the_camera_is_masked(count: int, top: bool) -> None:
    images = torch.stack([_cap(_room(*place), 15, top=top) for place in _PLACES[:count]])
    scene = detect_scene_mask(images)
    rows = round(15 / 180 * _HEIGHT)
    expected = torch.ones(_HEIGHT, 2 * _HEIGHT, dtype=torch.bool)
    expected[slice(0, rows) if top else slice(_HEIGHT - rows, None)] = False
    assert not scene[~expected].any()
    area = row_weights(_HEIGHT).float()[:, None].expand_as(expected)
    assert area[~scene].sum() < 2.2 * area[~expected].sum()
    assert scene[_HEIGHT // 3 : 2 * _HEIGHT // 3].all()


@pytest.mark.parametrize(("count", "plain"), [(2, False), (2, True), (5, False), (5, True)])
def test_floors_and_ceilings_are_not_masked(count: int, plain: bool) -> None:
    assert detect_scene_mask(torch.stack([_room(*p, plain=plain) for p in _PLACES[:count]])).all()


def test_nothing_is_masked_for_a_camera_that_did_not_move() -> None:
    image = _cap(_room(0, 0), 15, top=False)
    assert detect_scene_mask(torch.stack((image, image, image + 0.001))).all()


def test_rolling_the_panoramas_rolls_the_mask() -> None:
    images = torch.stack([_cap(_room(*place), 15, top=False) for place in _PLACES[:3]])
    images[:, :, 110:, 50:80] = 0  # an arm to one side
    rolled = detect_scene_mask(torch.roll(images, 64, dims=-1))
    assert (torch.roll(detect_scene_mask(images), 64, dims=-1) != rolled).float().mean() < 0.01


def test_nothing_is_masked_in_a_single_panorama() -> None:
    assert detect_scene_mask(_room(0, 0)[None]).all()


def test_masks_of_files_have_the_requested_size(tmp_path: Path) -> None:
    paths = []
    for i, place in enumerate(_PLACES[:3]):
        paths.append(tmp_path / f"{i}.png")
        write_image(paths[-1], _cap(_room(*place), 15, top=False))
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"no picture")
    scene = scene_mask_of_files((*paths, broken, tmp_path / "gone.png"), 90)
    assert scene.shape == (90, 180)
    assert not scene[-7:].any()
    assert scene[:70].all()


@pytest.mark.shared
def test_only_the_tripod_of_zind_is_masked(shared: Path) -> None:
    pair = load_sets(shared / "data" / "zind")[0]
    scene = scene_mask_of_files(pair.siblings, _HEIGHT)
    area = (row_weights(_HEIGHT)[:, None] * ~scene).sum() / (2 * _HEIGHT * row_weights(_HEIGHT).sum())
    assert 0.01 < float(area) < 0.04
    assert not scene[round(_HEIGHT * (1 - 6 / 180)) :].any()  # the body, 6 degrees around the nadir
    assert scene[: round(_HEIGHT * (1 - 35 / 180))].all()
    assert math.isclose(float(pair.load_context(64).masks.float().mean()), float(scene.float().mean()), abs_tol=0.01)


def test_patches_of_exact_black_are_holes_of_a_scan_and_dark_ones_or_single_pixels_are_none() -> None:
    image = torch.rand(3, 64, 128, generator=torch.Generator().manual_seed(0)).clamp_min(0.1)
    image[:, 20:30, 40:60] = 0
    image[:, 40:50, 40:60] = 1e-3
    image[:, 5, 5] = 0
    holes = torch.zeros(64, 128, dtype=torch.bool)
    holes[18:32, 38:62] = True  # the hole, and the pixels that resizing mixes with it
    assert torch.equal(find_holes(image, is_scan=True), holes)


@pytest.mark.parametrize("is_scan", [False, True])
def test_only_scans_have_holes_inside_the_picture(tmp_path: Path, is_scan: bool) -> None:
    """A black screen or a window at night in a photograph is a surface; a black cap around a pole is none."""
    image = torch.rand(3, 64, 128, generator=torch.Generator().manual_seed(0)).clamp_min(0.1)
    image[:, 20:30, 40:60] = 0
    image[:, 58:] = 0
    names = ("0/rgb.png", "1/rgb.png") if is_scan else ("0.png", "1.png")
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        write_image(tmp_path / name, image)
        (tmp_path / name).with_name("rot.txt").write_text("1 0 0 0 1 0 0 0 1" if is_scan else "")
        (tmp_path / name).with_name("tran.txt").write_text(f"{name[0]} 0 0")
    if not is_scan:
        poses = {name: [[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]] for x, name in enumerate(names)}
        content = {"convention": "cam2world opencv", "poses": poses}
        (tmp_path / "poses.json").write_text(json.dumps(content))
    views = load_sets(tmp_path)[0].load_context(64)
    assert not views.shown[:, 58:].any()
    assert torch.equal(views.shown[:, 20:30, 40:60], torch.full((2, 10, 20), not is_scan))
    assert views.shown[:, :18].all()
    assert views.masks.all()
    assert torch.allclose(views.images[0], image, atol=3e-3)
