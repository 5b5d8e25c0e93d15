"""Augmented samples are consistent: their depth still warps each view into the other."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pansplat.geometry.warp import relative_pose, warp_panorama
from pansplat.inputs.views import Sample, Views
from pansplat.training.augment import augment, roll_views


@pytest.fixture
def sample(sphere: type) -> Sample:
    """Three views inside a sphere with exact depth."""
    return sphere().sample(0, 48, 0)


def _warping_error(a: Views, b: Views) -> float:
    """Mean difference of the first image of `a` and the last of `b`, warped by the depth of the first."""
    assert a.depths is not None
    pose = relative_pose(a.cam2world[:1], b.cam2world[-1:]).float()
    warped = warp_panorama(b.images[-1:], 1 / a.depths[:1, None], pose)[0, :, 0]
    return float((warped - a.images[0]).abs().mean())


def test_augmented_views_warp_into_each_other(sample: Sample, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pansplat.training.augment._COLOUR", 0.0)
    mirrored = set()
    for seed in range(6):
        changed = augment(sample, np.random.default_rng(seed))
        assert _warping_error(changed.context, changed.context) < 3e-3
        assert _warping_error(changed.targets, changed.context) < 3e-3
        rotation = changed.context.cam2world[:, :3, :3]
        assert torch.allclose(rotation @ rotation.mT, torch.eye(3, dtype=torch.float64).expand(2, 3, 3), atol=1e-12)
        assert torch.allclose(torch.linalg.det(rotation), torch.ones(2, dtype=torch.float64))
        mirrored.add(float(changed.context.cam2world[1, 0, 3]) < float(changed.context.cam2world[0, 0, 3]))
    assert mirrored == {True, False}


def test_each_view_may_have_its_own_yaw(sample: Sample) -> None:
    views = roll_views(sample.context, [5, 17])
    assert _warping_error(views, views) < 3e-3


def test_colour_changes_are_shared_and_determined_by_the_seed(sample: Sample) -> None:
    same = replace(sample, targets=sample.context)
    changed, again, other = (augment(same, np.random.default_rng(seed)) for seed in (3, 3, 4))
    assert torch.equal(changed.context.images, changed.targets.images)
    assert torch.equal(changed.context.images, again.context.images)
    assert not torch.equal(changed.context.images, other.context.images)
    assert not torch.equal(changed.context.images.mean(), sample.context.images.mean())
    assert float(changed.context.images.min()) >= 0 and float(changed.context.images.max()) <= 1
