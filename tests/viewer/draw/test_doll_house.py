"""The doll's house view is the picture of the Gaussians that show their front, in every renderer."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pansplat.tours.doll_house import find_fronts
from pansplat_viewer.scene.settings import DrawSettings

pytestmark = pytest.mark.gl


@pytest.mark.parametrize("name", ["gl", "cpu"])
def test_outside_gaussians_with_their_back_to_the_camera_are_not_drawn(
    make_renderer, random_scene, pose, reference, assert_matches, name
):
    scene = random_scene(400, degree=0, size=0.12, seed=11)
    pose[:3, 3] = np.array((0.2, -3.0, -7.0))
    forward = -pose[:3, 3] / np.linalg.norm(pose[:3, 3])
    right = np.cross((0.0, 1.0, 0.0), forward)
    right /= np.linalg.norm(right)
    pose[:3, :3] = np.stack((right, np.cross(forward, right), forward), axis=1)
    fronts = find_fronts(scene.gaussians, scene.cam2world[:, :3, 3], torch.from_numpy(pose[:3, 3]))
    assert 0.1 < fronts.double().mean() < 0.9
    kept = replace(scene, gaussians=scene.gaussians.select(fronts))
    settings = DrawSettings(outside=True, vertical_fov_degrees=60)
    assert_matches(make_renderer(scene, name), pose, settings, reference(kept, pose, (96, 72), settings))
