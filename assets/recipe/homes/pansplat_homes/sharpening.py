"""Training of the sharpening network on single panoramas of tours of generated homes.

`pansplat-homes train-sharpening --out RUN --tours SHARDS...` trains until it is stopped; the options and the files are
those of `train-depth`. The tours have panoramas of 384 rows. The depth network is not trained.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from pansplat.geometry.equirect import resize_equirect, row_weights
from pansplat.inputs.views import Views
from pansplat.networks.depth_network import DepthEstimate
from pansplat.networks.depth_refinement import DepthRefinement
from pansplat.networks.depth_sharpening import DepthSharpening, SharpeningConfig
from pansplat.networks.layers import to_channels_last
from pansplat.sweep.guided_sweep import default_weights, load_network, save_network
from pansplat_homes.depth import MAX_DEPTH, DepthTrainConfig, DepthTrainer, Sample, run_trainer
from pansplat_homes.panes import close_panes

_NETWORK_HEIGHT = 128  # rows that the depth network sees
_SCALES = (1, 2, 4, 8)  # pixels, of the loss on differences between neighbours
_DIFFERENCE_WEIGHT, _LIKELIHOOD_WEIGHT = 2.0, 0.5
_NOISE = (0.0, 0.05, 0.12)  # deviations of the logarithm of the estimate, one of which is drawn for each panorama
_NOISE_CELLS = (4, 8)  # of the smooth noise: photographs of real rooms have larger errors than generated ones


@dataclass(frozen=True)
class SharpeningTrainConfig(DepthTrainConfig):
    """A training run of the sharpening network."""

    steps: int = 4000
    decay_steps: int = 1000
    warm_up: int = 100
    pairs: int = 1
    rate: float = 3e-4
    encoder_rate: float = 1e-4
    ema: float = 0.998
    validate_every: int = 250
    depth: Path = field(default_factory=default_weights)
    """Weights of the depth network, from which the sharpening network also starts."""
    network: SharpeningConfig = field(default_factory=SharpeningConfig)  # pyright: ignore[reportIncompatibleVariableOverride]

    def run(self) -> int:
        """Train, and return the exit status of the command."""
        return run_trainer(SharpeningTrainer, self)


class SharpeningTrainer(DepthTrainer):
    """A training run, resumed from its latest checkpoint if there is one."""

    TERMS = ("loss", "error", "differences", "likelihood", "estimate_error")

    def make_network(self) -> DepthSharpening:
        self.depth_network = load_network(self.config.depth, DepthRefinement).mono.to(self.device)
        return DepthSharpening(self.config.network)

    def load_start(self, path: Path | None) -> None:
        if path is not None:
            self.network.load_state_dict(load_network(path, DepthSharpening).state_dict())
            return
        start_from_depth_network(self.network, self.depth_network.state_dict())

    def compute_terms(
        self, network: DepthSharpening, samples: list[Sample], generator: torch.Generator | None
    ) -> dict[str, Tensor]:
        """Loss terms of panoramas and the camera heights; without a generator the estimates have no noise."""
        images = to_channels_last(torch.cat([views.images for views, _ in samples]).to(self.device))
        depth = torch.cat([_make_target(views, heights) for views, heights in samples])
        with torch.no_grad():
            small = interpolate(images, (_NETWORK_HEIGHT, 2 * _NETWORK_HEIGHT), mode="area")
            estimate = self.depth_network(to_channels_last(small))
        if generator is not None:
            deviations = torch.tensor(_NOISE)[torch.randint(len(_NOISE), (len(images),), generator=generator)]
            noise = torch.randn(len(images), 1, *_NOISE_CELLS, generator=generator) * deviations[:, None, None, None]
            noise = resize_equirect(noise, estimate.log_depth.shape[-2:])[:, 0]
            estimate = DepthEstimate(estimate.log_depth + noise.to(self.device), estimate.log_scale)
        with torch.autocast(self.device.type, torch.bfloat16):
            log_depth, half = network(images, estimate)
        return sharpening_loss(log_depth, half, depth.to(self.device)) | {
            "estimate_error": _mean_error(resize_equirect(estimate.log_depth[:, None], depth.shape[-2:])[:, 0], depth)
        }

    def save_network(self, path: Path) -> None:
        save_network(path, self.network, self.average.state)


def _make_target(views: Views, camera_heights: Float[Tensor, "view"]) -> Float[Tensor, "view h w"]:
    """Depth in camera heights, with panes closed; 0 where it is unknown."""
    assert views.depths is not None
    relative = (views.depths / camera_heights[:, None, None]).numpy()
    return torch.from_numpy(np.stack([close_panes(depth, np.random.default_rng(0)) for depth in relative]))


def sharpening_loss(
    log_depth: Float[Tensor, "batch height width"], half: DepthEstimate, depth: Float[Tensor, "batch height width"]
) -> dict[str, Tensor]:
    """Loss terms: absolute error, differences between neighbours at full size, and the likelihood at half.

    Args:
        log_depth, half: of the network.
        depth: in camera heights; 0 where it is unknown.
    """
    known, target = depth > 0, depth.clamp(1e-3, MAX_DEPTH).log()
    weight = known * row_weights(depth.shape[-2], dtype=torch.float32)[:, None].to(depth.device)
    weight = weight / weight.sum().clamp_min(1e-6)
    error = log_depth - target
    differences = error.new_zeros(())
    for step in _SCALES:
        across = weight * known.roll(-step, -1) * (error.roll(-step, -1) - error).abs()
        along = weight * known.roll(-step, -2) * (error.roll(-step, -2) - error).abs()
        differences = differences + (across.sum() + along[:, :-step].sum()) / len(_SCALES)
    at_half = weight[:, ::2, ::2] / weight[:, ::2, ::2].sum().clamp_min(1e-6)
    deviation = (half.log_depth - target[:, ::2, ::2]).abs() * (-half.log_scale).exp() + half.log_scale
    likelihood = (at_half * deviation).sum()
    absolute = (weight * error.abs()).sum()
    return {
        "loss": absolute + _DIFFERENCE_WEIGHT * differences + _LIKELIHOOD_WEIGHT * likelihood,
        "error": absolute,
        "differences": differences,
        "likelihood": likelihood,
    }


def _mean_error(log_depth: Tensor, depth: Tensor) -> Tensor:
    weight = (depth > 0) * row_weights(depth.shape[-2], dtype=torch.float32)[:, None].to(depth.device)
    error = (log_depth - depth.to(log_depth).clamp(1e-3, MAX_DEPTH).log()).abs()
    return (weight * error).sum() / weight.sum().clamp_min(1e-6)


def start_from_depth_network(network: DepthSharpening, weights: dict[str, Tensor]) -> None:
    """Copy a depth network's weights; those of the inputs and layers that it lacks start at zero or at random."""
    own = network.state_dict()
    for name, value in weights.items():
        if name in own and own[name].shape == value.shape:
            own[name] = value
        elif name in own and own[name].shape[2:] == value.shape[2:] and len(own[name]) == len(value) and value.ndim > 2:
            own[name].zero_()[:, : value.shape[1]] = value
    network.load_state_dict(own)
