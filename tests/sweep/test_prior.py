import math

import numpy as np
import pytest

from pansplat.sweep import prior as prior_module
from pansplat.sweep import search as search_module
from pansplat.sweep.matching import HypothesisSet, View
from pansplat.sweep.panoramas import ray_grid, resize_sphere, upright_rotation
from pansplat.sweep.prior import DepthPrior, PriorEstimator, apply_prior_cost
from pansplat.sweep.search import SearchConfig, observe, search

_CAMERA_HEIGHT = 1.2  # of `Room.high` over y = 0, metres
_DOWN = np.array((0.0, 1.0, 0.0))
_LIMITS = 1 / 8, 1 / 0.3  # inverse heights of the cameras over the floor


class TrueDepth:
    """A model that returns the room's depth at upright poses in units of the camera's height, and records its input."""

    fingerprint = "truth"

    def __init__(self, room, poses):
        self.room, self.poses, self.starts = room, poses, []

    def observe(self, images):
        self.images, self.priors = images, []
        for pose in self.poses:
            depth = self.room.cast(pose, 64)[1] / (self.room.high[1] - pose[1, 3])
            self.priors.append(DepthPrior(np.log(depth), np.full(depth.shape, 0.05)))
        return self

    def sharpen(self):
        return [resize_sphere(prior.log_depth, 96) for prior in self.priors]

    def refine(self, estimates, cam2world, neighbours, iterations):
        ratios = [np.median(e.log_depth - p.log_depth) for e, p in zip(estimates, self.priors, strict=True)]
        self.starts.append(np.exp(ratios))
        self.cam2world, self.iterations = cam2world, iterations
        return estimates


class SmallHalls(TrueDepth):
    """The same with all surfaces but the floor at half of their distance, as if halls were homes."""

    def observe(self, images):
        super().observe(images)
        for prior, pose in zip(self.priors, self.poses, strict=True):
            below = np.exp(prior.log_depth) * (ray_grid(64) @ pose[:3, :3].T @ _DOWN)
            prior.log_depth[np.abs(below - 1) > 0.01] -= math.log(2)
        return self


class TrueHeights(TrueDepth):
    """The same with the true depth after the refinement, because blank rooms do not show the heights."""

    def refine(self, estimates, cam2world, neighbours, iterations):
        super().refine(estimates, cam2world, neighbours, iterations)
        heights = [self.room.high[1] - pose[1, 3] for pose in self.poses]
        return [
            DepthPrior(prior.log_depth + math.log(height), prior.scale)
            for prior, height in zip(self.priors, heights, strict=True)
        ]


def _estimate(room, poses, model_type=TrueDepth):
    images = [room.cast(pose, 64)[0] for pose in poses]
    views = [View(image, np.ones(image.shape[:2], bool)) for image in images]
    upright = [pose.copy() for pose in poses]
    for pose in upright:
        turn = upright_rotation(pose[:3, :3], _DOWN)
        pose[:3, :3] = pose[:3, :3] if turn is None else pose[:3, :3] @ turn
    model = model_type(room, upright)
    estimator = PriorEstimator(model, images, np.stack(poses), _DOWN, _LIMITS)
    others = [[other for other in range(len(views)) if other != view] for view in range(len(views))]
    priors = estimator.estimate_by_matching(views, others)
    assert {len(own) for own in priors} == {len(model.starts)}
    return model, priors, estimator


def test_camera_heights_are_found_by_matching(make_room):
    room = make_room()
    poses = [room.pose((-0.6, 0.0, -0.2)), room.pose((0.5, 0.2, 0.1))]
    model, _, _ = _estimate(room, poses)
    for heights in model.starts:
        np.testing.assert_allclose(heights, (_CAMERA_HEIGHT, _CAMERA_HEIGHT - 0.2), rtol=0.02)


class Spheres(TrueDepth):
    """A model that sees a sphere of 1.4 camera heights around each camera."""

    def observe(self, images):
        self.priors = [DepthPrior(np.full((64, 128), math.log(1.4)), np.full((64, 128), 0.05)) for _ in images]
        return self


def test_neighbours_are_the_views_that_see_the_same_surfaces_best_first(make_room):
    """Three cameras along a line of a metre, and one 9 m away: it has a neighbour, but is none."""
    room = make_room()
    poses = [room.pose((x, 0.0, 0.0)) for x in (0.0, 1.0, 0.4, 9.0)]
    estimator = PriorEstimator(
        Spheres(room, poses), [np.ones((64, 128, 3), np.float32)] * 4, np.stack(poses), _DOWN, _LIMITS
    )
    *near, far = estimator.choose_neighbours(3)
    assert near == [[2, 1], [2, 0], [0, 1]] and len(far) == 1
    assert estimator.choose_neighbours(1)[:3] == [[2], [2], [0]]


def test_hall_has_a_prior_by_its_floor_and_one_by_all_surfaces(make_room):
    room = make_room(low=(-5.0, -4.0, -4.0), high=(5.0, 1.2, 4.5))
    poses = [room.pose((-0.6, 0.0, -0.2)), room.pose((0.5, 0.0, 0.1))]
    model, priors, _ = _estimate(room, poses, SmallHalls)
    np.testing.assert_allclose(model.starts[0], _CAMERA_HEIGHT, rtol=0.03)
    assert min(model.starts[1]) > 1.7 * _CAMERA_HEIGHT
    depth = np.log(room.cast(poses[0], 64)[1])
    errors = [np.abs(prior.log_depth - depth) for prior in priors[0]]
    assert np.median(np.minimum(*errors)) < 0.1 < np.median(errors[0])


