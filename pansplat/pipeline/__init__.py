"""The calls of users, which are also attributes of `pansplat`, and those that only commands and the window need.

`models` loads predictors, `calls` predicts the scene of any source: `prediction` that of a set of panoramas, `tours`
that of a tour; `drawing` makes images.
"""
# ruff: noqa: F401  # names for other packages

from pansplat.gaussians.formats import load_scene as load
from pansplat.gaussians.formats import save_scene as save
from pansplat.pipeline.calls import predict, predict_to_file
from pansplat.pipeline.drawing import Drawing, make_renderer, render
from pansplat.pipeline.models import can_stream, load_model, load_predictor
from pansplat.pipeline.prediction import (
    fuse,
    load_photographs,
    load_sets,
    refine,
    run_refinement,
)
from pansplat.pipeline.tours import choose_predictor, find_max_views, fit_to_scene, warn_of_single_views
