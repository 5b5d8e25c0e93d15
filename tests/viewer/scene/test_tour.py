"""The scenes of a tour are chosen, requested, kept and faded; hotspots are found; the film has no jumps."""

from dataclasses import replace

import av
import numpy as np
import pytest
from PIL import Image

from pansplat.data.pairs import Link
from pansplat.tours import FADE_SECONDS, plan_route
from pansplat_viewer import run
from pansplat_viewer.capture import Film, TourFrames, write_tour
from pansplat_viewer.draw.cpu_renderer import CpuRenderer
from pansplat_viewer.scene.camera import Camera
from pansplat_viewer.scene.settings import DrawSettings
from pansplat_viewer.scene.tour import CrossFade, TourScenes, find_clicked, find_hotspots, measure_bytes


@pytest.fixture
def scenes(house, load_house) -> TourScenes:
    """The tour with the scene of its first edge."""
    scenes = TourScenes(house)
    scenes.add(load_house(scenes.make_entry((0, 1))))
    return scenes


def test_the_least_recently_used_scene_is_dropped_when_the_memory_is_exceeded(house, load_house, scenes):
    size = measure_bytes(scenes.get((0, 1)).scene)
    assert size == 1000 * (4 * (3 + 3 + 4 + 1 + 3) + 8 + 8)
    scenes._budget = 2.5 * size
    for views in ((1, 2), (2, 3)):
        scenes.add(load_house(scenes.make_entry(views)))
    assert scenes.loaded == [(0, 1), (2, 3)], "the scene of the camera is kept"
    assert set(scenes.outlines) == {0, 1, 2, 3}, "outlines are kept"


def test_the_camera_needs_the_nearest_edge_and_keeps_it_near_a_panorama(scenes):
    for z, views in ((0.4, (0, 1)), (0.9, (0, 1)), (1.2, (1, 2)), (0.7, (1, 2)), (0.3, (0, 1))):
        scenes.move(np.array((0.0, 0.0, z)))
        assert scenes.views == views, z


def test_missing_scenes_are_requested_first_then_refinements(house, load_house, scenes):
    wanted = [(0, 1), (1, 2)]
    request = scenes.choose_request(wanted, None)
    assert request.views == (1, 2) and request.pair.name == "room1-room2" and request.tour is house
    assert scenes.choose_request(wanted, request) is None, "it is being loaded"
    scenes.add(replace(load_house(request), is_final=False))
    assert scenes.choose_request(wanted, None).views == (1, 2), "to be refined"
    scenes.add(load_house(request))
    assert scenes.choose_request(wanted, None) is None
    refining = scenes.make_entry((1, 2))
    assert scenes.choose_request([(2, 3), (1, 2)], refining).views == (2, 3), "the scene of the camera is missing"
    assert scenes.choose_request([(1, 2), (2, 3)], refining) is None


def test_a_route_can_be_flown_up_to_the_first_scene_that_is_missing(house, load_house, scenes):
    route = plan_route(house, [0, 1, 2, 3])
    limit = scenes.find_limit(route, 0.0)
    assert 0 < limit < 1 and route.edge(limit) == (0, 1)
    assert scenes.list_next(route, 0.0) == [(0, 1), (1, 2), (2, 3)]
    for views in ((1, 2), (2, 3)):
        scenes.add(load_house(scenes.make_entry(views)))
    assert scenes.find_limit(route, limit) == 1


def test_the_way_to_a_panorama_starts_at_the_camera(scenes):
    camera = Camera(position=(0.1, 0.0, 0.5), yaw_radians=0.4, pitch_radians=0.2)
    route = scenes.plan_way(camera.cam2world, 3)
    assert np.allclose(route.pose(0), camera.cam2world, atol=1e-3)
    assert route.walk == (1, 2, 3), "it does not go back to the first panorama"
    assert np.allclose(route.pose(1)[:3, 3], scenes.tour.positions[3])


def test_a_way_begins_at_the_edge_of_the_camera_after_a_jump(scenes):
    camera = Camera(position=(0.5, 0.0, 1.6)).cam2world
    assert scenes.edge == (0, 1), "the edge before the jump"
    assert scenes.plan_way(camera, 0).walk == (2, 1, 0)
    assert scenes.plan_route(camera, (1, 0)).walk == (2, 1, 0)
    assert scenes.plan_route(camera).walk[:2] == (3, 2), "the end of the edge that is nearer"


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
    route = scenes.plan_way(parted_house.cam2world[3].numpy(), 0)
    assert route.walk == (3, 2, 1, 0) and route.fades == (0,)
    scenes.add(load_house(scenes.make_entry((3,))))
    limit = scenes.find_limit(route, 0.0)
    assert route.edge(limit) is None and np.linalg.norm(route.pose(limit)[:3, 3] - parted_house.positions[3]) < 0.71
    assert scenes.camera_height == 1.0
    scenes.move(route.pose(1.0)[:3, 3], route, 1.0)
    assert scenes.views == (0, 1)


