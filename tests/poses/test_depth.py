"""Depth of single panoramas states distances of cameras, and which matches are right."""

import numpy as np
import pytest
from numpy import ndarray as Array

from pansplat.poses.depth import MatchDepths, estimate_depth, sample_nearest
from pansplat.poses.solvers import rotation_exp
from pansplat.sweep.prior import DepthPrior

CENTRE, FLOOR = np.array((0.4, 0.1, -0.5)), 1.35  # metres; the floor of the room of conftest.py
TILTED = rotation_exp(np.array((0.0, 1.1, 0.0))) @ rotation_exp(np.array((0.25, 0.0, -0.15)))


def make_rays(count: int = 2000) -> Array:
    rays = np.random.default_rng(0).normal(size=(count, 3))
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


@pytest.mark.parametrize("rotation", [np.eye(3), TILTED])
def test_depth_along_bearings_is_that_of_the_room(look_around, find_walls, rotation: Array) -> None:
    log_depth, deviation = look_around(0, rotation, CENTRE).depth.sample(make_rays())
    truth = np.log(find_walls(make_rays() @ rotation.T, CENTRE) / (FLOOR - CENTRE[1]))
    assert np.quantile(np.abs(log_depth - truth), 0.95) < 0.03  # 192 rows
    assert deviation == pytest.approx(np.hypot(0.03, 0.04))


def test_a_tilted_panorama_is_turned_upright_for_the_network(render_room, monkeypatch: pytest.MonkeyPatch) -> None:
    class Network:
        def observe(self, images: list[Array]) -> "Network":
            self.image = images[0]
            self.priors = [DepthPrior(np.zeros((8, 16), np.float32), np.full((8, 16), 0.1, np.float32))]
            return self

        def sharpen(self) -> list[Array]:
            return [np.ones((32, 64), np.float32)]

    network = Network()
    monkeypatch.setattr("pansplat.sweep.guided_sweep.load_default_sweep", lambda: type("Sweep", (), {"prior": network}))
    image = (render_room(0, TILTED, CENTRE) / 255).astype(np.float32)
    found = estimate_depth(image, TILTED.T @ (0.0, 1, 0))
    assert np.allclose((TILTED @ found.rotation)[:, 1], (0, 1, 0))
    assert np.abs(network.image - render_room(0, TILTED @ found.rotation, CENTRE) / 255).mean() < 0.02
    assert found.log_depth.shape == (32, 64) and found.scale.shape == (8, 16)
    unknown = estimate_depth(image, None)
    assert np.array_equal(unknown.rotation, np.eye(3)) and np.array_equal(network.image, image)


def make_matches(distance: float, count: int = 200, wrong: float = 0.0, seed: int = 0) -> tuple[MatchDepths, Array]:
    """Estimated depths with errors of 4 %, of which the last ones are random; triangulated ones in the distance."""
    rng = np.random.default_rng(seed)
    depths = rng.uniform(0.3, 4, (count, 2))
    logs = np.log(distance * depths) + 0.04 * rng.normal(size=depths.shape)
    first_wrong = count - round(wrong * count)
    logs[first_wrong:] = rng.uniform(-1, 2, (count - first_wrong, 2))
    return MatchDepths(logs, np.full(depths.shape, 0.06)), depths


@pytest.mark.parametrize("distance", [0.3, 2.3])
def test_the_distance_is_found_among_wrong_depths(distance: float) -> None:
    for seed in range(3):
        matches, depths = make_matches(distance, wrong=0.7, seed=seed)
        assert matches.find_distance(depths, np.ones(len(depths))) == pytest.approx(distance, rel=0.03)


def test_matches_without_weight_do_not_state_a_distance() -> None:
    matches, depths = make_matches(2.0, wrong=0.9)
    weight = np.where(np.arange(len(depths)) < 20, 1.0, 0.0)
    assert matches.find_distance(np.where(weight[:, None] > 0, depths, -1.0), weight) == pytest.approx(2, rel=0.03)
    assert np.isnan(matches.find_distance(depths, 0 * weight))


def test_right_depths_are_more_likely_than_wrong_ones() -> None:
    errors = np.array(((0, 0), (0.05, -0.05), (0, 0.7), (0.7, 0.7), (0.2, -0.2), (0.2, 0.2)))
    matches = MatchDepths(errors, np.full(errors.shape, 0.06))
    right, near, one, both, opposite, equal = matches.likelihood_ratio(
        np.full(errors.shape, 0.5), 2.0, np.full(len(errors), 0.5), np.full(len(errors), 1e-3)
    )
    assert right > near > 5 and both < 0.2 and both < one < 0.1 * right
    assert equal < 0.5 * opposite  # wrong matches of places on the floor have equal errors


def test_depths_say_nothing_without_parallax_and_little_with_a_small_one() -> None:
    wrong = MatchDepths(np.full((3, 2), 0.7), np.full((3, 2), 0.06))
    parallax, noise = np.array((0.5, 4e-3, 1e-3)), np.full(3, 1e-3)
    ratio = wrong.likelihood_ratio(np.ones((3, 2)), 1.0, parallax, noise)
    assert ratio[0] < ratio[1] < ratio[2] == 1
    behind = wrong.likelihood_ratio(np.full((3, 2), -1.0), 1.0, parallax, noise)
    assert np.isfinite(behind).all() and behind[0] < 0.2


def test_maps_are_sampled_at_the_nearest_pixel() -> None:
    values = np.arange(32.0).reshape(4, 8)
    rays = np.array(((0.0, 0, 1), (1, 0, 0), (-1e-9, 0, -1), (0, 1, 0), (0, -1, 0)))
    assert sample_nearest(values, rays).tolist() == [20, 22, 16, 28, 4]
