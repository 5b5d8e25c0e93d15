"""Evaluation of predictions against real panoramas: images, metrics and a table, with the cross-fade as baseline.

Source: PanSplat, section 4 (metrics of the views between the inputs).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from rich.table import Table
from torch import Tensor

from pansplat import pipeline
from pansplat.errors import InputError
from pansplat.evaluation.lpips import Lpips
from pansplat.evaluation.metrics import cross_fade, distortion, psnr, ssim, ws_psnr
from pansplat.evaluation.results import Column, Row, average_rows, make_folder, rich_table, write_json
from pansplat.gaussians.scene import Scene
from pansplat.images.image_files import write_image
from pansplat.inputs.panorama_sets import PanoramaSet
from pansplat.inputs.views import ONE_POSITION, Views
from pansplat.pipeline import Drawing
from pansplat.predictor import Predictor
from pansplat.refinement.fusion import BACKGROUND_LEVEL, OPAQUE
from pansplat.rendering import Rendering, rasterize
from pansplat.system.files import make_portable_name, make_unique_name
from pansplat.system.progress import report_progress, stage

_CROSS_FADE = {  # metrics of the cross-fade, by those of the prediction
    "ws_psnr": "cross_fade_ws_psnr",
    "masked_ws_psnr": "masked_cross_fade_ws_psnr",
    "lpips": "cross_fade_lpips",
}
ERROR_SCALE = 0.25  # mean absolute colour error that the brightest colour of an error image shows


def evaluate(
    pairs: Sequence[PanoramaSet],
    predictor: Predictor,
    out: Path,
    *,
    height: int = 512,
    refine_steps: int = 0,
    blend: str | int = "deferred",
    drawing: Drawing = "exact",
    lpips: Lpips | None = None,
) -> list[Row]:
    """Evaluate every target of the pairs, and write results.json and images into `out`.

    The case of a row has the name, the model, the height, and the paths of the images. Its values are those of
    `measure_image`; `own_ws_psnr`, the mean at the input cameras over unmasked pixels; `masked_ws_psnr` of the unmasked
    pixels, if the target has a mask; the same metrics of the cross-fade; `distortion`; times in seconds; and counts.

    For correct times, predictions are not read from the cache and the predictor runs once before the first pair.
    results.json is written after each pair, so that an interruption keeps the results so far.

    Args:
        refine_steps: steps of the refinement of each scene; 0 for none.
        blend, drawing: see `pipeline.render`. With "joint", scenes are fused (`fuse_views`), but those of networks are
            not: these are trained for joint drawing.
    """
    with_targets = [pair for pair in pairs if pair.targets]
    if not with_targets:
        raise InputError("none of the pairs has a target view to compare with; name targets in pairs.json")
    make_folder(out)
    with stage(0.0):
        warm_up(predictor)
    options = {"blend": blend, "size": (height, 2 * height), "drawing": drawing}
    rows: list[Row] = []
    for number, pair in enumerate(with_targets, 1):
        taken = {row.case["name"] for row in rows}
        joint = blend == "joint" and not pipeline.can_stream(predictor)
        with stage(number / len(with_targets), f"{pair.name}: "):
            rows += _evaluate_pair(pair, predictor, out, taken, height, refine_steps, joint, options, lpips)
        write_json([row.as_json() for row in rows], out / "results.json")
    return rows


def warm_up(predictor: Predictor) -> None:
    """Predict once from small noise, to compile the kernels that the predictor compiles at its first use."""
    images = torch.rand(2, 3, 64, 128, generator=torch.Generator().manual_seed(0))
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[1, 0, 3] = 1.0
    predictor(images, poses, 0.5, 10.0)


def _evaluate_pair(
    pair: PanoramaSet,
    predictor: Predictor,
    out: Path,
    taken: set[str],
    height: int,
    refine_steps: int,
    joint: bool,
    options: dict[str, Any],
    lpips: Lpips | None,
) -> Iterator[Row]:
    context, targets = pair.load_context(height), pair.load_targets(height)
    start = time.perf_counter()
    with stage(0.5 if refine_steps else 1.0):
        scene = pipeline.predict(context, predictor, joint=joint)
    predict_seconds = time.perf_counter() - start
    refine_seconds, start = 0.0, time.perf_counter()
    if refine_steps:
        scene = pipeline.refine(scene, context, steps=refine_steps)
        refine_seconds = time.perf_counter() - start
    render = pipeline.make_renderer(scene, "images", len(context.images) + len(targets.images), **options)
    own_ws_psnr = measure_own_views(scene, context, lambda _, pose: render(pose))
    for view, target in enumerate(targets.images):
        report_progress("rendering", 1.0)
        pose = targets.cam2world[view]
        start = time.perf_counter()
        with torch.no_grad():
            image = render(pose).color.float()
        render_seconds = time.perf_counter() - start
        name = pair.name if len(targets.images) == 1 else f"{pair.name} {Path(targets.names[view]).stem}"
        folder = out / make_unique_name(make_portable_name(name) or "case", taken)
        taken.add(folder.name)
        make_folder(folder)
        write_image(folder / "prediction.png", image)
        write_image(folder / "target.png", target)
        write_image(folder / "error.png", error_image(image, target))
        faded = cross_fade(context.images, context.cam2world, pose)
        mask = None if bool(targets.masks[view].all()) else targets.masks[view]
        faded_values = measure_image(faded, target, lpips, mask)
        yield Row(
            {
                "name": folder.name,
                "model": predictor.name,
                "height": height,
                "prediction": str((folder / "prediction.png").resolve()),
                "target": str((folder / "target.png").resolve()),
            },
            {
                **measure_image(image, target, lpips, mask),
                **{new: faded_values[old] for old, new in _CROSS_FADE.items() if old in faded_values},
                **measure_distortion(scene, pose[:3, 3]),
                "own_ws_psnr": own_ws_psnr,
                "predict_seconds": predict_seconds,
                "refine_seconds": refine_seconds,
                "render_seconds": render_seconds,
                "num_gaussians": len(scene.gaussians),
            },
        )


def measure_image(
    image: Float[Tensor, "3 height width"],
    target: Float[Tensor, "3 height width"],
    lpips: Lpips | None = None,
    mask: Bool[Tensor, "height width"] | None = None,
) -> dict[str, float]:
    """Metrics of an image by name: WS-PSNR and PSNR in dB, SSIM, and LPIPS if it is given.

    Only PSNR clamps. With a mask, there is the WS-PSNR of its pixels, too.
    """
    values = {"ws_psnr": ws_psnr(image, target), "psnr": psnr(image, target), "ssim": ssim(image, target)}
    masked = {} if mask is None else {"masked_ws_psnr": ws_psnr(image, target, mask=mask)}
    return values | masked | ({} if lpips is None else {"lpips": lpips.distance(image, target)})


def measure_own_views(scene: Scene, context: Views, render: Callable[[Scene, Tensor], Rendering]) -> float:
    """Mean WS-PSNR of the unmasked pixels at the input cameras."""
    with torch.no_grad():
        values = [
            ws_psnr(render(scene, pose).color.float(), image, mask=mask)
            for image, pose, mask in zip(context.images, scene.cam2world, context.masks, strict=True)
        ]
    return fmean(values)


@torch.no_grad()
def measure_distortion(scene: Scene, position: Float[Tensor, "3"]) -> dict[str, float]:
    """`distortion` at a position, the mean of the two nearest input cameras; no entry for what is not defined."""
    places = scene.cam2world[:, :3, 3]
    nearest = (places - position).norm(dim=1).argsort(stable=True)[:2].tolist()
    if len(nearest) < 2 or float((places[nearest[0]] - places[nearest[1]]).norm()) < ONE_POSITION * scene.near:
        return {}
    height, shares = min(scene.height, 256), []
    for view, other in (nearest, nearest[::-1]):
        # The background shines through: depth with it is not that of the surface.
        is_surface = (scene.gaussians.views == view) & (scene.gaussians.levels < BACKGROUND_LEVEL)
        pose = scene.cam2world[view]
        drawn = rasterize(scene.gaussians.select(is_surface), pose, size=(height, 2 * height))
        inverse_depth = torch.where(drawn.alpha > OPAQUE, 1 / drawn.depth, torch.nan)
        offset, ahead = ((place - pose[:3, 3]) @ pose[:3, :3] for place in (position, places[other]))
        shares.append(distortion(inverse_depth, offset, ahead))
    means = zip(("distortion_ahead", "distortion_aside"), torch.tensor(shares).nanmean(dim=0).tolist(), strict=True)
    return {name: mean for name, mean in means if not math.isnan(mean)}


def error_image(
    prediction: Float[Tensor, "3 height width"], target: Float[Tensor, "3 height width"]
) -> Float[Tensor, "3 height width"]:
    """The mean absolute colour error as a heat map: black at 0, pale yellow from ERROR_SCALE up."""
    from matplotlib import colormaps

    error = (prediction - target).abs().mean(0).div(ERROR_SCALE).clamp(0, 1).cpu().numpy()
    heat = np.asarray(colormaps["inferno"](error), np.float32)[..., :3]
    return torch.from_numpy(heat).permute(2, 0, 1)


_COLUMNS = (
    Column("case", "name"),
    Column("WS-PSNR", "ws_psnr", ".2f"),
    Column("unmasked", "masked_ws_psnr", ".2f"),
    Column("PSNR", "psnr", ".2f"),
    Column("SSIM", "ssim", ".4f"),
    Column("LPIPS", "lpips", ".4f"),
    Column("cross-fade", "cross_fade_ws_psnr", ".2f"),
    Column("torn ahead", "distortion_ahead", ".3f"),
    Column("torn aside", "distortion_aside", ".3f"),
    Column("at inputs", "own_ws_psnr", ".2f"),
    Column("predict s", "predict_seconds", ".1f"),
    Column("refine s", "refine_seconds", ".1f"),
    Column("render s", "render_seconds", ".1f"),
    Column("Gaussians", "num_gaussians", ",.0f"),
)
# Columns that are left out without values, or with zeros only.
_OPTIONAL = ("masked_ws_psnr", "lpips", "refine_seconds", "distortion_ahead", "distortion_aside")


def results_table(rows: Sequence[Row]) -> Table:
    """A printable table of the cases, their mean, and the mean of the cross-fade of the same cases."""
    columns = [c for c in _COLUMNS if c.value not in _OPTIONAL or any(row.get(str(c.value)) for row in rows)]
    # Without a mask, all pixels count.
    unmasked = {"masked_ws_psnr": "ws_psnr", "masked_cross_fade_ws_psnr": "cross_fade_ws_psnr"}
    rows = [Row(row.case, {new: row.values[old] for new, old in unmasked.items()} | row.values) for row in rows]
    (mean,) = average_rows(rows, ())
    faded = {old: mean.values[new] for old, new in _CROSS_FADE.items() if new in mean.values}
    below = [Row({"name": "mean"}, mean.values)] if len(rows) > 1 else []
    title = "{model}, {height}x{width}".format(**rows[0].case, width=2 * rows[0].case["height"])
    return rich_table(title, columns, rows, [*below, Row({"name": "cross-fade"}, faded)])
