"""The public functions: load pairs and predictors, predict, render, save and load scenes.

Every name in `__all__` is also an attribute of `pansplat`.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.cache import CachedPrediction, CachedScene
from pansplat.errors import InputError, InputWarning
from pansplat.gaussians.formats import load_scene as load
from pansplat.gaussians.formats import save_scene as save
from pansplat.gaussians.ply import save_ply_parts
from pansplat.gaussians.scene import Gaussians, Scene, empty_gaussians, prune
from pansplat.geometry.pose import blend_weights
from pansplat.inputs import folders
from pansplat.inputs.pairs import Pair
from pansplat.inputs.views import ONE_POSITION, Views
from pansplat.model.weights import WEIGHTS_SUFFIXES, read_model_name
from pansplat.poses.estimate import estimate_poses
from pansplat.poses.files import estimate_pairs
from pansplat.prediction_options import CompatChoice, Precision, PredictOptions, choose_caches
from pansplat.predictor import Predictor
from pansplat.refinement import (
    DISPLAY_HEIGHT,
    RefineConfig,
    Refinement,
    RefineReport,
    fuse_views,
)
from pansplat.rendering import Rendering, rasterize
from pansplat.rendering import blend as blend_renderings
from pansplat.rendering.color_fit import fit_colors
from pansplat.rendering.gains import equalize_gaussians, equalize_images, measure_gains
from pansplat.rendering.official import rasterize_official
from pansplat.system.console import with_progress_bar
from pansplat.system.devices import choose_device, note_full_card, with_device
from pansplat.system.files import expand_home, find_scene_suffix
from pansplat.system.options import CAMERA_HEIGHT, MIN_HEIGHT
from pansplat.system.progress import CONNECTED, POSED, report_progress, stage
from pansplat.tours.graph import (
    MAX_SCENE_VIEWS,
    TourGraph,
    find_tours,
    list_starts,
    make_graph,
    merge_scenes,
    select_views,
)
from pansplat.tours.overlap import connect

__all__ = [
    "estimate_poses",
    "fuse",
    "load",
    "load_model",
    "load_pairs",
    "predict",
    "predict_to_file",
    "predict_tour",
    "refine",
    "render",
    "save",
]

Drawing = Literal["exact", "original"]

_DEFAULT_HEIGHT = 512  # rows of the panoramas that networks predict from; larger ones take minutes
_MAX_CACHED_HEIGHT = 512  # rows of a network's prediction that is cached; taller ones are written tile by tile
_TOUR_HEIGHT = 512  # largest default height of the panoramas of a tour, which has many scenes
_GAUSSIANS_PER_SQUARE = 0.75  # Gaussians of a panorama over the square of its rows; about those of the default model
_MAX_COLOR = 1.5  # largest value of images in [0, 1], which filters may exceed; images of 8 bits have larger ones
_PIXEL_SECONDS = 2e-7  # time of a pixel of an image of a pair's scene, on two cores (docs/bench_raster.md)
_REFINE_STEPS = 40  # steps that take about 10 s of a pair on two cores; more change little
_JOINT_STEPS, _MIN_STEPS = 80, 8  # steps of joint drawing, about 20 s; least for each photograph (docs/refinement.md)
_STEP_SECONDS = 0.25  # time of a step on two cores
_MAX_MERGED = 4  # Gaussians that become one on average


@with_device
@with_progress_bar
def load_pairs(
    path: Path | str,
    *,
    convention: str | None = None,
    near: float | None = None,
    far: float | None = None,
    camera_height: float = CAMERA_HEIGHT,
    on_unposed: Callable[[list[Pair]], None] | None = None,
) -> list[Pair]:
    """The pairs at a path, those with targets first. Image files are read when a pair is loaded.

    The poses of a folder that holds panoramas only are estimated (docs/poses.md), with a warning, and cached. A
    panorama without a pose is a pair of a single view; poses of equal `Panorama.world` have a common world.

    Args:
        path: a panorama, a pair folder, a folder of many panoramas, a web tour, or a folder of pair folders, in one of
            the formats of docs/input.md. Also one of their files with poses, or the file that describes a tour.
        convention: pose convention, such as "world2cam opengl"; overrides that of the files.
        near, far: radial depth range in metres; overrides that of the files.
        camera_height: of the cameras over the floor, metres; the scale of estimated poses and of single views.
        on_unposed: called before poses are estimated, if none are cached, with a pair of a single view for each
            panorama.
    """
    if not 0 < camera_height < math.inf:
        raise InputError(f"`camera_height` must be a positive number of metres, got {camera_height}")
    collections = folders.load_collections(path, convention=convention)
    if collections[0].needs_poses:
        folder, panoramas = collections[0].folder, collections[0].unposed
        options = {"near": near, "far": far, "camera_height": camera_height}
        return estimate_pairs(folder, panoramas, **options, on_unposed=on_unposed)
    return folders.make_pairs(collections, near, far, camera_height)


@with_device
def load_model(
    name: str | Path = "default",
    *,
    compat: CompatChoice = "trained",
    precision: Precision = "float32",
    depth_network: str | Path | None = None,
    **options: Any,
) -> Predictor:
    """Load a predictor.

    Args:
        name: "default", the trained model of the package; "sweep", without weights; or a file of weights: a
            .safetensors file from `pansplat convert` or from training, or an official checkpoint (.ckpt).
        compat: for networks: "official" reproduces the official code with its defects; "fixed" corrects them;
            "trained" is the mode of the training, which is "official" for official weights.
        precision: for networks: number type of the convolutions; docs/bench_model.md shows time against error.
        depth_network: for "default" and files of depth networks: an ONNX file of relative depth, whose edges the
            surfaces have (docs/depth_network.md).
        **options: of "sweep", the arguments of `pansplat.sweep.Sweep`; of the weights of a network, those of
            `pansplat.model.network.load_predictor`; others have none.
        device: see `predict`.
    """
    if compat not in get_args(CompatChoice):
        raise InputError(f"`compat` must be one of {', '.join(get_args(CompatChoice))}, got {compat!r}")
    of_networks = [*(["compat"] if compat != "trained" else []), *(["precision"] if precision != "float32" else [])]
    if str(name) in _MODELS:
        _refuse_options(name, of_networks if str(name) == "sweep" else [*of_networks, *options])
        if depth_network is not None:
            return _load_guided(name, None, depth_network)
        return _MODELS[str(name)](**options)
    if Path(name).suffix.lower() not in WEIGHTS_SUFFIXES:
        raise InputError(
            f"`model` must be one of {', '.join(sorted(_MODELS))}, or a file of weights "
            f"({', '.join(WEIGHTS_SUFFIXES)}), got {str(name)!r}"
        )
    path = expand_home(name)
    if read_model_name(path) == "depth" or depth_network is not None:
        _refuse_options(name, [*of_networks, *options])
        return _load_guided(name, path, depth_network)
    from pansplat.model.network import load_predictor

    return load_predictor(path, compat, precision=precision, **options)


def _load_guided(name: str | Path, path: Path | None, depth_network: str | Path | None) -> Predictor:
    """The guided sweep of a file of weights of a depth network, by default the shipped one.

    Raises:
        InputError: a depth network is given for another predictor.
    """
    from pansplat.sweep.guided_sweep import default_weights, load_guided_sweep

    if str(name) == "sweep" or (path is not None and read_model_name(path) != "depth"):
        raise InputError(f"`depth_network` is for the model default, got the model {name}; leave one of them out")
    if path is None:
        return load_guided_sweep(default_weights(), depth_network=depth_network)
    return load_guided_sweep(path, path.stem, depth_network)


def _refuse_options(name: str | Path, options: Sequence[str]) -> None:
    if options:
        raise InputError(f"`{options[0]}` is for networks, and {name} is not one; leave it out")


def load_predictor(options: PredictOptions) -> Predictor:
    """The predictor of options; an InputError if there is none of that name or file, or it lacks the options."""
    return load_model(
        options.model, compat=options.compat, precision=options.precision, depth_network=options.depth_network
    )


def _load_default() -> Predictor:
    from pansplat.sweep.guided_sweep import load_default_sweep

    return load_default_sweep()


def _load_sweep(**options: Any) -> Predictor:
    from pansplat.sweep import Sweep

    return Sweep(**options)


_MODELS: dict[str, Callable[..., Predictor]] = {"default": _load_default, "sweep": _load_sweep}


def choose_predictor(pair: Pair, predictor: Predictor) -> Predictor:
    """The predictor of a scene of a tour: `default` for a single view if the given one needs two or more views."""
    return predictor if len(pair.context) >= _find_min_views(predictor) else load_model()


def warn_of_single_views(tour: TourGraph, predictor: Predictor) -> None:
    """Warn if `choose_predictor` replaces the predictor in some scenes of a tour."""
    count = sum(len(views) == 1 for views in set(tour.choose_scene_views().values()))
    if count and _find_min_views(predictor) > 1:
        warnings.warn(
            f"{tour.name}: {count} single view{'s are' if count > 1 else ' is'} predicted by default, because "
            f"{predictor.name} needs {_find_min_views(predictor)} or more panoramas of one room.",
            InputWarning,
            stacklevel=3,
        )


def find_max_views(predictor: Predictor) -> int:
    """The number of views, at most, that a predictor is given of a tour at once."""
    return getattr(predictor, "max_views", MAX_SCENE_VIEWS)


def _find_min_views(predictor: Predictor) -> int:
    return getattr(predictor, "min_views", 1)


def _require_views(source: Pair | Views, predictor: Predictor) -> None:
    """Raise an InputError for fewer panoramas than the predictor needs, before they are read."""
    count = len(source.context) if isinstance(source, Pair) else len(source.images)
    if count < _find_min_views(predictor):
        names = [str(view.image) for view in source.context] if isinstance(source, Pair) else source.names
        raise InputError(
            f"{', '.join(names) or 'the input'}: {predictor.name} needed {_find_min_views(predictor)} or more "
            f"panoramas of one room, got {count}; choose the model default, which accepts a single one, or add one."
        )


def choose_height(pair: Pair, predictor: Predictor) -> int:
    """The height to predict a pair at: that of its photographs, at most the largest default of the predictor."""
    return max(MIN_HEIGHT, min(pair.image_height, getattr(predictor, "default_height", _DEFAULT_HEIGHT)))


def fit_to_scene(options: PredictOptions, pair: Pair, gaussians: float = math.inf) -> PredictOptions:
    """The options of a scene of a tour, from those of the tour.

    The height, by default that of the photographs, at most 512, is halved while the prediction has more than four times
    as many Gaussians as are kept: a refinement after a few mergers fits the photographs better than after many.

    Args:
        pair: of `TourGraph.make_pair`.
        gaussians: number that is kept of each panorama.
    """
    height = options.height
    if height is None:
        height = max(MIN_HEIGHT, min(pair.image_height, _TOUR_HEIGHT))
        while height >= 2 * MIN_HEIGHT and _GAUSSIANS_PER_SQUARE * height**2 > _MAX_MERGED * gaussians:
            height //= 2
    count = None if math.isinf(gaussians) else max(int(gaussians * len(pair.context)), 1)
    return replace(options, height=height, gaussians=count)


def choose_refine_steps(views: int, *, joint: bool = False) -> int:
    """Default number of steps of a refinement, of a scene for joint drawing or for deferred blending.

    A step compares each view with a photograph, in joint drawing all views together with one. Few large steps leave a
    scene of many views worse than before.
    """
    return max(_JOINT_STEPS, _MIN_STEPS * views) if joint else _REFINE_STEPS


def load_photographs(pair: Pair, height: int) -> Views:
    """The context panoramas for the refinement of a scene of a height: with twice its rows, at most `DISPLAY_HEIGHT`.

    Those of the prediction do not show detail, and the gaps between Gaussians, that larger pictures show.
    """
    return pair.load_context(max(height, min(2 * height, DISPLAY_HEIGHT, pair.image_height)))


@dataclass(frozen=True)
class _Task:
    """What is predicted and how; `options` has no defaults that are still to be chosen."""

    source: Pair | Views
    predictor: Predictor
    options: PredictOptions

    @cached_property
    def views(self) -> Views:
        """The loaded panoramas."""
        return self.source if isinstance(self.source, Views) else self.source.load_context(self.options.height or 0)

    @property
    def cam2world(self) -> Float[Tensor, "view 4 4"]:
        """Poses of the panoramas, which need not be loaded."""
        if isinstance(self.source, Views):
            return self.source.cam2world
        return torch.stack([panorama.cam2world for panorama in self.source.context])

    def open_cache(self, *, refined: bool) -> CachedPrediction:
        """The entry of the prediction or of its refinement."""
        return CachedPrediction(self.source, self.predictor, self.options, refined=refined)


@with_device
@with_progress_bar
def predict(
    source: Pair | Views | str | Path,
    model: str | Path | Predictor | None = None,
    *,
    options: PredictOptions | None = None,
    on_predicted: Callable[[Scene], None] | None = None,
    **keywords: Any,
) -> Scene:
    """Predict the scene of a pair's context panoramas, and refine it.

    The prediction of a pair and its refinement are cached in its folder (`pansplat.cache`).

    Args:
        source: a pair; the path of a panorama or of a folder that holds exactly one pair; or loaded panoramas (never
            cached).
        model: the name of a predictor, a file of weights, or a predictor; by default that of the options.
        options: all of the following keywords in one object; a keyword replaces its value.
        on_predicted: called with the prediction before it is refined.
        compat, precision, depth_network: see `load_model`; without effect on a predictor object.
        height: panoramas are resized to (height, 2 height); by default `choose_height`. Loaded panoramas keep their
            size.
        refine_steps: of the refinement. By default 0, for none; that of `PredictOptions` is None, which is
            `choose_refine_steps`. A single view is not refined.
        gaussians: largest number after a refinement; similar neighbours are merged before it.
        joint: whether each surface is kept once, for programs that draw all Gaussians together (`fuse_views`). Without
            a refinement, only the colours are fitted.
        cache: whether to read and write the cache.
        device: of all work in the call, "cpu", "cuda" or "auto": a graphics card for long work (docs/platforms.md).
    """
    task = _prepare(source, *_choose_options(model, options, keywords))
    if task.options.refine_steps:
        return _refine_prediction(task, on_predicted)
    scene = _predict_views(task)
    return fuse(scene, task.views) if task.options.joint else scene


def _choose_options(
    model: str | Path | Predictor | None, options: PredictOptions | None, keywords: dict[str, Any]
) -> tuple[Predictor, PredictOptions]:
    """The predictor and the options of a call; without an object of options there is no refinement by default."""
    is_named = isinstance(model, (str, Path))
    options = PredictOptions(refine_steps=0) if options is None else options
    options = options.replace(**keywords, **({"model": str(model)} if is_named else {}))
    RefineConfig(gaussians=options.gaussians)
    steps = options.refine_steps
    if steps is not None and (isinstance(steps, bool) or not isinstance(steps, int) or steps < 0):
        raise InputError(f"`refine_steps` must be a whole number of at least 0, got {steps}")
    return load_predictor(options) if model is None or is_named else model, options


def _prepare(
    source: Pair | Views | str | Path,
    predictor: Predictor,
    options: PredictOptions,
) -> _Task:
    """The task of `predict`; what cannot be predicted is refused."""
    steps = options.refine_steps
    with stage(POSED), choose_caches(options):
        pair = _load_source(source)
    _require_views(pair, predictor)
    count = len(pair.images if isinstance(pair, Views) else pair.context)
    is_single, joint = count == 1, options.joint and count > 1
    if steps is None:
        steps = choose_refine_steps(count, joint=joint)
    height = pair.images.shape[-2] if isinstance(pair, Views) else options.height or choose_height(pair, predictor)
    chosen = replace(options, height=height, refine_steps=0 if is_single else steps, joint=joint)
    task = _Task(pair, predictor, chosen)
    if not is_single and float(torch.pdist(task.cam2world[:, :3, 3]).max()) < ONE_POSITION * pair.near:
        names = pair.names if isinstance(pair, Views) else [view.name for view in pair.context]
        warnings.warn(
            f"{', '.join(names)}: the cameras are at one place, so that depth is that of each photograph alone; check "
            "the poses.",
            InputWarning,
            stacklevel=3,
        )
    return task


@stage()
def _predict_views(task: _Task) -> Scene:
    """The scene without a refinement."""
    cached = task.open_cache(refined=False)
    content = cached.read()
    if content is not None:
        report_progress("read from the cache", 1.0)
        return _make_scene(content, task)
    views = task.views
    gaussians = task.predictor(views.images, views.cam2world, views.near, views.far, masks=views.masks)
    assert isinstance(gaussians, Gaussians)  # a list would be the result of a batch
    content = CachedScene(gaussians)
    cached.write(content)
    return _make_scene(content, task)


@stage()
def _refine_prediction(task: _Task, on_predicted: Callable[[Scene], None] | None) -> Scene:
    """The scene after its refinement."""
    cached, options = task.open_cache(refined=True), task.options
    found = cached.read()
    final = None if found is None else _make_scene(found, task, options.joint)
    if final is not None and on_predicted is None:
        report_progress("read from the cache", 1.0)
        return final
    with stage(0.5):
        scene = _predict_views(task)
    if options.joint:
        scene = fuse_views(scene)
    if on_predicted is not None:
        on_predicted(scene)
    if final is not None:
        return final
    photographs = task.views if isinstance(task.source, Views) else load_photographs(task.source, scene.height)
    config = RefineConfig(gaussians=options.gaussians)
    refined, _ = _refine_scene(scene, photographs, config, steps=options.refine_steps)
    content = CachedScene(refined.gaussians, refined.gains)
    cached.write(content)
    return _make_scene(content, task, options.joint)


@with_device
@with_progress_bar
def refine(
    scene: Scene,
    views: Views,
    *,
    steps: int | None = None,
    seconds: float = math.inf,
    config: RefineConfig | None = None,
    seed: int = 0,
) -> Scene:
    """Fit a scene to the photographs that it was predicted from, by rendering and comparison.

    It works for a scene of any predictor. `pansplat.refinement.Refinement` refines step by step, with a report.

    Args:
        scene: of one input camera for each photograph.
        views: the photographs, such as `pair.load_context(height)`; masked pixels are not compared.
        steps: number of steps, by default `choose_refine_steps`; the result is the same in every run.
        seconds: limit after which the run ends early, with a warning; the result depends on the speed of the machine.
        config: settings of the objective, the step sizes and the number of Gaussians.
        seed: of the blocks of pixels that are held out of the loss.
        device: see `predict`; a scene on a card is refined there.

    Returns:
        The refined scene, or the given one if held-out pixels show that it is better, or if it is of a single view.
    """
    refined, report = run_refinement(scene, views, config, seed, steps=steps, seconds=seconds)
    if report.stopped == "time limit":
        problem = f"the refinement ended after {report.steps} steps, at its limit of {seconds:g} s"
        warnings.warn(problem, InputWarning, stacklevel=4)
    return refined


def run_refinement(
    scene: Scene, views: Views, config: RefineConfig | None, seed: int, **run: Any
) -> tuple[Scene, RefineReport]:
    """The refined scene and what the refinement did; `run` holds arguments of `Refinement.run`."""
    poses = scene.frame.localize(views.frame.globalize(views.cam2world))
    if run["steps"] is None:
        run["steps"] = choose_refine_steps(len(views.images), joint=scene.joint)
    return _refine_scene(scene, replace(views, cam2world=poses, frame=scene.frame), config, seed, **run)


def _refine_scene(
    scene: Scene, views: Views, config: RefineConfig | None = None, seed: int = 0, **run: Any
) -> tuple[Scene, RefineReport]:
    """The refined scene and what the refinement did, which runs on the device of `choose_device`, or a given card's."""
    device = given = scene.gaussians.means.device

    def run_on(device: torch.device) -> tuple[Scene, RefineReport]:
        moved = replace(scene, gaussians=scene.gaussians.to(device=device))
        refinement = Refinement(moved, views, config, seed=seed)
        report = refinement.run(**run)
        refined = refinement.scene()
        if report.stopped == "torn":
            problem = f"{', '.join(scene.names)}: not refined, because pictures between the cameras would be torn"
            warnings.warn(problem, InputWarning, stacklevel=2)
        return replace(refined, gaussians=refined.gaussians.to(device=given)), report

    if given.type == "cpu":
        device = choose_device("refinement", _STEP_SECONDS * run["steps"], kernels=True)
    try:
        return run_on(device)
    except torch.cuda.OutOfMemoryError:
        if device == given:
            raise
        note_full_card("refinement")  # the tensors on the card are free outside of the block
    return run_on(given)


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
    predictor, options = _choose_options(model, options, keywords)
    if isinstance(tour, (str, Path)):
        with choose_caches(options):
            tour = _load_only_tour(tour)
    warn_of_single_views(tour, predictor)
    max_views, is_refined = find_max_views(predictor), options.joint and options.refine_steps != 0
    total = len(tour.choose_sources(max_views))
    part = math.inf if options.gaussians is None else options.gaussians / len(tour)  # limit of Gaussians of a panorama
    counter = itertools.count(1)
    each = replace(options, joint=False, refine_steps=0) if options.joint else options

    def predict_scene(views: tuple[int, ...]) -> Scene:
        number, pair = next(counter), tour.make_pair(views)
        fitted = fit_to_scene(each, pair, part)
        with stage(number / total, f"scene {number} of {total}: "):
            return predict(pair, choose_predictor(pair, predictor), options=fitted)

    with stage(0.5 if is_refined else 1.0):
        scene = merge_scenes(tour, predict_scene, max_views)
    if not options.joint:
        return scene
    return fuse_tour(tour, scene, refine_steps=options.refine_steps)


