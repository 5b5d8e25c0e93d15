"""Augmented samples are consistent: their depth still warps each view into the other."""

import math

import numpy as np
import pytest
import torch

from pansplat.geometry.equirect import pixel_directions
from pansplat.geometry.warp import relative_pose, warp_panorama
from pansplat.inputs.views import Sample, Views
from pansplat.training.augment import augment, roll_views

HEIGHT = 48
PLACES = ((0, 0, 0), (0.6, 0.1, 0.2))


def _room(*centres: tuple[float, float, float], yaw: float = 0.7) -> Views:
    """Views in a box with a smooth colour on its walls, and exact depth."""
    cosine, sine = math.cos(yaw), math.sin(yaw)
    pose = torch.eye(4, dtype=torch.float64).repeat(len(centres), 1, 1)
    pose[:, :3, :3] = torch.tensor(((cosine, 0, sine), (0, 1, 0), (-sine, 0, cosine)), dtype=torch.float64)
    pose[:, :3, 3] = torch.tensor(centres, dtype=torch.float64)
    rays = pixel_directions(HEIGHT, 2 * HEIGHT, dtype=torch.float64) @ pose[0, :3, :3].T
    walls = torch.tensor(((-2.0, -1.4, -3.0), (2.5, 1.2, 2.0)), dtype=torch.float64)
    images, depths = [], []
    for centre in pose[:, :3, 3]:
        depth = torch.maximum((walls[0] - centre) / rays, (walls[1] - centre) / rays).amin(dim=-1)
        points = centre + depth[..., None] * rays
        images.append((0.5 + 0.4 * torch.sin(1.7 * points + points.roll(1, -1))).movedim(-1, 0))
        depths.append(depth)
    masks = torch.ones(len(centres), HEIGHT, 2 * HEIGHT, dtype=torch.bool)
    names = tuple(str(i) for i in range(len(centres)))
    return Views(torch.stack(images).float(), pose, masks, 0.3, 10.0, names, torch.stack(depths).float())


def _sample() -> Sample:
    return Sample("room", _room(*PLACES), _room((0.3, 0, 0.1)))


def _warping_error(a: Views, b: Views) -> float:
    """Mean difference of the first image of `a` and the last of `b`, warped by the depth of the first."""
    assert a.depths is not None
    pose = relative_pose(a.cam2world[:1], b.cam2world[-1:]).float()
    warped = warp_panorama(b.images[-1:], 1 / a.depths[:1, None], pose)[0, :, 0]
    return float((warped - a.images[0]).abs().mean())


def test_augmented_views_warp_into_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pansplat.training.augment._COLOUR", 0.0)
    mirrored = set()
    for seed in range(6):
        changed = augment(_sample(), np.random.default_rng(seed))
        assert _warping_error(changed.context, changed.context) < 3e-3
        assert _warping_error(changed.targets, changed.context) < 3e-3
        rotation = changed.context.cam2world[:, :3, :3]
        assert torch.allclose(rotation @ rotation.mT, torch.eye(3, dtype=torch.float64).expand(2, 3, 3), atol=1e-12)
        assert torch.allclose(torch.linalg.det(rotation), torch.ones(2, dtype=torch.float64))
        mirrored.add(float(changed.context.cam2world[1, 0, 3]) < float(changed.context.cam2world[0, 0, 3]))
    assert mirrored == {True, False}


def test_each_view_may_have_its_own_yaw() -> None:
    views = roll_views(_room(*PLACES), [5, 17])
    assert _warping_error(views, views) < 3e-3


def test_colour_changes_are_shared() -> None:
    room = _room((0, 0, 0), (0, 0, 0))
    changed = augment(Sample("room", room, room), np.random.default_rng(0))
    assert torch.equal(changed.context.images[0], changed.context.images[1])
    assert torch.equal(changed.context.images, changed.targets.images)
    assert not torch.equal(changed.context.images.mean(), room.images.mean())
    assert float(changed.context.images.min()) >= 0 and float(changed.context.images.max()) <= 1


def test_augmentation_is_determined_by_the_seed() -> None:
    first, again, other = (augment(_sample(), np.random.default_rng(seed)) for seed in (3, 3, 4))
    assert torch.equal(first.context.images, again.context.images)
    assert not torch.equal(first.context.images, other.context.images)
