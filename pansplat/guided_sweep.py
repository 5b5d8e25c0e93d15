"""The default predictor: a sweep with a prior of depth from a small trained network."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from pansplat.model.depth_network import DepthEstimate
from pansplat.model.depth_refinement import DepthRefinement, Observations
from pansplat.model.layers import to_channels_last
from pansplat.sweep.prior import DepthPrior


class NetworkPrior:
    """A `PriorModel` of a depth network.

    Args:
        network: in eval mode.
        fingerprint: changes with the weights.
        height: height of the panoramas that the network sees, pixels.
    """

    def __init__(self, network: DepthRefinement, fingerprint: str, height: int = 128) -> None:
        self.network, self.fingerprint, self.height = network, fingerprint, height

    @torch.no_grad()
    def observe(self, images: Sequence[np.ndarray]) -> NetworkObservation:
        """Observe upright panoramas (h, w, 3), RGB in [0, 1]."""
        maps = torch.stack([torch.from_numpy(image).permute(2, 0, 1) for image in images]).float()
        small = torch.nn.functional.interpolate(maps, (self.height, 2 * self.height), mode="area")
        estimate, observed = self.network.observe(to_channels_last(small))
        return NetworkObservation(self.network, estimate, observed)


class NetworkObservation:
    """`ObservedViews` of a depth network."""

    def __init__(self, network: DepthRefinement, estimate: DepthEstimate, observed: Observations) -> None:
        self.network, self._estimate, self._observed = network, estimate, observed
        self.priors = _as_priors(estimate)

    @torch.no_grad()
    def refine(self, camera_heights: Sequence[float], cam2world: np.ndarray, iterations: int) -> list[DepthPrior]:
        """The estimates in the unit of the poses (v, 4, 4), refined by comparison of the views."""
        factor = torch.tensor(camera_heights, dtype=torch.float32).log()[:, None, None]
        estimate = DepthEstimate(self._estimate.log_depth + factor, self._estimate.log_scale)
        count = len(camera_heights)
        pairs = [(view, other) for view in range(count) for other in range(count) if other != view]
        for _ in range(iterations):
            estimate = self.network.refine(self._observed, estimate, torch.from_numpy(cam2world), pairs)
        return _as_priors(estimate)


def _as_priors(estimate: DepthEstimate) -> list[DepthPrior]:
    return [
        DepthPrior(log_depth.float().numpy(), log_scale.exp().float().numpy())
        for log_depth, log_scale in zip(estimate.log_depth, estimate.log_scale, strict=True)
    ]