def fuse(scene: Scene, views: Views) -> Scene:
    """The scene with each surface once, for programs that draw all Gaussians together, and colours of all photographs.

    Args:
        scene: of one input camera for each photograph.
        views: the photographs that it was predicted from.
    """
    if len(views.images) == 1:
        return scene
    fused, poses = fuse_views(scene), scene.cam2world
    gains = measure_gains(fused.gaussians, views.images, poses, views.masks, joint=True)
    gaussians, images = equalize_gaussians(fused.gaussians, gains, poses), equalize_images(views.images, gains)
    return replace(fused, gaussians=fit_colors(gaussians, images, poses, views.masks, joint=True))


@with_device
@with_progress_bar
def fuse_tour(tour: TourGraph, scene: Scene, *, refine_steps: int | None = 0) -> Scene:
    """The scene of a whole tour with each surface once, and fitted to all photographs of each part.

    Args:
        tour, scene: the graph, and its scene by `predict_tour`.
        refine_steps: see `predict`; without a refinement only colours are fitted.
    """
    fused: list[Gaussians] = []
    gains = [(1.0, 1.0, 1.0)] * len(tour)
    parts = tour.list_parts()
    for number, nodes in enumerate(parts, 1):
        part = select_views(scene, nodes)
        if len(nodes) > 1:
            pair = tour.make_pair(nodes)
            views = replace(pair.load_context(scene.height), cam2world=part.cam2world, frame=part.frame)
            steps = choose_refine_steps(len(nodes), joint=True) if refine_steps is None else refine_steps
            if steps:
                with stage(number / len(parts)):
                    part, _ = _refine_scene(fuse_views(part), views, steps=steps)
            else:
                part = fuse(part, views)
        for view, node in enumerate(nodes):
            gains[node] = part.gains[view] if part.gains else gains[node]
        fused.append(replace(part.gaussians, views=torch.tensor(nodes)[part.gaussians.views.long()]))
    return replace(scene, gaussians=Gaussians.cat(fused), gains=tuple(gains), joint=True)


