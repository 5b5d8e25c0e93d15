"""Boxes found from records are the reference's, pixel by pixel."""

import math

import numpy as np
import pytest
import torch

from pansplat.rendering.bounds import equirect_boxes, kappa, pinhole_boxes
from pansplat.rendering.cpu.boxes import find_boxes
from pansplat.rendering.cpu.observe import Camera, observe
from pansplat.rendering.panorama import pictures


def _expected(observed, picture):
    """The reference's boxes as pixels; and which Gaussians are seen."""
    level, (height, width) = kappa(observed.peak), picture.size
    if picture.is_panorama:
        edges = equirect_boxes(observed.direction, observed.covariance, level, picture.size)
    else:
        turn = picture.rotation
        covariance = turn.T @ observed.covariance @ turn
        edges = pinhole_boxes(observed.direction @ turn, covariance, level, picture.size, picture.focal)
    left, right, top, bottom = edges.numpy().T
    x0, x1 = np.ceil(left - 0.51), np.floor(right - 0.49)
    y0, y1 = np.maximum(np.ceil(top - 0.51), 0), np.minimum(np.floor(bottom - 0.49), height - 1)
    if picture.is_panorama:
        seen, around = (x0 <= x1) & (y0 <= y1) & (left <= right), x1 - x0 >= width - 1
        x0, x1 = np.where(around, 0, x0 % width), np.where(around, width - 1, x1 % width)
    else:
        x0, x1 = np.maximum(x0, 0), np.minimum(x1, width - 1)
        seen = (x0 <= x1) & (y0 <= y1) & (left <= right)
    return np.stack((x0, x1, y0, y1), axis=1), seen


@pytest.mark.parametrize("scale", [0.01, 0.3, 2.0])
@pytest.mark.parametrize(("layout", "size"), [("equirect", (64, 128)), ("pinhole", (64, 96)), ("cubemap", (64, 128))])
def test_boxes_are_the_references(layout, size, scale, make_scene, seen, truth, lease):
    scene = make_scene(2000, scale=scale)
    observed, expected = seen(scene), truth(scene)
    for picture in pictures(layout, size, vertical_fov_degrees=90.0, face_size=None, device=torch.device("cpu")):
        boxes = find_boxes(observed.records, picture, lease, 1)
        wanted, is_seen = _expected(expected, picture)
        found = boxes[:, 3] >= boxes[:, 2]
        # A box may end within rounding of a pixel's centre, or of the plane through the eye.
        assert (found != is_seen).mean() < 2e-3
        both = found & is_seen
        assert both.sum() > 50
        assert (boxes[both] != wanted[both]).any(axis=1).mean() < 2e-3


def test_a_gaussian_on_the_axis_of_the_poles_takes_whole_rows(make_scene, fields, lease):
    scene = make_scene(2, scale=0.05)
    scene.means[:] = torch.tensor(((0.0, -1.0, 0.0), (0.0, 1.0, 0.0)))
    observed = observe(fields(scene), Camera(np.eye(4), 1e-4, True, 0.05), lease, 1)
    (picture,) = pictures("equirect", (64, 128), vertical_fov_degrees=90, face_size=None, device=torch.device("cpu"))
    boxes = find_boxes(observed.records, picture, lease, 1)
    assert boxes[:, :2].tolist() == [[0, 127], [0, 127]]
    assert boxes[0, 2] == 0 and boxes[1, 3] == 63


def test_a_box_at_the_panoramas_seam_goes_on_at_the_left(make_scene, fields, lease):
    scene = make_scene(1, scale=0.05)
    scene.means[:] = torch.tensor((0.0, 0.0, -1.0))
    observed = observe(fields(scene), Camera(np.eye(4), 1e-4, True, 0.05), lease, 1)
    (picture,) = pictures("equirect", (64, 128), vertical_fov_degrees=90, face_size=None, device=torch.device("cpu"))
    x0, x1, y0, y1 = find_boxes(observed.records, picture, lease, 1)[0]
    assert 100 < x0 < 128 and 0 <= x1 < 28
    assert math.isclose(x0 + x1, 127, abs_tol=2) and y0 < 32 <= y1
