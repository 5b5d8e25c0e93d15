"""The default predictor: a sweep with a prior of depth from a small trained network."""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache, partial
from importlib.resources import files
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from pansplat.errors import InputError
from pansplat.networks.depth_network import DepthEstimate
from pansplat.networks.depth_refinement import DepthRefinement, Observations, RefinementConfig
from pansplat.networks.depth_sharpening import DepthSharpening, SharpeningConfig
from pansplat.networks.layers import to_channels_last
from pansplat.networks.relative_depth import RelativeDepthNetwork, load_relative_depth
from pansplat.networks.weights import (
    build_on_meta,
    config_from_dict,
    load_weights,
    pack_weights,
    require_shapes,
    save_weights,
)
from pansplat.sweep import Sweep
from pansplat.sweep.joined_crops import crop_panorama, join_crops
from pansplat.sweep.panoramas import resize_sphere
from pansplat.sweep.prior import DepthPrior
from pansplat.sweep.search import SearchConfig
from pansplat.system.devices import choose_device
from pansplat.system.source_hash import hash_sources

# Names in files of weights, and types of settings.
_KINDS: dict[type, tuple[str, type]] = {
    DepthRefinement: ("depth", RefinementConfig),
    DepthSharpening: ("depth_sharpening", SharpeningConfig),
}
_PANORAMA_SECONDS = 1.0  # time that the networks take for a panorama on two cores
_SEARCH_HEIGHT = 384  # rows; 512 take 1.6 times as long, 256 break stems of lamps (docs/what_was_tried.md)


def load_guided_sweep(path: Path, name: str = "default", depth_network: Path | str | None = None) -> Sweep:
    """The sweep guided by the network of a weights file, with the package's sharpening network.

    Args:
        depth_network: an ONNX file whose network replaces the sharpening network (`networks.relative_depth`).
    """
    files_of_weights = path, _shipped("sharpening.safetensors")
    relative = None if depth_network is None else load_relative_depth(depth_network)
    digest = hashlib.blake2b(b"".join(file.read_bytes() for file in files_of_weights), digest_size=8)
    fingerprint = digest.hexdigest() + hash_sources(__name__) + ("" if relative is None else relative.fingerprint)
    prior = NetworkPrior(partial(_load_networks, *files_of_weights), fingerprint, relative=relative)
    if path != default_weights():
        _ = prior.networks  # other files are refused before the work begins
    # A user's network has better shapes than ours, whose scale errs so that the whole range of depth is searched.
    return Sweep(SearchConfig(_SEARCH_HEIGHT, near_single_views=relative is not None), prior, name)


@lru_cache(maxsize=1)
def load_default_sweep() -> Sweep:
    """The guided sweep of the weights that the package ships; it is loaded once."""
    return load_guided_sweep(default_weights())


def _load_networks(path: Path, sharpening: Path) -> tuple[DepthRefinement, DepthSharpening]:
    return load_network(path, DepthRefinement), load_network(sharpening, DepthSharpening)


Network = TypeVar("Network", DepthRefinement, DepthSharpening)


def load_network(path: Path, network_type: type[Network]) -> Network:
    """The network of a file of `save_network`, in eval mode; all names and shapes of the weights must fit."""
    model, config_type = _KINDS[network_type]
    weights = load_weights(path)
    if weights.model != model:
        raise InputError(f"{path}: needed weights of a {model} network, got weights of {weights.model!r}")
    config = config_from_dict(config_type, weights.config, f"{path}: config")
    expected = build_on_meta(lambda: network_type(config), model, path).state_dict()
    require_shapes(weights.tensors, expected, path)
    network = network_type(config)
    network.load_state_dict(weights.tensors)
    return network.eval()


def save_network(path: Path, network: DepthRefinement | DepthSharpening, state: dict[str, Tensor]) -> None:
    """Write a network's weights: kernels in float16, the rest in float32.

    Args:
        state: the weights, such as their moving average.
    """
    half = {name: t.half() if t.is_floating_point() and t.ndim > 1 else t for name, t in state.items()}
    save_weights(path, pack_weights(_KINDS[type(network)][0], network.config, half, compat="fixed"))


def default_weights() -> Path:
    """The weights of the depth network that the package ships."""
    return _shipped("model.safetensors")


def list_default_weights() -> list[Path]:
    """The files of weights of the default model."""
    return [default_weights(), _shipped("sharpening.safetensors")]


def _shipped(name: str) -> Path:
    return Path(str(files("pansplat.default_model").joinpath(name)))