@with_device
@with_progress_bar
def predict_to_file(
    source: Pair | Views | str | Path,
    path: str | Path,
    model: str | Path | Predictor | None = None,
    *,
    options: PredictOptions | None = None,
    degree: int | None = None,
    **keywords: Any,
) -> int:
    """Predict a scene and write it in the format of the file's suffix (docs/formats.md).

    The prediction of a network that is not fused, refined or cached is computed tile by tile, in bounded memory; a .ply
    is written tile by tile, too. The Gaussians are those of `predict`, ordered by tile.

    Args:
        source, model, options, **keywords: see `predict`.
        path: the file.
        degree: highest degree of harmonics in the file; None keeps all.
        cache: see `predict`; without options by default not, and networks do not cache heights above 512.

    Returns:
        The number of Gaussians in the file.
    """
    suffix = find_scene_suffix(path)
    if options is None:
        keywords.setdefault("cache", False)
    task = _prepare(source, *_choose_options(model, options, keywords))
    predictor, options = task.predictor, task.options
    is_cached = options.cache and (options.height or 0) <= _MAX_CACHED_HEIGHT
    if can_stream(predictor) and not (options.joint or options.refine_steps or is_cached):
        views = task.views
        parts: Iterator[Gaussians] = predictor.stream(  # pyright: ignore[reportAttributeAccessIssue]
            views.images, views.cam2world, views.near, views.far, masks=views.masks
        )
        pruned = (prune(part, degree=degree) for part in parts)
        if suffix == ".ply":
            return save_ply_parts(_make_scene(CachedScene(empty_gaussians()), task), pruned, path)
        scene = _make_scene(CachedScene(Gaussians.cat(list(pruned))), task)
    else:
        scene = predict(task.source, predictor, options=options)
        scene = replace(scene, gaussians=prune(scene.gaussians, degree=degree))
    save(scene, path)
    return len(scene.gaussians)


