"""How good the network is so far: numbers over samples it does not learn from, and pictures to look at."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from pansplat.data.images import write_image
from pansplat.data.sources import SampleSource
from pansplat.data.views import Sample, collate
from pansplat.errors import InputError
from pansplat.evaluation.metrics import psnr, ssim, ws_psnr
from pansplat.model.heads import merge_tiles
from pansplat.model.mvsplat import MVSplat
from pansplat.model.pansplat import PanSplat
from pansplat.training.rendering import TargetRenderer
from pansplat.training.step import as_type

MEASURES = ("psnr", "ws_psnr", "ssim", "depth_error")
"""Columns of the table: dB, dB, 1, and the mean relative error of the finest depth (NaN where no depth is known)."""


@torch.no_grad()
def validate(
    network: PanSplat | MVSplat,
    source: SampleSource,
    renderer: TargetRenderer,
    *,
    samples: int,
    pictures: int,
    tiles: int,
    folder: Path | None,
    name: str,
) -> dict[str, float]:
    """Means over the first samples of a source; leaves the network in eval mode.

    Args:
        renderer: how the targets are drawn.
        pictures: how many of the samples are written as PNG: the truth above, what is drawn below.
        folder: for the pictures; None for none.
        name: of the pictures, before the sample's number.

    Raises:
        InputError: none of the samples can be read, or a picture cannot be written.
    """
    network.eval()
    sums, count = dict.fromkeys(MEASURES, 0.0), 0
    for number, sample in enumerate(_readable(source, samples, renderer.height)):
        found, drawn = _measure(network, sample, renderer, tiles)
        sums = {measure: sums[measure] + found[measure] for measure in MEASURES}
        count += 1
        if folder is not None and number < pictures:
            folder.mkdir(parents=True, exist_ok=True)
            both = torch.cat((sample.targets.images[0], drawn.clamp(0, 1).float().cpu()), dim=1)
            write_image(folder / f"{name}_{number}.png", both)
    return {measure: sums[measure] / count for measure in MEASURES}


def _measure(
    network: PanSplat | MVSplat, sample: Sample, renderer: TargetRenderer, tiles: int
) -> tuple[dict[str, float], Tensor]:
    """The measures of a sample's first target, and the picture drawn of it."""
    weight = next(network.parameters())
    batch = as_type(collate([sample]), weight.dtype).to(weight.device)
    matched = network.match_views(batch.images, batch.cam2world, batch.near, batch.far)
    (scene,) = merge_tiles(list(network.lift_gaussians(matched, tiles=tiles)), network.compat)
    drawn = renderer.render(scene, batch.target_cam2world[0, 0], batch.cam2world[0])
    truth = batch.target_images[0, 0]
    error = math.nan
    if batch.depths is not None:
        depth = matched.depths.depth[-1]
        known = torch.nn.functional.interpolate(batch.depths, depth.shape[-2:], mode="nearest-exact")
        seen = (known > batch.near[..., None, None]) & (known < batch.far[..., None, None])
        error = float(((depth - known).abs() / known)[seen].mean())
    numbers = {"psnr": psnr(drawn, truth), "ws_psnr": ws_psnr(drawn, truth), "ssim": ssim(drawn, truth)}
    return {**numbers, "depth_error": error}, drawn


def _readable(source: SampleSource, count: int, height: int) -> Iterator[Sample]:
    """The first samples that can be read.

    Raises:
        InputError: none can.
    """
    failures, given = [], 0
    for index in range(min(count, len(source))):
        try:
            yield source.sample(index, height, 0)
            given += 1
        except InputError as error:
            failures.append(str(error))
    if not given:
        raise InputError(f"needed samples to validate with, got none that can be read: {'; '.join(failures[:3])}")
