"""The states of a scene, without a window."""

from dataclasses import replace

import pytest

from pansplat_viewer.scene.life import SceneLife
from pansplat_viewer.scene.loader import LoadedScene, SceneEntry
from pansplat_viewer.scene.slots import keep_largest

ENTRY = SceneEntry("kitchen")


@pytest.fixture
def prediction(small_scene) -> LoadedScene:
    return LoadedScene(ENTRY, small_scene, is_final=False)


@pytest.fixture
def refined(small_scene) -> LoadedScene:
    return LoadedScene(ENTRY, replace(small_scene, near=0.5))


@pytest.fixture
def refining(prediction) -> SceneLife:
    life = SceneLife(ENTRY)
    assert life.state == "photograph" and not life.is_known
    life.request()
    assert life.state == "predicting" and life.loaded is None and not life.is_known
    life.receive(prediction)
    assert life.state == "refining" and life.loaded is prediction and life.is_known
    return life


def test_a_refined_scene_is_kept_beside_its_prediction(refining, prediction, refined):
    refining.receive(refined)
    assert refining.state == "refined" and refining.loaded is refined and refining.prediction is prediction.scene
    refining.revert()
    assert refining.state == "predicted" and refining.loaded.scene is prediction.scene and refining.prediction is None


def test_a_prediction_need_not_be_kept_beside_the_refined_scene(refining, refined):
    refining.receive(refined, keep_prediction=False)
    assert refining.state == "refined" and refining.loaded is refined and refining.prediction is None


def test_a_scene_that_is_final_at_once_is_predicted_and_has_nothing_before_it(refined):
    life = SceneLife(ENTRY)
    life.request()
    life.receive(refined)
    assert life.state == "predicted" and life.loaded is refined and life.prediction is None
    life.revert()
    life.cancel()
    assert life.state == "predicted" and life.loaded is refined


def test_a_cancelled_prediction_leaves_photographs_and_a_cancelled_refinement_the_prediction(refining, prediction):
    refining.cancel()
    assert refining.state == "predicted" and refining.loaded is prediction
    refining.request()
    assert refining.state == "refining", "what is there is refined"
    life = SceneLife(ENTRY)
    life.request()
    life.cancel()
    assert life.state == "photograph"


@pytest.mark.parametrize("is_final", [False, True])
def test_a_refined_scene_is_not_cancelled(refining, refined, prediction, is_final):
    refining.receive(refined if is_final else prediction)
    refining.cancel()
    assert refining.state == ("refined" if is_final else "predicted")


def test_a_failed_refinement_keeps_the_prediction_and_a_new_request_makes_it_again(refining, prediction, refined):
    refining.fail()
    assert refining.state == "failed" and refining.loaded is prediction and not refining.is_known
    refining.request()
    refining.receive(refined)
    assert refining.state == "refined"


def test_what_was_dropped_from_memory_is_known_and_predicted_again(refining, refined):
    refining.receive(refined)
    assert refining.drop() is refined
    assert refining.loaded is None and refining.prediction is None and refining.is_known
    refining.request()
    assert refining.state == "predicting"


def test_a_scene_that_is_too_large_is_reduced_to_a_life_of_its_own(refining, small_scene):
    refining.exhaust()
    refining.exhaust()
    assert refining.state == "too large" and refining.reduced == len(small_scene.gaussians) // 4
    reduced = refining.reduce(keep_largest)
    assert reduced.state == "predicted" and len(reduced.loaded.scene.gaussians) == refining.reduced
    assert reduced.entry is ENTRY and len(refining.loaded.scene.gaussians) == len(small_scene.gaussians)


def test_the_message_of_a_scene_that_is_too_large_is_dismissed(refining):
    refining.exhaust()
    refining.cancel()
    assert refining.state == "too large"
    refining.dismiss()
    refining.dismiss()
    assert refining.state == "refining"
