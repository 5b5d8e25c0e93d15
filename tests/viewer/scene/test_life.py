"""The states of a scene, without a window."""

from dataclasses import replace

import pytest

from pansplat_viewer.scene.life import SceneLife
from pansplat_viewer.scene.loader import LoadedScene, SceneEntry

ENTRY = SceneEntry("kitchen")


@pytest.mark.parametrize(
    ("events", "state", "near"),
    [
        ("", "photograph", None),
        ("request", "predicting", None),
        ("request cancel", "photograph", None),
        ("request show", "refining", 0.45),
        ("request show final", "refined", 0.5),
        ("request final", "predicted", 0.5),
        ("request show cancel", "predicted", 0.45),
        ("request show cancel request", "refining", 0.45),
        ("request show final cancel", "refined", 0.5),
        ("request show fail", "failed", 0.45),
        ("request show fail request final", "refined", 0.5),
        ("request show final drop", "refined", None),
        ("request show final drop request", "predicting", None),
    ],
)
def test_the_state_after_events(small_scene, events, state, near):
    """Events are calls, or `show` and `final`, which receive the prediction and the refined scene."""
    scenes = {
        "show": LoadedScene(ENTRY, small_scene, is_final=False),
        "final": LoadedScene(ENTRY, replace(small_scene, near=0.5)),
    }
    life = SceneLife(ENTRY)
    for event in events.split():
        if event in scenes:
            life.receive(scenes[event])
        else:
            getattr(life, event)()
    assert life.state == state
    assert (None if life.loaded is None else life.loaded.scene.near) == near
    assert life.is_known == (state in ("predicted", "refining", "refined"))
