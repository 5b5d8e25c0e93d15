"""Loads pairs, predicts the scene of a pair, of one panorama or of loaded views, and refines it."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.cache import CachedPrediction, CachedScene
from pansplat.errors import InputError, InputWarning
from pansplat.gaussians.formats import save_scene
from pansplat.gaussians.ply import save_ply_parts
from pansplat.gaussians.scene import Gaussians, Scene, empty_gaussians, prune
from pansplat.inputs import folders
from pansplat.inputs.panorama_sets import PanoramaSet
from pansplat.inputs.views import ONE_POSITION, Views
from pansplat.pipeline.models import can_stream, find_min_views, load_predictor
from pansplat.poses.files import estimate_sets
from pansplat.prediction_options import PredictOptions, choose_caches
from pansplat.predictor import Predictor
from pansplat.refinement import DISPLAY_HEIGHT, RefineConfig, Refinement, RefineReport, fuse_views
from pansplat.rendering.color_fit import fit_colors
from pansplat.rendering.gains import equalize_gaussians, equalize_images, measure_gains
from pansplat.system.console import with_progress_bar
from pansplat.system.devices import choose_device, note_full_card, with_device
from pansplat.system.files import find_scene_suffix
from pansplat.system.options import CAMERA_HEIGHT, MIN_HEIGHT
from pansplat.system.progress import POSED, report_progress, stage
from pansplat.tours.graph import find_tours
from pansplat.tours.merge import list_starts

_DEFAULT_HEIGHT = 512  # rows of the panoramas that networks predict from; larger ones take minutes
_MAX_CACHED_HEIGHT = 512  # rows of a network's prediction that is cached; taller ones are written tile by tile
_MAX_COLOR = 1.5  # largest value of images in [0, 1], which filters may exceed; images of 8 bits have larger ones
_REFINE_STEPS = 40  # default steps of layers; more change little (docs/refinement.md)
_JOINT_STEPS, _MIN_STEPS = 80, 8  # default steps of joint drawing, and the least for each photograph
_STEP_SECONDS = 0.25  # time of a step on two cores, photographs of 512 rows


@with_device
@with_progress_bar
def load_sets(
    path: Path | str,
    *,
    convention: str | None = None,
    near: float | None = None,
    far: float | None = None,
    camera_height: float = CAMERA_HEIGHT,
    on_unposed: Callable[[list[PanoramaSet]], None] | None = None,
) -> list[PanoramaSet]:
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
        return estimate_sets(folder, panoramas, **options, on_unposed=on_unposed)
    return folders.make_sets(collections, near, far, camera_height)


def choose_height(pair: PanoramaSet, predictor: Predictor) -> int:
    """The height to predict a pair at: that of its photographs, at most the largest default of the predictor."""
    return max(MIN_HEIGHT, min(pair.image_height, getattr(predictor, "default_height", _DEFAULT_HEIGHT)))


@with_device
@with_progress_bar
def predict(
    source: PanoramaSet | Views | str | Path,
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
    return _run(_prepare(source, model, options, keywords), on_predicted)


@with_device
@with_progress_bar
def predict_to_file(
    source: PanoramaSet | Views | str | Path,
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
    task = _prepare(source, model, options, keywords)
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
        scene = _run(task)
        scene = replace(scene, gaussians=prune(scene.gaussians, degree=degree))
    save_scene(scene, path)
    return len(scene.gaussians)


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
        views: the photographs, such as `pair.load_context(2 * scene.height)`: those of the scene's height do not show
            what larger pictures do (docs/refinement.md). Masked pixels are not compared.
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
    return refine_scene(scene, replace(views, cam2world=poses, frame=scene.frame), config, seed, **run)


def refine_scene(
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


def choose_refine_steps(views: int, *, joint: bool = False) -> int:
    """Default number of steps of a refinement, of a scene for joint drawing or for deferred blending.

    A step compares each view with a photograph, in joint drawing all views together with one. Few large steps leave a
    scene of many views worse than before.
    """
    return max(_JOINT_STEPS, _MIN_STEPS * views) if joint else _REFINE_STEPS


def load_photographs(pair: PanoramaSet, height: int) -> Views:
    """The context panoramas for the refinement of a scene of a height: with twice its rows, at most `DISPLAY_HEIGHT`.

    Those of the prediction do not show detail, and the gaps between Gaussians, that larger pictures show.
    """
    return pair.load_context(max(height, min(2 * height, DISPLAY_HEIGHT, pair.image_height)))


@dataclass(frozen=True)
class _Task:
    """What is predicted and how; `options` has no defaults that are still to be chosen."""

    source: PanoramaSet | Views
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


def choose_options(
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
    source: PanoramaSet | Views | str | Path,
    model: str | Path | Predictor | None,
    options: PredictOptions | None,
    keywords: dict[str, Any],
) -> _Task:
    """The task of a call; what cannot be predicted is refused before it is read."""
    predictor, options = choose_options(model, options, keywords)
    with stage(POSED), choose_caches(options):
        pair = _load_source(source)
    loaded = isinstance(pair, Views)
    count, needed = len(pair.images if loaded else pair.context), find_min_views(predictor)
    if count < needed:
        files = pair.names if loaded else [str(view.image) for view in pair.context]
        raise InputError(
            f"{', '.join(files) or 'the input'}: {predictor.name} needed {needed} or more panoramas of one room, got "
            f"{count}; choose the model default, which accepts a single one, or add one."
        )
    joint = options.joint and count > 1
    steps = choose_refine_steps(count, joint=joint) if options.refine_steps is None else options.refine_steps
    height = pair.images.shape[-2] if loaded else options.height or choose_height(pair, predictor)
    task = _Task(pair, predictor, replace(options, height=height, refine_steps=steps if count > 1 else 0, joint=joint))
    if count > 1 and float(torch.pdist(task.cam2world[:, :3, 3]).max()) < ONE_POSITION * pair.near:
        names = pair.names if loaded else [view.name for view in pair.context]
        warnings.warn(
            f"{', '.join(names)}: the cameras are at one place, so that depth is that of each photograph alone; check "
            "the poses.",
            InputWarning,
            stacklevel=3,
        )
    return task


@stage()
def _run(task: _Task, on_predicted: Callable[[Scene], None] | None = None) -> Scene:
    """The scene of a task; its prediction is made for `on_predicted`, too, if the refinement is in the cache."""
    options = task.options
    if not options.refine_steps:
        scene = _predict_views(task)
        return fuse(scene, task.views) if options.joint else scene
    cached = CachedPrediction(task.source, task.predictor, options, refined=True)
    content = cached.read()
    if content is None or on_predicted is not None:
        with stage(0.5):
            scene = _predict_views(task)
        scene = fuse_views(scene) if options.joint else scene
        if on_predicted is not None:
            on_predicted(scene)
        if content is None:
            source = task.source
            photographs = task.views if isinstance(source, Views) else load_photographs(source, scene.height)
            config = RefineConfig(gaussians=options.gaussians)
            refined, _ = refine_scene(scene, photographs, config, steps=options.refine_steps)
            content = CachedScene(refined.gaussians, refined.gains)
            cached.write(content)
    else:
        report_progress("read from the cache", 1.0)
    return _make_scene(content, task, options.joint)


@stage()
def _predict_views(task: _Task) -> Scene:
    """The scene without a refinement."""
    cached, predictor = CachedPrediction(task.source, task.predictor, task.options, refined=False), task.predictor
    content = cached.read()
    if content is None:
        views = task.views
        gaussians = predictor(views.images, views.cam2world, views.near, views.far, masks=views.masks)
        assert isinstance(gaussians, Gaussians)  # a list would be the result of a batch
        content = CachedScene(gaussians)
        cached.write(content)
    else:
        report_progress("read from the cache", 1.0)
    return _make_scene(content, task)


def _load_source(source: PanoramaSet | Views | str | Path) -> PanoramaSet | Views:
    """The pair of a path; a pair or views as they are, with tensors in place of arrays."""
    if isinstance(source, (str, Path)):
        pairs = load_sets(source)
        if len(pairs) == 1:
            return pairs[0]
        names = ", ".join(pair.name for pair in pairs[:8]) + (", ..." if len(pairs) > 8 else "")
        every = ", or all in one scene: predict_tour(path)" if len(find_tours(pairs)) == 1 else ""
        advice = f"choose one: predict(load_sets(path)[0]){every}"
        raise InputError(f"{source} holds {len(pairs)} pairs ({names}); {advice}")
    if isinstance(source, PanoramaSet):
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


def _make_scene(content: CachedScene, task: _Task, joint: bool = False) -> Scene:
    source, gaussians, cam2world = task.source, content.gaussians, task.cam2world.double()
    panoramas = source.context if isinstance(source, PanoramaSet) else ()
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
