"""Records and values of projected Gaussians are those of the float64 reference."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from pansplat.rendering.cpu.projection import CULLED
from pansplat.rendering.cpu.records import LOG2_PEAK


def _relative(found, expected):
    found, expected = found.reshape(len(found), -1), expected.reshape(len(expected), -1)
    return float(((found - expected).norm(dim=1) / expected.norm(dim=1).clamp_min(1e-30)).max())


def _invariants(direction, a, b, l, radial_variance, peak):  # noqa: E741
    """The quantities of a footprint that do not depend on how a and b are turned about n."""
    return direction, a[:, :, None] * a[:, None, :] + b[:, :, None] * b[:, None, :], l, radial_variance, peak


@pytest.mark.parametrize(("degree", "by_covariance"), [(0, False), (1, True), (2, False), (3, True), (4, False)])
def test_records_and_values_equal_the_reference(
    degree, by_covariance, make_scene, project, project_reference, decode_records
):
    scene = make_scene(1000, scale=0.3, degree=degree).to(dtype=torch.float32)
    covariances = scene.covariances if by_covariance else None
    projected, expected = project(scene, covariances).projected, project_reference(scene, covariances)
    assert projected.dropped == projected.near == 0
    found = _invariants(*decode_records(torch.from_numpy(projected.records).double()))
    wanted = _invariants(expected.direction, *expected.rows.unbind(1), expected.radial_variance, expected.peak)
    for ours, theirs, tolerance in zip(found, wanted, (1e-14, 3e-7, 3e-7, 3e-7, 3e-7), strict=True):
        assert _relative(ours, theirs) < tolerance
    torch.testing.assert_close(torch.from_numpy(projected.values).double(), expected.values, rtol=3e-7, atol=2e-6)
    assert np.abs(projected.radii / expected.values[:, -1].numpy() - 1).max() < 1e-14


@pytest.mark.parametrize("channels", [1, 2, 4, 32])
def test_values_of_any_number_of_channels_equal_the_reference(channels, make_scene, project, project_reference):
    harmonics = torch.randn(200, 9, channels, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    scene = dataclasses.replace(make_scene(200, degree=2), harmonics=harmonics)
    found = torch.from_numpy(project(scene).projected.values).double()
    torch.testing.assert_close(found, project_reference(scene).values, rtol=3e-7, atol=3e-6)


@pytest.mark.parametrize("field", ["means", "quats", "scales", "opacities", "harmonics"])
def test_an_unusable_number_in_a_whole_vector_drops_its_gaussian_and_changes_no_other(field, make_scene, project):
    scene = make_scene(150, degree=3).to(dtype=torch.float32)
    clean, others = project(scene).projected, np.arange(150) != 100
    for number in (math.nan, math.inf, -math.inf, 3e30):
        values = getattr(scene, field).clone()
        values[100].view(-1)[-1] = number
        projected = project(dataclasses.replace(scene, **{field: values})).projected
        assert (projected.dropped, projected.near) == (1, 0)
        assert (projected.records[:, LOG2_PEAK] == CULLED).nonzero()[0].tolist() == [100]
        assert np.array_equal(projected.records[others], clean.records[others])
        assert np.array_equal(projected.values[others], clean.values[others])
