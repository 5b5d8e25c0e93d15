"""Predictors that run a network: loading, input checks, tiles, masks, batches and the cache fingerprint."""

from __future__ import annotations

import functools
import hashlib
import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.equirect import fit_panoramas, uv_from_directions
from pansplat.geometry.world import require_working_world
from pansplat.model.heads import MatchedViews, TileGaussians, merge_tiles
from pansplat.model.official_weights import convert_tensors
from pansplat.model.pansplat import PanSplat, PanSplatConfig
from pansplat.networks.layers import Compat, Precision, require_views
from pansplat.networks.weights import (
    CHECKPOINT_SUFFIXES,
    WeightsFile,
    build_on_meta,
    config_from_dict,
    load_weights,
    pack_weights,
    read_checkpoint,
    require_shapes,
)
from pansplat.prediction_options import CompatChoice
from pansplat.predictor import require_matching_inputs, select_item
from pansplat.system.devices import choose_device, note_full_card
from pansplat.system.progress import report_progress
from pansplat.system.source_hash import hash_sources

_UNTILED_HEIGHT = 512  # rows; above, the number of tiles along each side doubles with the height
_HEIGHT_MULTIPLE = 32  # divides the working height, for levels, windows and their shifts
_MATCHING_FRACTION = 0.4  # fraction of the prediction's time that matching takes, for the progress


class NetworkPredictor:
    """A `Predictor` that runs a network.

    Args:
        name: name of the predictor in messages and scene files.
        network: the network, which is set to eval mode.
        tiles: tiles along each side of the panorama; by default `choose_tiles`.
    """

    min_views = 2
    """Number of panoramas below which nothing is predicted; 1 if a predictor states none."""

    def __init__(self, name: str, network: PanSplat, *, tiles: int | None = None) -> None:
        self.name = name
        network.eval()
        self.network = network
        self.tiles = tiles

    def __repr__(self) -> str:
        millions = sum(parameter.numel() for parameter in self.network.parameters()) / 1e6
        return (
            f"<NetworkPredictor {self.name}: {type(self.network).__name__} of {millions:.1f} million parameters, "
            f"{self.network.compat}, for {self.min_views} or more panoramas>"
        )

    @functools.cached_property
    def fingerprint(self) -> str:
        """Hash of weights, settings and source code, so that a cached prediction is never outdated."""
        network = self.network
        precisions = (network.precision, network.attention_precision)
        settings = (network.config, network.compat, *precisions, self.tiles, hash_sources(__name__))
        digest = hashlib.blake2b(repr(settings).encode(), digest_size=8)
        for name, tensor in sorted(self.network.state_dict().items()):
            digest.update(name.encode())
            digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
        return f"{self.name}-{self.network.compat}-{digest.hexdigest()}"

    def __call__(
        self,
        images: Float[Tensor, "*batch view 3 height width"],
        cam2world: Float[Tensor, "*batch view 4 4"],
        near: float | Tensor,
        far: float | Tensor,
        *,
        masks: Bool[Tensor, "*batch view height width"] | None = None,
    ) -> Gaussians | list[Gaussians]:
        """Predict from RGB in [0, 1] and OpenCV cam2world poses (metres); a list when there is a batch axis.

        Args:
            near, far: radial depth range, metres: a number, or a tensor with one value per batch item or view.
            masks: True where a pixel shows the scene; Gaussians elsewhere are removed.
        """
        if images.ndim == 5:
            return [
                self._predict(
                    images[n],
                    cam2world[n],
                    select_item(near, n),
                    select_item(far, n),
                    None if masks is None else masks[n],
                )
                for n in range(len(images))
            ]
        return self._predict(images, cam2world, near, far, masks)

    def _predict(
        self, images: Tensor, cam2world: Tensor, near: float | Tensor, far: float | Tensor, masks: Tensor | None
    ) -> Gaussians:
        parts = list(self._list_parts(images, cam2world, near, far, masks))
        gaussians = merge_tiles(parts, self.network.compat)[0]
        return gaussians if masks is None else remove_masked_gaussians(gaussians, cam2world, masks)

    def stream(
        self,
        images: Float[Tensor, "view 3 height width"],
        cam2world: Float[Tensor, "view 4 4"],
        near: float | Tensor,
        far: float | Tensor,
        *,
        masks: Bool[Tensor, "view height width"] | None = None,
    ) -> Iterator[Gaussians]:
        """Yield the Gaussians of `__call__` tile by tile, in bounded memory; errors are raised at the first part."""
        for part in self._list_parts(images, cam2world, near, far, masks):
            (gaussians,) = part.gaussians
            yield gaussians if masks is None else remove_masked_gaussians(gaussians, cam2world, masks)

    def _list_parts(
        self, images: Tensor, cam2world: Tensor, near: float | Tensor, far: float | Tensor, masks: Tensor | None
    ) -> Iterator[TileGaussians]:
        """Yield the Gaussians of one item tile by tile.

        Out of a card's memory there are more tiles if none was made, then the processor makes those that are left.
        """
        tiles = first = self.tiles or choose_tiles(images.shape[-2])
        done, parts = 0, None
        while True:
            with torch.no_grad():  # the block ends before each yield, so that the caller keeps its own mode
                try:
                    if parts is None:
                        matched = self._match(images, cam2world, near, far, masks, tiles)
                        parts = itertools.islice(self._lift(matched, tiles), done, None)
                    part = next(parts, None)
                except torch.cuda.OutOfMemoryError:  # only a graphics card raises it
                    matched = parts = None
                    if done == 0 and tiles < 4 * first:
                        tiles *= 2
                        note_full_card(self.name, f"{tiles}x{tiles} tiles")
                    else:
                        tiles = tiles if done else first
                        note_full_card(self.name)
                        self.network.cpu()
                    continue
            if part is None:
                return
            done += 1
            yield TileGaussians([part.gaussians[0].to(device=images.device)], part.index)

    def _match(
        self,
        images: Tensor,
        cam2world: Tensor,
        near: float | Tensor,
        far: float | Tensor,
        masks: Tensor | None,
        tiles: int,
    ) -> MatchedViews:
        """Check and match the views of one item, for a number of tiles along each side."""
        views = len(images)
        low, high = (torch.as_tensor(bound, dtype=torch.float32) for bound in (near, far))
        _check_inputs(images, cam2world, low, high, masks, self.network.compat)
        report_progress("matching views", 0.0)
        weight = next(self.network.parameters())
        images, _ = fit_panoramas(images, None, max(_HEIGHT_MULTIPLE, 8 * tiles))
        pose = cam2world.to(device=weight.device, dtype=weight.dtype)
        near_views, far_views = (bound.to(weight).expand(views)[None] for bound in (low, high))
        return self.network.match_views(images.to(weight)[None], pose[None], near_views, far_views)

    def _lift(self, matched: MatchedViews, tiles: int) -> Iterator[TileGaussians]:
        report_progress("making Gaussians", _MATCHING_FRACTION)
        for done, part in enumerate(self.network.lift_gaussians(matched, tiles=tiles), start=1):
            yield part
            report_progress("making Gaussians", _MATCHING_FRACTION + (1 - _MATCHING_FRACTION) * done / tiles**2)
        report_progress("done", 1.0)