def test_the_hotspot_of_a_link_is_where_it_meets_the_floor(parted_house, load_house):
    scenes = TourScenes(parted_house)
    scenes.add(load_house(scenes.make_entry((1, 2))))
    scenes.move(parted_house.positions[2])
    camera = Camera(position=(0.0, 0.0, 1.6), vertical_fov_degrees=120.0)
    (hotspot,) = find_hotspots(scenes, camera, (200, 200))
    assert (hotspot.node, hotspot.label, hotspot.is_fade) == (3, "to the hall", True)
    focal = 100 / np.tan(np.radians(60))
    assert hotspot.center == pytest.approx((100 + focal * np.tan(0.1), 100 + focal * np.tan(0.6) / np.cos(0.1)))
    scenes.move(parted_house.positions[3])
    for pitch, distance in ((1.4, 1.0), (0.05, 3.0), (-0.2, 3.0)):
        panoramas = list(parted_house.panoramas)
        panoramas[3] = replace(panoramas[3], links=(Link("room2", 0.0, pitch),))
        scenes.tour = replace(parted_house, panoramas=tuple(panoramas))
        (hotspot,) = find_hotspots(scenes, replace(camera, position=(20.0, 0.0, 1.6)), (200, 200))
        assert hotspot.center == pytest.approx((100, 100 + focal / distance)), "1 to 3 m away"
        assert hotspot.label == "room2"


def test_a_hotspot_is_below_its_panorama_and_a_click_finds_the_nearest(scenes):
    camera = Camera(position=(0.0, 0.0, 0.0), vertical_fov_degrees=90.0)
    hotspots = find_hotspots(scenes, camera, (200, 200))
    assert [hotspot.node for hotspot in hotspots] == [2], "the floor below panorama 1 is not in the image"
    x, y = hotspots[0].center
    assert x == pytest.approx(100) and y == pytest.approx(100 + 100 / 1.6), "1 m below the camera, 1.6 m ahead"
    assert find_clicked(hotspots, (x + 5, y)) == 2
    assert find_clicked(hotspots, (x, y - 60)) is None
    assert find_hotspots(scenes, replace(camera, yaw_radians=np.pi), (200, 200)) == []


def test_the_film_of_a_fade_between_parts_mixes_both_last_views(parted_house, load_house):
    scenes = TourScenes(parted_house)
    renderers = [CpuRenderer(None), CpuRenderer(None)]
    settings = DrawSettings(mode="deferred")
    frames = TourFrames(renderers, scenes, lambda entry: load_house(entry), (64, 36), settings)
    route = plan_route(parted_house, [2, 3])
    (jump,) = route.jumps

    def draw(sample: int, seconds: float) -> np.ndarray:
        pose = route.pose(sample / (len(route.legs) - 1))
        scenes.move(pose[:3, 3], route, sample / (len(route.legs) - 1))
        return frames.draw_scene(pose, 75.0, seconds)[0]

    before = draw(jump, 0.0)
    assert np.abs(draw(jump + 1, 1.0) - before).max() < 1e-6, "the fade begins with the last view"
    middle = draw(jump + 1, 1.0 + FADE_SECONDS / 2)
    after = draw(jump + 1, 1.0 + FADE_SECONDS)
    assert np.abs(after - before).mean() > 0.1 and np.abs(middle - (before + after) / 2).max() < 1e-6
    for renderer in renderers:
        renderer.release()


def read_film(path) -> np.ndarray:
    with av.open(str(path)) as film:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]).astype(float)


def test_the_film_of_a_tour_has_neither_black_nor_jumps(house, load_house, scenes, tmp_path):
    loaded = []

    def load(entry):
        loaded.append(entry.views)
        return load_house(entry)

    route = plan_route(house, house.plan_walk(0))
    renderers = [CpuRenderer(None), CpuRenderer(None)]
    film = Film((64, 36), fps=12)
    frames = TourFrames(renderers, scenes, load, film.size, DrawSettings(mode="deferred"))
    written = write_tour(frames, scenes, route, tmp_path, film, lambda task, done: None)
    for renderer in renderers:
        renderer.release()
    frames = read_film(written[0])
    assert len(frames) == round(12 * route.seconds) and loaded == [(1, 2), (2, 3)]
    assert frames.max(-1).min() > 40, "no black"
    steps = np.abs(np.diff(frames, axis=0)).mean((1, 2, 3))
    change = np.abs(frames[0].mean((0, 1)) - frames[-1].mean((0, 1))).mean()
    assert change > 30 and steps.max() < 0.3 * change, "scenes of different colours fade"
    with Image.open(written[1]) as plan:
        assert max(plan.size) == 1024


@pytest.mark.gl
def test_the_command_writes_the_film_of_a_folder_of_panoramas(house, load_house, monkeypatch, tmp_path, capsys):
    rows = {p.image.name: p.cam2world.tolist() for p in house.panoramas}
    (house.folder / "poses.json").write_text(str({"convention": "cam2world opencv", "poses": rows}).replace("'", '"'))

    def predict(pair, **options):
        views = tuple(int(panorama.name[-1]) for panorama in pair.context)
        assert options["height"] == 128
        return load_house(TourScenes(house).make_entry(views)).scene

    monkeypatch.setattr("pansplat.pipeline.predict", predict)
    monkeypatch.setattr("pansplat.tours.connect", lambda tour, progress: replace(tour, overlaps=house.overlaps))
    arguments = ["--offscreen", str(tmp_path), "--size", "64x32", "--seconds", "0.5", "--renderer", "cpu"]
    assert run([str(house.folder), *arguments]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["floor_plan.png", "tour.mp4"]
    assert len(read_film(tmp_path / "tour.mp4")) == 12
    assert "tour.mp4" in capsys.readouterr().out
