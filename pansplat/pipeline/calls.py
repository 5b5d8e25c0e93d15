"""`predict` and `predict_to_file`: the scene of a path, a tour, one set of panoramas or loaded views."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from pansplat.cache import CachedScene
from pansplat.errors import InputError
from pansplat.gaussians.formats import save_scene
from pansplat.gaussians.ply import save_ply_parts
from pansplat.gaussians.scene import Gaussians, Scene, empty_gaussians, prune
from pansplat.inputs.panorama_sets import PanoramaSet
from pansplat.inputs.views import Views
from pansplat.pipeline.models import can_stream, load_predictor
from pansplat.pipeline.prediction import load_sets, make_scene, make_task, predict_set
from pansplat.pipeline.tours import predict_tour
from pansplat.prediction_options import PredictOptions, choose_caches
from pansplat.predictor import Predictor
from pansplat.refinement import RefineConfig
from pansplat.system.console import with_progress_bar
from pansplat.system.devices import with_device
from pansplat.system.files import find_scene_suffix
from pansplat.system.progress import CONNECTED, POSED, stage
from pansplat.tours.graph import TourGraph, find_tours
from pansplat.tours.overlap import connect

_MAX_CACHED_HEIGHT = 512  # rows of a network's prediction that is cached; taller ones are written tile by tile
_MAX_COLOR = 1.5  # largest value of images in [0, 1], which filters may exceed; images of 8 bits have larger ones

Source = PanoramaSet | TourGraph | Views | str | Path


@with_device
@with_progress_bar
def predict(
    source: Source,
    model: str | Path | Predictor | None = None,
    *,
    options: PredictOptions | None = None,
    on_predicted: Callable[[Scene], None] | None = None,
    **keywords: Any,
) -> Scene:
    """Predict the scene of panoramas, and refine it.

    That of a tour is merged from the scenes of its parts: `default` and `sweep` predict a part at once, networks two or
    three panoramas. Single views are predicted by `default`, with a warning, if the model needs two or more.

    Predictions and refinements are cached in the folder of the panoramas (`pansplat.cache`).

    Args:
        source: a pair or another set of `load_sets`; a tour (`pansplat.tours.overlap.connect`); loaded panoramas (never
            cached); or the path of a panorama, of a folder that holds exactly one pair or the panoramas of exactly one
            tour, or of a web tour.
        model: the name of a predictor, a file of weights, or a predictor; by default that of the options.
        options: all of the following keywords in one object; a keyword replaces its value.
        on_predicted: called with the prediction of a set or of views before it is refined.
        compat, precision, depth_network: see `load_model`; without effect on a predictor object.
        height: panoramas are resized to (height, 2 height); by default that of the photographs, at most the largest
            default of the predictor, of a tour 512. Loaded panoramas keep their size.
        refine_steps: of the refinement. 0 for none (the default here); None: `choose_refine_steps`, 0 for networks. A
            single view is not refined.
        gaussians: largest number after a refinement; similar neighbours are merged before it. In a tour each panorama
            has an equal part of it; without a refinement the scene may have more.
        joint: whether each surface is kept once, for programs that draw all Gaussians together (`fuse_views`). Without
            a refinement, only the colours are fitted. The refinement of a tour is that of each part as a whole, and not
            cached. Networks keep all.
        cache: whether to read and write the cache.
        device: of all work in the call, "cpu", "cuda" or "auto": a graphics card for long work (docs/platforms.md).
    """
    predictor, options, source = _prepare(source, model, options, keywords)
    if isinstance(source, TourGraph):
        return predict_tour(source, predictor, options)
    return predict_set(make_task(source, predictor, options), on_predicted)


@with_device
@with_progress_bar
def predict_to_file(
    source: Source,
    path: str | Path,
    model: str | Path | Predictor | None = None,
    *,
    options: PredictOptions | None = None,
    degree: int | None = None,
    **keywords: Any,
) -> int:
    """Predict a scene and write it in the format of the file's suffix (docs/formats.md).

    The prediction of one set by a network, neither refined nor cached, is computed tile by tile, in bounded memory; a
    .ply is written tile by tile, too. The Gaussians are those of `predict`, ordered by tile.

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
    predictor, options, source = _prepare(source, model, options, keywords)
    if isinstance(source, TourGraph):
        scene = predict_tour(source, predictor, options)
    else:
        task = make_task(source, predictor, options)
        is_cached = options.cache and (task.options.height or 0) <= _MAX_CACHED_HEIGHT
        if can_stream(predictor) and not (task.options.refine_steps or is_cached):
            views = task.views
            parts: Iterator[Gaussians] = predictor.stream(  # pyright: ignore[reportAttributeAccessIssue]
                views.images, views.cam2world, views.near, views.far, masks=views.masks
            )
            pruned = (prune(part, degree=degree) for part in parts)
            if suffix == ".ply":
                return save_ply_parts(make_scene(CachedScene(empty_gaussians()), task), pruned, path)
            scene = make_scene(CachedScene(Gaussians.cat(list(pruned))), task)
        else:
            scene = predict_set(task)
    scene = replace(scene, gaussians=prune(scene.gaussians, degree=degree))
    save_scene(scene, path)
    return len(scene.gaussians)


