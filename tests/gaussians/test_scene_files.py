"""Damaged labels and fields of the pansplat entry are ignored with a warning; the Gaussians are kept."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from pansplat.errors import InputWarning
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.gaussians.scene_files import format_entry, make_scene

COUNT = 12
HUGE = 10**400
_POSES = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
_LABELS = torch.zeros(COUNT, dtype=torch.int64)
GAUSSIANS = Gaussians(*(torch.ones(COUNT, *shape) for shape in ((3,), (3,), (4,), (), (1, 3))), _LABELS, _LABELS)
ENTRY = json.loads(format_entry(Scene(GAUSSIANS, _POSES, near=0.45, far=10.0), [[0, 0, 6], [0, 1, 6]]))

RUNS = {
    "sum that overflows": [[0, 0, 10**18 - 1]] * 19 + [[0, 0, 12]],
    "negative length": [[0, 0, -1], [0, 0, 13]],
    "length above the count": [[0, 0, 10**12]],
    "view that is missing": [[0, 5, 12]],
    "level of 2^60": [[2**59, 0, 12]],
    "fractions": [[0.5, 0, 12]],
    "booleans": [[False, False, 12]],
    "texts": [["0", "0", "12"]],
    "pairs instead of triples": [[0, 12]],
    "an object in the list": [{"a": 1}],
    "numbers instead of lists": [0, 0, 12],
    "lists in lists": [[[0], [0], [12]]],
}
FIELDS: dict[str, tuple[Any, ...]] = {
    "runs": (7, [[0, 0, HUGE]], [[0, 0, 2**63 - 1], [0, 0, 2**63 - 1], [0, 0, 14]]),
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
    "overlaps": (
        7,
        [0, 1, 0.5],
        [[0, 1]],
        [[0, 2, 0.5]],
        [[1, 0, 0.5]],
        [[0, 1, 2]],
        [[0, 1, "a"]],
        [[True, 1, 0.5]],
        [[0, 0, 1]],
    ),
    "links": (
        7,
        [0, 1, 0, 0, ""],
        [[0, 1, 0, 0]],
        [[0, 2, 0, 0, ""]],
        [[1, 1, 0, 0, ""]],
        [[0, 1, 1e9, 0, ""]],
        [[0, 1, "a", 0, ""]],
        [[0, 1, 0, 0, 5]],
        [[True, 0, 0, 0, ""]],
    ),
    "starts": (7, [0, 1], [None], [[0, 0]], [[0], None], [[0, "a"], None], [[0, 1e9], None], [None] * 3),
    "cam2world": (7, "pose", [[1, 2], [3]], [[[1e30] * 4] * 4], [[["a"] * 4] * 4], [[1.0] * 16], {"a": 1}),
}
TEXTS = ("[" * 100_000, "{", "[1, 2]", "5", "null", '{"near": NaN}', '{"near": 1e999}', '{"near": 1' + "0" * 5000 + "}",
         '{"near": 1, "near": 2}', '{"names": ["\\ud800"]}')  # fmt: skip


def read(text: str) -> Scene:
    return make_scene(GAUSSIANS, text, Path("scene.ply"))


def test_the_undamaged_entry_is_read() -> None:
    scene = read(json.dumps(ENTRY))
    assert scene.gaussians.views.tolist() == [0] * 6 + [1] * 6 and torch.equal(scene.cam2world, _POSES)


@pytest.mark.parametrize("name", RUNS)
def test_labels_that_do_not_fit_are_ignored(name: str) -> None:
    with pytest.warns(InputWarning, match=r"scene\.ply: its levels and views do not fit .* are ignored"):
        scene = read(json.dumps(ENTRY | {"runs": RUNS[name]}))
    assert len(scene.gaussians) == COUNT and not scene.gaussians.views.any() and len(scene.cam2world) == 2


@pytest.mark.parametrize("key", FIELDS)
def test_an_entry_with_an_unusable_field_is_ignored(key: str) -> None:
    for value in FIELDS[key]:
        with pytest.warns(InputWarning, match=rf"scene\.ply: its pansplat comment is damaged \(.*{key}"):
            scene = read(json.dumps(ENTRY | {key: value}))
        assert len(scene.gaussians) == COUNT and not scene.gaussians.views.any() and not len(scene.cam2world)


@pytest.mark.parametrize("text", TEXTS, ids=lambda text: text[:24])
def test_an_entry_that_is_not_an_object_of_valid_json_is_ignored(text: str) -> None:
    with pytest.warns(InputWarning, match="comment is damaged"):
        assert not len(read(text).cam2world)


@pytest.mark.parametrize("value", [True, False, None, 1, "yes"])
def test_only_a_stated_scene_for_joint_drawing_is_one(value: object) -> None:
    entry = ENTRY if value is None else ENTRY | {"joint": value}
    assert read(json.dumps(entry)).joint is (value is True)


def test_joint_drawing_is_written() -> None:
    scene = Scene(GAUSSIANS, _POSES, near=0.45, far=10.0, joint=True)
    assert read(format_entry(scene, [[0, 0, 12]])).joint
