"""What the sweep reaches on photographs and scans: a guard, well under what is measured (docs/sweep.md)."""

from pathlib import Path

import pytest
import torch

import pansplat
from pansplat.data.pairs import Pair
from pansplat.evaluation.metrics import cross_fade, ws_psnr

pytestmark = pytest.mark.shared


def _decibels(pair: Pair, height: int) -> tuple[float, float]:
    """WS-PSNR of the middle view, by the sweep and by the cross-fade."""
    context, targets = pair.load_context(height), pair.load_targets(height)
    scene = pansplat.predict(pair, height=height, cache=False)
    with torch.no_grad():
        picture = pansplat.render(scene, targets.cam2world[0])
    faded = cross_fade(context.images, context.cam2world, targets.cam2world[0])
    assert (picture.alpha > 0.9).float().mean() > 0.9 and picture.alpha.min() > 0.4, "holes"
    return ws_psnr(picture.color, targets.images[0]), ws_psnr(faded, targets.images[0])


@pytest.mark.slow
def test_a_scanned_room_is_seen_from_between_its_views(shared: Path):
    (pair,) = (pair for pair in pansplat.load_pairs(shared / "data/mp3d_sample") if pair.targets)
    reached, faded = _decibels(pair, 256)
    assert reached >= 24.0  # 24.6 measured
    assert reached >= faded + 7.0


@pytest.mark.slow
def test_photographed_homes_are_seen_better_than_by_fading(shared: Path):
    pairs = [pair for pair in pansplat.load_pairs(shared / "data/zind") if pair.targets]
    figures = torch.tensor([_decibels(pair, 128) for pair in pairs])
    assert len(pairs) == 3
    assert (figures[:, 0] > figures[:, 1]).all()
    assert float((figures[:, 0] - figures[:, 1]).mean()) >= 3.0