def can_stream(predictor: Predictor) -> bool:
    """Whether the predictor computes a scene tile by tile."""
    return hasattr(predictor, "stream")


def render(
    scene: Scene,
    cam2world: Float[Tensor, "4 4"] | np.ndarray,
    *,
    blend: str | int | None = None,
    size: tuple[int, int] | None = None,
    layout: str = "equirect",
    eye_distance: float | None = None,
    drawing: Drawing = "exact",
    **raster: Any,
) -> Rendering:
    """Render a scene from a pose: colour, alpha and radial depth.

    Args:
        scene: the Gaussians and their input cameras.
        cam2world: pose of the camera, OpenCV axes, in the world of `scene.cam2world`; `scene.frame.localize` brings a
            pose of the user's world there.
        blend: "deferred" renders the Gaussians of each context view and blends the images by nearness; in a scene of
            a tour, those of the views at the nearest edge, and other views of its part fill their holes. "joint"
            renders all Gaussians together, of a tour those of the part; a number renders those of one view only. By
            default as the scene is made for (`Scene.joint`).
        size: (height, width), pixels; by default the scene's height, 2:1 (16:9 for `pinhole`).
        layout: "equirect", "cubemap" or "pinhole".
        eye_distance: if given, omni-directional stereo (docs/rendering.md, section 9): the left eye's panorama above
            the right eye's; `size` is that of one. Metres.
        drawing: "exact", or "original": a panorama as the official code renders it, with its defects, to reproduce
            published figures (docs/paper.md).
        **raster: further arguments of `pansplat.rasterize`, with "exact".
    """
    pose = torch.as_tensor(cam2world, dtype=torch.float64, device=scene.gaussians.means.device)
    if pose.shape != (4, 4):
        raise InputError(f"`cam2world` must be a pose (4, 4), such as scene.pose_between(0.5), got {tuple(pose.shape)}")
    if eye_distance is not None:
        if raster.get("eye_offset") or not 0 < eye_distance < math.inf:
            raise InputError(f"`eye_distance` must be above 0, without `eye_offset`, got {eye_distance}")
        both = [
            render(scene, pose, blend=blend, size=size, layout=layout, drawing=drawing, eye_offset=offset, **raster)
            for offset in (-0.5 * eye_distance, 0.5 * eye_distance)
        ]
        color, alpha, depth = (
            torch.cat([getattr(eye, name) for eye in both], dim=-2) for name in ("color", "alpha", "depth")
        )
        return Rendering(color, alpha, depth)
    if blend is None:
        blend = "joint" if scene.joint else "deferred"
    if size is None:
        size = (scene.height, round(scene.height * 16 / 9) if layout == "pinhole" else 2 * scene.height)
    rasterize_gaussians = _choose_rasterizer(drawing, scene, size, layout, raster)
    num_views = len(scene.cam2world)
    if isinstance(blend, int):
        if not 0 <= blend < max(num_views, 1):
            raise InputError(f"`blend` must be a view from 0 to {max(num_views, 1) - 1}, got {blend}")
        return rasterize_gaussians(scene.gaussians.select(scene.gaussians.views == blend), pose)
    if blend not in ("deferred", "joint"):
        raise InputError(f"`blend` must be deferred, joint or the number of a view, got {blend!r}")
    tour = make_graph(scene) if scene.overlaps else None
    edge = None if tour is None else tour.find_nearest_edge(pose[:3, 3].detach().cpu().numpy())[0]
    shown = list(range(num_views))
    if tour is not None and edge is not None:
        shown = [view for view in shown if not tour.is_fade(view, edge[0])]
    if blend == "joint" or num_views < 2:
        gaussians = scene.gaussians
        if len(shown) < num_views:
            gaussians = gaussians.select(torch.isin(gaussians.views, torch.tensor(shown).to(gaussians.views)))
        return rasterize_gaussians(gaussians, pose)
    group = shown if tour is None or edge is None else list(tour.choose_scene_views()[edge])
    weights = torch.zeros(num_views, dtype=torch.float64, device=pose.device)
    near = torch.tensor(group, device=pose.device)
    forward = pose[:3, 2] if layout == "pinhole" else None
    weights[near] = blend_weights(pose[:3, 3], scene.cam2world[group, :3, 3].to(pose), forward)
    views = [scene.gaussians.select(scene.gaussians.views == view) for view in shown]
    renderings = [rasterize_gaussians(view, pose) for view in views]
    return blend_renderings(renderings, weights[torch.tensor(shown, device=pose.device)])


