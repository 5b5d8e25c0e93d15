"""Options of predictions: what the key of the cache is made of."""

from pathlib import Path

import pytest

from pansplat.prediction_options import PredictOptions

OTHERS = {
    "model": "sweep",
    "compat": "fixed",
    "precision": "bfloat16",
    "depth_network": Path("depth.onnx"),
    "height": 96,
    "refine_steps": 3,
    "gaussians": 9,
    "joint": True,
    "cache": False,
}
REFINED = "refine_steps", "gaussians", "joint"


@pytest.mark.parametrize("name", vars(PredictOptions()))
def test_an_option_is_in_the_key_unless_the_predictor_has_it(name: str) -> None:
    usual, other = PredictOptions(), PredictOptions().replace(**{name: OTHERS[name]})
    assert (usual.describe(refined=True) != other.describe(refined=True)) is (name in ("height", *REFINED))
    assert (usual.describe(refined=False) != other.describe(refined=False)) is (name == "height")
