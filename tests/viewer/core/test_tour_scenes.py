"""The scenes of a tour are chosen, requested, kept and faded; the film has no jumps."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from PIL import Image

from pansplat.export.film import Film, Shot, plan_visits
from pansplat.gaussians.scene import Scene
from pansplat.tours.cross_fade import CrossFade
from pansplat.tours.facts import TourFacts
from pansplat.tours.graph import TourGraph
from pansplat.tours.merge import merge_scenes
from pansplat.tours.route import FADE_SECONDS, plan_route
from pansplat_viewer import run
from pansplat_viewer.capture import open_film, write_flight
from pansplat_viewer.core.camera import Camera
from pansplat_viewer.core.hotspots import find_hotspots
from pansplat_viewer.core.loader import SceneEntry
from pansplat_viewer.core.settings import DrawSettings
from pansplat_viewer.core.stop_fade import StopFade
from pansplat_viewer.core.tour_scenes import TourScenes, measure_bytes
from pansplat_viewer.draw.cpu_renderer import CpuRenderer


@pytest.fixture
def scenes(house, load_house) -> TourScenes:
    """The tour with the scene of its first edge."""
    scenes = TourScenes(house)
    scenes.add(load_house(scenes.make_entry((0, 1))))
    return scenes


def test_the_least_recently_used_scene_is_dropped_when_the_memory_is_exceeded(house, load_house, scenes, monkeypatch):
    size = measure_bytes(scenes.get((0, 1)).scene)
    assert size == 1000 * (4 * (3 + 3 + 4 + 1 + 3) + 8 + 8)
    monkeypatch.setattr("pansplat_viewer.core.tour_scenes._MEMORY", 2.5 * size)
    for views in ((1, 2), (2, 3)):
        scenes.add(load_house(scenes.make_entry(views)))
    assert scenes.loaded == [(0, 1), (2, 3)], "the scene of the camera is kept"
    assert set(scenes.outlines) == set(scenes.tour.clearances) == {0, 1, 2, 3}, "outlines are kept"


def test_missing_scenes_are_requested_first_then_refinements(house, load_house, scenes):
    wanted = [(0, 1), (1, 2)]
    request = scenes.choose_request(wanted, None)
    assert request.views == (1, 2) and request.pair.name == "room1-room2" and request.tour is scenes.tour
    assert scenes.choose_request(wanted, request) is None, "it is being loaded"
    scenes.add(replace(load_house(request), is_final=False))
    assert scenes.choose_request(wanted, None).views == (1, 2), "to be refined"
    scenes.add(load_house(request))
    assert scenes.choose_request(wanted, None) is None
    refining = scenes.make_entry((1, 2))
    assert scenes.choose_request([(1, 2), (2, 3)], refining) is None
    scenes.move(house.positions[3])
    assert scenes.choose_request([(2, 3), (1, 2)], refining).views == (2, 3), "the scene of the camera is missing"
    scenes._predictions[0, 1].drop()
    assert scenes.choose_request([(2, 3), (0, 1)], scenes.make_entry((0, 1))) is None, "a prediction is not lost"
    scenes.fail((2, 3))
    assert scenes.choose_request([(2, 3)], None) is None, "it is not tried again"


def test_scenes_of_edges_are_selected_from_one_prediction_of_their_part(house, load_house):
    entry = SceneEntry(house.name, tour=house, max_views=64)
    first = load_house(replace(entry, pair=house.make_set((0, 1)), views=(0, 1), start=1))
    scenes = TourScenes.start(first)
    assert scenes.views == (0, 1) and scenes.loaded == [(0, 1)] and scenes.get((0, 1)) is first
    (part,) = scenes.list_next(None, 0.0)
    assert part == (0, 1, 2, 3), "all are predicted at once"
    request = scenes.choose_request([part], first.entry)
    assert request.views == part and request.name == "4 panoramas", "the first scene is not refined"
    predicted = load_house(request)
    scenes.add(replace(predicted, is_final=False))
    assert scenes.loaded == [(0, 1), (1, 2), (2, 3)] and scenes.choose_request([part], request) is None
    for views in scenes.loaded:
        scene, gaussians = scenes.get(views).scene, predicted.scene.gaussians
        assert scene is scenes.get(views).scene is not first.scene
        assert np.allclose(scene.cam2world, house.cam2world[list(views)])
        for view, node in enumerate(views):
            means = scene.gaussians.means[scene.gaussians.views == view]
            assert means.equal(gaussians.means[gaussians.views == node])
    before = scenes.get((0, 1)).scene
    scenes.add(predicted)
    assert scenes.get((0, 1)).scene is not before, "selected from the refined part"
    assert scenes.choose_request([part], None) is None, "nothing is predicted twice"


def test_a_poor_edge_of_a_scene_becomes_a_zoom(house, load_house):
    first = SceneEntry(house.name, tour=house, pair=house.make_set((0, 1)), views=(0, 1), start=1, max_views=64)
    scenes = TourScenes.start(load_house(first))
    camera = scenes.tour.cam2world[0].numpy()
    assert scenes.plan_way(camera, (1,)).steps[0].kind == "flight"
    (part,) = scenes.list_next(None, 0.0)
    for _ in range(2):
        loaded = load_house(scenes.make_entry(part))
        vars(loaded.facts).update(poor=[(0, 1), (0, 3)])
        scenes.add(loaded)
    assert scenes.tour.poor == ((0, 1),), "each edge once, and no others"
    assert scenes.plan_way(camera, (1,)).steps[0].kind == "zoom"


def test_a_zoom_shows_both_photographs_and_ends_in_that_of_its_goal(parted_house):
    route, stop = plan_route(parted_house, [2, 3]), StopFade()
    stop.update(2, 0.0)
    shown = []
    for seconds in np.arange(0, route.steps[0].seconds, 1 / 30):
        moment = route.at(seconds / route.seconds)
        stop.follow(moment, seconds)
        shown.append((stop.before, stop.index, stop.weight))
        assert stop.is_whole, "nothing is seen of the scene"
    assert shown[0] == (2, 3, 0) and shown[-1][:2] == (2, 3) and 0.9 < shown[-1][2] < 1
    stop.update(3, route.seconds)
    assert (stop.before, stop.index, stop.weight) == (None, 3, 1)
    stop.update(None, route.seconds + 0.1)
    assert stop.index == 3 and stop.weight < 1, "into the scene"


def test_a_wall_that_a_scene_shows_is_no_edge_and_needs_no_other_prediction(house, load_house):
    first = SceneEntry(house.name, tour=house, pair=house.make_set((0, 1)), views=(0, 1), start=1, max_views=64)
    first = load_house(first)
    scenes = TourScenes.start(first)
    (part,) = scenes.list_next(None, 0.0)
    loaded = load_house(scenes.make_entry(part))
    vars(loaded.facts).update(walls=[(0, 1), (2, 3)])
    scenes.add(loaded)
    assert scenes.tour.walls == ((0, 1), (2, 3)) and scenes.tour.parts == (0, 1, 1, 2)
    assert scenes.edge == (0, 0) and scenes.get(scenes.views) is not None, "the camera stays where it is"
    assert scenes.list_next(None, 0.0) == [part]
    assert [step.kind for step in scenes.plan_way(house.cam2world[0].numpy(), (2,)).steps] == ["zoom", "flight"]
    camera = Camera(position=tuple(house.positions[0].tolist()))
    (hotspot,) = find_hotspots(scenes.tour, scenes.find_place(house.positions[0]), camera, (200, 200))
    assert hotspot.node == 1 and hotspot.is_zoom, "a ring leads through the wall"


def test_a_scene_between_two_predictions_has_the_gaussians_of_both(house, load_house, monkeypatch):
    monkeypatch.setattr("pansplat.tours.scene_views._MAX_PREDICTED", 2)
    scenes = TourScenes(house, max_views=64)
    predictions = scenes.list_next(None, 0.0)
    assert set(predictions) == {(0, 1), (1, 2, 3)}, "with the best neighbour of panorama 2"
    for views in predictions:
        scenes.add(load_house(scenes.make_entry(views)))
    scene = scenes.get((1, 2)).scene
    for view, views in enumerate(((0, 1), (1, 2, 3))):
        source = scenes._predictions[views].loaded.scene.gaussians
        expected = source.harmonics[source.views == 1]
        assert scene.gaussians.harmonics[scene.gaussians.views == view].equal(expected), "panorama 1 of the first"


def test_a_scene_is_good_along_its_edges_and_near_its_panoramas(scenes):
    for z, views in ((0.4, (0, 1)), (0.9, (0, 1)), (1.2, (1, 2)), (0.7, (1, 2)), (0.3, (0, 1))):
        scenes.move(np.array((0.0, 0.0, z)))
        assert scenes.views == views, "the edge is kept near a panorama"
    for z, inside in ((0.4, True), (1.0, True), (1.15, False), (1.6, False)):
        scenes.edge = (0, 1) if z < 0.8 else (1, 2)
        assert scenes.is_inside(np.array((0.0, 0.0, z)), (0, 1)) == inside, z


def test_predictions_go_on_to_the_last_scene_and_what_was_dropped_is_read_again(house, load_house, monkeypatch):
    monkeypatch.setattr("pansplat_viewer.core.tour_scenes._MEMORY", 0)
    panoramas = [replace(house.panoramas[0], cam2world=torch.eye(4, dtype=torch.float64)) for _ in range(8)]
    for k, panorama in enumerate(panoramas):
        panorama.cam2world[2, 3] = 0.8 * k
    row = replace(house, panoramas=tuple(panoramas), overlaps={(k, k + 1): 0.4 for k in range(7)})
    scenes, loaded = TourScenes(row), []
    while (request := scenes.choose_request(scenes.list_next(None, 0.0), None)) is not None:
        loaded.append(request.views)
        scenes.add(load_house(request))
        assert len(scenes.loaded) <= 3
    assert loaded == [(k, k + 1) for k in range(7)], "the nearest first, each once"
    scenes.move(row.positions[3])
    assert scenes.views not in scenes.loaded
    assert scenes.choose_request(scenes.list_next(None, 0.0), None).views == scenes.views


def test_a_way_begins_at_the_camera_and_after_a_jump_at_its_edge_and_zooms_where_there_is_no_scene(scenes, load_house):
    kinds = [step.kind for step in scenes.plan_way(scenes.tour.cam2world[0].numpy(), (2,)).steps]
    assert "flight" in kinds and "zoom" in kinds, "only the scene of the first edge is there"
    for views in ((1, 2), (2, 3)):
        scenes.add(load_house(scenes.make_entry(views)))
    looking = Camera(position=(0.1, 0.0, 0.5), yaw_radians=0.4, pitch_radians=0.2)
    route = scenes.plan_way(looking.cam2world, (3,))
    assert np.allclose(route.pose(0), looking.cam2world, atol=1e-3)
    assert route.walk == (1, 2, 3), "it does not go back to the first panorama"
    camera = Camera(position=(0.5, 0.0, 1.6)).cam2world
    assert scenes.edge == (0, 1), "the edge before the jump"
    assert scenes.plan_way(camera, (0,)).walk == (2, 1, 0)
    assert scenes.plan_way(camera, (1, 0)).walk == (2, 1, 0)
    assert scenes.plan_way(camera).walk[:2] == (3, 2), "the end of the edge that is nearer"


def test_a_fade_is_continuous_and_another_one_begins_after_its_end(small_scene):
    first, second = small_scene, replace(small_scene)
    fade = CrossFade()
    assert fade.choose_slot(first) == 0
    fade.show(0, first, 0.0)
    assert fade.compute_weight(0.0) == 1 and fade.choose_slot(first) is None, "the first scene does not fade in"
    assert fade.choose_slot(second) == 1
    fade.show(1, second, 1.0)
    times = 1.0 + np.linspace(0, FADE_SECONDS, 31)
    weights = [fade.compute_weight(time) for time in times[:-1]]
    assert weights[0] == 0 and np.all(np.diff(weights) > 0) and np.max(np.diff(weights)) < 0.06
    assert fade.choose_slot(first) is None, "a fade is going on"
    assert fade.compute_weight(times[-1]) == 1 and fade.choose_slot(first) == 0


def test_a_scene_of_another_part_is_drawn_from_the_last_pose_in_its_part(small_scene):
    fade, poses = CrossFade(), [np.full((4, 4), float(k)) for k in range(5)]
    fade.show(0, small_scene, 0.0, part=1)
    fade.move(poses[0], 1)
    fade.move(poses[1], 1)
    fade.move(poses[2], 2)
    assert fade.poses[0] is poses[1], "the camera has jumped, and the next scene is not there yet"
    fade.show(1, replace(small_scene), 1.0, part=2)
    fade.move(poses[3], 2)
    assert fade.poses == [poses[1], poses[3]] and fade.front == 1
    fade.move(poses[4], 1)
    assert fade.poses == [poses[4], poses[3]]


def test_scenes_of_other_parts_are_loaded_next_those_of_links_first(parted_house, load_house):
    scenes = TourScenes(parted_house)
    assert scenes.list_next(None, 0.0) == [(0, 1), (1, 2), (3,)]
    scenes.move(parted_house.positions[3] - (0, 0, 3))
    assert scenes.part == 1, "at first, the part of the nearest panorama"
    scenes.move(parted_house.positions[0])
    scenes.move(parted_house.positions[3])
    assert scenes.views == (3,) and scenes.part == 1, "after a jump"
    assert scenes.list_next(None, 0.0)[:2] == [(3,), (1, 2)]
    route = scenes.plan_way(parted_house.cam2world[3].numpy(), (0,))
    assert route.walk == (3, 2, 1, 0) and "zoom" in [step.kind for step in route.steps]
    scenes.add(load_house(scenes.make_entry((3,))))
    assert scenes.list_next(route, 0.0) == [(3,), (1, 2), (0, 1)], "those of the route"
    assert scenes.find_place(parted_house.positions[3]).camera_height == 1.0
    scenes.move(route.pose(1.0)[:3, 3], route.at(1.0).step.edge)
    assert scenes.views == (0, 1)


@pytest.fixture
def open_tour_film(load_house) -> Iterator[Callable[[TourGraph], tuple[Film, Scene]]]:
    """Opens the film of a tour, without photographs, and returns the scene, too."""
    with contextlib.ExitStack() as stack:

        def open_one(tour: TourGraph) -> tuple[Film, Scene]:
            entries, settings = TourScenes(tour), DrawSettings(mode="deferred")
            scene = merge_scenes(tour, lambda views: load_house(entries.make_entry(views)).scene)
            film = open_film(lambda: CpuRenderer(None), scene, None, (64, 36), settings)
            return stack.enter_context(film), scene

        yield open_one


def test_the_film_of_a_zoom_mixes_the_views_of_both_panoramas(parted_house, open_tour_film):
    film, _ = open_tour_film(parted_house)
    route = plan_route(parted_house, [2, 3])
    zoom = route.steps[0]

    def draw(part: float) -> np.ndarray:
        """The frame after a part of the zoom."""
        at = part * zoom.seconds / route.seconds
        moment = route.at(at)
        return film.draw(Shot.of_moment(moment, 75.0, at * route.seconds))

    before, grown, last, after = (draw(part) for part in (0.001, 0.3, 0.999, 1.0))
    assert np.abs(grown - before).mean() > 1e-3 and np.abs(after - before).mean() > 0.1
    assert np.abs(last - after).max() < 0.01, "no jump at the end"


def read_film(path) -> np.ndarray:
    with av.open(str(path)) as film:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]).astype(float)


def test_the_film_of_a_tour_has_neither_black_nor_jumps(house, open_tour_film, tmp_path):
    written, complete = [], []

    def show_file(file):
        written.append(file.name)
        complete.append((tmp_path / "film.mp4").exists())

    film, scene = open_tour_film(house)
    facts = TourFacts(scene)
    vars(facts)["poor"] = ()  # the scenes are made up
    write_flight(film, facts, tmp_path, 12, None, show_file)
    names = [f"{node + 1:02d}_{house.panoramas[node].name}.png" for node in range(4)]
    assert written == [*names, "film.mp4"] and complete == [False] * 4 + [True]
    frames = read_film(tmp_path / "film.mp4")
    with Image.open(tmp_path / names[0]) as still:
        assert np.abs(np.asarray(still).astype(float) - frames[0]).mean() < 6, "the still of the first panorama"
    assert len(frames) == round(12 * plan_visits(facts).seconds)
    assert frames.max(-1).min() > 40, "no black"
    steps = np.abs(np.diff(frames, axis=0)).mean((1, 2, 3))
    change = np.abs(frames[0].mean((0, 1)) - frames[-1].mean((0, 1))).mean()
    assert change > 30 and steps.max() < 0.3 * change, "scenes of different colours fade"


@pytest.mark.gl
def test_the_command_writes_the_film_of_a_folder_of_panoramas(house, load_house, monkeypatch, tmp_path, capsys):
    rows = {p.image.name: p.cam2world.tolist() for p in house.panoramas}
    (house.folder / "poses.json").write_text(str({"convention": "cam2world opencv", "poses": rows}).replace("'", '"'))

    def predict(tour, *, options):
        entries = TourScenes(tour)
        return merge_scenes(tour, lambda views: load_house(entries.make_entry(views)).scene)

    monkeypatch.setattr("pansplat.pipeline.predict", predict)
    monkeypatch.setattr("pansplat.tours.overlap.connect", lambda tour: replace(tour, overlaps=house.overlaps))
    arguments = ["--offscreen", str(tmp_path), "--size", "64x32", "--seconds", "0.5", "--renderer", "cpu"]
    assert run([str(house.folder), *arguments]) == 0
    stills = [f"{node + 1:02d}_{house.panoramas[node].name}.png" for node in range(4)]
    assert sorted(path.name for path in tmp_path.iterdir()) == [*stills, "film.mp4"]
    assert len(read_film(tmp_path / "film.mp4")) == 12
    lines = capsys.readouterr().out.splitlines()[1:]  # without the note on several scenes
    assert [Path(line).name for line in lines if "Gaussians" not in line] == [*stills, "film.mp4"]
    assert lines[0].endswith(" Gaussians"), "before the first still"
