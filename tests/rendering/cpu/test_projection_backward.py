"""Gradients of the numba stage's records, chained back by hand, are those of float64 autograd."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from pansplat.rendering import projection
from pansplat.rendering.cpu.projection import Camera, project_gaussians
from pansplat.rendering.cpu.projection_backward import GaussianGradients, accumulate_slots, backpropagate_projection
from pansplat.rendering.cpu.records import (
    DIRECTION_RESIDUAL,
    HALF_LOG2_E,
    L_ALONG_A,
    L_ALONG_B,
    LOG2_PEAK,
    RADIAL_VARIANCE,
    ROW_A,
    ROW_B,
)

_NO_TOTALS = np.zeros((0, 10))
_NAMES = ("means", "quats", "scales", "opacities", "harmonics")


def _response(direction, first, second, front, along, peak, values, weights):
    """A number that depends on all of a record, but not on the choice of its axes."""
    rays, by_ray, by_value = weights
    step = rays - direction[:, None]
    a, b = (first[:, None] * step).sum(2), (second[:, None] * step).sum(2)
    ahead, q = 1 + (front[:, None] * step).sum(2), a * a + b * b
    alpha = peak[:, None] * torch.exp(-0.5 * q / (ahead * ahead + along[:, None] * q))
    return (by_ray * alpha).sum() + (by_value * values).sum()


def _weights(direction, channels):
    generator = torch.Generator().manual_seed(2)
    rays = direction[:, None] + 0.3 * torch.randn(len(direction), 6, 3, generator=generator, dtype=torch.float64)
    by_ray = torch.randn(len(direction), 6, generator=generator, dtype=torch.float64)
    by_value = torch.randn(len(direction), channels + 1, generator=generator, dtype=torch.float64)
    return torch.nn.functional.normalize(rays, dim=2), by_ray, by_value


def _slot_gradients(observed, weights):
    """Gradients of records and values, as the tiles would give them, in float32."""
    records = torch.from_numpy(observed.records).double()
    direction = (records[:, :DIRECTION_RESIDUAL] + records[:, DIRECTION_RESIDUAL:ROW_A]).requires_grad_()
    rest = records[:, ROW_A:].clone().requires_grad_()
    values = torch.from_numpy(observed.values).double().requires_grad_()
    first, second = rest[:, :3], rest[:, ROW_B - ROW_A : L_ALONG_A - ROW_A]
    front = direction + rest[:, L_ALONG_A - ROW_A, None] * first + rest[:, L_ALONG_B - ROW_A, None] * second
    unit, peak = math.sqrt(HALF_LOG2_E), 2 ** rest[:, LOG2_PEAK - ROW_A]
    along = rest[:, RADIAL_VARIANCE - ROW_A] * HALF_LOG2_E
    _response(direction, first / unit, second / unit, front, along, peak, values, weights).backward()
    grad_records = np.zeros(observed.records.shape, np.float32)
    grad_records[:, :DIRECTION_RESIDUAL], grad_records[:, ROW_A:] = direction.grad, rest.grad
    return grad_records, values.grad.float().numpy()


def _motions(pose, gradient):
    """A pose's gradient along rigid motions, all that a rigid pose can use."""
    turn = pose[:3, :3].T @ gradient[:3, :3]
    return torch.cat((turn - turn.T, gradient[:3, 3:]), dim=1)


