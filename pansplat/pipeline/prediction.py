"""Loads sets of panoramas, predicts the scene of one set or of loaded views, and refines it."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.cache import CachedPrediction, CachedScene
from pansplat.errors import InputError, InputWarning
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.inputs import folders
from pansplat.inputs.panorama_sets import PanoramaSet
from pansplat.inputs.views import ONE_POSITION, Views
from pansplat.pipeline.models import can_stream, find_min_views
from pansplat.prediction_options import PredictOptions
from pansplat.predictor import Predictor
from pansplat.refinement import DISPLAY_HEIGHT, RefineConfig, Refinement, RefineReport, fuse_views
from pansplat.rendering.color_fit import fit_colors
from pansplat.rendering.gains import equalize_gaussians, equalize_images, measure_gains
from pansplat.system.console import with_progress_bar
from pansplat.system.devices import choose_device, note_full_card, with_device
from pansplat.system.options import CAMERA_HEIGHT, MIN_HEIGHT
from pansplat.system.progress import report_progress, stage
from pansplat.tours.scene_graph import list_starts

_DEFAULT_HEIGHT = 512  # rows of the panoramas that networks predict from; larger ones take minutes
_REFINE_STEPS = 40  # default steps of layers; more change little (docs/refinement.md)
_JOINT_STEPS, _MIN_STEPS = 80, 8  # default steps of joint drawing, and the least for each photograph
_STEP_SECONDS = 0.25  # seconds of a step of a refinement on two cores, photographs of 512 rows


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
        from pansplat.poses.files import estimate_sets  # takes a second

        folder, panoramas = collections[0].folder, collections[0].unposed
        options = {"near": near, "far": far, "camera_height": camera_height}
        return estimate_sets(folder, panoramas, **options, on_unposed=on_unposed)
    return folders.make_sets(collections, near, far, camera_height)


def choose_height(pair: PanoramaSet, predictor: Predictor) -> int:
    """The height to predict a pair at: that of its photographs, at most the largest default of the predictor."""
    return max(MIN_HEIGHT, min(pair.image_height, getattr(predictor, "default_height", _DEFAULT_HEIGHT)))


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
class Task:
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


def make_task(source: PanoramaSet | Views, predictor: Predictor, options: PredictOptions) -> Task:
    """The task of a prediction; what cannot be predicted is refused before it is read."""
    loaded = isinstance(source, Views)
    count, needed = len(source.images if loaded else source.context), find_min_views(predictor)
    if count < needed:
        files = source.names if loaded else [str(view.image) for view in source.context]
        raise InputError(
            f"{', '.join(files) or 'the input'}: {predictor.name} needed {needed} or more panoramas of one room, got "
            f"{count}; choose the model default, which accepts a single one, or add one."
        )
    is_network = can_stream(predictor)
    joint = options.joint and count > 1 and not is_network
    steps = options.refine_steps
    if steps is None:
        steps = 0 if is_network else choose_refine_steps(count, joint=joint)
    height = source.images.shape[-2] if loaded else options.height or choose_height(source, predictor)
    task = Task(source, predictor, replace(options, height=height, refine_steps=steps if count > 1 else 0, joint=joint))
    if count > 1 and float(torch.pdist(task.cam2world[:, :3, 3]).max()) < ONE_POSITION * source.near:
        names = source.names if loaded else [view.name for view in source.context]
        warnings.warn(
            f"{', '.join(names)}: the cameras are at one place, so that depth is that of each photograph alone; check "
            "the poses.",
            InputWarning,
            stacklevel=3,
        )
    return task


@stage()
def predict_set(task: Task, on_predicted: Callable[[Scene], None] | None = None) -> Scene:
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
    return make_scene(content, task, options.joint)


@stage()
def _predict_views(task: Task) -> Scene:
    """The scene without a refinement."""
    cached, predictor = CachedPrediction(task.source, task.predictor, task.options, refined=False), task.predictor
    content = cached.read()
    if content is None:
        views = task.views
        holes = {"holes": views.holes} if getattr(predictor, "takes_holes", False) else {}
        gaussians = predictor(views.images, views.cam2world, views.near, views.far, masks=views.masks, **holes)
        assert isinstance(gaussians, Gaussians)  # a list would be the result of a batch
        content = CachedScene(gaussians)
        cached.write(content)
    else:
        report_progress("read from the cache", 1.0)
    return make_scene(content, task)


def make_scene(content: CachedScene, task: Task, joint: bool = False) -> Scene:
    """The scene of a task with the Gaussians of its prediction or refinement."""
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
