"""Short texts stand for scenes, panoramas and poses, whatever their size."""

from pathlib import Path

import numpy as np
import pytest
import torch

from pansplat.gaussians.scene import Gaussians, Scene, empty_gaussians
from pansplat.inputs.pairs import Pair, Panorama
from pansplat.inputs.placements import Placement
from pansplat.inputs.views import Views
from pansplat.model.network import NetworkPredictor
from pansplat.model.pansplat import PanSplat
from pansplat.pipeline import load_model
from pansplat.poses.estimate import PoseEstimate, PoseGroup
from pansplat.rendering import Rendering
from pansplat.system.descriptions import describe_count, describe_range, list_first
from pansplat.tours.graph import TourGraph

POSES = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)


def make_gaussians(count: int = 1200) -> Gaussians:
    zeros = torch.zeros(count)
    labels = torch.arange(count) % 2
    return Gaussians(torch.zeros(count, 3), torch.ones(count, 3), torch.ones(count, 4), zeros, torch.zeros(count, 4, 3),
                     labels, labels)  # fmt: skip


def make_panorama(name: str, **fields: object) -> Panorama:
    return Panorama(name, Path(f"{name}.jpg"), POSES[0], **fields)


def test_counts_names_and_ranges() -> None:
    assert (describe_count(1, "panorama"), describe_count(1200, "panorama")) == ("1 panorama", "1,200 panoramas")
    assert list_first(list("abcde")) == "a, b, c, d, e"
    assert list_first(list("abcdefg")) == "a, b, c, d and 3 more"
    assert (describe_range(0.45, 10, "m"), describe_range(2, 2)) == ("0.45 to 10 m", "2")


def test_gaussians() -> None:
    text = "<Gaussians: 1,200 of 2 views, levels 0 to 1, harmonics of degree 1, float32 on cpu>"
    assert repr(make_gaussians()) == text
    assert repr(empty_gaussians()) == "<Gaussians: 0, harmonics of degree 0, float32 on cpu>"


@pytest.mark.parametrize(("joint", "drawing"), [(True, "joint drawing"), (False, "deferred blending")])
def test_scenes(joint: bool, drawing: str) -> None:
    scene = Scene(make_gaussians(), POSES, 0.45, 10.0, ("left", "right"), "default", 256, joint=joint)
    assert repr(scene) == (
        "<Scene: 1,200 Gaussians, 2 panoramas (left, right), near and far 0.45 to 10 m, "
        f"predicted by default at 256x512, for {drawing}>"
    )


def test_scenes_without_cameras() -> None:
    scene = Scene(empty_gaussians(), POSES[:0], 0.1, 5.0)
    assert repr(scene) == "<Scene: 0 Gaussians, no input cameras, near and far 0.1 to 5 m>"


def test_renderings() -> None:
    depth = torch.full((8, 16), 2.0)
    depth[0], alpha = 0.0, torch.ones(8, 16)
    alpha[0] = 0.0
    rendering = Rendering(torch.zeros(3, 8, 16, requires_grad=True), alpha.requires_grad_(), depth.requires_grad_())
    assert repr(rendering) == "<Rendering: 8x16, RGB, alpha 0 to 1, depth 2 m>"
    assert repr(Rendering(torch.zeros(1, 8, 16), alpha, depth)).startswith("<Rendering: 8x16, 1 channel, ")


def test_views() -> None:
    masks = torch.ones(2, 8, 16, dtype=torch.bool)
    masks[:, :4] = False
    views = Views(torch.zeros(2, 3, 8, 16), POSES, masks, 0.45, 10.0, ("left", "right"))
    assert repr(views) == "<Views: 2 panoramas (left, right), 8x16, near and far 0.45 to 10 m, masks show 50 %>"
    none = Views(torch.zeros(0, 3, 8, 16), POSES[:0], masks[:0], 0.45, 10.0, ())
    assert repr(none) == "<Views: 0 panoramas, 8x16, near and far 0.45 to 10 m>"


def test_pairs_panoramas_and_tours() -> None:
    left, right = make_panorama("left"), make_panorama("right", title="Hall", placement=Placement("not placed"))
    pair = Pair("room", Path("folder"), (left, right), (left,), 0.45, 10.0)
    assert repr(pair) == "<Pair room: context left, right, target left, near and far 0.45 to 10 m, in folder>"
    assert repr(left) == "<Panorama left: left.jpg, at (0, 0, 0) m>"
    assert repr(right) == "<Panorama Hall: right.jpg, not placed>"
    tour = TourGraph("home", Path(), (left, right), 0.45, 10.0, overlaps={(0, 0): 1.0, (1, 1): 1.0})
    assert repr(tour) == "<TourGraph home: 2 panoramas (left, Hall), 0 edges in 2 parts, near and far 0.45 to 10 m>"


def test_pose_estimates() -> None:
    images = Path("a.jpg"), Path("b.jpg")
    group = PoseGroup({image: np.eye(4) for image in images}, 0.4, 8.0, 0.25, "the camera's height")
    estimate = PoseEstimate(images, (group,), {}, {})
    assert repr(group) == "<PoseGroup: 2 panoramas (a.jpg, b.jpg), near and far 0.4 to 8 m, residual 0.25 degrees>"
    assert repr(estimate) == f"<PoseEstimate: {estimate.summary}>"


def test_predictors(small_config) -> None:
    assert repr(load_model("default")).startswith("<Sweep default: guided by a depth network, ")
    assert repr(load_model("sweep")).startswith("<Sweep sweep: no weights, ")
    text = repr(NetworkPredictor("mine", PanSplat(small_config)))
    assert text.startswith("<NetworkPredictor mine: PanSplat of 1.5 million") and len(text) < 120
