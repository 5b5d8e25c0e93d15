"""Homes are closed, walkable and reproducible; their variants differ in doors and movable things only."""

import numpy as np
import pytest

from pansplat_homes.homes import Home, build_home
from pansplat_homes.plans import OUTSIDE


@pytest.fixture(scope="module")
def homes() -> list[Home]:
    return [build_home(np.random.default_rng((11, index))) for index in range(12)]


def test_equal_seeds_give_equal_homes(homes: list[Home]) -> None:
    again = build_home(np.random.default_rng((11, 0)))
    for first, second in zip(homes[0].variants, again.variants, strict=True):
        assert np.array_equal(first.arrays.bodies.maps, second.arrays.bodies.maps)
        assert np.array_equal(first.arrays.lights, second.arrays.lights)
    assert homes[1].plan.rooms != again.plan.rooms


def test_rays_leave_a_home_only_through_its_openings(homes: list[Home]) -> None:
    for home in homes[:6]:
        for room in home.plan.rooms[:3]:
            pose = np.eye(4)
            pose[0, 3], pose[1, 3], pose[2, 3] = room.middle[0], -1.9, room.middle[1]
            _, depth = home.variants[0].panorama(pose, 24, 1)
            weight = np.cos((np.arange(24) + 0.5) * np.pi / 24 - np.pi / 2)[:, None]
            assert ((depth < 15) * weight).sum() / (weight.sum() * 48) > 0.8
            assert (depth[0] < 5).all() and (depth[-1] < 3).all()


def test_variants_share_most_bodies_and_some_doors_move(homes: list[Home]) -> None:
    moved = 0
    for home in homes:
        first, second = ({row.tobytes() for row in variant.arrays.bodies.maps} for variant in home.variants)
        assert len(first & second) > 0.75 * len(first)
        moved += first != second
    assert moved > 0.6 * len(homes)


def test_cameras_are_in_rooms_near_each_other_and_clear_of_bodies(homes: list[Home]) -> None:
    found = 0
    for home in homes:
        cameras = home.sample_cameras(np.random.default_rng(5), 4)
        found += len(cameras)
        for place, (variant, pose) in enumerate(cameras):
            centre = pose[:3, 3]
            assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3))
            assert home.plan.room_at(centre[0], centre[2]) != OUTSIDE
            assert home.variants[variant].clearance(centre[None])[0] >= 0.35
            others = [np.linalg.norm(other[:3, 3] - centre) for _, other in cameras[:place]]
            assert not others or 0.3 <= min(others) <= 4.0
    assert found > 3.5 * len(homes)


def test_light_is_positive_and_finite(homes: list[Home]) -> None:
    for home in homes[:6]:
        for variant, pose in home.sample_cameras(np.random.default_rng(6), 3):
            image, depth = home.variants[variant].panorama(pose, 32, 2)
            assert np.isfinite(image).all() and image.min() >= 0
            assert np.isfinite(depth).all()