def test_blank_room_has_one_prior_at_the_usual_height(make_room):
    room = make_room("blank")
    model, _, _ = _estimate(room, [room.pose((-0.6, 0.0, -0.2)), room.pose((0.5, 0.0, 0.1))])
    assert len(model.starts) == 1
    np.testing.assert_allclose(model.starts[0], 1.5, rtol=0.06)  # a step of the candidates


def test_tilted_cameras_are_turned_upright(make_room, turn):
    room = make_room()
    tilt = turn("x", 12) @ turn("z", -9)
    poses = [room.pose((-0.6, 0.0, -0.2), tilt), room.pose((0.5, 0.0, 0.1))]
    model, priors, _ = _estimate(room, poses)
    np.testing.assert_allclose(model.cam2world[0, :3, 1], _DOWN, atol=1e-6)
    np.testing.assert_array_equal(model.cam2world[1], poses[1])
    assert np.abs(model.images[0] - room.cast(model.cam2world[0], 64)[0]).mean() < 0.02
    error = np.abs(
        priors[0][0].log_depth - np.log(room.cast(poses[0], 64)[1]) - math.log(model.starts[0][0] / _CAMERA_HEIGHT)
    )
    assert np.median(error) < 0.01


@pytest.mark.parametrize("cap", (0.5, 3.0))
@pytest.mark.parametrize("count_priors", (1, 3))
def test_cost_grows_with_the_deviation_from_the_nearest_prior_up_to_the_cap(cap, count_priors, monkeypatch):
    generator = np.random.default_rng(0)
    shape, count = (4, 8), 5
    base = generator.uniform(0.2, 0.4, shape).astype(np.float32)
    hypotheses = HypothesisSet(base, np.full(shape, 0.1, np.float32), np.zeros(count, np.float32))
    priors = [
        DepthPrior(generator.uniform(0, 1, shape), generator.uniform(0.01, 0.5, shape)) for _ in range(count_priors)
    ]
    numbers = {"_DEVIATION_COST": 0.7, "_MAX_DEVIATION": cap, "_MIN_SCALE": 0.1, "_FURTHER_PENALTY": 0.4}
    for name, value in numbers.items():
        monkeypatch.setattr(prior_module, name, value)
    cost = np.ones((*shape, count), np.float32)
    apply_prior_cost(cost, priors, [hypotheses])
    log_inverse = np.log(base[..., None] + 0.1 * np.arange(count))
    away = [
        np.abs(log_inverse + prior.log_depth[..., None]) / np.maximum(prior.scale, 0.1)[..., None] + (0.4 if n else 0)
        for n, prior in enumerate(priors)
    ]
    np.testing.assert_allclose(cost, 1 + 0.7 * np.minimum(np.min(away, axis=0), cap), rtol=1e-4)


@pytest.mark.parametrize("views", (1, 2))
def test_views_at_one_place_have_the_sharpened_depth_at_a_usual_height(make_room, views):
    room = make_room()
    poses = [room.pose((-0.4, 0.0, -0.2))] * views
    observed = room.observe(64, poses)
    surfaces = search(observe(observed.posed, SearchConfig(), TrueDepth(room, poses)))
    assert len(surfaces) == views
    expected = observed.depths[0] * 1.5 / _CAMERA_HEIGHT
    for surface in surfaces:
        assert np.median(np.abs(surface.inverse_depth * expected - 1)) < 0.02


def test_prior_decides_where_photographs_are_blank(make_room):
    room = make_room("blank")
    observed = room.observe(64)
    surfaces = search(observe(observed.posed, SearchConfig(), TrueHeights(room, room.two_poses())))
    for surface, depth in zip(surfaces, observed.depths, strict=True):
        assert np.median(np.abs(surface.inverse_depth * depth - 1)) < 0.05


class BentDepth(TrueHeights):
    """The same with single views whose depth has smooth errors of up to 20 %."""

    def sharpen(self):
        return [log_depth + _smooth_error(96) for log_depth in super().sharpen()]


def _smooth_error(height):
    x, y, z = np.moveaxis(ray_grid(height), -1, 0)
    return 0.2 * np.sin(2 * x + 1) * np.cos(2 * z) * np.cos(y)


def _search_near(room, model_type):
    """The median error of log-depth of each view, and the steps of the finest level."""
    observed = room.observe(96)
    model = model_type(room, list(observed.posed.cam2world))
    surfaces = search(observe(observed.posed, SearchConfig(near_single_views=True), model))
    errors = [np.abs(np.log(s.inverse_depth * depth)) for s, depth in zip(surfaces, observed.depths, strict=True)]
    steps = search_module._SINGLE_VIEW_CANDIDATES[-1] - 1
    return [np.median(error) for error in errors], 2 * search_module._SINGLE_VIEW_REACH[-1] / steps


def test_search_near_single_views_removes_their_smooth_errors(make_room):
    errors, step = _search_near(make_room(box=((-0.3, -0.1, 1.0), (0.4, 1.2, 1.7))), BentDepth)
    assert max(errors) < step < np.median(np.abs(_smooth_error(96))) / 4


def test_search_near_exact_single_views_keeps_walls_without_texture(make_room):
    errors, step = _search_near(make_room(paint="blank"), TrueHeights)
    assert max(errors) < step / 2  # the middle hypothesis, with any fraction of a step
