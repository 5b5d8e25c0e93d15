"""The shipped sample: rigid poses, exact depth, a free licence for every model."""

import hashlib
import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pansplat.geometry.equirect import pixel_directions, row_weights, sample_equirect, uv_from_directions
from pansplat.geometry.pose import invert_pose, orthonormal_error

SAMPLE = Path(__file__).parents[2] / "assets" / "living_room"
RECIPE = SAMPLE.parent / "recipe" / "living_room"
NAMES = ("left", "middle", "right")
INPUTS = ("left", "right")
STRIDE = 6  # of the pixels that are compared


class View:
    """One panorama of the sample: colour (3 H W) at the depth's size, radial depth (H W) in metres, pose."""

    def __init__(self, name: str, entry: dict) -> None:
        depth = np.asarray(Image.open(SAMPLE / entry["depth"]))
        image = Image.open(SAMPLE / f"{name}.jpg")
        self.size = image.size
        color = np.asarray(image.resize(depth.shape[::-1], Image.Resampling.BOX))
        self.color = torch.from_numpy(color.copy()).permute(2, 0, 1).double() / 255
        self.depth = torch.from_numpy(depth.astype(np.float64)) / 1000
        self.pose = torch.tensor(entry["cam2world"], dtype=torch.float64)


@pytest.fixture(scope="module")
def poses() -> dict:
    return json.loads((SAMPLE / "poses.json").read_text())


@pytest.fixture(scope="module")
def views(poses: dict) -> dict[str, View]:
    return {name: View(name, poses["poses"][f"{name}.jpg"]) for name in NAMES}


