"""Augmented samples are consistent: their depth still warps each view into the other."""

import math

import numpy as np
import pytest
import torch

from pansplat.geometry.equirect import pixel_directions
from pansplat.geometry.warp import relative_pose, warp_panorama
from pansplat.inputs.views import Sample, Views
from pansplat.training.augment import Augmentation, augment

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


@pytest.mark.parametrize(
    "settings",
    [
        Augmentation(yaw="shared", mirror="off", colour=0),
        Augmentation(yaw="each", mirror="off", colour=0),
        Augmentation(yaw="off", mirror="half", colour=0),
        Augmentation(yaw="off", mirror="off", tilt_degrees=5, colour=0),
        Augmentation(yaw="each", mirror="half", tilt_degrees=5, colour=0),
    ],
)
def test_augmented_views_warp_into_each_other(settings: Augmentation) -> None:
    for seed in range(4):
        changed = augment(_sample(), settings, np.random.default_rng(seed))
        limit = 8e-3 if settings.tilt_degrees else 3e-3  # nearest depth under a tilt
        assert _warping_error(changed.context, changed.context) < limit
        assert _warping_error(changed.targets, changed.context) < limit
        rotation = changed.context.cam2world[:, :3, :3]
        assert torch.allclose(rotation @ rotation.mT, torch.eye(3, dtype=torch.float64).expand(2, 3, 3), atol=1e-12)
        assert torch.allclose(torch.linalg.det(rotation), torch.ones(2, dtype=torch.float64))


def test_colour_changes_are_shared_and_exposure_differs_by_view() -> None:
    room = _room((0, 0, 0), (0, 0, 0))
    sample = Sample("room", room, room)
    alike = augment(sample, Augmentation(colour=0.2), np.random.default_rng(0))
    assert torch.equal(alike.context.images[0], alike.context.images[1])
    assert torch.equal(alike.context.images, alike.targets.images)
    assert not torch.equal(alike.context.images.mean(), room.images.mean())
    assert float(alike.context.images.min()) >= 0 and float(alike.context.images.max()) <= 1
    each = augment(sample, Augmentation(colour=0, exposure=1), np.random.default_rng(0))
    assert not torch.equal(each.context.images[0], each.context.images[1])


def test_augmentation_is_determined_by_the_seed() -> None:
    settings = Augmentation(tilt_degrees=3, exposure=0.5)
    first, again = (augment(_sample(), settings, np.random.default_rng(3)) for _ in range(2))
    assert torch.equal(first.context.images, again.context.images)
    other = augment(_sample(), settings, np.random.default_rng(4))
    assert not torch.equal(first.context.images, other.context.images)
