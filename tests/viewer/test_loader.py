"""What a path offers, and loading it beside a living window."""

import threading
import time
from pathlib import Path

import pytest

from pansplat.errors import InputError
from pansplat.gaussians.ply import save_ply
from pansplat_viewer.loader import LoadedScene, LoadOptions, SceneEntry, SceneLoader, find_entries, load_entry


def wait_for(loader: SceneLoader) -> object:
    deadline = time.monotonic() + 10
    while (outcome := loader.poll()) is None:
        assert time.monotonic() < deadline, "nothing came"
        time.sleep(0.005)
    return outcome


def test_no_such_path_says_so(tmp_path):
    with pytest.raises(InputError, match=r"nowhere.*no such file or folder.*give"):
        find_entries(tmp_path / "nowhere", LoadOptions())


def test_a_file_that_is_no_scene_is_refused(tmp_path):
    file = tmp_path / "picture.jpg"
    file.write_bytes(b"x")
    with pytest.raises(InputError, match=r"picture\.jpg"):
        find_entries(file, LoadOptions())


def test_an_empty_folder_is_refused(tmp_path):
    with pytest.raises(InputError):
        find_entries(tmp_path, LoadOptions())


def test_a_damaged_scene_is_refused_when_loaded(tmp_path):
    file = tmp_path / "scene.ply"
    file.write_bytes(b"ply\nnot really")
    (entry,) = find_entries(file, LoadOptions())
    with pytest.raises(InputError, match=r"scene\.ply"):
        load_entry(entry, LoadOptions(), lambda what, done: None)


def test_a_folder_of_scenes_offers_each(tmp_path, small_scene):
    for name in ("b", "a"):
        save_ply(small_scene, tmp_path / f"{name}.ply")
    entries = find_entries(tmp_path, LoadOptions())
    assert [entry.name for entry in entries] == ["a", "b"]
    loaded = load_entry(entries[0], LoadOptions(), lambda what, done: None)
    assert len(loaded.scene.gaussians) == len(small_scene.gaussians)
    assert loaded.photos is None


@pytest.mark.shared
def test_a_folder_of_pairs_offers_each(shared):
    entries = find_entries(shared / "data" / "zind", LoadOptions())
    assert len(entries) >= 3 and all(entry.pair is not None for entry in entries)


@pytest.mark.parametrize(
    ("name", "folder"), [("a/b c", "a_b_c"), ("../x", "x"), ("...", "scene"), ("Küche 1", "Küche_1")]
)
def test_an_entrys_folder_name_is_one_safe_name(name, folder):
    assert SceneEntry(name).folder_name == folder


def test_loading_reports_progress_and_hands_over_the_result(small_scene):
    go, reported = threading.Event(), threading.Event()

    def load(entry, progress):
        progress("thinking", 0.25)
        reported.set()
        assert go.wait(10)
        return LoadedScene(entry, small_scene)

    loader = SceneLoader(load)
    assert loader.progress is None and loader.poll() is None
    loader.request(SceneEntry("kitchen"))
    assert reported.wait(10)
    assert loader.progress == ("kitchen", "thinking", 0.25) and loader.poll() is None
    go.set()
    assert wait_for(loader).scene is small_scene
    assert loader.progress is None and loader.poll() is None
    loader.close()


def test_a_failure_is_handed_over_instead_of_raised():
    def load(entry, progress):
        raise InputError(f"{entry.name} is damaged")

    loader = SceneLoader(load)
    loader.request(SceneEntry("kitchen"))
    assert str(wait_for(loader)) == "kitchen is damaged"
    loader.close()


def test_a_new_request_takes_the_place_of_the_one_under_way(small_scene):
    first_stopped = threading.Event()

    def load(entry, progress):
        if entry.name == "first":
            try:
                while True:
                    progress("working", 0.5)
                    time.sleep(0.001)
            finally:
                first_stopped.set()
        return LoadedScene(entry, small_scene)

    loader = SceneLoader(load)
    loader.request(SceneEntry("first"))
    loader.request(SceneEntry("second"))
    assert wait_for(loader).entry.name == "second"
    assert first_stopped.wait(10)
    loader.close()


def test_closing_stops_the_work_and_joins_its_thread():
    def load(entry, progress):
        while True:
            progress("working", 0.5)
            time.sleep(0.001)

    loader = SceneLoader(load)
    loader.request(SceneEntry("endless"))
    loader.close()
    assert not any(thread.name == "load endless" for thread in threading.enumerate())


def test_cached_predictions_are_asked_for_as_the_options_say(monkeypatch, small_scene):
    asked = {}

    class FakePair:
        name = "kitchen"

        def load_context(self, height: int) -> str:
            return f"photographs at {height}"

    def predict(pair, **options):
        asked.update(options)
        options["progress"]("predicting", 0.5)
        return small_scene

    monkeypatch.setattr("pansplat.pipeline.predict", predict)
    said = []
    entry = SceneEntry("kitchen", pair=FakePair())
    options = LoadOptions(model="sweep", height=256, cache=False)
    loaded = load_entry(entry, options, lambda what, done: said.append(what))
    assert (asked["model"], asked["height"], asked["cache"]) == ("sweep", 256, False)
    assert loaded.photos == "photographs at 1024" and said[0] == "predicting"
    assert load_entry(entry, options, lambda what, done: None, photos=False).photos is None


def test_home_is_expanded_by_the_command_not_by_the_library(tmp_path):
    with pytest.raises(InputError, match="no such"):
        find_entries(Path("~nobody-has-this-name"), LoadOptions())
