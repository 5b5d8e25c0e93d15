"""What a scene shows of a tour is computed once, and stored by all that it depends on."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from synthetic_scenes import make_balls, place_cameras, see_box

from pansplat.export.plan_files import write_plan
from pansplat.gaussians.scene import Gaussians, Scene, SceneTour
from pansplat.tours import facts
from pansplat.tours.facts import TourFacts

PARTS = ("heights", "ceilings", "outlines", "outlooks", "clearances", "hidden", "walls", "poor", "plan")


@pytest.fixture(scope="module")
def scene() -> Scene:
    """What two cameras show of a room."""
    poses = place_cameras((0.0, 0.0, 0.0), (1.0, 0.0, 0.5))
    low, high = torch.tensor((-2.0, -1.1, -2.5)), torch.tensor((2.5, 1.5, 2.0))
    views = [make_balls(see_box(low, high, pose[:3, 3], 20000), 0.02, 1.0, views=k) for k, pose in enumerate(poses)]
    return Scene(Gaussians.cat(views), poses, 0.45, 10.0, names=("a", "b"), tour=SceneTour(((0, 1, 0.5),)))


def forbid(*_: object) -> None:
    pytest.fail("computed again")


def test_what_is_read_from_the_store_equals_what_was_computed(scene, tmp_path, monkeypatch) -> None:
    computed = TourFacts(scene, folder=tmp_path)
    expected = [getattr(computed, part) for part in PARTS]
    assert len(computed.plan.rooms) == 1 and set(computed.outlines) == {0, 1}
    for name in ("find_surfaces", "find_floor", "find_walls", "make_plan"):
        monkeypatch.setattr(facts, name, forbid)
    stored = TourFacts(scene, folder=tmp_path)
    for part, value in zip(PARTS, expected, strict=True):
        found = getattr(stored, part)
        if part == "outlines":
            assert found.keys() == value.keys()
            assert all(np.array_equal(found[node].corners, value[node].corners) for node in value)
        elif part == "plan":
            assert found.tour is stored.tour and np.array_equal(found.rooms[0].outline, value.rooms[0].outline)
            assert [found.rooms[0].panoramas, found.num_walls] == [value.rooms[0].panoramas, value.num_walls]
        else:
            assert np.array_equal(found, value), part


@pytest.mark.parametrize("what", ["surfaces", "opacities", "poses", "edges", "names"])
def test_what_depends_on_a_change_is_computed_again(what: str, scene: Scene, tmp_path: Path) -> None:
    gaussians, poses = scene.gaussians, scene.cam2world.clone()
    poses[1, 0, 3] += 0.1
    changes = {
        "surfaces": {"gaussians": dataclasses.replace(gaussians, means=gaussians.means * 1.1)},
        "opacities": {"gaussians": dataclasses.replace(gaussians, opacities=gaussians.opacities * 0.2)},
        "poses": {"cam2world": poses},
        "edges": {"tour": SceneTour(((0, 0, 1.0), (1, 1, 1.0)))},
        "names": {"names": ("hall", "b")},
    }
    computed = TourFacts(scene, folder=tmp_path)
    assert computed.plan.rooms[0].name == "a / b"
    other = dataclasses.replace(scene, **changes[what])
    stored, fresh = TourFacts(other, folder=tmp_path), TourFacts(other)
    assert [room.name for room in stored.plan.rooms] == [room.name for room in fresh.plan.rooms]
    assert stored.heights == fresh.heights and stored.poor == fresh.poor
    assert np.array_equal(stored.outlooks, fresh.outlooks)
    changed = (stored.heights, stored.outlooks.tolist(), [room.name for room in stored.plan.rooms])
    assert changed != (computed.heights, computed.outlooks.tolist(), [room.name for room in computed.plan.rooms])


def test_nothing_is_written_without_a_folder(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert TourFacts(scene).plan.rooms and list(tmp_path.iterdir()) == []


def test_the_plan_of_a_file_is_stored_beside_the_panoramas(scene, tmp_path, monkeypatch) -> None:
    first = write_plan(scene, tmp_path / "first.svg", tmp_path)
    for name in ("find_surfaces", "make_plan"):
        monkeypatch.setattr(facts, name, forbid)
    again = write_plan(scene, tmp_path / "again.svg", tmp_path)
    assert np.array_equal(first.rooms[0].outline, again.rooms[0].outline)
