"""The floor under cameras, and floor plans."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import PIL.Image
import pytest
import torch
from synthetic_scenes import make_balls, place_cameras, see_box

from pansplat.errors import InputError
from pansplat.export.plan_files import write_picture
from pansplat.gaussians.scene import Scene
from pansplat.inputs.pairs import Panorama
from pansplat.inputs.placements import Placement
from pansplat.tours import floor
from pansplat.tours.facts import TourFacts
from pansplat.tours.floor import draw_floor_plan, find_floor_outline
from pansplat.tours.graph import TourGraph, make_graph


@pytest.fixture(scope="module")
def room_scene() -> Scene:
    """Gaussians on the surfaces of a room 4 m wide and 6 m long, around a camera 1.5 m over its floor; z is up."""
    pose = place_cameras((0.5, 0.0, 1.5))
    pose[:, :3, :3] = torch.tensor(((1.0, 0, 0), (0, 0, 1), (0, -1, 0)))
    low, high = torch.tensor((-1.0, -2.0, 0.0)), torch.tensor((3.0, 4.0, 2.5))
    return Scene(make_balls(see_box(low, high, pose[0, :3, 3], 20000), 0.02, 1.0), pose, 0.45, 10.0)


def test_the_floor_of_a_room_ends_at_its_walls(room_scene):
    level = room_scene.cam2world[0, :3, :3].numpy()
    outline = find_floor_outline(room_scene, 0, level)
    assert outline.camera_height == pytest.approx(1.5, abs=0.01)
    assert np.allclose(outline.center, (0.5, 0.0)), "right is x, forward is y of this world"
    inside = (outline.corners - (-1, -2)) / (4, 6)
    border = np.minimum(inside, 1 - inside).min(axis=1)
    assert np.abs(border).max() < 0.04, "all corners are near a wall"
    scene = Scene(room_scene.gaussians.select(torch.arange(20)), room_scene.cam2world, 0.45, 10.0)
    assert find_floor_outline(scene, 0, level) is None and floor.find_camera_height(scene, 0, level) is None
    assert floor.find_camera_height(room_scene, 0, level) == outline.camera_height
    assert floor.choose_camera_height((1.0, None, 1.4, 1.6), 10.0) == 1.4
    assert floor.choose_camera_height((None,), 10.0) == 1.5


def test_the_plan_shows_the_floor_and_its_walls(room_scene):
    panoramas = (Panorama("a", Path("a"), room_scene.cam2world[0]),)
    tour = TourGraph("", Path(), panoramas, 0.45, 10.0)
    outline = find_floor_outline(room_scene, 0, tour.level_axes)
    plan = draw_floor_plan(tour, [outline], size=200)
    assert max(plan.image.shape[:2]) in (200, 201)

    def alpha(x: float, y: float) -> int:
        column, row = plan.to_pixels(np.array((x, y))).round().astype(int)
        return int(plan.image[row, column, 3])

    assert alpha(0.5, 0) == alpha(2.8, 3.8) == alpha(-0.8, -1.8) == 255
    assert alpha(3.3, 0) == alpha(0.5, 4.3) == alpha(-1.3, -2.3) == 0
    walls = (plan.image[..., 0] > 200).sum() / plan.pixels_per_metre
    assert 20 < walls / 2 < 26, "a line of 2 pixels around 20 m"
    empty = draw_floor_plan(tour, [])
    assert empty.image.max() == 0
    assert math.isfinite(empty.pixels_per_metre)


def test_the_plan_of_a_scene_is_a_file_with_its_panoramas(room_scene, tmp_path):
    facts = TourFacts(room_scene)
    floor.write_floor_plan(facts.tour, facts.outlines, tmp_path / "plan.png")
    with PIL.Image.open(tmp_path / "plan.png") as image:
        colors = np.asarray(image.convert("RGB")).astype(int)
    assert max(colors.shape[:2]) in (1024, 1025)
    assert (np.abs(colors - (90, 204, 255)).max(axis=2) < 12).sum() > 60, "the dot of the panorama"
    empty = dataclasses.replace(room_scene, gaussians=room_scene.gaussians.select(torch.arange(20)))
    for scene in (empty, dataclasses.replace(empty, cam2world=torch.zeros(0, 4, 4, dtype=torch.float64))):
        with pytest.raises(InputError, match="needed a floor below"):
            write_picture(scene, tmp_path / "none.png")
    assert not (tmp_path / "none.png").exists()


def test_a_panorama_that_is_probably_placed_is_a_ring(room_scene):
    pose = room_scene.cam2world[0]
    views = [Panorama(state, Path(state), pose, placement=Placement(state)) for state in ("placed", "probable")]
    colors = []
    for view in views:
        tour = TourGraph("", Path(), (view, view), 0.45, 10.0, overlaps={(0, 1): 0.5})
        outline = find_floor_outline(room_scene, 0, pose[:3, :3].numpy())
        image, plan = floor.paint_floor_plan(tour, {0: outline}), draw_floor_plan(tour, [outline], size=1024)
        x, y = plan.to_pixels(np.array((0.5, 0.0))).round().astype(int)
        colors.append((image[y, x].tolist(), image[y, x + 6].tolist()))
    assert colors[0][0] == [90, 204, 255] != colors[1][0] and colors[1][1] == [90, 204, 255]


def test_storeys_are_levels_of_cameras_and_stairs_are_in_none():
    assert floor.find_storeys(np.empty(0)) == []
    assert floor.find_storeys(np.array((1.5, 1.2, 1.52, 1.15))) == [[0, 1, 2, 3]], "two steps of a room"
    assert floor.find_storeys(np.array((1.5, 1.5, 2.5))) == [[0, 1]], "one on the stairs"
    assert floor.find_storeys(np.array((1.5, 2.5))) == [[0, 1]], "nothing states which one is on stairs"
    assert floor.find_storeys(np.array((2.9, 0.0, 0.3, 1.0, 3.0, 2.0, 0.1))) == [[1, 2, 6], [0, 4]]
    assert floor.find_storeys(np.array((0.0, 1.4, 0.05, 2.9))) == [[0, 2], [3]], "one alone between two levels"
    assert floor.find_storeys(np.array((1.0, 2.0, 0.0))) == [[2], [1]]
    assert floor.find_storeys(np.array((0.0, 0.5, 1.0, 1.1, 6.0, 6.0))) == [[2, 3], [4, 5]]


def _make_two_storeys(room_scene: Scene) -> TourGraph:
    """Two panoramas of a lower storey and two of an upper one, one on the stairs, and one of another world."""
    panoramas = []
    for number, (rise, world) in enumerate(((0, 0), (0.1, 0), (1.6, 0), (2.9, 0), (2.8, 0), (1.4, 1))):
        pose = room_scene.cam2world[0].clone()
        pose[2, 3] += rise  # z is up
        pose[0, 3] += 0.2 * number
        panoramas.append(Panorama(str(number), Path(str(number)), pose, world=world))
    return TourGraph("", Path(), tuple(panoramas), 0.45, 10.0)


def test_other_storeys_are_those_of_the_same_world_at_another_level(room_scene):
    tour = _make_two_storeys(room_scene)
    assert floor.find_other_storeys(tour, tour.positions[0] + (0, 0, 0.3)) == {2, 3, 4}
    assert floor.find_other_storeys(tour, tour.positions[4]) == {0, 1}, "the stairs are nearer to the upper storey"
    assert floor.find_other_storeys(tour, tour.positions[2]) == {0, 1}
    assert floor.find_other_storeys(tour, tour.positions[5]) == frozenset(), "levels of two worlds cannot be compared"


def test_panoramas_that_are_not_placed_neither_add_nor_merge_storeys(room_scene):
    heights = torch.tensor([0.0, 0.0, 0.0, 2.3, 2.3, 2.3, *[1.15] * 5], dtype=torch.float64)
    poses = room_scene.cam2world[:1].repeat(len(heights), 1, 1)
    poses[:, 2, 3] += heights  # z is up
    edges = (*((k, k + 1, 0.5) for k in range(5)), *((k, k, 1.0) for k in range(6, 11)))
    tour = make_graph(dataclasses.replace(room_scene, cam2world=poses, names=(), overlaps=edges))
    assert floor.assign_storeys(tour) == [0, 0, 0, 1, 1, 1, 0, 0, 0, 0, 0]
    assert floor.find_other_storeys(tour, tour.positions[0]) == {3, 4, 5}
    assert floor.find_other_storeys(tour, tour.positions[8]) == frozenset(), "it has no storey"


def test_storeys_of_a_plan_are_next_to_each_other(room_scene):
    tour = _make_two_storeys(room_scene)
    outline = find_floor_outline(room_scene, 0, tour.level_axes)
    image = floor.paint_floor_plan(tour, {0: outline})
    plan = draw_floor_plan(tour, [outline], size=1024)
    height, width = plan.image.shape[:2]
    assert image.shape == (height, 2 * width, 3)
    for node, panel in ((0, 0), (4, 1), (5, 0)):
        x, y = plan.to_pixels(tour.positions[node] @ tour.level_axes[:, (0, 2)]).round().astype(int)
        marked = [image[y, x + shift].tolist() == [90, 204, 255] for shift in (0, width)]
        assert marked == [panel == 0, panel == 1], "a panorama is marked in its own storey only"
    corner = plan.to_pixels(np.array(((2.8, 3.8),))).round().astype(int)[0]
    lower, upper = image[corner[1], corner[0]], image[corner[1], corner[0] + width]
    assert lower.sum() > upper.sum() > 3 * 24, "the lower floor is faint in the plan of the upper storey"


def test_the_floor_of_another_storey_is_faint_below_the_others(room_scene):
    tour = _make_two_storeys(room_scene)
    outline = find_floor_outline(room_scene, 0, tour.level_axes)
    part = dataclasses.replace(outline, corners=outline.center + 0.5 * (outline.corners - outline.center))
    plan = draw_floor_plan(tour, [part], faint=[outline], size=200)
    column, row = plan.to_pixels(np.array(((0.5, 0.0), (2.8, 3.8)))).round().astype(int).T
    assert plan.image[row, column, 3].tolist() == [255, 90]
