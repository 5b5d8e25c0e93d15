"""LPIPS: the perceptual distance of two images, from the activations of an image classifier.

The classifiers (VGG-16, AlexNet, SqueezeNet 1.1) and the weights of their channels are read from the user's files;
nothing is downloaded. Layers are numbered as in torchvision, so that its files can be loaded.

Large images are processed in bands of rows: the activations of a 4K image and their gradient would take 30 GB. A block
of the classifier (the convolutions between two poolings) reads as many rows beyond a band as it has convolutions. A
band of a block's output is therefore computed with that many additional rows, which are then removed. The backward
pass computes each band again.

Source: Zhang et al., The unreasonable effectiveness of deep features as a perceptual metric, CVPR 2018, equation 1;
version 0.1 of its weights. docs/official.md, sections 11 and 13: the paper's figures are those of VGG.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterable, Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

from pansplat.errors import InputError
from pansplat.networks.weights import read_checkpoint
from pansplat.system.files import expand_home

Backbone = Literal["vgg", "alex", "squeeze"]

MIN_IMAGE_SIZE = 32
"""Least height and width of an image, pixels; the last layers have no output for a smaller one."""

# Normalisation of the classifiers' training images, for images in [-1, 1].
_MEAN = (-0.030, -0.088, -0.188)
_DEVIATION = (0.458, 0.448, 0.450)
# VGG has the largest activations: more than _MAX_WHOLE_PIXELS are processed in bands of _BAND_PIXELS.
_MAX_WHOLE_PIXELS, _BAND_PIXELS = 1 << 19, 1 << 18

_VGG = (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512)  # channels; 0 is a pooling
# Fire modules: inputs, squeezed channels, expanded channels by each of two convolutions; 0 is a pooling.
_SQUEEZE = ((64, 16, 64), (128, 16, 64), 0, (128, 32, 128), (256, 32, 128), 0, (256, 48, 192), (384, 48, 192))

# Layers whose activations are compared, with their number of channels.
LAYER_CHANNELS: dict[Backbone, dict[int, int]] = {
    "vgg": {3: 64, 8: 128, 15: 256, 22: 512, 29: 512},
    "alex": {1: 64, 4: 192, 7: 384, 9: 256, 11: 256},
    "squeeze": {1: 64, 4: 128, 7: 256, 9: 384, 10: 384, 11: 512, 12: 512},
}


class Lpips(nn.Module):
    """The metric with its weights, which are not trained; differentiable in the images."""

    def __init__(self, backbone: Backbone) -> None:
        super().__init__()
        self.backbone: Backbone = backbone
        self.name = f"lpips-{backbone}"
        self.features = _LAYERS[backbone]()
        self.heads = nn.ParameterList(torch.zeros(channels) for channels in LAYER_CHANNELS[backbone].values())
        self.requires_grad_(False)
        self.eval()

    def train(self, mode: bool = True) -> Lpips:
        """Has no effect: the metric stays in evaluation mode."""
        return super().train(False)

    def forward(
        self,
        prediction: Float[Tensor, "batch 3 height width"],
        target: Float[Tensor, "batch 3 height width"],
        weights: Float[Tensor, "batch height width"] | None = None,
    ) -> Float[Tensor, "batch"]:
        """The distance of each pair of images; 0 for equal ones.

        Args:
            prediction, target: RGB in [0, 1]; values outside are not clamped.
            weights: one for each pixel; by default equal. The prediction is not used at pixels of weight 0.
        """
        if min(target.shape[-2:]) < MIN_IMAGE_SIZE:
            size = "x".join(str(side) for side in target.shape[-2:])
            raise InputError(
                f"LPIPS needs images of {MIN_IMAGE_SIZE} pixels or more along each side, got {size}; "
                "choose a larger height, or no LPIPS"
            )
        if weights is not None:
            prediction = torch.where(weights[:, None] > 0, prediction, target)
        total = target.new_zeros(len(target))
        for layer_distances in self._compare_layers(self._normalize(prediction), self._normalize(target)):
            total = total + _average_map(layer_distances, weights)
        return total

    @torch.no_grad()
    def distance(self, prediction: Float[Tensor, "3 height width"], target: Float[Tensor, "3 height width"]) -> float:
        """The distance of two single images."""
        return float(self(prediction[None], target[None]))

    def _compare_layers(self, a: Tensor, b: Tensor) -> Iterator[Float[Tensor, "batch _ _"]]:
        """The distance map of each compared layer."""
        if self.backbone == "vgg" and a.shape[-2] * a.shape[-1] > _MAX_WHOLE_PIXELS:
            return banded_distances(a, b, self.features, self.heads, _BAND_PIXELS)
        activations = (self._compute_activations(maps) for maps in (a, b))
        return (distances(*pair, head) for head, *pair in zip(self.heads, *activations, strict=True))

    def _normalize(self, images: Tensor) -> Tensor:
        mean, deviation = (images.new_tensor(values)[:, None, None] for values in (_MEAN, _DEVIATION))
        return (2 * images - 1 - mean) / deviation

    def _compute_activations(self, maps: Tensor) -> list[Tensor]:
        kept = []
        for index, layer in enumerate(self.features):
            maps = layer(maps)
            if index in LAYER_CHANNELS[self.backbone]:
                kept.append(maps)
        return kept


def _average_map(
    maps: Float[Tensor, "batch h w"], weights: Float[Tensor, "batch height width"] | None
) -> Float[Tensor, "batch"]:
    """Mean over the pixels of a layer, weighted by the mean weight of the image pixels they cover."""
    if weights is None:
        return maps.mean(dim=(1, 2))
    pooled = functional.adaptive_avg_pool2d(weights[:, None].to(maps), (maps.shape[-2], maps.shape[-1]))[:, 0]
    return (maps * pooled).sum(dim=(1, 2)) / pooled.sum(dim=(1, 2)).clamp_min(torch.finfo(maps.dtype).tiny)


class _Fire(nn.Module):
    """A 1x1 convolution to fewer channels, then a 1x1 and a 3x3 convolution in parallel."""

    def __init__(self, inputs: int, squeezed: int, expanded: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(inputs, squeezed, 1)
        self.expand1x1 = nn.Conv2d(squeezed, expanded, 1)
        self.expand3x3 = nn.Conv2d(squeezed, expanded, 3, padding=1)

    def forward(self, maps: Tensor) -> Tensor:
        squeezed = functional.relu(self.squeeze(maps))
        return functional.relu(torch.cat((self.expand1x1(squeezed), self.expand3x3(squeezed)), dim=1))


def _vgg() -> nn.Sequential:
    layers: list[nn.Module] = []
    inputs = 3
    for outputs in _VGG:
        if outputs == 0:
            layers.append(nn.MaxPool2d(2))
            continue
        layers += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU()]
        inputs = outputs
    return nn.Sequential(*layers)


def _alex() -> nn.Sequential:
    return nn.Sequential(
        *(nn.Conv2d(3, 64, 11, stride=4, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)),
        *(nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)),
        *(nn.Conv2d(192, 384, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(384, 256, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(256, 256, 3, padding=1), nn.ReLU()),
    )


def _squeeze() -> nn.Sequential:
    layers: list[nn.Module] = [nn.Conv2d(3, 64, 3, stride=2), nn.ReLU(), nn.MaxPool2d(3, 2, ceil_mode=True)]
    for shape in (*_SQUEEZE, (384, 64, 256), (512, 64, 256)):
        layers.append(_Fire(*shape) if isinstance(shape, tuple) else nn.MaxPool2d(3, 2, ceil_mode=True))
    return nn.Sequential(*layers)


_LAYERS = {"vgg": _vgg, "alex": _alex, "squeeze": _squeeze}

_EPSILON = 1e-20  # added to the squared length of a pixel's activations; zero activations have a finite gradient


def distances(
    a: Float[Tensor, "batch channel height width"],
    b: Float[Tensor, "batch channel height width"],
    head: Float[Tensor, "channel"],
) -> Float[Tensor, "batch height width"]:
    """Squared difference of the normalised activations at each pixel, with channel weights `head`."""
    return torch.einsum("bchw,c->bhw", (_normalize_channels(a) - _normalize_channels(b)).square(), head)


def banded_distances(
    a: Float[Tensor, "batch channel height width"],
    b: Float[Tensor, "batch channel height width"],
    layers: nn.Sequential,
    heads: Iterable[Float[Tensor, "_"]],
    pixels: int,
) -> Iterator[Float[Tensor, "batch _ _"]]:
    """`distances` after each block of a classifier of padded 3x3 convolutions, ReLUs and 2x2 poolings.

    Args:
        heads: one for each block.
        pixels: number of pixels of a band, at the resolution of its block.
    """
    needs_gradient = torch.is_grad_enabled() and (a.requires_grad or b.requires_grad)
    for block, head in zip(_split_blocks(layers), heads, strict=True):
        height, width = a.shape[-2:]
        rows = max(2, pixels // width // 2 * 2)  # an even number, so that bands do not split a pooling window
        parts = []
        for first in range(0, height, rows):
            given = (block, a, b, head, first, min(first + rows, height))
            parts.append(
                checkpoint(_process_band, *given, use_reentrant=False, preserve_rng_state=False)
                if needs_gradient
                else _process_band(*given)
            )
        a, b = (torch.cat([part[i] for part in parts], dim=2) for i in (0, 1))
        yield torch.cat([part[2] for part in parts], dim=1)


def _split_blocks(layers: nn.Sequential) -> list[nn.Sequential]:
    """The layers up to each pooling, and those after the last."""
    ends = [index + 1 for index, layer in enumerate(layers) if isinstance(layer, nn.MaxPool2d)]
    bounds = [0, *ends, len(layers)]
    return [layers[start:end] for start, end in itertools.pairwise(bounds)]


def _process_band(
    block: nn.Sequential, a: Tensor, b: Tensor, head: Tensor, first: int, end: int
) -> tuple[Tensor, Tensor, Tensor]:
    """The rows of both images for the next block, and the distances of this block."""
    pooling = block[-1] if isinstance(block[-1], nn.MaxPool2d) else nn.Identity()
    convolving = block[:-1] if isinstance(block[-1], nn.MaxPool2d) else block
    margin = sum(isinstance(layer, nn.Conv2d) for layer in convolving)
    above, below = min(margin, first), min(margin, a.shape[2] - end)
    a, b = (convolving(maps[:, :, first - above : end + below])[:, :, above : above + end - first] for maps in (a, b))
    return (*(_pool_rows(pooling, maps) for maps in (a, b)), distances(a, b, head))


def _pool_rows(pooling: nn.Module, maps: Tensor) -> Tensor:
    """Pooled rows; pooling drops the last row of an odd number, also where it is a band."""
    is_dropped = isinstance(pooling, nn.MaxPool2d) and maps.shape[2] == 1
    return maps[:, :, :0, : maps.shape[3] // 2] if is_dropped else pooling(maps)


def _normalize_channels(
    maps: Float[Tensor, "batch channel height width"],
) -> Float[Tensor, "batch channel height width"]:
    """Activations divided by their length over the channels."""
    return maps * (maps.square().sum(1, keepdim=True) + _EPSILON).rsqrt()


FOLDER_VARIABLE = "PANSPLAT_LPIPS"
"""Environment variable that names the folder of the weights."""

_CLASSIFIERS: dict[Backbone, str] = {
    "vgg": "vgg16-397923af.pth",
    "alex": "alexnet-owt-7be5be79.pth",
    "squeeze": "squeezenet1_1-b8a52dc0.pth",
}
_CLASSIFIER_SITE = "https://download.pytorch.org/models/"
_HEAD_FOLDERS = (".", "lpips_heads", "lpips", "v0.1")  # inside a folder of weights
_HEAD_SITE = "https://github.com/richzhang/PerceptualSimilarity/tree/master/lpips/weights/v0.1"


def load_lpips(backbone: Backbone, folder: Path | None = None) -> Lpips:
    """LPIPS with its weights.

    Args:
        backbone: the paper's figures are those of "vgg".
        folder: searched first; then the folder of PANSPLAT_LPIPS, the cache of torch.hub, and, for the channels'
            weights, an installed `lpips` package.
    """
    classifier, heads = find_classifier(backbone, folder), find_heads(backbone, folder)
    if classifier is None or heads is None:
        raise InputError(_describe_missing_files(backbone, folder, classifier, heads))
    metric = Lpips(backbone)
    state = {**_load_classifier(metric, classifier), **_load_heads(backbone, heads)}
    metric.load_state_dict(state)
    return metric


def find_backbone(folder: Path | None = None) -> Backbone | None:
    """The first of vgg, alex and squeeze whose files exist; None without any."""
    found = (b for b in get_args(Backbone) if find_classifier(b, folder) and find_heads(b, folder))
    return next(found, None)


def find_classifier(backbone: Backbone, folder: Path | None = None) -> Path | None:
    """The file of torchvision's classifier, by its name or a name with the same beginning."""
    pattern = f"{_CLASSIFIERS[backbone].partition('-')[0]}*.pth"
    found = (path for candidate in _list_folders(folder) for path in sorted(candidate.glob(pattern)))
    return next(found, None)


