"""Poses of level cameras by estimated depth are found in every direction."""

import math

import numpy as np
import pytest

from pansplat.poses.axes import RotationPrior, SceneAxes
from pansplat.poses.depth import MatchDepths
from pansplat.poses.link_directions import NO_LINKS
from pansplat.poses.proposals import propose_by_depth
from pansplat.poses.solvers import rotation_angle, rotation_exp

HEIGHT = 1.35  # of the cameras over the floor, metres
AXES = np.array(((0.0, 1, 0), (0, 0, 1), (1, 0, 0)))  # down, and two walls, in the world


@pytest.mark.parametrize("way", [(1.4, 0.0), (0.0, 1.4), (-1.0, 1.1)])
def test_a_pose_by_comparison_is_near_the_right_one(look_around, find_walls, way) -> None:
    turns = np.eye(3), rotation_exp(np.array((0, math.radians(35), 0)))
    centres = np.array((-way[0] / 2, 0, -way[1] / 2)), np.array((way[0] / 2, 0, way[1] / 2))
    views = [look_around(0, turn, centre) for turn, centre in zip(turns, centres, strict=True)]
    rng = np.random.default_rng(0)
    rays = rng.normal(size=(60, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    points = centres[0] + rays * find_walls(rays, centres[0])[:, None]
    seen = [(points - centre) @ turn for turn, centre in zip(turns, centres, strict=True)]
    lengths = [np.linalg.norm(x, axis=1, keepdims=True) for x in seen]
    log_depth = np.log(np.concatenate(lengths, axis=1) / HEIGHT) + rng.normal(scale=0.04, size=(60, 2))
    log_depth[30:] += rng.normal(scale=1.0, size=(30, 2))  # wrong ones
    axes = RotationPrior(*(SceneAxes(AXES @ turn, True, True) for turn in turns))
    proposals = propose_by_depth(
        seen[0] / lengths[0],
        seen[1] / lengths[1],
        np.full(60, 0.5),
        MatchDepths(log_depth, np.full((60, 2), 0.05)),
        axes,
        (views[0], views[1]),
        NO_LINKS,
    )
    rotation, translation = turns[1].T @ turns[0], turns[1].T @ (centres[0] - centres[1]) / HEIGHT
    errors = [
        float(np.linalg.norm(t - translation)) if rotation_angle(r @ rotation.T) < 0.02 else math.inf
        for r, t in proposals[:2]
    ]
    assert min(errors) < 0.1
