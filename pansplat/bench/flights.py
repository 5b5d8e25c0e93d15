"""`pansplat bench flights`: pictures on the way between two panoramas, against the truth.

A row is a pair with targets, and a way to draw: "deferred" (views drawn one by one and mixed), "joint" (each surface
once, as pages and files have it), and each view alone. Values are means over the targets: `ws_psnr_db`, `lpips`, and
`jumps`, the fraction of pixels beside a jump of depth, which flakes and shreds of surfaces increase; `true_jumps` is
that of the true depth, where the targets have one. `predict_s` and `predict_ratio` are as in `pansplat bench refine`.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray as Array

from pansplat import pipeline
from pansplat.bench.harness import MEAN, Header, Suite, announce, make_axes
from pansplat.bench.refine import time_prediction
from pansplat.evaluation.lpips import Lpips
from pansplat.evaluation.metrics import ws_psnr
from pansplat.evaluation.report import warm_up
from pansplat.evaluation.results import Column, Row, average_rows
from pansplat.gaussians.scene import Scene
from pansplat.inputs.pairs import Pair
from pansplat.inputs.views import Views
from pansplat.refinement import fuse_views

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ROWS, _FIRST, _LAST = 256, 32, 224  # rows of depth maps in which jumps are counted; those at the poles are left out
_JUMP = math.log(1.1)  # of depth between two pixels


def measure_flights(pairs: Sequence[Pair], model: str, height: int, lpips: Lpips | None) -> Iterator[Row]:
    """Yield a row for each pair and way to draw, then the means over the pairs.

    Args:
        model: name of a predictor, or a file of weights.
        height: of the panoramas, pixels.
        lpips: None for no LPIPS.
    """
    predictor = pipeline.load_model(model)
    warm_up(predictor)
    rows = []
    for pair in pairs:
        announce(pair.name)
        context, targets = pair.load_context(height), pair.load_targets(height)
        scene, times = time_prediction(context, predictor)
        drawings: dict[str, tuple[Scene, str | int]] = {"deferred": (scene, "deferred")}
        drawings["joint"] = fuse_views(scene), "joint"
        drawings |= {f"view {view}": (scene, view) for view in range(len(context.images))}
        for name, (drawn, blend) in drawings.items():
            errors = _compare(drawn, blend, targets, lpips)
            rows.append(Row({"suite": "flights", "scene": pair.name, "drawing": name}, {**errors, **times}))
            yield rows[-1]
    for row in average_rows(rows, ("suite", "drawing")):
        yield Row({"scene": MEAN, **row.case}, row.values)


@torch.no_grad()
def _compare(scene: Scene, blend: str | int, targets: Views, lpips: Lpips | None) -> dict[str, float]:
    """Mean errors over the targets."""
    values: dict[str, list[float]] = {}
    for number, (pose, image) in enumerate(zip(targets.cam2world, targets.images, strict=True)):
        drawn = pipeline.render(scene, pose, blend=blend, size=(image.shape[-2], image.shape[-1]))
        values.setdefault("ws_psnr_db", []).append(ws_psnr(drawn.color.float(), image))
        if lpips is not None:
            values.setdefault("lpips", []).append(lpips.distance(drawn.color.float(), image))
        values.setdefault("jumps", []).append(measure_jumps(drawn.depth.numpy()))
        if targets.depths is not None:
            values.setdefault("true_jumps", []).append(measure_jumps(targets.depths[number].numpy()))
    return {name: statistics.fmean(numbers) for name, numbers in values.items()}


def measure_jumps(depth: Float[Array, "h w"]) -> float:
    """Fraction of the pixels beside a jump of depth of more than 10 %, at 256x512, without the poles."""
    size = (2 * _ROWS, _ROWS)
    log_depth = np.log(np.maximum(cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST_EXACT), 1e-3))
    across = np.abs(log_depth - np.roll(log_depth, -1, axis=1)) > _JUMP
    along = np.abs(np.diff(log_depth, axis=0)) > _JUMP
    beside = across | np.roll(across, 1, axis=1)
    beside[1:] |= along
    beside[:-1] |= along
    return float(beside[_FIRST:_LAST].mean())


def plot_flights(rows: Sequence[Row], header: Header) -> Figure:
    """Plot LPIPS and the fraction of jumps of each pair, by way to draw."""
    figure, axes = make_axes(2, (12, 4))
    pairs = [row for row in rows if row.get("scene") != MEAN]
    for drawing in dict.fromkeys(row.get("drawing") for row in pairs):
        chosen = [row for row in pairs if row.get("drawing") == drawing]
        for axis, name in zip(axes, ("lpips", "jumps"), strict=True):
            axis.plot([row.get("scene") for row in chosen], [row.get(name) for row in chosen], "o", label=drawing)
    truth = [row for row in pairs if row.get("drawing") == "deferred"]
    axes[1].plot([row.get("scene") for row in truth], [row.get("true_jumps") for row in truth], "k_", label="truth")
    for axis, label in zip(
        axes, (header["lpips"] or "LPIPS", "fraction of pixels beside a jump of depth"), strict=True
    ):
        axis.set(ylabel=label)
        axis.tick_params(axis="x", rotation=90)
        axis.legend(fontsize=8)
    return figure


FLIGHTS = Suite(
    "flights",
    (
        Column("drawing", "drawing"),
        Column("WS-PSNR dB", "ws_psnr_db", ".2f"),
        Column("LPIPS", "lpips", ".3f"),
        Column("jumps", "jumps", ".4f"),
        Column("true jumps", "true_jumps", ".4f"),
        Column("predict s", "predict_s", ".1f"),
        Column("predict ratio", "predict_ratio", ".0f"),
    ),
    lambda row: row.get("scene"),
    plot_flights,
    width=110,
)
