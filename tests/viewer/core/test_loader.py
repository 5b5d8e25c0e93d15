"""Session at a path are found, and loaded in a worker thread."""

import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from refusals import expect_error

from pansplat.errors import InputWarning
from pansplat.gaussians.ply import save_ply
from pansplat.gaussians.scene import SceneTour
from pansplat.geometry.world import WorldFrame
from pansplat.prediction_options import PredictOptions, ReadOptions
from pansplat.system.progress import report_progress
from pansplat_viewer.core.loader import SceneEntry, find_entries, list_panoramas_of_folder, load_entry
from pansplat_viewer.core.settings import DrawSettings
from pansplat_viewer.core.state import fit_settings
from pansplat_viewer.core.tour_scenes import TourScenes


def test_paths_without_scenes_are_refused(tmp_path):
    (tmp_path / "image.jpg").write_bytes(b"x")
    (tmp_path / "empty").mkdir()
    for path, message in (
        (tmp_path / "nowhere", r"nowhere.*no such file or folder.*give"),
        (tmp_path / "image.jpg", r"image\.jpg"),
        (tmp_path / "empty", "empty"),
        (Path("~nobody-has-this-name"), "no such"),
    ):
        expect_error(message, find_entries, path, ReadOptions(), PredictOptions())
    (tmp_path / "scene.ply").write_bytes(b"ply\nnot really")
    (entry,) = find_entries(tmp_path / "scene.ply", ReadOptions(), PredictOptions())
    expect_error(r"scene\.ply", lambda: load_entry(entry, PredictOptions()))


def test_a_folder_of_scenes_has_an_entry_for_each(tmp_path, small_scene):
    for name in ("b", "a"):
        save_ply(small_scene, tmp_path / f"{name}.ply")
    entries = find_entries(tmp_path, ReadOptions(), PredictOptions())
    assert [entry.name for entry in entries] == ["a", "b"]
    loaded = load_entry(entries[0], PredictOptions())
    assert len(loaded.scene.gaussians) == len(small_scene.gaussians)
    assert [entry.notes for entry in entries] == [(), ()]
    (tmp_path / "hall.jpg").write_bytes(b"half a photograph")
    with pytest.warns(InputWarning, match=r"the photographs are left out: .*hall\.jpg"):
        entries = find_entries(tmp_path, ReadOptions(), PredictOptions())
    assert [entry.name for entry in entries] == ["a", "b"] and all("hall.jpg" in entry.notes[0] for entry in entries)


def test_a_file_with_the_graph_of_a_tour_is_a_tour_of_its_parts(house, house_file):
    (entry,) = find_entries(house_file, ReadOptions(), PredictOptions())
    first = load_entry(entry, PredictOptions())
    tour, scenes = first.entry.tour, TourScenes.start(first)
    assert tour.name == "home" and tour.overlaps == house.overlaps and first.is_final
    assert np.allclose(tour.positions, house.positions) and first.entry.views == (0, 1)
    assert first.entry.panoramas == ()
    assert set(first.facts.outlines) <= {0, 1, 2, 3} and scenes.edge == (0, 1) and not scenes.list_next(None, 0.0)[1:]
    other = scenes.get((2, 3))
    assert other.entry.views == (2, 3) and scenes.loaded == [(0, 1), (1, 2), (2, 3)]
    assert other.scene.gaussians.views.unique().tolist() == [0, 1]
    assert np.allclose(other.scene.cam2world, house.cam2world[2:])


def test_photographs_are_placed_by_camera_heights_in_the_unit_of_their_files(house):
    tour = replace(house, panoramas=tuple(view.in_frame(WorldFrame(1000.0)) for view in house.panoramas))
    views = list_panoramas_of_folder([SceneEntry("house", tour=tour)], house.folder)
    assert {view.camera_height for view in views} == {1500.0}
    assert [view.cam2world.tolist() for view in views] == [view.cam2world.tolist() for view in house.panoramas]


def test_warnings_about_the_input_are_notes_of_its_entries(monkeypatch, house):
    def load_sets(path, **options):
        warnings.warn("b.jpg: no pose was found", InputWarning, stacklevel=2)
        return [house.make_set((0, 1))]

    monkeypatch.setattr("pansplat.pipeline.load_sets", load_sets)
    with pytest.warns(InputWarning, match="no pose was found"):
        (entry,) = find_entries(house.folder, ReadOptions(), PredictOptions())
    assert entry.notes == ("b.jpg: no pose was found",)


