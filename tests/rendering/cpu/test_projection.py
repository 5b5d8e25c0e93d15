"""Records and values of the numba stage are those of the float64 reference."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from pansplat.rendering.cpu.projection import CULLED, Camera, project_gaussians
from pansplat.rendering.cpu.records import LOG2_PEAK


def _relative(found, expected):
    found, expected = found.reshape(len(found), -1), expected.reshape(len(expected), -1)
    return float(((found - expected).norm(dim=1) / expected.norm(dim=1).clamp_min(1e-30)).max())


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
@pytest.mark.parametrize("by_covariance", [False, True])
def test_records_and_values_are_the_references(degree, by_covariance, make_scene, seen, truth, decode):
    scene = make_scene(1000, scale=0.3, degree=degree).to(dtype=torch.float32)
    covariances = scene.covariances if by_covariance else None
    observed, expected = seen(scene, covariances), truth(scene, covariances)
    found = decode(torch.from_numpy(observed.records).double())
    a, b, front = expected.rows.unbind(1)
    across = a[:, :, None] * a[:, None, :] + b[:, :, None] * b[:, None, :]
    assert observed.dropped == observed.near == 0
    assert _relative(found["direction"], expected.direction) < 1e-14
    assert _relative(found["across"], across) < 3e-7
    assert _relative(found["front"], front) < 3e-7
    assert _relative(found["along"], expected.radial_variance) < 3e-7
    assert _relative(found["peak"], expected.peak) < 3e-7
    torch.testing.assert_close(torch.from_numpy(observed.values).double(), expected.values, rtol=3e-7, atol=2e-6)
    assert np.abs(observed.radii / expected.values[:, -1].numpy() - 1).max() < 1e-14


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 32])
def test_any_number_of_channels_is_the_references(channels, make_scene, seen, truth):
    scene = make_scene(200, degree=2)
    harmonics = torch.randn(200, 9, channels, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    scene = dataclasses.replace(scene, harmonics=harmonics)
    found = torch.from_numpy(seen(scene).values).double()
    torch.testing.assert_close(found, truth(scene).values, rtol=3e-7, atol=3e-6)


@pytest.mark.parametrize("field", ["means", "quats", "scales", "opacities", "harmonics"])
@pytest.mark.parametrize("poison", [math.nan, math.inf, -math.inf, 3e30])
def test_unusable_numbers_drop_their_gaussian_alone(field, poison, make_scene, seen):
    scene = make_scene(150, degree=3).to(dtype=torch.float32)
    value = getattr(scene, field).clone()
    value[100].view(-1)[-1] = poison
    clean, observed = seen(scene), seen(dataclasses.replace(scene, **{field: value}))
    others = np.arange(150) != 100
    assert observed.dropped == 1 and observed.near == 0
    assert observed.records[100, LOG2_PEAK] == CULLED
    assert np.array_equal(observed.records[others], clean.records[others])
    assert np.array_equal(observed.values[others], clean.values[others])


def test_a_matrix_with_a_negative_eigenvalue_is_dropped(make_scene, seen):
    scene = make_scene(64).to(dtype=torch.float32)
    covariances = scene.covariances.clone()
    eigenvalues, axes = torch.linalg.eigh(covariances[[5, 6]])
    smallest = torch.tensor((-2e-3, -5e-4)) * eigenvalues[:, 2]  # too negative, and what rounding may leave
    eigenvalues = torch.stack((smallest, eigenvalues[:, 1], eigenvalues[:, 2]), dim=1)
    covariances[[5, 6]] = axes @ torch.diag_embed(eigenvalues) @ axes.transpose(1, 2)
    observed = seen(scene, covariances)
    assert observed.dropped == 1
    assert (observed.records[:, LOG2_PEAK] == CULLED).nonzero()[0].tolist() == [5]


def test_near_and_faint_gaussians_are_not_drawn(make_scene, seen, pose):
    scene = make_scene(10)
    scene.means[3] = pose[:3, 3] + torch.tensor((0.0, 0.01, 0.0))
    scene.means[4] = pose[:3, 3]
    scene.opacities[5] = 0.999 / 255
    scene.opacities[6] = -1.0
    observed = seen(scene)
    assert (observed.dropped, observed.near) == (0, 2)
    assert (observed.records[:, LOG2_PEAK] == CULLED).nonzero()[0].tolist() == [3, 4, 5, 6]


@pytest.mark.parametrize("unit", [1e-18, 1e-3, 1e4, 1e18])
def test_records_do_not_depend_on_the_scenes_unit(unit, make_scene, fields, workspace, decode):
    scene = make_scene(100)
    large = dataclasses.replace(scene, means=scene.means * unit, scales=scene.scales * unit)
    here = project_gaussians(fields(scene), Camera(np.eye(4), 1e-4, True, 1e-30), workspace, 1)
    there = project_gaussians(fields(large), Camera(np.eye(4), 1e-4, True, 1e-30), workspace, 1)
    before, after = (decode(torch.from_numpy(o.records).double()) for o in (here, there))
    for name in before:
        assert _relative(after[name], before[name]) < 2e-6, name


@pytest.mark.parametrize("quats", [(0.0, 0.0, 0.0, 0.0), (1e-25, 0.0, 0.0, 0.0), (3.0, 0.0, 0.0, 0.0)])
def test_the_length_of_a_quaternion_does_not_matter_and_zero_is_the_identity(quats, make_scene, seen):
    scene = make_scene(3)
    scene.quats[:] = torch.tensor((1.0, 0.0, 0.0, 0.0))
    other = dataclasses.replace(scene, quats=torch.tensor(quats, dtype=torch.float64).expand(3, 4).contiguous())
    assert np.array_equal(seen(scene).records, seen(other).records)


@pytest.mark.parametrize("threads", [2, 3, 5])
def test_records_are_the_same_bits_on_any_number_of_threads(threads, make_scene, seen):
    scene = make_scene(20000, degree=1)
    one, several = seen(scene), seen(scene, threads=threads)
    for before, after in zip(one[:4], several[:4], strict=True):
        assert np.array_equal(before, after)


def test_no_gaussians_are_no_records(make_scene, seen):
    observed = seen(make_scene(0))
    assert observed.records.shape == (0, 16) and observed.dropped == 0
