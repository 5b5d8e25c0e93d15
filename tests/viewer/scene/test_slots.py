"""Conversion of scenes in a worker thread."""

import threading

import pytest

from pansplat_viewer.scene import slots
from pansplat_viewer.scene.slots import ScenePreparer


@pytest.fixture(autouse=True)
def all_scenes_are_large(monkeypatch):
    monkeypatch.setattr(slots, "_SMALL_SCENE", 0)


def test_a_scene_is_converted_once_and_its_progress_is_reported(random_scene, wait_until):
    go, reported = threading.Event(), threading.Event()

    def prepare(scene, report):
        report(0.5)
        reported.set()
        assert go.wait(300)
        return len(scene.gaussians)

    preparer, scene = ScenePreparer(prepare), random_scene(20)
    assert not preparer.is_ready(scene) and reported.wait(300)
    assert preparer.progress == 0.5 and not preparer.is_ready(scene)
    go.set()
    wait_until(lambda: preparer.is_ready(scene), "conversion")
    assert preparer.progress is None and preparer.take(scene) == 20
    assert preparer.take(scene) is None, "not kept"
    preparer.close()


def test_another_scene_ends_the_conversion_and_errors_are_raised_when_it_is_taken(random_scene, wait_until):
    started, ended = threading.Event(), threading.Event()

    def prepare(scene, report):
        if len(scene.gaussians) == 10:
            raise MemoryError("too many")
        started.set()
        try:
            while True:
                report(0.1)
        finally:
            ended.set()

    preparer, scene = ScenePreparer(prepare), random_scene(10)
    assert not preparer.is_ready(random_scene(20)) and started.wait(300)
    preparer.is_ready(scene)
    assert ended.wait(300)
    wait_until(lambda: preparer.is_ready(scene), "end")
    with pytest.raises(MemoryError):
        preparer.take(scene)
    preparer.close()


def test_small_scenes_are_not_converted_in_a_thread(random_scene, monkeypatch):
    monkeypatch.setattr(slots, "_SMALL_SCENE", 20)
    preparer = ScenePreparer(lambda scene, report: 1)
    assert preparer.is_ready(random_scene(20)) and preparer.take(random_scene(20)) is None
    preparer.close()
