"""Records, boxes and gradients of the EWA kernel are those of the float64 reference."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from pansplat.rendering import projection as reference
from pansplat.rendering.cpu.ewa import EWA_GRAD_SIZE, backpropagate_ewa, project_ewa
from pansplat.rendering.cpu.projection import Camera
from pansplat.rendering.cpu.records import DIRECTION_RESIDUAL, HALF_LOG2_E, LOG2_PEAK, RECORD_SIZE, ROW_A, ROW_B
from pansplat.rendering.image_planes import image_planes

_NAMES = ("means", "quats", "scales", "opacities")
_DILATION = {"angular": 0.0, "3dgs": 0.3}
_UNIT = math.sqrt(HALF_LOG2_E)


@pytest.fixture
def plane():
    return image_planes("pinhole", (48, 64), vertical_fov_degrees=80)[0]


def _camera(pose, lowpass, plane):
    variance = (0.1 if lowpass == "angular" else 1e-9) * plane.pixel_angle**2
    return Camera(pose.numpy(), variance, lowpass == "angular", 0.05)


def _reference(scene, pose, lowpass, plane):
    """Footprints and projected covariances of Gaussians in front, and their indices."""
    variance = 0.1 * plane.pixel_angle**2 if lowpass == "angular" else 0.0
    projected = reference.project_gaussians(
        scene, None, pose, filter_variance=variance, compensate=lowpass == "angular", exact=False
    )
    front = projected.direction[:, 2] * projected.values[:, -1] > 0.01
    chosen = reference.ProjectedGaussians(*(field[front] for field in projected))
    geometry = plane.rotation, plane.size, plane.focal
    return *reference.ewa_footprints(chosen, *geometry, _DILATION[lowpass]), front.nonzero()[:, 0].numpy()


@pytest.mark.parametrize("lowpass", ["angular", "3dgs"])
@pytest.mark.parametrize("flat", [False, True])
def test_records_and_boxes_equal_the_reference(flat, lowpass, make_scene, project, workspace, pose, plane):
    scene = make_scene(2000, scale=0.1).to(dtype=torch.float32)
    if flat:
        scene.scales[:, 0] = 0
    expected, variances, front = _reference(scene.to(dtype=torch.float64), pose, lowpass, plane)
    view = project(scene, camera=_camera(pose, lowpass, plane))
    records, boxes = project_ewa(*view, plane, _DILATION[lowpass], 0.01, workspace, 1)
    edges = reference.ewa_boxes(expected.point, variances, reference.kappa(expected.peak)).numpy()
    x0, x1 = np.maximum(np.ceil(edges[:, 0] - 0.51), 0), np.minimum(np.floor(edges[:, 1] - 0.49), 63)
    y0, y1 = np.maximum(np.ceil(edges[:, 2] - 0.51), 0), np.minimum(np.floor(edges[:, 3] - 0.49), 47)
    visible = (x0 <= x1) & (y0 <= y1)
    assert visible.sum() > 200
    behind = np.setdiff1d(np.arange(2000), front)
    assert (boxes[behind, 3] < boxes[behind, 2]).all()
    boxes, records = boxes[front], torch.from_numpy(records[front][visible]).double()
    assert ((boxes[:, 3] >= boxes[:, 2]) != visible).mean() < 2e-3
    assert (boxes[visible] != np.stack((x0, x1, y0, y1), axis=1)[visible]).any(axis=1).mean() < 5e-3
    points = records[:, :2] + records[:, DIRECTION_RESIDUAL : DIRECTION_RESIDUAL + 2]
    torch.testing.assert_close(points, expected.point[visible][:, :2].double(), rtol=1e-12, atol=1e-9)
    rows, tolerance = expected.rows[visible], {"rtol": 2e-6, "atol": 1e-6}
    torch.testing.assert_close(records[:, ROW_A] / _UNIT, rows[:, 0, 0], **tolerance)
    torch.testing.assert_close(records[:, ROW_B : ROW_B + 2] / _UNIT, rows[:, 1, :2], **tolerance)
    torch.testing.assert_close(2 ** records[:, LOG2_PEAK], expected.peak[visible], **tolerance)


@pytest.mark.parametrize("lowpass", ["angular", "3dgs"])
def test_gradients_equal_autograd(lowpass, make_scene, project, backpropagate, rigid_part, workspace, pose, plane):
    scene = make_scene(400, scale=0.2, degree=0).to(dtype=torch.float32)
    view = project(scene, camera=_camera(pose, lowpass, plane))
    _, boxes = project_ewa(*view, plane, _DILATION[lowpass], 0.01, workspace, 1)
    visible = boxes[:, 3] >= boxes[:, 2]
    weights = torch.randn(400, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    weights[~visible] = 0

    leaves = {name: getattr(scene, name).double().requires_grad_() for name in (*_NAMES, "harmonics")}
    pose = pose.clone().requires_grad_()
    footprints, _, front = _reference(dataclasses.replace(scene, **leaves), pose, lowpass, plane)
    a_x, (b_x, b_y) = footprints.rows[:, 0, 0], footprints.rows[:, 1, :2].unbind(1)
    numbers = (*footprints.point[:, :2].unbind(1), a_x, b_x, b_y, torch.log(footprints.peak))
    (weights[front] * torch.stack(numbers, dim=1)).sum().backward()

    offsets = np.concatenate((np.zeros(1, np.int64), np.cumsum(visible)))
    slots, weights = np.zeros((int(offsets[-1]), RECORD_SIZE), np.float32), weights[visible].numpy()
    slots[:, :2], slots[:, ROW_A], slots[:, ROW_B : ROW_B + 2] = weights[:, :2], weights[:, 2], weights[:, 3:5]
    slots[:, [ROW_A, ROW_B, ROW_B + 1]] /= _UNIT  # a record's rows are _UNIT times the footprint's
    slots[:, LOG2_PEAK] = weights[:, 5] * math.log(2)
    ewa_grads = np.zeros((400, EWA_GRAD_SIZE))
    backpropagate_ewa(view.gaussians, view.camera, plane, _DILATION[lowpass], slots, offsets, ewa_grads, 1)
    no_records, grad_values = np.zeros((0, RECORD_SIZE), np.float32), np.zeros((400, 4), np.float32)
    found = backpropagate(view, no_records, grad_values, ewa_grads=ewa_grads)
    for name in _NAMES:
        expected = leaves[name].grad
        difference = torch.from_numpy(getattr(found, name)).double() - expected
        assert float(difference.norm() / expected.norm()) < 2e-6, name
    expected, got = (rigid_part(pose, gradient) for gradient in (pose.grad, torch.from_numpy(found.pose)))
    assert float((got - expected)[:, :3].norm() / expected[:, :3].norm()) < 2e-6
    torch.testing.assert_close(got[:, 3], expected[:, 3], rtol=1e-6, atol=0)
