"""Gradients of the projection, derived by hand, are those of float64 autograd through the reference."""

import dataclasses

import numpy as np
import pytest
import torch

from pansplat.rendering import projection as reference
from pansplat.rendering.cpu.projection import Camera
from pansplat.rendering.cpu.projection_backward import accumulate_slots
from pansplat.rendering.cpu.records import DIRECTION_RESIDUAL, RECORD_SIZE, ROW_A

_NAMES = ("means", "quats", "scales", "opacities", "harmonics")


def _loss(direction, a, b, l, radial_variance, peak, values, weights):  # noqa: E741
    """A number that depends on all of a record, but not on how a and b are turned about n."""
    rays, by_ray, by_value = weights
    step = rays - direction[:, None]
    on_a, on_b = (a[:, None] * step).sum(2), (b[:, None] * step).sum(2)
    front, q = 1 + (l[:, None] * step).sum(2), on_a * on_a + on_b * on_b
    alpha = peak[:, None] * torch.exp(-0.5 * q / (front * front + radial_variance[:, None] * q))
    return (by_ray * alpha).sum() + (by_value * values).sum()


def _random_weights(direction, channels):
    generator = torch.Generator().manual_seed(2)
    rays = direction[:, None] + 0.3 * torch.randn(len(direction), 6, 3, generator=generator, dtype=torch.float64)
    by_ray = torch.randn(len(direction), 6, generator=generator, dtype=torch.float64)
    by_value = torch.randn(len(direction), channels + 1, generator=generator, dtype=torch.float64)
    return torch.nn.functional.normalize(rays, dim=2), by_ray, by_value


def _record_gradients(projected, decode_records, weights):
    """Gradients of records and values, as the rasteriser's backward writes them, in float32."""
    records = torch.from_numpy(projected.records).double().requires_grad_()
    values = torch.from_numpy(projected.values).double().requires_grad_()
    _loss(*decode_records(records), values, weights).backward()
    records.grad[:, DIRECTION_RESIDUAL:ROW_A] = 0
    return records.grad.float().numpy(), values.grad.float().numpy()


def _random_slots(count, channels=3):
    random = np.random.default_rng(0)
    return [random.standard_normal((count, size)).astype(np.float32) for size in (RECORD_SIZE, channels + 1)]


@pytest.mark.parametrize(
    ("degree", "by_covariance", "compensate"),
    [(0, False, True), (0, True, False), (1, False, False), (2, True, True), (3, False, True), (4, True, True)],
)
def test_gradients_equal_autograd(
    degree, by_covariance, compensate, make_scene, project, decode_records, backpropagate, rigid_part, pose
):
    scene = make_scene(500, scale=0.3, degree=degree).to(dtype=torch.float32)
    covariances = scene.covariances.double().requires_grad_() if by_covariance else None
    leaves = {name: getattr(scene, name).double().requires_grad_() for name in _NAMES}
    camera = Camera(pose.numpy(), 1e-4, compensate, 0.05)
    pose = pose.clone().requires_grad_()
    expected = reference.project_gaussians(
        dataclasses.replace(scene, **leaves),
        covariances,
        pose,
        filter_variance=camera.filter_variance,
        compensate=compensate,
        exact=True,
    )
    weights = _random_weights(expected.direction.detach(), 3)
    rows = expected.rows.unbind(1)
    _loss(expected.direction, *rows, expected.radial_variance, expected.peak, expected.values, weights).backward()

    view = project(scene, None if covariances is None else covariances.detach(), camera=camera)
    found = backpropagate(view, *_record_gradients(view.projected, decode_records, weights))
    gradients = {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
    if covariances is not None:
        gradients["covariances"] = covariances.grad
    assert len(gradients) == (4 if by_covariance else 5)
    for name, gradient in gradients.items():
        difference = torch.from_numpy(getattr(found, name)).double() - gradient
        assert float(difference.norm() / gradient.norm()) < 5e-7, name
    wanted, got = (rigid_part(pose, gradient) for gradient in (pose.grad, torch.from_numpy(found.pose)))
    assert float((got - wanted).norm() / wanted.norm()) < 5e-7


@pytest.mark.parametrize("channels", [1, 3, 5])
def test_slots_of_a_gaussian_are_summed(channels, make_scene, project, backpropagate):
    harmonics = torch.randn(75, 4, channels, generator=torch.Generator().manual_seed(1)).double()
    # More Gaussians than a block, and no multiple of a vector's lanes.
    view = project(dataclasses.replace(make_scene(75, degree=1), harmonics=harmonics))
    counts = np.arange(75) % 5
    offsets, owner = np.cumsum([0, *counts]), np.repeat(np.arange(75), counts)
    slots = _random_slots(len(owner), channels)
    summed = [np.zeros((75, part.shape[1]), np.float32) for part in slots]
    for part, total in zip(slots, summed, strict=True):
        np.add.at(total, owner, part)
    found, expected = backpropagate(view, *slots, offsets=offsets), backpropagate(view, *summed)
    for name in (*_NAMES, "pose"):
        assert np.array_equal(getattr(found, name), getattr(expected, name)), name


def test_accumulated_slots_are_added_to_totals():
    offsets, slots = np.array([0, 2, 2, 5]), np.arange(10, dtype=np.float32).reshape(5, 2)
    totals = np.ones((3, 2), np.float32)
    accumulate_slots(offsets, slots, totals, 1)
    assert totals.tolist() == [[3, 5], [1, 1], [19, 22]]
