"""The states of a scene, without a window."""

from dataclasses import replace

import pytest

from pansplat_viewer.scene.life import SceneLife
from pansplat_viewer.scene.loader import LoadedScene, SceneEntry

ENTRY = SceneEntry("kitchen")


@pytest.fixture
def live(small_scene):
    """Returns a life after events: calls, or `show` and `final`, which receive the prediction and the refined scene."""
    scenes = {
        "show": LoadedScene(ENTRY, small_scene, is_final=False),
        "final": LoadedScene(ENTRY, replace(small_scene, near=0.5)),
    }

    def live(events: str) -> SceneLife:
        life = SceneLife(ENTRY)
        for event in events.split():
            if event in scenes:
                life.receive(scenes[event])
            elif event == "alone":
                life.receive(scenes["final"], keep_prediction=False)
            else:
                getattr(life, event)()
        return life

    return live


@pytest.mark.parametrize(
    ("events", "state", "near", "has_prediction"),
    [
        ("", "photograph", None, False),
        ("request", "predicting", None, False),
        ("request cancel", "photograph", None, False),
        ("request show", "refining", 0.45, False),
        ("request show final", "refined", 0.5, True),
        ("request show alone", "refined", 0.5, False),
        ("request show final revert", "predicted", 0.45, False),
        ("request final", "predicted", 0.5, False),
        ("request final revert cancel", "predicted", 0.5, False),
        ("request show cancel", "predicted", 0.45, False),
        ("request show cancel request", "refining", 0.45, False),
        ("request show final cancel", "refined", 0.5, True),
        ("request show fail", "failed", 0.45, False),
        ("request show fail request final", "refined", 0.5, True),
        ("request show final drop", "refined", None, False),
        ("request show final drop request", "predicting", None, False),
    ],
)
def test_the_state_after_events(live, events, state, near, has_prediction):
    life = live(events)
    assert (life.state, life.prediction is not None) == (state, has_prediction)
    assert (None if life.loaded is None else life.loaded.scene.near) == near
    assert life.is_known == (state in ("predicted", "refining", "refined"))
