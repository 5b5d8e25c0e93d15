"""Conversion of scenes in a worker thread; tests/viewer/test_viewer.py has that of a scene that is shown."""

import threading

import pytest

from pansplat_viewer.draw import rendered_scene
from pansplat_viewer.draw.rendered_scene import ScenePreparer


@pytest.fixture(autouse=True)
def all_scenes_are_large(monkeypatch):
    monkeypatch.setattr(rendered_scene, "_SMALL_SCENE", 0)


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
