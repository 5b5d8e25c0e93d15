"""Records of the classic kernel, found from the exact kernel's, are the reference's, forward and backward."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from pansplat.rendering import projection
from pansplat.rendering.cpu.ewa import EWA_GRAD_SIZE, backpropagate_ewa, project_ewa
from pansplat.rendering.cpu.projection import Camera, project_gaussians
from pansplat.rendering.cpu.projection_backward import GaussianGradients, backpropagate_projection
from pansplat.rendering.cpu.records import DIRECTION_RESIDUAL, HALF_LOG2_E, LOG2_PEAK, ROW_A, ROW_B
from pansplat.rendering.image_planes import image_planes
from pansplat.rendering.projection import ewa_boxes, kappa

_NAMES = ("means", "quats", "scales", "opacities", "harmonics")
_DILATED = {"angular": 0.0, "3dgs": 0.3}


def _picture():
    (picture,) = image_planes("pinhole", (48, 64), vertical_fov_degrees=80, face_size=None, device=torch.device("cpu"))
    return picture


def _reference(scene, pose, lowpass, picture):
    """The reference's splats of Gaussians in front, and their numbers."""
    spread = 0.1 * picture.pixel_angle**2 if lowpass == "angular" else 0.0
    seen = projection.project_gaussians(
        scene, None, pose, filter_variance=spread, compensate=lowpass == "angular", exact=False
    )
    front = seen.direction[:, 2] * seen.values[:, -1] > 0.01
    chosen = projection.ProjectedGaussians(*(field[front] for field in seen))
    drawn, variances = projection.ewa_footprints(
        chosen, picture.rotation, picture.size, picture.focal, _DILATED[lowpass]
    )
    return drawn, variances, front.nonzero()[:, 0].numpy()


def _ours(scene, pose, lowpass, picture, fields, workspace):
    spread = (0.1 if lowpass == "angular" else 1e-9) * picture.pixel_angle**2
    camera = Camera(pose.numpy(), spread, lowpass == "angular", 0.05)
    given = fields(scene)
    observed = project_gaussians(given, camera, workspace, 1)
    records, boxes = project_ewa(given, camera, observed, picture, _DILATED[lowpass], 0.01, workspace, 1)
    return given, camera, observed, records, boxes


@pytest.mark.parametrize("lowpass", ["angular", "3dgs"])
@pytest.mark.parametrize("flat", [False, True])
def test_projected_records_and_boxes_are_the_references(flat, lowpass, make_scene, fields, workspace, pose):
    scene = make_scene(2000, scale=0.1).to(dtype=torch.float32)
    if flat:
        scene.scales[:, 0] = 0
    picture = _picture()
    expected, variances, front = _reference(scene.to(dtype=torch.float64), pose, lowpass, picture)
    *_, records, boxes = _ours(scene, pose, lowpass, picture, fields, workspace)
    edges = ewa_boxes(expected.point, variances, kappa(expected.peak)).numpy()
    x0, x1 = np.maximum(np.ceil(edges[:, 0] - 0.51), 0), np.minimum(np.floor(edges[:, 1] - 0.49), 63)
    y0, y1 = np.maximum(np.ceil(edges[:, 2] - 0.51), 0), np.minimum(np.floor(edges[:, 3] - 0.49), 47)
    seen = (x0 <= x1) & (y0 <= y1)
    assert seen.sum() > 200
    behind = np.setdiff1d(np.arange(2000), front)
    assert (boxes[behind, 3] < boxes[behind, 2]).all()
    boxes, records = boxes[front], torch.from_numpy(records[front][seen]).double()
    assert ((boxes[:, 3] >= boxes[:, 2]) != seen).mean() < 2e-3
    assert (boxes[seen] != np.stack((x0, x1, y0, y1), axis=1)[seen]).any(axis=1).mean() < 5e-3
    where = records[:, :2] + records[:, DIRECTION_RESIDUAL : DIRECTION_RESIDUAL + 2]
    torch.testing.assert_close(where, expected.point[seen][:, :2].double(), rtol=1e-12, atol=1e-9)
    unit, tolerance = math.sqrt(HALF_LOG2_E), {"rtol": 2e-6, "atol": 1e-6}
    torch.testing.assert_close(records[:, ROW_A] / unit, expected.rows[seen][:, 0, 0], **tolerance)
    torch.testing.assert_close(records[:, ROW_B : ROW_B + 2] / unit, expected.rows[seen][:, 1, :2], **tolerance)
    torch.testing.assert_close(2 ** records[:, LOG2_PEAK], expected.peak[seen], **tolerance)


@pytest.mark.parametrize("lowpass", ["angular", "3dgs"])
def test_gradients_through_the_projection_are_autograds(lowpass, make_scene, fields, workspace, pose):
    scene = make_scene(400, scale=0.2, degree=0).to(dtype=torch.float32)
    picture, camera = _picture(), pose.clone().requires_grad_()
    given, numba_camera, observed, _, boxes = _ours(scene, pose, lowpass, picture, fields, workspace)
    visible = boxes[:, 3] >= boxes[:, 2]
    weights = torch.randn(400, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    weights[~visible] = 0

    leaves = {name: getattr(scene, name).double().requires_grad_() for name in _NAMES}
    drawn, _, front = _reference(dataclasses.replace(scene, **leaves), camera, lowpass, picture)
    a_x, (b_x, b_y) = drawn.rows[:, 0, 0], drawn.rows[:, 1, :2].unbind(1)
    numbers = torch.stack((*drawn.point[:, :2].unbind(1), a_x, b_x, b_y, torch.log(drawn.peak)), dim=1)
    (weights[front] * numbers).sum().backward()

    offsets = np.concatenate((np.zeros(1, np.int64), np.cumsum(visible)))
    slots, unit = np.zeros((int(offsets[-1]), 16), np.float32), math.sqrt(HALF_LOG2_E)
    weights = weights[visible].numpy()
    slots[:, :2], slots[:, ROW_A], slots[:, ROW_B : ROW_B + 2] = weights[:, :2], weights[:, 2], weights[:, 3:5]
    slots[:, [ROW_A, ROW_B, ROW_B + 1]] /= unit  # of the record's numbers, which are unit times the forms
    slots[:, LOG2_PEAK] = weights[:, 5] * math.log(2)
    totals = np.zeros((400, EWA_GRAD_SIZE))
    backpropagate_ewa(given, numba_camera, picture, _DILATED[lowpass], slots, offsets, totals, 1)
    wanted = GaussianGradients(*(np.full_like(field, np.nan) for field in given), pose=np.zeros((3, 4)))
    found = backpropagate_projection(
        given,
        numba_camera,
        observed,
        np.zeros((0, 16), np.float32),
        np.zeros((400, 4), np.float32),
        totals,
        np.arange(401),
        wanted,
        1,
    )
    for name in _NAMES[:4]:
        expected = leaves[name].grad
        difference = torch.from_numpy(getattr(found, name)).double() - expected
        assert float(difference.norm() / expected.norm()) < 2e-6, name
    turns = [pose[:3, :3].T @ gradient[:3, :3] for gradient in (camera.grad, torch.from_numpy(found.pose))]
    skews = [turn - turn.T for turn in turns]
    assert float((skews[1] - skews[0]).norm() / skews[0].norm()) < 2e-6
    torch.testing.assert_close(torch.from_numpy(found.pose[:, 3]), camera.grad[:3, 3], rtol=1e-6, atol=0)
