"""Damaged labels of the pansplat entry are ignored with a warning; the Gaussians are kept."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.gaussians.scene_files import format_entry, restore_scene

COUNT = 12
_POSES = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
_LABELS = torch.zeros(COUNT, dtype=torch.int64)
GAUSSIANS = Gaussians(*(torch.ones(COUNT, *shape) for shape in ((3,), (3,), (4,), (), (1, 3))), _LABELS, _LABELS)
ENTRY = json.loads(format_entry(Scene(GAUSSIANS, _POSES, near=0.45, far=10.0), [[0, 0, 6], [0, 1, 6]]))


def read(text: str) -> Scene:
    return restore_scene(GAUSSIANS, text, Path("scene.ply"))


@pytest.mark.parametrize("value", [True, False, None, 1, "yes"])
def test_only_a_stated_scene_for_joint_drawing_is_one(value: object) -> None:
    entry = ENTRY if value is None else ENTRY | {"joint": value}
    assert read(json.dumps(entry)).joint is (value is True)


def test_joint_drawing_is_written() -> None:
    scene = Scene(GAUSSIANS, _POSES, near=0.45, far=10.0, joint=True)
    assert read(format_entry(scene, [[0, 0, 12]])).joint
