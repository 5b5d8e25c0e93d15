"""The scene of a whole tour, and the options of its parts."""

from __future__ import annotations

import itertools
import math
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from pansplat.errors import InputError, InputWarning
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.inputs.panorama_sets import PanoramaSet
from pansplat.pipeline.models import find_min_views, load_model
from pansplat.pipeline.prediction import choose_options, choose_refine_steps, fuse, load_sets, predict, refine_scene
from pansplat.prediction_options import PredictOptions, choose_caches
from pansplat.predictor import Predictor
from pansplat.refinement import fuse_views
from pansplat.system.console import with_progress_bar
from pansplat.system.devices import with_device
from pansplat.system.options import MIN_HEIGHT
from pansplat.system.progress import CONNECTED, POSED, stage
from pansplat.tours.graph import TourGraph, find_tours
from pansplat.tours.merge import merge_scenes, select_views
from pansplat.tours.overlap import connect
from pansplat.tours.scene_views import MAX_SCENE_VIEWS, choose_scene_views, choose_sources

_TOUR_HEIGHT = 512  # largest default height of the panoramas of a tour, which has many scenes
_GAUSSIANS_PER_SQUARE = 0.75  # Gaussians of a panorama over the square of its rows; about those of the default model
_MAX_MERGED = 4  # Gaussians that become one on average


@with_device
@with_progress_bar
def predict_tour(
    tour: TourGraph | str | Path,
    model: str | Path | Predictor | None = None,
    *,
    options: PredictOptions | None = None,
    **keywords: Any,
) -> Scene:
    """Predict one scene of all panoramas of a tour: the scenes of its parts, merged.

    `default` and `sweep` predict a part at once; networks predict scenes of two or three panoramas. Single views are
    predicted by `default`, with a warning, if the model needs two or more views.

    Args:
        tour: of `pansplat.tours.overlap.connect`, or the path of a folder that holds the panoramas of one tour.
        model, options, compat, precision, depth_network, refine_steps, cache: see `predict`.
        height: panoramas are resized to (height, 2 height); by default that of the photographs, at most 512.
        gaussians: number that the scene is needed in, such as that of a web page. Each panorama has an equal part after
            a refinement; without one the scene may have more.
        joint: see `predict`; the refinement is then that of each part of the tour as a whole, and not cached.
    """
    predictor, options = choose_options(model, options, keywords)
    if isinstance(tour, (str, Path)):
        with choose_caches(options):
            tour = _load_only_tour(tour)
    warn_of_single_views(tour, predictor)
    max_views, is_refined = find_max_views(predictor), options.joint and options.refine_steps != 0
    total = len(choose_sources(tour, max_views))
    part = math.inf if options.gaussians is None else options.gaussians / len(tour)  # limit of Gaussians of a panorama
    counter = itertools.count(1)
    each = replace(options, joint=False, refine_steps=0) if options.joint else options

    def predict_scene(views: tuple[int, ...]) -> Scene:
        number, pair = next(counter), tour.make_set(views)
        fitted = fit_to_scene(each, pair, part)
        with stage(number / total, f"scene {number} of {total}: "):
            return predict(pair, choose_predictor(pair, predictor), options=fitted)

    with stage(0.5 if is_refined else 1.0):
        scene = merge_scenes(tour, predict_scene, max_views)
    if not options.joint:
        return scene
    return _fuse_tour(tour, scene, options.refine_steps)


def _fuse_tour(tour: TourGraph, scene: Scene, refine_steps: int | None) -> Scene:
    """The scene of a whole tour with each surface once, fitted to all photographs of each part, or only its colours."""
    fused: list[Gaussians] = []
    gains = [(1.0, 1.0, 1.0)] * len(tour)
    parts = tour.list_parts()
    for number, nodes in enumerate(parts, 1):
        part = select_views(scene, nodes)
        if len(nodes) > 1:
            pair = tour.make_set(nodes)
            views = replace(pair.load_context(scene.height), cam2world=part.cam2world, frame=part.frame)
            steps = choose_refine_steps(len(nodes), joint=True) if refine_steps is None else refine_steps
            if steps:
                with stage(number / len(parts)):
                    part, _ = refine_scene(fuse_views(part), views, steps=steps)
            else:
                part = fuse(part, views)
        for view, node in enumerate(nodes):
            gains[node] = part.gains[view] if part.gains else gains[node]
        fused.append(replace(part.gaussians, views=torch.tensor(nodes)[part.gaussians.views.long()]))
    return replace(scene, gaussians=Gaussians.cat(fused), gains=tuple(gains), joint=True)


def choose_predictor(pair: PanoramaSet, predictor: Predictor) -> Predictor:
    """The predictor of a scene of a tour: `default` for a single view if the given one needs two or more views."""
    return predictor if len(pair.context) >= find_min_views(predictor) else load_model()


def warn_of_single_views(tour: TourGraph, predictor: Predictor) -> None:
    """Warn if `choose_predictor` replaces the predictor in some scenes of a tour."""
    count = sum(len(views) == 1 for views in set(choose_scene_views(tour).values()))
    if count and find_min_views(predictor) > 1:
        warnings.warn(
            f"{tour.name}: {count} single view{'s are' if count > 1 else ' is'} predicted by default, because "
            f"{predictor.name} needs {find_min_views(predictor)} or more panoramas of one room.",
            InputWarning,
            stacklevel=3,
        )


def find_max_views(predictor: Predictor) -> int:
    """The number of views, at most, that a predictor is given of a tour at once."""
    return getattr(predictor, "max_views", MAX_SCENE_VIEWS)


def fit_to_scene(options: PredictOptions, pair: PanoramaSet, gaussians: float = math.inf) -> PredictOptions:
    """The options of a scene of a tour, from those of the tour.

    The height, by default that of the photographs, at most 512, is halved while the prediction has more than four times
    as many Gaussians as are kept: a refinement after a few mergers fits the photographs better than after many.

    Args:
        pair: of `TourGraph.make_set`.
        gaussians: number that is kept of each panorama.
    """
    height = options.height
    if height is None:
        height = max(MIN_HEIGHT, min(pair.image_height, _TOUR_HEIGHT))
        while height >= 2 * MIN_HEIGHT and _GAUSSIANS_PER_SQUARE * height**2 > _MAX_MERGED * gaussians:
            height //= 2
    count = None if math.isinf(gaussians) else max(int(gaussians * len(pair.context)), 1)
    return replace(options, height=height, gaussians=count)


def _load_only_tour(path: str | Path) -> TourGraph:
    with stage(POSED):
        tours = find_tours(load_sets(path))
    if len(tours) != 1:
        names = f" ({', '.join(tour.name for tour in tours[:8])}{', ...' if len(tours) > 8 else ''})" if tours else ""
        advice = "give its folder" if tours else "predict one pair: predict(load_sets(path)[0])"
        raise InputError(f"{path}: needed the panoramas of one tour, got {len(tours)} tours{names}; {advice}")
    with stage(CONNECTED):
        return connect(tours[0])
