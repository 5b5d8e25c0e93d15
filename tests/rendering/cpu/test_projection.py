"""Records and values of projected Gaussians are those of the float64 reference."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from pansplat.rendering.cpu.projection import CULLED, Camera
from pansplat.rendering.cpu.records import LOG2_PEAK


def _relative(found, expected):
    found, expected = found.reshape(len(found), -1), expected.reshape(len(expected), -1)
    return float(((found - expected).norm(dim=1) / expected.norm(dim=1).clamp_min(1e-30)).max())


def _invariants(direction, a, b, l, radial_variance, peak):  # noqa: E741
    """The quantities of a footprint that do not depend on how a and b are turned about n."""
    return direction, a[:, :, None] * a[:, None, :] + b[:, :, None] * b[:, None, :], l, radial_variance, peak


def _culled(projected):
    return (projected.records[:, LOG2_PEAK] == CULLED).nonzero()[0].tolist()


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
@pytest.mark.parametrize("by_covariance", [False, True])
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
@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf, 3e30])
def test_an_unusable_number_drops_its_gaussian_and_changes_no_other(field, number, make_scene, project):
    scene = make_scene(150, degree=3).to(dtype=torch.float32)
    values = getattr(scene, field).clone()
    values[100].view(-1)[-1] = number
    clean = project(scene).projected
    projected = project(dataclasses.replace(scene, **{field: values})).projected
    others = np.arange(150) != 100
    assert projected.dropped == 1 and projected.near == 0
    assert _culled(projected) == [100]
    assert np.array_equal(projected.records[others], clean.records[others])
    assert np.array_equal(projected.values[others], clean.values[others])


def test_a_covariance_with_a_negative_eigenvalue_is_dropped(make_scene, project):
    scene = make_scene(64).to(dtype=torch.float32)
    covariances = scene.covariances.clone()
    eigenvalues, axes = torch.linalg.eigh(covariances[[5, 6]])
    smallest = torch.tensor((-2e-3, -5e-4)) * eigenvalues[:, 2]  # beyond the bound for rounding, and within it
    eigenvalues = torch.stack((smallest, eigenvalues[:, 1], eigenvalues[:, 2]), dim=1)
    covariances[[5, 6]] = axes @ torch.diag_embed(eigenvalues) @ axes.transpose(1, 2)
    projected = project(scene, covariances).projected
    assert projected.dropped == 1 and _culled(projected) == [5]


def test_near_and_faint_gaussians_are_culled(make_scene, project, pose):
    scene = make_scene(10)
    scene.means[3] = pose[:3, 3] + torch.tensor((0.0, 0.01, 0.0))
    scene.means[4] = pose[:3, 3]
    scene.opacities[5] = 0.999 / 255
    scene.opacities[6] = -1.0
    projected = project(scene).projected
    assert (projected.dropped, projected.near) == (0, 2)
    assert _culled(projected) == [3, 4, 5, 6]


@pytest.mark.parametrize("unit", [1e-18, 1e-3, 1e4, 1e18])
def test_records_do_not_depend_on_the_unit_of_length(unit, make_scene, project, decode_records):
    scene, camera = make_scene(100), Camera(np.eye(4), 1e-4, True, 1e-30)
    scaled = dataclasses.replace(scene, means=scene.means * unit, scales=scene.scales * unit)
    before, after = (
        _invariants(*decode_records(torch.from_numpy(project(each, camera=camera).projected.records).double()))
        for each in (scene, scaled)
    )
    for expected, found in zip(before, after, strict=True):
        assert _relative(found, expected) < 2e-6


@pytest.mark.parametrize("quats", [(0.0, 0.0, 0.0, 0.0), (1e-25, 0.0, 0.0, 0.0), (3.0, 0.0, 0.0, 0.0)])
def test_the_length_of_a_quaternion_does_not_matter_and_zero_is_the_identity(quats, make_scene, project):
    scene = make_scene(3)
    scene.quats[:] = torch.tensor((1.0, 0.0, 0.0, 0.0))
    other = dataclasses.replace(scene, quats=torch.tensor(quats, dtype=torch.float64).expand(3, 4).contiguous())
    assert np.array_equal(project(scene).projected.records, project(other).projected.records)


def test_the_number_of_threads_changes_no_bit(make_scene, project):
    scene = make_scene(20000, degree=1)
    one = project(scene).projected
    for threads in (2, 3, 5):
        for before, after in zip(one[:4], project(scene, threads=threads).projected[:4], strict=True):
            assert np.array_equal(before, after)


def test_no_gaussians_give_no_records(make_scene, project):
    projected = project(make_scene(0)).projected
    assert projected.records.shape == (0, 16) and projected.dropped == 0
