"""Short texts stand for scenes, panoramas and poses, whatever their size."""

from pathlib import Path

import numpy as np
import torch

from pansplat.gaussians.scene import Gaussians, Scene, empty_gaussians
from pansplat.inputs.panorama_sets import Panorama, PanoramaSet
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
SCENE = Scene(GAUSSIANS, POSES, 0.45, 10.0, ("left", "right"), "default", 256)
VIEWS = Views(torch.zeros(2, 3, 8, 16), POSES, MASKS, 0.45, 10.0, ("left", "right"))
PAIR = PanoramaSet("room", Path("folder"), (LEFT, RIGHT), (LEFT,), 0.45, 10.0)
TOUR = TourGraph("home", Path(), (LEFT, RIGHT), 0.45, 10.0, overlaps={(0, 0): 1.0, (1, 1): 1.0})
ESTIMATE = PoseEstimate(tuple(Path(f"{n}.jpg") for n in "abc"), (GROUP,), {Path("c.jpg"): "dark"}, {})


def test_values_are_described_by_short_texts() -> None:
    bare = Scene(empty_gaussians(), POSES[:0], 0.1, 5.0)
    rendering = Rendering(torch.zeros(3, 8, 16), ALPHA, 2 * ALPHA)
    for value in (GAUSSIANS, SCENE, bare, rendering, VIEWS, PAIR, LEFT, RIGHT, TOUR, GROUP, ESTIMATE):
        text = repr(value)
        assert text.startswith(f"<{type(value).__name__}") and len(text) < 160 and "\n" not in text
    assert all(part in repr(SCENE) for part in ("1,200", "left, right", "0.45 to 10 m", "default", "256x512"))


def test_counts_names_and_ranges() -> None:
    assert (describe_count(1, "panorama"), describe_count(1200, "panorama")) == ("1 panorama", "1,200 panoramas")
    assert list_first(list("abcdefg")) == "a, b, c, d and 3 more"
    assert (describe_range(0.45, 10, "m"), describe_range(2, 2)) == ("0.45 to 10 m", "2")


def test_predictors(small_config) -> None:
    assert repr(load_model("default")).startswith("<Sweep default: guided by a depth network, ")
    text = repr(NetworkPredictor("mine", PanSplat(small_config)))
    assert text.startswith("<NetworkPredictor mine: PanSplat of 1.5 million") and len(text) < 120
