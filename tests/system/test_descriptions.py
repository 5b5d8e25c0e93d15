"""Short texts stand for scenes, panoramas and poses, whatever their size."""

from pathlib import Path
from typing import Any

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
LABELS = torch.arange(1200) % 2
GAUSSIANS = Gaussians(*(torch.zeros(1200, *s) for s in ((3,), (3,), (4,), (), (4, 3))), LABELS, LABELS)
MASKS = torch.ones(2, 8, 16, dtype=torch.bool)
MASKS[:, :4] = False
ALPHA = torch.ones(8, 16)
ALPHA[0] = 0.0
LEFT = Panorama("left", Path("left.jpg"), POSES[0])
RIGHT = Panorama("right", Path("right.jpg"), POSES[0], title="Hall", placement=Placement("not placed"))
GROUP = PoseGroup({Path(f"{name}.jpg"): np.eye(4) for name in "ab"}, 0.4, 8.0, 0.25, "the camera's height")
SCENE = (
    "<Scene: 1,200 Gaussians, 2 panoramas (left, right), near and far 0.45 to 10 m, predicted by default at 256x512,"
)
TEXTS: dict[str, Any] = {
    "<Gaussians: 1,200 of 2 views, levels 0 to 1, harmonics of degree 1, float32 on cpu>": GAUSSIANS,
    "<Gaussians: 0, harmonics of degree 0, float32 on cpu>": empty_gaussians(),
    **{
        f"{SCENE} for {drawing}>": Scene(
            GAUSSIANS, POSES, 0.45, 10.0, ("left", "right"), "default", 256, joint=drawing == "joint drawing"
        )
        for drawing in ("joint drawing", "deferred blending")
    },
    "<Scene: 0 Gaussians, no input cameras, near and far 0.1 to 5 m>": Scene(empty_gaussians(), POSES[:0], 0.1, 5.0),
    "<Rendering: 8x16, RGB, alpha 0 to 1, depth 2 m>": Rendering(torch.zeros(3, 8, 16), ALPHA, 2 * ALPHA),
    "<Views: 2 panoramas (left, right), 8x16, near and far 0.45 to 10 m, masks show 50 %>": Views(
        torch.zeros(2, 3, 8, 16), POSES, MASKS, 0.45, 10.0, ("left", "right")
    ),
    "<Pair room: context left, right, target left, near and far 0.45 to 10 m, in folder>": Pair(
        "room", Path("folder"), (LEFT, RIGHT), (LEFT,), 0.45, 10.0
    ),
    "<Panorama left: left.jpg, at (0, 0, 0) m>": LEFT,
    "<Panorama Hall: right.jpg, not placed>": RIGHT,
    "<TourGraph home: 2 panoramas (left, Hall), 0 edges in 2 parts, near and far 0.45 to 10 m>": TourGraph(
        "home", Path(), (LEFT, RIGHT), 0.45, 10.0, overlaps={(0, 0): 1.0, (1, 1): 1.0}
    ),
    "<PoseGroup: 2 panoramas (a.jpg, b.jpg), near and far 0.4 to 8 m, residual 0.25 degrees>": GROUP,
    "<PoseEstimate: 2 of 3 panoramas have a pose, by 0 pairs; residual 0.25 degrees; scale: the camera's height>": (
        PoseEstimate(tuple(map(Path, ("a.jpg", "b.jpg", "c.jpg"))), (GROUP,), {Path("c.jpg"): "dark"}, {})
    ),
}


@pytest.mark.parametrize("text", TEXTS)
def test_a_value_is_described_by_a_short_text(text: str) -> None:
    assert repr(TEXTS[text]) == text


def test_counts_names_and_ranges() -> None:
    assert (describe_count(1, "panorama"), describe_count(1200, "panorama")) == ("1 panorama", "1,200 panoramas")
    assert list_first(list("abcdefg")) == "a, b, c, d and 3 more"
    assert (describe_range(0.45, 10, "m"), describe_range(2, 2)) == ("0.45 to 10 m", "2")


def test_predictors(small_config) -> None:
    assert repr(load_model("default")).startswith("<Sweep default: guided by a depth network, ")
    text = repr(NetworkPredictor("mine", PanSplat(small_config)))
    assert text.startswith("<NetworkPredictor mine: PanSplat of 1.5 million") and len(text) < 120