def make_renderer(scene: Scene, work: str, count: int, **options: Any) -> Callable[..., Rendering]:
    """A function from a pose to its image, on the device for their number; on the processor once a card is full.

    Keywords of the function replace those of all images.

    Args:
        scene: in main memory, as the images are.
        work: name of the images.
        count: of images.
        options: keywords of `render`, with the size.
    """
    device = choose_device(work, count * math.prod(options["size"]) * _PIXEL_SECONDS, kernels=True)
    placed = replace(scene, gaussians=scene.gaussians.to(device=device))

    def draw(cam2world: Tensor | np.ndarray, **changed: Any) -> Rendering:
        nonlocal placed
        try:
            image = render(placed, cam2world, **options | changed)
        except torch.cuda.OutOfMemoryError:
            note_full_card(work)
            placed = scene
            return draw(cam2world, **changed)
        return replace(image, color=image.color.cpu(), alpha=image.alpha.cpu(), depth=image.depth.cpu())

    return draw


def _choose_rasterizer(
    drawing: Drawing, scene: Scene, size: tuple[int, int], layout: str, raster: dict[str, Any]
) -> Callable[[Gaussians, Tensor], Rendering]:
    """Return a function from Gaussians and a pose to their rendering."""
    if drawing == "exact":
        return partial(rasterize, size=size, layout=layout, **raster)
    if drawing != "original":
        raise InputError(f"`drawing` must be exact or original, got {drawing!r}")
    if layout != "equirect" or set(raster) - {"backend"}:
        given = ", ".join([*sorted(raster), *(["layout"] if layout != "equirect" else [])])
        raise InputError(f"drawing='original' sets all options but size and backend, got {given}; omit them")
    return partial(rasterize_official, size=size, near=scene.near, **raster)


