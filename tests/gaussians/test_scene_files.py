"""Damaged labels and fields of the pansplat entry are ignored with a warning; the Gaussians are kept."""

from __future__ import annotations

import json
import random
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pansplat.errors import InputWarning
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.gaussians.scene_files import format_entry, make_scene

COUNT = 12
HUGE = 10**400
_POSES = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
_LABELS = torch.zeros(COUNT, dtype=torch.int64)
GAUSSIANS = Gaussians(*(torch.ones(COUNT, *shape) for shape in ((3,), (3,), (4,), (), (1, 3))), _LABELS, _LABELS)
_TOUR = {"overlaps": ((0, 1, 0.5),), "links": ((1, 0, -3.0, 0.25, "x"),), "starts": (None, (1.0, -0.5))}
_NAMED = {"names": ("a", "b"), "model": "sweep", "height": 256, "gains": ((1.25, 1.0, 0.5), (0.8, 1.0, 2.0))}
ENTRY = json.loads(format_entry(Scene(GAUSSIANS, _POSES, 0.45, 10.0, **_NAMED, **_TOUR), [[0, 0, 6], [0, 1, 6]]))


def read(text: str) -> Scene:
    return make_scene(GAUSSIANS, text, Path("scene.ply"))


JUNK = (
    *(None, True, -1, 0, 0.5, 7, 10**18, 2**63 - 1, HUGE, 1e-300, 1e30, 1e300, -0.45, "a", "", [], {}, {"a": 1}),
    *([1], [[1]], [[0, 0, HUGE]], [[0, 0, 10**18 - 1]] * 19 + [[0, 0, 12]], [[0, 5, 12]], [[0, 0, -1], [0, 0, 13]]),
)


def _replace_any(value: Any, junk: Any, random: random.Random) -> Any:
    """A copy with one of its parts, or all of it, replaced."""
    if not isinstance(value, (dict, list)) or not value or random.random() < 0.2:
        return junk
    key = random.choice(list(value) if isinstance(value, dict) else range(len(value)))
    changed = dict(value) if isinstance(value, dict) else list(value)
    changed[key] = _replace_any(value[key], junk, random)
    return changed


@settings(max_examples=100)
@given(junk=st.sampled_from(JUNK), seed=st.integers(0, 10**6))
def test_any_change_of_the_entry_is_read_or_ignored_with_a_warning(junk: Any, seed: int) -> None:
    changed = _replace_any(ENTRY, junk, random.Random(seed))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = read(json.dumps(changed))
    assert len(scene.gaussians) == COUNT and int(scene.gaussians.views.max()) < max(1, len(scene.cam2world))
    assert all("scene.ply: its " in str(warning.message) for warning in caught)
    if caught:
        return
    unread = ("version", "runs", "cam2world", "joint", "names")  # any name is read as a text
    expected = {key: value for key, value in changed.items() if value and key not in unread}
    written = json.loads(format_entry(scene, [[0, 0, COUNT]]))
    assert {key: written.get(key) for key in expected} == expected, "what is read is what was written"
    assert torch.isfinite(scene.cam2world).all() and 0 < scene.near < scene.far < 1e30


UNUSABLE: dict[str, tuple[Any, ...]] = {
    "near": (1e-300, 1e-40, 1e300, -1.0, 0.0, 10.0, "0.45", [1], True, HUGE),
    "far": (1e38, 1e300, 0.45, "far", {}),
    "height": (10**17, -5, 0, 64.5, "64", HUGE, True),
    "names": ("a.png", {"a": 1}, 3),
    "model": (3, ["sphere"]),
    "gains": (
        7,
        [1, 1],
        [[1, 1, 1]],
        [[1, 1]] * 2,
        [["a"] * 3] * 2,
        [[0, 1, 1]] * 2,
        [[1e9] * 3] * 2,
        [[True] * 3] * 2,
    ),
    "overlaps": (7, [0, 1, 0.5], [[0, 1]], [[0, 2, 0.5]], [[1, 0, 0.5]], [[0, 1, 2]], [[0, 1, "a"]], [[0, 0, 1]]),
    "links": (7, [[0, 1, 0, 0]], [[0, 2, 0, 0, ""]], [[1, 1, 0, 0, ""]], [[0, 1, 1e9, 0, ""]], [[0, 1, 0, 0, 5]]),
    "starts": (7, [0, 1], [None], [[0, 0]], [[0], None], [[0, "a"], None], [[0, 1e9], None], [None] * 3),
    "cam2world": (7, [[1, 2], [3]], [[[1e30] * 4] * 4], [[["a"] * 4] * 4], [[1.0] * 16], {"a": 1}, [[[None] * 4] * 4]),
}


@pytest.mark.parametrize("key", UNUSABLE)
def test_an_entry_with_an_unusable_field_is_ignored_and_the_field_is_named(key: str) -> None:
    for value in UNUSABLE[key]:
        with pytest.warns(InputWarning, match=rf"scene\.ply: its pansplat comment is damaged \(.*{key}"):
            scene = read(json.dumps(ENTRY | {key: value}))
        assert len(scene.gaussians) == COUNT and not scene.gaussians.views.any() and not len(scene.cam2world)


def test_labels_that_do_not_fit_are_ignored() -> None:
    for runs in ([[0, 0, 10**18 - 1]] * 19 + [[0, 0, 12]], [[0, 0, -1], [0, 0, 13]], [[0, 5, 12]], [[0.5, 0, 12]]):
        with pytest.warns(InputWarning, match=r"scene\.ply: its levels and views do not fit .* are ignored"):
            scene = read(json.dumps(ENTRY | {"runs": runs}))
        assert not scene.gaussians.views.any() and len(scene.cam2world) == 2


def test_an_entry_that_is_not_an_object_of_valid_json_is_ignored() -> None:
    for text in (
        "[" * 100_000,
        "{",
        "[1]",
        "null",
        '{"near": 1e999}',
        '{"near": 1, "near": 2}',
        '{"names": ["\\ud800"]}',
    ):
        with pytest.warns(InputWarning, match="comment is damaged"):
            assert not len(read(text).cam2world)


@pytest.mark.parametrize("value", [True, False, None, 1, "yes"])
def test_only_a_stated_scene_for_joint_drawing_is_one(value: object) -> None:
    entry = ENTRY if value is None else ENTRY | {"joint": value}
    assert read(json.dumps(entry)).joint is (value is True)


def test_joint_drawing_is_written() -> None:
    scene = Scene(GAUSSIANS, _POSES, near=0.45, far=10.0, joint=True)
    assert read(format_entry(scene, [[0, 0, 12]])).joint
