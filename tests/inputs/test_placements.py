"""Where panoramas without a pose are drawn."""

from pathlib import Path

import numpy as np
import pytest
from panorama_formats import write_posed
from PIL import Image
from pytest import approx

from pansplat.errors import InputWarning
from pansplat.gaussians.scene import Scene, empty_gaussians
from pansplat.inputs.folders import load_sets
from pansplat.tours.graph import find_tours
from pansplat.tours.linked_rooms import find_stated_place
from pansplat.tours.merge import merge_scenes


def test_an_approximate_place_is_as_far_away_in_every_unit_of_measured_poses(tmp_path: Path):
    """Two camera heights of 1.5 m, in a poses.json of metres and one of millimetres, with the unit and without."""
    for unit, worlds in ((1, []), (1000, []), (1, [{"unit": 1.5}]), (1000, [{"unit": 1500}])):
        folder = tmp_path / f"{unit}{len(worlds)}"
        pictures = {f"{name}.png": np.full((64, 128, 3), (2 * ord(name), 9, 9), np.uint8) for name in "abc"}
        stated = {"approximate": [{"between": ["a.png", "c.png"], "place": [0, 2, 0]}]}
        third = pictures.pop("c.png")
        write_posed(folder, pictures, (0, unit), near=0.5 * unit, far=9 * unit, worlds=worlds, estimate=stated)
        Image.fromarray(third).save(folder / "c.png")
        with pytest.warns(InputWarning, match=r"no pose of c\.png"):
            (tour,) = find_tours(load_sets(folder))
        centers = tour.positions @ tour.level_axes[:, (0, 2)]
        away = find_stated_place(tour, 2).move(centers[2]) - centers[0]
        assert tour.panoramas[2].name == "c" and np.linalg.norm(away) == approx(3)
        scene = merge_scenes(tour, lambda v, t=tour: Scene(empty_gaussians(), t.cam2world[list(v)], 1.0, 9.0))
        assert scene.tour.approximate[0][:4] == (2, 0, approx(0), approx(3 * unit))