def find_heads(backbone: Backbone, folder: Path | None = None) -> Path | None:
    """The lpips package's file of the channels' weights, such as vgg.pth."""
    candidates = [candidate / inner for candidate in _list_folders(folder) for inner in _HEAD_FOLDERS]
    package = find_spec("lpips")
    for root in (package.submodule_search_locations or ()) if package else ():
        candidates.append(Path(root) / "weights" / "v0.1")
    return next((path for candidate in candidates if (path := candidate / f"{backbone}.pth").is_file()), None)


def _list_folders(folder: Path | None) -> list[Path]:
    named = os.environ.get(FOLDER_VARIABLE)
    return [*([folder] if folder else []), *([expand_home(named)] if named else []), _hub_folder()]


def _hub_folder() -> Path:
    return Path(torch.hub.get_dir()) / "checkpoints"


def _describe_missing_files(
    backbone: Backbone, folder: Path | None, classifier: Path | None, heads: Path | None
) -> str:
    missing = []
    if classifier is None:
        missing.append(f"{_CLASSIFIERS[backbone]} (from {_CLASSIFIER_SITE}{_CLASSIFIERS[backbone]})")
    if heads is None:
        missing.append(f"{backbone}.pth (from {_HEAD_SITE}, or `pip install lpips`)")
    searched = ", ".join(str(candidate) for candidate in _list_folders(folder))
    return (
        f"LPIPS with {backbone} needed {' and '.join(missing)}, got no such file in {searched}; "
        f"put it into {_hub_folder()} or into a folder that --lpips-weights or {FOLDER_VARIABLE} names. "
        "Nothing is downloaded."
    )


def _load_classifier(metric: Lpips, path: Path) -> dict[str, Tensor]:
    """The layers of the classifier that the metric uses."""
    content = read_checkpoint(path)
    needed = {name: t for name, t in metric.state_dict().items() if name.startswith("features.")}
    return {name: _take_tensor(content, name, needed[name].shape, path) for name in needed}


def _load_heads(backbone: Backbone, path: Path) -> dict[str, Tensor]:
    content = read_checkpoint(path)
    shapes = {i: torch.Size((1, channels, 1, 1)) for i, channels in enumerate(LAYER_CHANNELS[backbone].values())}
    return {f"heads.{i}": _take_tensor(content, f"lin{i}.model.1.weight", s, path).flatten() for i, s in shapes.items()}


def _take_tensor(content: Mapping[str, object], name: str, shape: torch.Size, path: Path) -> Tensor:
    tensor = content.get(name)
    if not isinstance(tensor, Tensor) or tensor.shape != shape:
        got = f"one of {tuple(tensor.shape)}" if isinstance(tensor, Tensor) else "none"
        raise InputError(f"{path}: needed a tensor {name} of {tuple(shape)}, got {got}; download the file again.")
    return tensor.float()
