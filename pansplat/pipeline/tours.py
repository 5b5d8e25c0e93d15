"""The scene of a whole tour, and the options of its parts."""

from __future__ import annotations

import itertools
import math
import warnings
from dataclasses import replace

import torch

from pansplat.errors import InputWarning
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.inputs.panorama_sets import PanoramaSet
from pansplat.pipeline.models import can_stream, find_min_views, load_model
from pansplat.pipeline.prediction import choose_refine_steps, fuse, make_task, predict_set, refine_scene
from pansplat.prediction_options import PredictOptions
from pansplat.predictor import Predictor
from pansplat.refinement import fuse_views
from pansplat.system.options import MIN_HEIGHT
from pansplat.system.progress import stage
from pansplat.tours.graph import TourGraph
from pansplat.tours.merge import merge_scenes, select_views
from pansplat.tours.scene_views import MAX_SCENE_VIEWS, choose_scene_views, choose_sources

_TOUR_HEIGHT = 512  # largest default height of the panoramas of a tour, which has many scenes
_GAUSSIANS_PER_SQUARE = 0.75  # Gaussians of a panorama over the square of its rows; about those of the default model
_MAX_MERGED = 4  # Gaussians that become one on average


def predict_tour(tour: TourGraph, predictor: Predictor, options: PredictOptions) -> Scene:
    """The scene of all panoramas of a tour; see `pansplat.predict`."""
    is_network = can_stream(predictor)
    if is_network and options.refine_steps is None:
        options = replace(options, refine_steps=0)
    options = replace(options, joint=options.joint and not is_network)
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
            return predict_set(make_task(pair, choose_predictor(pair, predictor), fitted))

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