def choose_tiles(height: int) -> int:
    """Tiles along each side: 1 up to 512 rows, 2 up to 1024, 4 above, as in the paper."""
    return 1 if height <= _UNTILED_HEIGHT else 2 if height <= 2 * _UNTILED_HEIGHT else 4


def remove_masked_gaussians(
    gaussians: Gaussians, cam2world: Float[Tensor, "view 4 4"], masks: Bool[Tensor, "view height width"]
) -> Gaussians:
    """Keep the Gaussians whose mean projects into the mask of their own view."""
    height, width = masks.shape[-2:]
    kept = torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
    for view, (pose, mask) in enumerate(zip(cam2world.to(gaussians.means), masks, strict=True)):
        of_view = gaussians.views == view
        uv = uv_from_directions((gaussians.means[of_view] - pose[:3, 3]) @ pose[:3, :3])
        column, row = (uv[:, 0] * width).long(), (uv[:, 1] * height).long()
        kept[of_view] = mask.to(kept.device)[row.clamp(0, height - 1), column.clamp(0, width - 1)]
    return gaussians.select(kept)


def _check_inputs(
    images: Tensor, cam2world: Tensor, near: Tensor, far: Tensor, masks: Tensor | None, compat: Compat
) -> None:
    shape = tuple(images.shape)
    if images.ndim != 4 or shape[1] != 3 or shape[3] != 2 * shape[2]:
        raise InputError(
            f"`images` must be (view, 3, height, 2 * height), got {shape}; stack RGB equirectangular images of one size"
        )
    require_views(shape[0], compat)
    require_matching_inputs(images, cam2world, masks=masks)
    if near.numel() not in (1, shape[0]) or far.numel() not in (1, shape[0]):
        raise InputError(
            f"`near` and `far` must be one number, or one number per view, got {near.tolist()} and {far.tolist()}"
        )
    for low, high in zip(near.expand(shape[0]).tolist(), far.expand(shape[0]).tolist(), strict=True):
        require_working_world(cam2world, low, high)


