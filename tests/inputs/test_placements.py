"""Which panoramas of a group are only probably placed, and where those without a pose are drawn."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from pytest import approx

from pansplat.errors import InputWarning
from pansplat.gaussians.scene import Scene, empty_gaussians
from pansplat.inputs.folders import load_pairs
from pansplat.inputs.placements import Tie, find_probable, judge, read_ties
from pansplat.tours.graph import find_tours, merge_scenes

SOURCE = Path("poses.json")


def _ties(certain: str, probable: str = "") -> list[Tie]:
    """Pairs such as "ab bc"."""
    return [Tie(*pair, True) for pair in certain.split()] + [Tie(*pair, False) for pair in probable.split()]


@pytest.mark.parametrize(
    ("names", "certain", "probable", "found"),
    [
        ("abc", "ab bc", "", ""),
        ("abc", "", "", ""),  # poses of another program
        ("abc", "ab", "bc", "c"),
        ("abc", "ab bc", "ac", ""),  # the certain pairs hold it, too
        ("abc", "ab", "ac bc", "c"),
        ("abcd", "ab cd", "bc", "cd"),  # the first of two equal parts is the core
        ("abcde", "cd de ab", "bc", "ab"),  # the larger part is
        ("abcd", "ab", "bc cd", "cd"),  # a chain
        ("ab", "", "ab", "ab"),  # nothing is certain
        ("abc", "ab", "bx", ""),  # of another group
        ("abcd", "ab cd", "", ""),  # placed beside each other by hand
    ],
)
def test_a_panorama_is_probable_if_only_probable_pairs_connect_it_with_the_core(names, certain, probable, found):
    assert "".join(find_probable(names, _ties(certain, probable))) == found


def test_the_reason_of_a_probable_panorama_names_the_pairs_of_its_part():
    assert find_probable("abcd", _ties("ab cd", "bc ac"))["d"] == "by probable pairs only: b - c, a - c"


def test_a_panorama_that_is_placed_by_hand_needs_no_pair():
    placements = judge("abc", _ties("ab", "bc"), {"c"}, SOURCE)
    assert [placements[name].state for name in "abc"] == ["placed", "placed", "by hand"]
    assert judge("a", [], (), SOURCE)["a"].state == "not placed"  # alone in its world


def test_an_approximate_place_is_as_far_away_in_every_unit_of_measured_poses(tmp_path: Path):
    """Two camera heights of 1.5 m, in a poses.json of metres and one of millimetres, with the unit and without."""
    for unit, worlds in ((1, []), (1000, []), (1, [{"unit": 1.5}]), (1000, [{"unit": 1500}])):
        folder = tmp_path / f"{unit}{len(worlds)}"
        folder.mkdir()
        poses = {f"{name}.png": np.eye(4).tolist() for name in "ab"}
        poses["b.png"][0][3] = float(unit)
        for name in "abc":
            Image.new("RGB", (128, 64), (2 * ord(name), 9, 9)).save(folder / f"{name}.png")
        stated = {"approximate": [{"between": ["a.png", "c.png"], "place": [0, 2, 0]}]}
        content = {"convention": "cam2world opencv", "poses": poses, "near": 0.5 * unit, "far": 9 * unit}
        content |= {"worlds": worlds, "estimate": stated}
        (folder / "poses.json").write_text(json.dumps(content))
        with pytest.warns(InputWarning, match=r"no pose of c\.png"):
            (tour,) = find_tours(load_pairs(folder))
        drawn = tour.approximate[2]
        assert tour.panoramas[2].name == "c" and np.linalg.norm(drawn.place - tour.positions[0, [0, 2]]) == approx(3)
        scene = merge_scenes(tour, lambda v, t=tour: Scene(empty_gaussians(), t.cam2world[list(v)], 1.0, 9.0))
        assert scene.approximate[0][:4] == (2, 0, approx(0), approx(3 * unit))


def test_invalid_pairs_of_a_file_are_ignored():
    pairs = [{"between": ["a", "b"], "check": "certain"}, {"between": ["a"]}, 3, {"between": "ab"}, {}]
    assert read_ties({"pairs": pairs}) == [Tie("a", "b", True)]
    assert read_ties({"pairs": {}}) == read_ties(None) == []
