"""The states of a scene, without a window."""

from dataclasses import replace

import pytest

from pansplat_viewer.core.loader import LoadedScene, SceneEntry
from pansplat_viewer.core.tracked_scene import TrackedScene

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
    tracked = TrackedScene(ENTRY)
    for event in events.split():
        if event in scenes:
            tracked.receive(scenes[event])
        else:
            getattr(tracked, event)()
    assert tracked.state == state
    assert (None if tracked.loaded is None else tracked.loaded.scene.near) == near
    assert tracked.is_known == (state in ("predicted", "refining", "refined"))
