"""Sorting by distance."""

import numpy as np

from pansplat_viewer.draw.splats import Splats, sort_splats


def test_splats_are_sorted_by_distance_from_the_position(random_scene):
    splats = Splats.from_scene(random_scene())
    position = (0.3, -0.2, 0.1)
    result = sort_splats(splats, position)
    distance = np.linalg.norm(splats.means.astype(np.float64) - position, axis=1)
    assert np.all(np.diff(distance[result.order]) > -1e-6)
    assert sorted(result.order.tolist()) == list(range(len(splats)))