def _empty(fields):
    return GaussianGradients(*(np.full_like(field, np.nan) for field in fields), pose=np.zeros((3, 4)))


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
@pytest.mark.parametrize("by_covariance", [False, True])
@pytest.mark.parametrize("compensate", [False, True])
def test_chained_gradients_are_autograds(degree, by_covariance, compensate, make_scene, fields, workspace, pose):
    scene = make_scene(500, scale=0.3, degree=degree).to(dtype=torch.float32)
    covariances = scene.covariances.double().requires_grad_() if by_covariance else None
    leaves = {name: getattr(scene, name).double().requires_grad_() for name in _NAMES}
    camera, spread = pose.clone().requires_grad_(), 1e-4
    seen = projection.project_gaussians(
        dataclasses.replace(scene, **leaves),
        covariances,
        camera,
        filter_variance=spread,
        compensate=compensate,
        exact=True,
    )
    weights = _weights(seen.direction.detach(), 3)
    first, second, front = seen.rows.unbind(1)
    _response(seen.direction, first, second, front, seen.radial_variance, seen.peak, seen.values, weights).backward()

    given = fields(scene, None if covariances is None else covariances.detach())
    numba_camera = Camera(pose.numpy(), spread, compensate, 0.05)
    observed = project_gaussians(given, numba_camera, workspace, 1)
    slots = *_slot_gradients(observed, weights), _NO_TOTALS, np.arange(501)
    found = backpropagate_projection(given, numba_camera, observed, *slots, _empty(given), 1)
    expected = {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
    if covariances is not None:
        expected["covariances"] = covariances.grad
    assert len(expected) == (4 if by_covariance else 5)
    for name, gradient in expected.items():
        difference = torch.from_numpy(getattr(found, name)).double() - gradient
        assert float(difference.norm() / gradient.norm()) < 5e-7, name
    wanted, got = _motions(pose, camera.grad), _motions(pose, torch.from_numpy(found.pose))
    assert float((got - wanted).norm() / wanted.norm()) < 5e-7


def test_gaussians_that_are_not_drawn_have_zero_gradients_and_spoil_no_others(make_scene, fields, workspace, pose):
    scene = make_scene(130, degree=2).to(dtype=torch.float32)
    scene.means[1], scene.quats[2], scene.harmonics[3] = math.nan, math.inf, math.nan
    scene.opacities[4], scene.scales[5, 0], scene.opacities[6] = 0.0, 1e30, math.nan
    scene.means[7] = pose[:3, 3]
    given, camera = fields(scene), Camera(pose.numpy(), 1e-4, True, 0.05)
    observed = project_gaussians(given, camera, workspace, 1)
    random = np.random.default_rng(0)
    # Gradients come for drawn Gaussians only: the others have no slots.
    offsets = np.cumsum([0] + [0 if 1 <= g <= 7 else 2 for g in range(130)])
    slots = [random.standard_normal((offsets[-1], size)).astype(np.float32) for size in (16, 4)]
    found = backpropagate_projection(given, camera, observed, *slots, _NO_TOTALS, offsets, _empty(given), 1)
    for name in _NAMES:
        gradient = getattr(found, name)
        assert np.isfinite(gradient).all(), name
        assert not gradient[1:8].any(), name
        assert gradient[8:].any(), name
    assert np.isfinite(found.pose).all()


@pytest.mark.parametrize("channels", [1, 3, 5])
def test_a_gaussian_s_slots_count_as_their_sum(channels, make_scene, fields, workspace, pose):
    scene = make_scene(75, degree=1)  # more than a block, and no multiple of a vector
    coefficients = torch.randn(75, 4, channels, generator=torch.Generator().manual_seed(1)).double()
    given = fields(dataclasses.replace(scene, harmonics=coefficients))
    camera = Camera(pose.numpy(), 1e-4, True, 0.05)
    observed, random = project_gaussians(given, camera, workspace, 1), np.random.default_rng(0)
    counts = np.arange(75) % 5
    offsets, owner = np.cumsum([0, *counts]), np.repeat(np.arange(75), counts)
    slots = [random.standard_normal((len(owner), size)).astype(np.float32) for size in (16, channels + 1)]
    summed = [np.zeros((75, part.shape[1]), np.float32) for part in slots]
    for part, total in zip(slots, summed, strict=True):
        np.add.at(total, owner, part)
    found = backpropagate_projection(given, camera, observed, *slots, _NO_TOTALS, offsets, _empty(given), 1)
    expected = backpropagate_projection(given, camera, observed, *summed, _NO_TOTALS, np.arange(76), _empty(given), 1)
    for name in (*_NAMES, "pose"):
        assert np.array_equal(getattr(found, name), getattr(expected, name)), name


@pytest.mark.parametrize("threads", [2, 3, 5])
def test_gradients_are_the_same_bits_on_any_number_of_threads(threads, make_scene, fields, workspace, pose):
    given, camera = fields(make_scene(20000, degree=1)), Camera(pose.numpy(), 1e-4, True, 0.05)
    observed = project_gaussians(given, camera, workspace, 1)
    random = np.random.default_rng(0)
    slots = [random.standard_normal((20000, size)).astype(np.float32) for size in (16, 4)]
    one, several = (
        backpropagate_projection(given, camera, observed, *slots, _NO_TOTALS, np.arange(20001), _empty(given), count)
        for count in (1, threads)
    )
    for name in (*_NAMES, "pose"):
        assert np.array_equal(getattr(one, name), getattr(several, name)), name


def test_a_zero_quaternion_has_zero_gradient(make_scene, fields, workspace, pose):
    scene = make_scene(3)
    scene.quats[1] = 0
    given, camera = fields(scene), Camera(pose.numpy(), 1e-4, True, 0.05)
    observed = project_gaussians(given, camera, workspace, 1)
    slots = np.ones((3, 16), np.float32), np.ones((3, 4), np.float32), _NO_TOTALS, np.arange(4)
    quats = backpropagate_projection(given, camera, observed, *slots, _empty(given), 1).quats
    assert not quats[1].any() and quats[0].any() and quats[2].any()
    # A quaternion's length does not matter, so the gradient has no part along it.
    assert abs((quats * given.quats).sum(axis=1)).max() < 1e-6 * abs(quats).max()


def test_slots_are_summed_by_gaussian():
    offsets, slots = np.array([0, 2, 2, 5]), np.arange(10, dtype=np.float32).reshape(5, 2)
    totals = np.ones((3, 2), np.float32)
    accumulate_slots(0, offsets, slots, totals)
    assert totals.tolist() == [[3, 5], [1, 1], [19, 22]]