def project(view: View, pose: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Positions of the pixels of `view` in a camera at `pose`: uv, distance to the camera, solid angles."""
    height, width = view.depth.shape
    rays = pixel_directions(height, width, dtype=torch.float64)[::STRIDE, ::STRIDE]
    points = rays * view.depth[::STRIDE, ::STRIDE, None]
    points = points @ view.pose[:3, :3].T + view.pose[:3, 3]
    inverse = invert_pose(pose)
    there = points @ inverse[:3, :3].T + inverse[:3, 3]
    weights = row_weights(height)[::STRIDE, None].expand(points.shape[:2])
    return uv_from_directions(there), there.norm(dim=-1), weights


def nearest_depth(view: View, uv: torch.Tensor) -> torch.Tensor:
    height, width = view.depth.shape
    row = (uv[..., 1] * height).long().clamp(0, height - 1)
    column = (uv[..., 0] * width).long() % width
    return view.depth[row, column]


def weighted_median(values: torch.Tensor, weights: torch.Tensor) -> float:
    order = values.argsort()
    total = weights[order].cumsum(0)
    return float(values[order][(total < total[-1] / 2).sum()])


def photometric_error(middle: View, other: View, pose: torch.Tensor) -> float:
    """Median absolute colour difference of the middle view and `other`, if its pose were `pose`."""
    uv, distance, weights = project(middle, pose)
    seen = (nearest_depth(other, uv) / distance - 1).abs() < 0.03
    difference = (sample_equirect(other.color, uv) - middle.color[:, ::STRIDE, ::STRIDE]).abs().mean(0)
    return weighted_median(difference[seen], weights[seen]) if seen.float().mean() > 0.3 else 1.0


def test_the_pair_has_two_context_views_and_the_middle_target(poses: dict):
    pairs = json.loads((SAMPLE / "pairs.json").read_text())
    assert pairs == {"pairs": [{"context": ["left.jpg", "right.jpg"], "target": ["middle.jpg"]}]}
    assert poses["convention"] == "cam2world opencv"
    assert set(poses["poses"]) == {f"{name}.jpg" for name in NAMES}


def test_cameras_are_a_metre_apart_turned_and_tilted_with_the_target_midway(views: dict[str, View]):
    assert max(orthonormal_error(v.pose) for v in views.values()) < 1e-12
    left, middle, right = (views[n].pose[:3, 3] for n in NAMES)
    torch.testing.assert_close(middle, (left + right) / 2)
    assert float((right - left).norm()) == pytest.approx(1.0)
    first, second = (views[n].pose[:3, :3] for n in INPUTS)
    assert 20 < float(torch.rad2deg(torch.acos(((first.T @ second).trace() - 1) / 2))) < 90
    assert all(1.0 < float(torch.rad2deg(torch.acos(rotation[1, 1]))) < 5.0 for rotation in (first, second))


@pytest.mark.parametrize("name", NAMES)
def test_panoramas_are_well_exposed_with_depth_between_near_and_far(views: dict[str, View], poses: dict, name: str):
    view, luma = views[name], views[name].color.mean(0)
    assert view.depth.shape[1] == 2 * view.depth.shape[0] >= 1024
    assert view.size[0] == 2 * view.size[1] >= view.depth.shape[1]
    assert (SAMPLE / f"{name}.jpg").stat().st_size < 3.3e6
    assert poses["near"] < float(view.depth.min()) and float(view.depth.max()) < poses["far"]
    assert 0.3 < float(luma.mean()) < 0.65
    assert float((view.color > 0.99).all(0).double().mean()) < 0.01
    assert float((luma < 0.02).double().mean()) < 0.03
    down = view.pose[:3, :3].T @ torch.tensor((0.0, 1.0, 0.0), dtype=torch.float64)
    assert float(nearest_depth(view, uv_from_directions(down[None]))) == pytest.approx(1.5, abs=0.03)  # less the rug
    assert 1.0 < float(nearest_depth(view, uv_from_directions(-down[None]))) < 1.25


@pytest.mark.parametrize("name", INPUTS)
def test_warping_gives_the_other_view_with_its_pose_only(views: dict[str, View], name: str):
    view, middle = views[name], views["middle"]
    right = photometric_error(middle, view, view.pose)
    assert right < 0.015
    reversed_, inverted, still, flipped = (view.pose.clone() for _ in range(4))
    reversed_[:3, 3] = 2 * middle.pose[:3, 3] - view.pose[:3, 3]
    inverted[:3, :3] = view.pose[:3, :3].T
    still[:3, 3] = middle.pose[:3, 3]
    flipped[:3, 1:3] *= -1
    for wrong in (reversed_, inverted, still, flipped):
        uv, _, weights = project(middle, wrong)
        difference = (sample_equirect(view.color, uv) - middle.color[:, ::STRIDE, ::STRIDE]).abs().mean(0)
        assert weighted_median(difference.flatten(), weights.flatten()) > 2.5 * right


@pytest.mark.parametrize("name", INPUTS)
def test_depths_of_two_views_agree(views: dict[str, View], name: str):
    uv, distance, weights = project(views["middle"], views[name].pose)
    ratio = nearest_depth(views[name], uv) / distance
    fractions = weights / weights.sum()
    assert float(fractions[(ratio - 1).abs() < 0.02].sum()) > 0.85
    assert float(fractions[ratio > 1.02].sum()) < 0.05  # no surface is transparent; pixels on edges may differ
    assert weighted_median((ratio - 1).abs().flatten(), weights.flatten()) < 0.002


def test_every_model_is_credited_under_a_free_licence():
    credits = json.loads((SAMPLE / "credits.json").read_text())
    readme = (SAMPLE / "README.md").read_text()
    assert len(credits) >= 20
    for credit in credits:
        assert credit["licence"] in ("CC0 1.0", "CC BY 3.0", "CC BY 3.0 US")
        row = f"| {credit['model']} | {credit['title']} | {credit['author']} | {credit['licence']} |"
        assert row in readme, row


def test_readme_lists_the_checksum_of_every_file():
    listed = dict(re.findall(r"^([0-9a-f]{64})  (\S+)$", (SAMPLE / "README.md").read_text(), re.MULTILINE))
    found = {
        hashlib.sha256(p.read_bytes()).hexdigest(): p.name
        for p in SAMPLE.iterdir()
        if p.is_file() and p.name != "README.md"
    }
    assert listed == found


def test_the_recipe_has_no_absolute_paths():
    for path in [*RECIPE.iterdir(), *SAMPLE.glob("*.md"), *SAMPLE.glob("*.json")]:
        if path.is_file():
            assert not re.search(r"/(tmp|home|work|root|Users|media)/", path.read_text()), path