def test_a_tour_of_parts_begins_with_the_scene_of_one_view_where_its_walk_does(monkeypatch, parted_house, load_house):
    alone = parted_house.panoramas[3]
    tour = replace(parted_house, panoramas=(alone, *parted_house.panoramas[:3]), originals=())
    tour = replace(tour, overlaps={(0, 0): 1.0, (1, 2): 0.4, (2, 3): 0.4})
    monkeypatch.setattr("pansplat.tours.overlap.connect", lambda tour: tour)
    scene = load_house(TourScenes(tour).make_entry((0,))).scene
    monkeypatch.setattr("pansplat.pipeline.predict", lambda pair, model, **options: scene)
    single = replace(tour, panoramas=(alone,), overlaps={(0, 0): 1.0})
    for each in (tour, single):
        loaded = load_entry(SceneEntry("house", tour=each), PredictOptions())
        assert loaded.entry.views == (0,) and loaded.entry.tour is each and loaded.scene is scene


def test_the_first_scene_is_where_the_photographs_are_and_the_rest_of_its_part_follows(monkeypatch, house, load_house):
    # The walk of the graph that is not connected starts at 0; that of the connected one at 3.
    connected = replace(house, overlaps={(0, 1): 0.13, (1, 2): 0.4, (2, 3): 0.4, (0, 2): 0.4})
    monkeypatch.setattr("pansplat.tours.overlap.connect", lambda tour: connected)
    asked = []

    def predict(pair, model, *, options, on_predicted):
        views = tuple(int(view.name[-1]) for view in pair.context)
        asked.append((views, options.refine_steps, on_predicted is not None))
        return load_house(TourScenes(house).make_entry(views)).scene

    monkeypatch.setattr("pansplat.pipeline.predict", predict)
    first = load_entry(SceneEntry("house", tour=house), PredictOptions(), lambda loaded: None)
    assert first.entry.start == 0 and 0 in first.entry.views and first.entry.tour is connected
    scenes = TourScenes.start(first)
    request = scenes.choose_request(scenes.list_next(None, 0.0), SceneEntry("house", tour=house))
    assert request.views == (0, 1, 2, 3)
    part = load_entry(request, PredictOptions(), lambda loaded: None)
    assert asked[0] == ((0, 1, 2), 0, False), "the first scene is not refined"
    assert asked[1] == ((0, 1, 2, 3), None, True)
    assert part.entry.views == request.views and set(part.facts.outlines) <= set(request.views)


@pytest.mark.shared
def test_a_folder_of_pairs_has_an_entry_for_each(shared):
    entries = find_entries(shared / "data" / "zind", ReadOptions(), PredictOptions())
    assert entries[0].tour is not None and len(entries[0].tour) == 13, "the tour of all panoramas is the first"
    assert len(entries) >= 4 and all(entry.pair is not None for entry in entries[1:])


def test_panoramas_are_shown_before_their_poses_are_estimated_but_not_if_these_are_cached(tmp_path, monkeypatch):
    shown, estimates = [], []
    for name in ("kitchen", "hall"):
        Image.fromarray(np.full((16, 32, 3), 100, np.uint8)).save(tmp_path / f"{name}.png")

    def estimate(folder, panoramas, *_):
        estimates.append([len(entries) for entries in shown])
        unplaced = {panorama.name: "bare walls" for panorama in panoramas}
        return {"worlds": [], "poses": {}, "estimate": {"unplaced": unplaced}, "unreadable": []}

    monkeypatch.setattr("pansplat.poses.files._estimate", estimate)
    for _ in range(2):
        with pytest.warns(InputWarning, match="bare walls"):
            entries = find_entries(tmp_path, ReadOptions(), PredictOptions(), shown.append)
    (early,), (entry, *_) = shown[0], entries
    assert estimates == [[1]] and len(shown) == 1
    assert [view.name for view in early.tour.panoramas] == [view.name for view in entry.tour.panoramas]
    assert len(set(early.tour.parts)) == 2


def test_a_prediction_has_the_options_and_is_shown_before_the_refined_scene(monkeypatch, small_scene):
    options = PredictOptions("sweep", height=256, cache=False, refine_steps=3)

    def predict(pair, **arguments):
        assert arguments["options"] is options
        report_progress("predicting", 0.5)
        arguments["on_predicted"](small_scene)
        return small_scene

    monkeypatch.setattr("pansplat.pipeline.predict", predict)
    shown = []
    entry = SceneEntry("kitchen", pair=SimpleNamespace(name="kitchen"))
    final = load_entry(entry, options, shown.append)
    assert [loaded.is_final for loaded in (*shown, final)] == [False, True]


def test_a_fused_tour_is_one_scene_that_is_drawn_jointly(tmp_path, small_scene):
    count = len(small_scene.cam2world)
    edges = tuple((view, view + 1, 0.5) for view in range(count - 1))
    for joint in (False, True):
        save_ply(replace(small_scene, tour=SceneTour(edges), joint=joint), tmp_path / "tour.ply")
        (entry,) = find_entries(tmp_path / "tour.ply", ReadOptions(), PredictOptions())
        loaded = load_entry(entry, PredictOptions())
        assert (loaded.entry.tour is None) == joint
        assert fit_settings(DrawSettings(mode="deferred"), loaded.scene).mode == ("joint" if joint else "deferred")
