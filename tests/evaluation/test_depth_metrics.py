"""Depth errors have their closed forms' values, over the pixels whose depth is known."""

import math

import pytest
import torch

from pansplat.evaluation.depth_metrics import depth_errors

NEAR, FAR = 0.45, 10.0


def test_constant_depths_have_the_closed_forms_errors() -> None:
    truth = torch.full((2, 8, 16), 4.0)
    errors = depth_errors(torch.full((2, 4, 8), 5.0), truth, NEAR, FAR)
    assert (errors.abs_rel, errors.sq_rel, errors.rmse) == pytest.approx((0.25, 0.25, 1.0))
    errors = depth_errors(torch.full((2, 4, 8), 2.0), truth, NEAR, FAR)
    assert (errors.abs_rel, errors.sq_rel, errors.rmse) == pytest.approx((0.5, 1.0, 2.0))


def test_pixels_of_all_views_are_one_set() -> None:
    truth = torch.full((2, 4, 8), 2.0)
    truth[0, :3] = 0  # the first view has a quarter of its pixels
    depth = truth.clone()
    depth[0], depth[1] = 3.0, 4.0
    errors = depth_errors(depth, truth, NEAR, FAR)
    assert errors.abs_rel == pytest.approx((8 * 0.5 + 32 * 1.0) / 40)
    assert errors.rmse == pytest.approx(math.sqrt((8 * 1 + 32 * 4) / 40))


@pytest.mark.parametrize("unknown", [0.0, NEAR, FAR, 30.0])
def test_depth_at_or_beyond_the_range_is_unknown(unknown: float) -> None:
    truth = torch.full((1, 4, 8), 2.0)
    truth[:, 2:] = unknown
    depth = torch.full((1, 4, 8), 2.0)
    depth[:, 2:] = 100.0
    errors = depth_errors(depth, truth, NEAR, FAR)
    assert (errors.abs_rel, errors.sq_rel, errors.rmse) == (0, 0, 0)


def test_a_smaller_map_is_made_larger_bilinearly_between_pixel_centres() -> None:
    """Two columns of 1 and 3 metres become 1, 1.5, 2.5, 3."""
    depth = torch.tensor([1.0, 3.0]).expand(1, 1, 2)
    truth = torch.tensor([1.0, 1.5, 2.5, 3.0]).expand(1, 2, 4)
    assert depth_errors(depth, truth, NEAR, FAR).rmse == pytest.approx(0, abs=1e-12)


def test_without_a_known_pixel_errors_are_not_numbers() -> None:
    errors = depth_errors(torch.ones(1, 4, 8), torch.zeros(1, 4, 8), NEAR, FAR)
    assert math.isnan(errors.abs_rel) and math.isnan(errors.sq_rel) and math.isnan(errors.rmse)