def _load_source(source: Pair | Views | str | Path) -> Pair | Views:
    """The pair of a path or of listed panoramas; a pair or views as they are, with tensors in place of arrays."""
    if isinstance(source, (str, Path)):
        return _load_only_pair(source)
    if isinstance(source, Pair):
        return source
    if isinstance(source, Views):
        return _as_tensors(source)
    raise InputError(
        f"needed a pair, a path or Views, got {type(source).__name__}; "
        "give arrays as Views(images, cam2world, masks, near, far, names)"
    )


def _as_tensors(views: Views) -> Views:
    images, masks = torch.as_tensor(views.images), torch.as_tensor(views.masks, dtype=torch.bool)
    images = images / 255 if images.dtype == torch.uint8 else images.float()
    if images.numel() and float(images.nan_to_num().max()) > _MAX_COLOR:
        raise InputError(
            f"`images` must be RGB in [0, 1], got values up to {float(images.max()):g}; divide them by 255"
        )
    poses = torch.as_tensor(views.cam2world, dtype=torch.float64)
    return replace(views, images=images, masks=masks, cam2world=poses)


def _load_only_pair(path: str | Path) -> Pair:
    pairs = load_pairs(path)
    if len(pairs) != 1:
        names = ", ".join(pair.name for pair in pairs[:8]) + (", ..." if len(pairs) > 8 else "")
        every = ", or all in one scene: predict_tour(path)" if len(find_tours(pairs)) == 1 else ""
        raise InputError(f"{path} holds {len(pairs)} pairs ({names}); choose one: predict(load_pairs(path)[0]){every}")
    return pairs[0]