class NetworkPrior:
    """Estimates of depth by a depth network. `fingerprint` changes whenever they could.

    Args:
        load: reads the two networks, in eval mode, when they are needed first.
        fingerprint: changes with the weights.
        height: height of the panoramas that the depth network sees, pixels.
        relative: replaces the sharpening network.
    """

    def __init__(
        self,
        load: Callable[[], tuple[DepthRefinement, DepthSharpening]],
        fingerprint: str,
        height: int = 128,
        relative: RelativeDepthNetwork | None = None,
    ) -> None:
        self._load, self.fingerprint, self.height, self.relative = load, fingerprint, height, relative

    @cached_property
    def networks(self) -> tuple[DepthRefinement, DepthSharpening]:
        """The network, and the one that sharpens its estimate."""
        return self._load()

    @torch.no_grad()
    def observe(self, images: Sequence[np.ndarray]) -> NetworkObservation:
        """Observe upright panoramas (h, w, 3), RGB in [0, 1]."""
        device = choose_device("depth networks", len(images) * _PANORAMA_SECONDS)
        network, sharpening = self.networks
        if device.type != "cpu":  # other threads use these networks, too, so they are copied
            network, sharpening = (copy.deepcopy(each).to(device) for each in (network, sharpening))
        maps = torch.stack([torch.from_numpy(image).permute(2, 0, 1) for image in images]).float()
        small = interpolate(maps, (self.height, 2 * self.height), mode="area")
        estimate, observed = network.observe(to_channels_last(small.to(device)))
        return NetworkObservation(network, estimate, observed, partial(self._sharpen, sharpening, maps, estimate))

    @torch.no_grad()
    def _sharpen(
        self, sharpening: DepthSharpening, maps: Float[Tensor, "view 3 h w"], estimate: DepthEstimate
    ) -> list[np.ndarray]:
        """Sharpened log-depth of the panoramas, in camera heights; one after another, in bounded memory."""
        height, device = sharpening.config.height, "cpu" if self.relative else estimate.log_depth.device
        each = [DepthEstimate(*(map[n : n + 1].to(device) for map in estimate)) for n in range(len(maps))]
        if self.relative is not None:
            rows = min(height, maps.shape[-2])
            return [
                join_crops(self.relative.estimate(crop_panorama(image, self.relative.size)), own, rows).float().numpy()
                for image, own in zip(maps, each, strict=True)
            ]
        large = [torch.from_numpy(resize_sphere(_as_image(m), height)).permute(2, 0, 1)[None] for m in maps]
        sharp = [sharpening(to_channels_last(image.to(device)), own)[0] for image, own in zip(large, each, strict=True)]
        return [log_depth[0].float().cpu().numpy() for log_depth in sharp]


class NetworkObservation:
    """The depth network's view of upright panoramas.

    Attributes:
        priors: the estimate of each panorama by itself, in units of its camera's height.
        sharpen: returns log-depth (h, w) of each panorama by itself, larger than the priors, with the edges of the
            photograph.
    """

    def __init__(
        self,
        network: DepthRefinement,
        estimate: DepthEstimate,
        observed: Observations,
        sharpen: Callable[[], list[np.ndarray]],
    ) -> None:
        self.network, self._observed, self.sharpen = network, observed, sharpen
        self.priors = _as_priors(estimate)

    @torch.no_grad()
    def refine(
        self,
        estimates: Sequence[DepthPrior],
        cam2world: np.ndarray,
        neighbours: Sequence[Sequence[int]],
        iterations: int,
    ) -> list[DepthPrior]:
        """Estimates in the unit of the poses (v, 4, 4), refined by comparison of each view with its neighbours."""
        device = next(self.network.parameters()).device
        log_depth = torch.from_numpy(np.stack([estimate.log_depth for estimate in estimates])).float().to(device)
        log_scale = torch.from_numpy(np.stack([estimate.scale for estimate in estimates])).float().to(device).log()
        estimate = DepthEstimate(log_depth, log_scale)
        pairs = [(view, other) for view, others in enumerate(neighbours) for other in others]
        for _ in range(iterations):
            estimate = self.network.refine(self._observed, estimate, torch.from_numpy(cam2world).to(device), pairs)
        return _as_priors(estimate)


def _as_image(maps: Float[Tensor, "c h w"]) -> np.ndarray:
    return np.ascontiguousarray(maps.permute(1, 2, 0).numpy())


def _as_priors(estimate: DepthEstimate) -> list[DepthPrior]:
    return [
        DepthPrior(log_depth.float().cpu().numpy(), log_scale.exp().float().cpu().numpy())
        for log_depth, log_scale in zip(estimate.log_depth, estimate.log_scale, strict=True)
    ]
