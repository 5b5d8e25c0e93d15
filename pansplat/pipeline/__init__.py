"""The calls of users, which are also attributes of `pansplat`, and those that only commands and the window need.

`models` loads predictors, `prediction` makes and refines the scene of a pair, `tours` that of a tour, `drawing` images.
"""
# ruff: noqa: F401  # names for other packages

from pansplat.gaussians.formats import load_scene as load
from pansplat.gaussians.formats import save_scene as save
from pansplat.pipeline.drawing import Drawing, make_renderer, render
from pansplat.pipeline.models import can_stream, load_model, load_predictor
from pansplat.pipeline.prediction import (
    fuse,
    load_photographs,
    load_sets,
    predict,
    predict_to_file,
    refine,
    run_refinement,
)
from pansplat.pipeline.tours import choose_predictor, find_max_views, fit_to_scene, predict_tour, warn_of_single_views