def _load_only_tour(path: str | Path) -> TourGraph:
    with stage(POSED):
        tours = find_tours(load_pairs(path))
    if len(tours) != 1:
        names = f" ({', '.join(tour.name for tour in tours[:8])}{', ...' if len(tours) > 8 else ''})" if tours else ""
        advice = "give its folder" if tours else "predict one pair: predict(load_pairs(path)[0])"
        raise InputError(f"{path}: needed the panoramas of one tour, got {len(tours)} tours{names}; {advice}")
    with stage(CONNECTED):
        return connect(tours[0])


def _make_scene(content: CachedScene, task: _Task, joint: bool = False) -> Scene:
    source, gaussians, cam2world = task.source, content.gaussians, task.cam2world.double()
    panoramas = source.context if isinstance(source, Pair) else ()
    first = source if isinstance(source, Views) else source.context[0]
    if len(cam2world) == 1:  # it is predicted as if the camera stood at the usual height
        gaussians = gaussians.scaled(first.camera_height / CAMERA_HEIGHT, cam2world[0, :3, 3])
    return Scene(
        gaussians,
        cam2world,
        near=source.near,
        far=source.far,
        names=source.names if isinstance(source, Views) else tuple(panorama.label for panorama in panoramas),
        model=task.predictor.name,
        height=task.options.height or 0,
        gains=content.gains,
        starts=list_starts(panoramas),
        joint=joint,
        frame=first.frame,
    )
