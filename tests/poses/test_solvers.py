"""Minimal solvers find the exact pose of exact bearings, anywhere on the sphere."""

import numpy as np
import pytest

from pansplat.poses.solvers import (
    angle_between,
    decompose_essential,
    epipolar_angles,
    essential_from_five,
    rotation_angle,
    rotation_exp,
    skew,
    two_view_depths,
    upright_from_three,
)


@pytest.mark.parametrize("planar", [False, True])
def test_five_exact_bearings_give_the_essential_matrix(scene, planar) -> None:
    for seed in range(5):
        bearings = scene(seed, 40, planar=planar)
        a, b = (x.reshape(8, 5, 3) for x in (bearings.first, bearings.second))
        found, sample = essential_from_five(a, b)
        truth, found = (
            x / np.linalg.norm(x, axis=(-2, -1), keepdims=True)
            for x in (skew(bearings.translation) @ bearings.rotation, found)
        )
        distances = np.minimum(*(np.abs(found - sign * truth).max(axis=(1, 2)) for sign in (1, -1)))
        errors = [distances[sample == s].min() for s in range(8) if (sample == s).any()]
        assert np.median(errors) < 1e-6
        assert len(errors) >= 7


def test_singular_samples_of_five_bearings_give_no_invalid_number() -> None:
    a = np.zeros((2, 5, 3))
    a[..., 2] = 1
    found, _ = essential_from_five(a, a)
    assert np.isfinite(found).all()


def test_three_bearings_give_the_pose_of_upright_cameras_in_most_samples(scene) -> None:
    for seed in range(5):
        translation = np.array((np.cos(seed), 0.4, np.sin(seed)))
        bearings = scene(seed, 60, upright=True, translation=translation / np.linalg.norm(translation))
        a, b = (x.reshape(20, 3, 3) for x in (bearings.first, bearings.second))
        rotations, translations = upright_from_three(a, b)
        errors = rotation_angle(rotations @ bearings.rotation.T) + np.minimum(
            angle_between(translations, bearings.translation), angle_between(-translations, bearings.translation)
        )
        assert (errors < 1e-6).sum() >= 12  # of 20; pairs of nearly equal roots are missed


def test_one_of_the_four_decompositions_is_the_pose(scene) -> None:
    bearings = scene(3)
    options = decompose_essential(skew(bearings.translation) @ bearings.rotation)
    errors = [
        float(rotation_angle(r @ bearings.rotation.T) + angle_between(t, bearings.translation)) for r, t in options
    ]
    assert sorted(errors)[0] < 1e-7 < sorted(errors)[1]


def test_points_are_in_front_of_both_cameras_for_the_right_pose_only(scene) -> None:
    bearings = scene(4)
    for r, t in decompose_essential(skew(bearings.translation) @ bearings.rotation):
        is_right = rotation_angle(r @ bearings.rotation.T) + angle_between(t, bearings.translation) < 1e-6
        in_front = (two_view_depths(bearings.first, bearings.second, r, t) > 0).all(axis=1).mean()
        assert in_front == 1 if is_right else in_front < 0.6


def test_rotation_matrices_have_the_angles_of_their_vectors() -> None:
    for vector in ((0.3, -0.2, 0.9), (1e-9, 0, 0), (0, 3.0, 0)):
        assert np.isclose(rotation_angle(rotation_exp(np.array(vector))), np.linalg.norm(vector), atol=1e-9)


def test_epipolar_angles_are_those_of_the_plain_form(scene) -> None:
    bearings = scene(2, 100, outliers=0.5)
    a, b, t = bearings.first @ bearings.rotation.T, bearings.second, bearings.translation
    sine = (np.cross(t, a) * b).sum(axis=1, keepdims=True)
    gradients = np.cross(t, a) - sine * b, np.cross(b, t) - sine * a
    expected = sine[:, 0] / np.sqrt(sum((gradient**2).sum(axis=1) for gradient in gradients))
    found = epipolar_angles(bearings.first, b, bearings.rotation, t)
    assert found == pytest.approx(expected, abs=1e-12)