def _prepare(
    source: Source, model: str | Path | Predictor | None, options: PredictOptions | None, keywords: dict[str, Any]
) -> tuple[Predictor, PredictOptions, PanoramaSet | TourGraph | Views]:
    """The predictor, the options, by default without a refinement, and what is predicted."""
    is_named = isinstance(model, (str, Path))
    options = PredictOptions(refine_steps=0) if options is None else options
    options = options.replace(**keywords, **({"model": str(model)} if is_named else {}))
    RefineConfig(gaussians=options.gaussians)  # an invalid number is an error before the prediction
    steps = options.refine_steps
    if steps is not None and (isinstance(steps, bool) or not isinstance(steps, int) or steps < 0):
        raise InputError(f"`refine_steps` must be a whole number of at least 0, got {steps}")
    predictor = load_predictor(options) if model is None or is_named else model
    with choose_caches(options):
        return predictor, options, _load_source(source)


def _load_source(source: Source) -> PanoramaSet | TourGraph | Views:
    """The only pair or tour of a path; else the source, with tensors in place of arrays."""
    if isinstance(source, Views):
        return _as_tensors(source)
    if isinstance(source, (PanoramaSet, TourGraph)):
        return source
    if not isinstance(source, (str, Path)):
        raise InputError(
            f"needed a pair, a tour, a path or Views, got {type(source).__name__}; "
            "give arrays as Views(images, cam2world, masks, near, far, names)"
        )
    with stage(POSED):
        pairs = load_sets(source)
    if len(pairs) == 1:
        return pairs[0]
    tours = find_tours(pairs)
    images = {view.image for pair in pairs for view in pair.context}
    if len(tours) == 1 and images <= {view.image for view in tours[0].panoramas}:
        with stage(CONNECTED):
            return connect(tours[0])
    names = ", ".join(pair.name for pair in pairs[:8]) + (", ..." if len(pairs) > 8 else "")
    raise InputError(
        f"{source}: needed one pair or one tour, got {len(pairs)} pairs ({names}) of more; choose one: "
        "predict(load_sets(path)[0]), or give the folder of one tour"
    )


def _as_tensors(views: Views) -> Views:
    images, masks = torch.as_tensor(views.images), torch.as_tensor(views.masks, dtype=torch.bool)
    images = images / 255 if images.dtype == torch.uint8 else images.float()
    if images.numel() and float(images.nan_to_num().max()) > _MAX_COLOR:
        raise InputError(
            f"`images` must be RGB in [0, 1], got values up to {float(images.max()):g}; divide them by 255"
        )
    poses = torch.as_tensor(views.cam2world, dtype=torch.float64)
    holes = None if views.holes is None else torch.as_tensor(views.holes, dtype=torch.bool)
    return replace(views, images=images, masks=masks, cam2world=poses, holes=holes)
