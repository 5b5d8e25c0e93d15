"""Validation during training: image and depth measures of unseen samples, and renderings of them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from statistics import fmean

import torch
from torch import Tensor

from pansplat.errors import InputError
from pansplat.evaluation.metrics import psnr, ssim, ws_psnr
from pansplat.images.image_files import write_image
from pansplat.inputs.views import Sample, collate
from pansplat.model.heads import merge_tiles
from pansplat.model.pansplat import PanSplat
from pansplat.training.rendering import TargetRenderer
from pansplat.training.sources import SampleSource

MEASURES = ("psnr", "ws_psnr", "ssim", "depth_error")
"""Columns of validation.csv: dB, dB, 1, and the mean relative error of the finest depth (NaN without true depth)."""


@torch.no_grad()
def validate(
    network: PanSplat,
    source: SampleSource,
    renderer: TargetRenderer,
    *,
    samples: int,
    pictures: int,
    tiles: int,
    folder: Path | None,
    name: str,
) -> dict[str, float]:
    """Mean measures over the first samples of a source. Leaves the network in eval mode.

    Args:
        renderer: renders the targets.
        pictures: number of samples that are written as PNG: the target above, its rendering below.
        folder: folder of the PNGs; None for none.
        name: file name of the PNGs before the sample's number.
    """
    network.eval()
    values: dict[str, list[float]] = {measure: [] for measure in MEASURES}
    for number, sample in enumerate(_readable_samples(source, samples, renderer.height)):
        measures, rendered = _measure(network, sample, renderer, tiles)
        for measure, value in measures.items():
            values[measure].append(value)
        if folder is not None and number < pictures:
            folder.mkdir(parents=True, exist_ok=True)
            both = torch.cat((sample.targets.images[0], rendered.clamp(0, 1).float().cpu()), dim=1)
            write_image(folder / f"{name}_{number}.png", both)
    return {measure: fmean(values[measure]) if values[measure] else math.nan for measure in MEASURES}


def describe_measures(measures: dict[str, float]) -> str:
    """PSNR, SSIM and, where depth is known, its error, as a line for people."""
    text = f"PSNR {measures['psnr']:.2f} dB, SSIM {measures['ssim']:.3f}"
    error = measures["depth_error"]
    return text if math.isnan(error) else f"{text}, relative depth error {100 * error:.1f} %"


def _measure(
    network: PanSplat, sample: Sample, renderer: TargetRenderer, tiles: int
) -> tuple[dict[str, float], Tensor]:
    """Measures of a sample's first target, without the error of depth if no depth is known; and its rendering."""
    parameter = next(network.parameters())
    batch = collate([sample]).to(parameter.device, parameter.dtype)
    matched = network.match_views(batch.images, batch.cam2world, batch.near, batch.far)
    (scene,) = merge_tiles(list(network.lift_gaussians(matched, tiles=tiles)), network.compat)
    rendered = renderer.render(scene, batch.target_cam2world[0, 0], batch.cam2world[0])
    target = batch.target_images[0, 0]
    measures = {"psnr": psnr(rendered, target), "ws_psnr": ws_psnr(rendered, target), "ssim": ssim(rendered, target)}
    if batch.depths is not None:
        depth = matched.depths.depth[-1]
        true_depth = torch.nn.functional.interpolate(batch.depths, depth.shape[-2:], mode="nearest-exact")
        is_known = (true_depth > batch.near[..., None, None]) & (true_depth < batch.far[..., None, None])
        if is_known.any():
            measures["depth_error"] = float(((depth - true_depth).abs() / true_depth)[is_known].mean())
    return measures, rendered


def _readable_samples(source: SampleSource, count: int, height: int) -> Iterator[Sample]:
    """The readable ones of the first `count` samples; an InputError if there is none."""
    failures, readable = [], 0
    for index in range(min(count, len(source))):
        try:
            yield source.sample(index, height, 0)
            readable += 1
        except InputError as error:
            failures.append(str(error))
    if not readable:
        raise InputError(f"needed readable validation samples, got none: {'; '.join(failures[:3])}")