def load_network_predictor(
    path: str | Path,
    compat: CompatChoice = "trained",
    *,
    precision: Precision = "float32",
    attention_precision: Precision = "float32",
) -> NetworkPredictor:
    """Load a predictor from a file of weights.

    Args:
        path: a .safetensors of `pansplat convert` or of training, or an official Lightning checkpoint.
        compat: "official" computes the numbers of the official code, "fixed" corrects its defects, "trained" is the
            mode of the training ("official" for official checkpoints).
        precision: number type of PanSplat's convolutions; docs/bench_model.md lists the time and error of bfloat16.
        attention_precision: number type that attention rounds to; bfloat16 in the official code.
    """
    path, device = Path(path), choose_device("network")
    if device.type == "cpu" or precision not in get_args(Precision):
        require_precision(precision)
    weights = read_weights(path)
    network = build_network(
        weights,
        weights.compat if compat == "trained" else compat,
        path,
        precision=precision,
        attention_precision=attention_precision,
    )
    return NetworkPredictor(weights.model, network.to(device))


def read_weights(path: Path) -> WeightsFile:
    """The content of a weights file, or that of an official checkpoint, converted."""
    is_official = path.suffix.lower() in CHECKPOINT_SUFFIXES
    return convert_checkpoint(read_checkpoint(path), path) if is_official else load_weights(path)


def convert_checkpoint(content: Mapping[str, object], source: object) -> WeightsFile:
    """The content of a weights file from that of an official checkpoint; an InputError for a modified model."""
    tensors = convert_tensors(content, source)
    weights = pack_weights(PanSplat.model, PanSplatConfig(), tensors, compat="official")
    require_shapes(tensors, build_empty_network(weights, "official", source).state_dict(), source)
    return weights


def require_precision(precision: str) -> None:
    """Raise an InputError for an unknown precision, or one without instructions of the processor."""
    if precision not in get_args(Precision):
        raise InputError(f"`precision` must be {' or '.join(get_args(Precision))}, got {precision!r}")
    if precision == "bfloat16" and not has_bfloat16():
        raise InputError(
            "`precision` bfloat16 needs a processor with bfloat16 instructions (AVX512_BF16, AMX), got one "
            "without them; use float32, which is faster on it"
        )


def has_bfloat16() -> bool:
    """Whether the processor has bfloat16 instructions; True if torch cannot detect them."""
    get_capabilities = getattr(torch.cpu, "get_capabilities", None)
    if get_capabilities is None:
        return True
    capabilities = get_capabilities()
    return any(capabilities.get(name, False) for name in ("avx512_bf16", "amx_bf16", "bf16"))


def build_network(weights: WeightsFile, compat: Compat, source: object, **choices: Any) -> PanSplat:
    """Build the network of a weights file, in eval mode.

    Args:
        choices: `precision` and `attention_precision`, as in `load_network_predictor`.
    """
    network = build_empty_network(weights, compat, source, **choices)
    require_shapes(weights.tensors, network.state_dict(), source)
    network.load_state_dict(weights.tensors, strict=True, assign=True)
    return network.eval()


def build_empty_network(
    weights: WeightsFile,
    compat: Compat,
    source: object,
    *,
    precision: Precision = "float32",
    attention_precision: Precision = "float32",
) -> PanSplat:
    """The network on the meta device, without memory for weights; an InputError if the settings fit none."""
    if weights.model != PanSplat.model:
        raise InputError(f"{source}: needed weights of {PanSplat.model}, got weights of {weights.model!r}")

    def build() -> PanSplat:
        config = config_from_dict(PanSplatConfig, weights.config, f"{source}: config")
        return PanSplat(config, compat, precision=precision, attention_precision=attention_precision)

    return build_on_meta(build, weights.model, source)
