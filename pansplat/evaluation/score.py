"""One case of a test set: predict once, draw the targets, measure.

Source: OFFICIAL.md, section 13.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat import pipeline
from pansplat.data.sample import Sample
from pansplat.data.views import Views
from pansplat.evaluation.depth_metrics import DepthErrors, depth_errors
from pansplat.evaluation.lpips import Lpips
from pansplat.evaluation.metrics import psnr, ssim, ws_psnr
from pansplat.gaussians.gaussians import Gaussians
from pansplat.gaussians.scene import Scene
from pansplat.model.network import NetworkPredictor
from pansplat.pipeline import Drawing
from pansplat.predictor import Predictor

Blend = Literal["joint", "deferred"]


@dataclass(frozen=True)
class Method:
    """A predictor with the way its Gaussians are drawn: a row of a table.

    Attributes:
        blend: how the views' Gaussians are brought together.
        drawing: see `pipeline.render`.
    """

    name: str
    predictor: Predictor
    blend: Blend
    drawing: Drawing = "exact"


@dataclass(frozen=True)
class Score:
    """Figures of one target: dB, SSIM, and LPIPS where its weights are here."""

    case: str
    target: str
    ws_psnr: float
    psnr: float
    ssim: float
    lpips: float | None


@dataclass(frozen=True)
class Prediction:
    """What a predictor makes of a case.

    Attributes:
        depth: radial, metres, of the inputs at the finest level that was swept; None where the predictor has none.
        seconds: the prediction took.
    """

    scene: Scene
    depth: Float[Tensor, "view _ _"] | None
    seconds: float


@dataclass(frozen=True)
class Drawn:
    """A target as drawn, with its figures."""

    score: Score
    picture: Float[Tensor, "3 height width"]
    target: Float[Tensor, "3 height width"]
    seconds: float


def predict_case(context: Views, predictor: Predictor) -> Prediction:
    """The scene of a case's inputs, and their depth where the predictor is a network."""
    masks = None if bool(context.masks.all()) else context.masks
    inputs = (context.images, context.cam2world, context.near, context.far)
    began = time.perf_counter()
    depth = None
    if isinstance(predictor, NetworkPredictor):
        gaussians, depths = predictor.predict_with_depths(*inputs, masks=masks)
        depth = depths[-1]
    else:
        gaussians = predictor(*inputs, masks=masks)
    seconds = time.perf_counter() - began
    assert isinstance(gaussians, Gaussians)  # a list answers a batch only
    scene = Scene(
        gaussians,
        context.cam2world,
        near=context.near,
        far=context.far,
        names=context.names,
        model=predictor.name,
        height=context.images.shape[-2],
    )
    return Prediction(scene, depth, seconds)


def draw_targets(
    sample: Sample, prediction: Prediction, blend: Blend, lpips: Lpips | None, drawing: Drawing = "exact"
) -> Iterator[Drawn]:
    """Each target of the case, drawn and measured; nothing is clamped but for PSNR, nothing masked."""
    for index, target in enumerate(sample.targets.images):
        began = time.perf_counter()
        with torch.no_grad():
            pose, size = sample.targets.cam2world[index], (target.shape[-2], target.shape[-1])
            drawn = pipeline.render(prediction.scene, pose, blend=blend, size=size, drawing=drawing)
            picture = drawn.color.float()
        seconds = time.perf_counter() - began
        score = Score(
            case=sample.name,
            target=sample.targets.names[index],
            ws_psnr=ws_psnr(picture, target),
            psnr=psnr(picture, target),
            ssim=ssim(picture, target),
            lpips=None if lpips is None else lpips.of_pictures(picture, target),
        )
        yield Drawn(score, picture, target, seconds)


def measure_depth(context: Views, prediction: Prediction) -> DepthErrors | None:
    """Errors of the inputs' depth; None where there is no true depth.

    A predictor without depth maps is measured by what its Gaussians draw at each input, from that input's own.
    """
    if context.depths is None:
        return None
    depth = prediction.depth
    if depth is None:
        size = (context.images.shape[-2], context.images.shape[-1])
        with torch.no_grad():
            drawn = [
                pipeline.render(prediction.scene, pose, blend=view, size=size).depth
                for view, pose in enumerate(context.cam2world)
            ]
        depth = torch.stack(drawn)
    return depth_errors(depth, context.depths, context.near, context.far)


def mean_depth_errors(errors: list[DepthErrors]) -> DepthErrors | None:
    """Mean over the scenes; None where there are none."""
    if not errors:
        return None
    names = [field.name for field in dataclasses.fields(DepthErrors)]
    return DepthErrors(*(sum(getattr(error, name) for error in errors) / len(errors) for name in names))
