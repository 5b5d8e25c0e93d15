"""Which panoramas of a group are only probably placed, and what leaves the group without a probable pair."""

from pathlib import Path

import pytest

from pansplat.inputs.placements import Tie, find_holds, judge, read_ties

SOURCE = Path("poses.json")


def _ties(certain: str, probable: str = "") -> list[Tie]:
    """Pairs such as "ab bc"."""
    return [Tie(*pair, True) for pair in certain.split()] + [Tie(*pair, False) for pair in probable.split()]


@pytest.mark.parametrize(
    ("names", "certain", "probable", "held"),
    [
        ("abc", "ab bc", "", {}),
        ("abc", "", "", {}),  # poses of another program
        ("abc", "ab", "bc", {"c": "c"}),
        ("abc", "ab bc", "ac", {}),  # the certain pairs hold it, too
        ("abc", "ab", "ac bc", {"c": "c"}),
        ("abcd", "ab cd", "bc", {"c": "cd", "d": "cd"}),  # the first of two equal parts is the core
        ("abcde", "cd de ab", "bc", {"a": "ab", "b": "ab"}),  # the larger part is
        ("abcd", "ab", "bc cd", {"c": "cd", "d": "d"}),  # a chain
        ("ab", "", "ab", {"a": "a", "b": "b"}),  # nothing is certain
        ("abc", "ab", "bx", {}),  # of another group
    ],
)
def test_a_panorama_is_probable_if_only_probable_pairs_connect_it_with_the_core(names, certain, probable, held):
    holds = find_holds(names, _ties(certain, probable))
    assert {name: "".join(hold.members) for name, hold in holds.items()} == held


def test_the_reason_of_a_probable_panorama_names_its_pairs_towards_the_core():
    holds = find_holds("abcd", _ties("ab", "bc ac cd"))
    assert holds["c"].reason == "by probable pairs only: b - c, a - c"
    assert holds["d"].reason == "by probable pairs only: c - d"


def test_a_panorama_that_is_placed_by_hand_needs_no_pair():
    placements = judge("abc", _ties("ab", "bc"), {"c"}, SOURCE)
    assert [placements[name].state for name in "abc"] == ["placed", "placed", "by hand"]
    assert judge("a", [], (), SOURCE)["a"].state == "not placed"  # alone in its world


def test_invalid_pairs_of_a_file_are_ignored():
    pairs = [{"between": ["a", "b"], "check": "certain"}, {"between": ["a"]}, 3, {"between": "ab"}, {}]
    assert read_ties({"pairs": pairs}) == [Tie("a", "b", True)]
    assert read_ties({"pairs": {}}) == read_ties(None) == []
