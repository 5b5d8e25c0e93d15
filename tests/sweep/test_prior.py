import math

import numpy as np
import pytest

from pansplat.sweep import prior as prior_module
from pansplat.sweep.matching import HypothesisSet, MatchingConfig, View
from pansplat.sweep.prior import DepthPrior, PriorConfig, apply_prior_cost, estimate_priors
from pansplat.sweep.search import SearchConfig, search_surfaces
from pansplat.sweep.surface import ray_grid, resize_sphere

_CAMERA_HEIGHT = 1.2  # of `Room.high` over y = 0, metres
_DOWN = np.array((0.0, 1.0, 0.0))


class TrueDepth:
    """A model that returns the room's depth at upright poses in units of the camera's height, and records its input."""

    fingerprint = "truth"

    def __init__(self, room, poses):
        self.room, self.poses = room, poses

    def observe(self, images):
        self.images, self.priors = images, []
        for pose in self.poses:
            depth = self.room.cast(pose, 64)[1] / (self.room.high[1] - pose[1, 3])
            self.priors.append(DepthPrior(np.log(depth), np.full(depth.shape, 0.05)))
        return self

    def refine(self, camera_heights, cam2world, iterations):
        self.heights, self.cam2world, self.iterations = camera_heights, cam2world, iterations
        return [
            DepthPrior(prior.log_depth + math.log(height), prior.scale)
            for prior, height in zip(self.priors, camera_heights, strict=True)
        ]


class TrueHeights(TrueDepth):
    """The same with the true heights in the refinement, because blank rooms do not show them."""

    def refine(self, camera_heights, cam2world, iterations):
        return super().refine([self.room.high[1] - pose[1, 3] for pose in self.poses], cam2world, iterations)


def _estimate(room, poses):
    images = [room.cast(pose, 64)[0] for pose in poses]
    down = [ray_grid(64) @ pose[:3, :3].T @ _DOWN for pose in poses]
    views = [View(i, np.ones(i.shape[:2], bool), d.astype(np.float32)) for i, d in zip(images, down, strict=True)]
    upright = [pose.copy() for pose in poses]
    for pose in upright:
        turn = prior_module._upright_rotation(pose[:3, :3], _DOWN)
        pose[:3, :3] = pose[:3, :3] if turn is None else pose[:3, :3] @ turn
    model = TrueDepth(room, upright)
    limits = (1 / 8, 1 / 0.3)
    priors = estimate_priors(model, images, np.stack(poses), views, _DOWN, limits, PriorConfig(), MatchingConfig())
    return model, priors


def test_camera_heights_are_found_by_matching(make_room):
    room = make_room()
    poses = [room.pose((-0.6, 0.0, -0.2)), room.pose((0.5, 0.2, 0.1))]
    model, _ = _estimate(room, poses)
    np.testing.assert_allclose(model.heights, (_CAMERA_HEIGHT, _CAMERA_HEIGHT - 0.2), rtol=0.02)


def test_tilted_cameras_are_turned_upright(make_room, turn):
    room = make_room()
    tilt = turn("x", 12) @ turn("z", -9)
    poses = [room.pose((-0.6, 0.0, -0.2), tilt), room.pose((0.5, 0.0, 0.1))]
    model, priors = _estimate(room, poses)
    np.testing.assert_allclose(model.cam2world[0, :3, 1], _DOWN, atol=1e-6)
    np.testing.assert_array_equal(model.cam2world[1], poses[1])
    assert np.abs(model.images[0] - room.cast(model.cam2world[0], 64)[0]).mean() < 0.02
    error = np.abs(
        priors[0].log_depth - np.log(room.cast(poses[0], 64)[1]) - math.log(model.heights[0] / _CAMERA_HEIGHT)
    )
    assert np.median(error) < 0.01


def test_upside_down_camera_is_turned_by_half(turn):
    rotation = prior_module._upright_rotation(turn("x", 180), _DOWN)
    assert rotation is not None
    np.testing.assert_allclose((turn("x", 180) @ rotation)[:, 1], _DOWN, atol=1e-12)
    assert prior_module._upright_rotation(turn("y", 77), _DOWN) is None


def test_prior_rotated_there_and_back_is_the_same(make_room, turn):
    depth = make_room().cast(np.eye(4), 64)[1]
    prior = DepthPrior(np.log(depth).astype(np.float32), np.full(depth.shape, 0.1, np.float32))
    rotation = turn("x", 20)
    back = prior.rotate(rotation).rotate(rotation.T)
    assert np.median(np.abs(back.log_depth - prior.log_depth)) < 5e-3


@pytest.mark.parametrize("cap", (0.5, 3.0))
def test_cost_grows_with_the_deviation_up_to_the_cap(cap):
    generator = np.random.default_rng(0)
    shape, count = (4, 8), 5
    base = generator.uniform(0.2, 0.4, shape).astype(np.float32)
    hypotheses = HypothesisSet(
        base, np.full(shape, 0.1, np.float32), np.zeros((2, count), np.float32), np.zeros(shape, np.uint8)
    )
    prior = DepthPrior(generator.uniform(0, 1, shape), generator.uniform(0.01, 0.5, shape))
    config = PriorConfig(weight=0.7, cap=cap, min_scale=0.1)
    cost = np.ones((*shape, count), np.float32)
    apply_prior_cost(cost, prior, [hypotheses], config)
    log_inverse = np.log(base[..., None] + 0.1 * np.arange(count))
    away = np.abs(log_inverse + prior.log_depth[..., None]) / np.maximum(prior.scale, 0.1)[..., None]
    np.testing.assert_allclose(cost, 1 + 0.7 * np.minimum(away, cap), rtol=1e-4)


def test_resized_prior_keeps_its_values():
    prior = DepthPrior(np.full((8, 16), 1.5, np.float32), np.full((8, 16), 0.2, np.float32)).resize(32)
    assert prior.log_depth.shape == (32, 64)
    np.testing.assert_allclose(prior.log_depth, 1.5)
    np.testing.assert_allclose(resize_sphere(prior.scale, 4), 0.2, rtol=1e-6)


def test_coincident_cameras_have_the_first_estimate_at_a_usual_height(make_room, observe):
    room = make_room()
    pose = room.pose((-0.4, 0.0, -0.2))
    observed = observe(room, [pose, pose], 64)
    model = TrueDepth(room, [pose, pose])
    surfaces = search_surfaces(observed.posed, SearchConfig(room_layout=None), lambda what, fraction: None, model)
    expected = observed.depths[0] * 1.5 / _CAMERA_HEIGHT
    for surface in surfaces:
        assert np.median(np.abs(surface.inverse_depth * expected - 1)) < 0.02


def test_prior_decides_where_photographs_are_blank(make_room, observe, two_poses):
    room = make_room("blank")
    poses = two_poses(room)
    observed = observe(room, poses, 64)
    upright = [pose.copy() for pose in poses]
    surfaces = search_surfaces(
        observed.posed, SearchConfig(room_layout=None), lambda what, fraction: None, TrueHeights(room, upright)
    )
    for surface, depth in zip(surfaces, observed.depths, strict=True):
        assert np.median(np.abs(surface.inverse_depth * depth - 1)) < 0.05
