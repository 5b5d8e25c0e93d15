"""Where the weights of LPIPS lie on this machine, and reading them. Nothing is fetched."""

from __future__ import annotations

import os
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import get_args

import torch
from torch import Tensor

from pansplat.errors import InputError
from pansplat.evaluation.lpips import TAPS, Backbone, Lpips
from pansplat.model.checkpoint import read_checkpoint

FOLDER_VARIABLE = "PANSPLAT_LPIPS"
"""Environment variable with the folder of the weights."""

_CLASSIFIERS: dict[Backbone, str] = {
    "vgg": "vgg16-397923af.pth",
    "alex": "alexnet-owt-7be5be79.pth",
    "squeeze": "squeezenet1_1-b8a52dc0.pth",
}
_PATTERNS: dict[Backbone, str] = {"vgg": "vgg16*.pth", "alex": "alexnet*.pth", "squeeze": "squeezenet1_1*.pth"}
_CLASSIFIER_SITE = "https://download.pytorch.org/models/"
_HEAD_FOLDERS = (".", "lpips_heads", "lpips", "v0.1")  # inside a folder of weights
_HEAD_SITE = "https://github.com/richzhang/PerceptualSimilarity/tree/master/lpips/weights/v0.1"


def load_lpips(backbone: Backbone, folder: Path | None = None) -> Lpips:
    """LPIPS with its weights.

    Args:
        backbone: the paper's figures are those of "vgg".
        folder: where to look first; then the folder that PANSPLAT_LPIPS names, the cache of torch.hub, and, for the
            channels' weights, an installed `lpips` package.

    Raises:
        InputError: when a file is missing (it says which, where it is to be had and where it belongs) or damaged.
    """
    classifier, heads = find_classifier(backbone, folder), find_heads(backbone, folder)
    if classifier is None or heads is None:
        raise InputError(_what_to_fetch(backbone, folder, classifier, heads))
    metric = Lpips(backbone)
    state = {**_classifier_state(metric, classifier), **_head_state(backbone, heads)}
    metric.load_state_dict(state)
    return metric


def first_available(folder: Path | None = None) -> Backbone | None:
    """The first of vgg, alex and squeeze whose files are here; None when there are none."""
    found = (b for b in get_args(Backbone) if find_classifier(b, folder) and find_heads(b, folder))
    return next(found, None)


def find_classifier(backbone: Backbone, folder: Path | None = None) -> Path | None:
    """The file of torchvision's classifier: by its own name or one that begins alike."""
    found = (path for place in _places(folder) for path in sorted(place.glob(_PATTERNS[backbone])))
    return next(found, None)


def find_heads(backbone: Backbone, folder: Path | None = None) -> Path | None:
    """The lpips package's file of the channels' weights, such as vgg.pth."""
    places = [place / inner for place in _places(folder) for inner in _HEAD_FOLDERS]
    package = find_spec("lpips")
    for root in (package.submodule_search_locations or ()) if package else ():
        places.append(Path(root) / "weights" / "v0.1")
    return next((path for place in places if (path := place / f"{backbone}.pth").is_file()), None)


def _places(folder: Path | None) -> list[Path]:
    named = os.environ.get(FOLDER_VARIABLE)
    return [*([folder] if folder else []), *([Path(named).expanduser()] if named else []), _hub()]


def _hub() -> Path:
    return Path(torch.hub.get_dir()) / "checkpoints"


def _what_to_fetch(backbone: Backbone, folder: Path | None, classifier: Path | None, heads: Path | None) -> str:
    missing = []
    if classifier is None:
        missing.append(f"{_CLASSIFIERS[backbone]} (from {_CLASSIFIER_SITE}{_CLASSIFIERS[backbone]})")
    if heads is None:
        missing.append(f"{backbone}.pth (from {_HEAD_SITE}, or `pip install lpips`)")
    looked = ", ".join(str(place) for place in _places(folder))
    return (
        f"LPIPS with {backbone} needed {' and '.join(missing)}, got no such file in {looked}; put it into {_hub()} or "
        f"into a folder that --lpips-weights or {FOLDER_VARIABLE} names. Nothing is fetched by itself."
    )


def _classifier_state(metric: Lpips, path: Path) -> dict[str, Tensor]:
    """The classifier's layers that the metric has; those that decide on a class are left."""
    content = read_checkpoint(path)
    wanted = {name: t for name, t in metric.state_dict().items() if name.startswith("features.")}
    return {name: _tensor(content, name, wanted[name].shape, path) for name in wanted}


def _head_state(backbone: Backbone, path: Path) -> dict[str, Tensor]:
    content = read_checkpoint(path)
    state = {}
    for index, channels in enumerate(TAPS[backbone].values()):
        weight = _tensor(content, f"lin{index}.model.1.weight", torch.Size((1, channels, 1, 1)), path)
        state[f"heads.{index}"] = weight.flatten()
    return state


def _tensor(content: Mapping[str, object], name: str, shape: torch.Size, path: Path) -> Tensor:
    tensor = content.get(name)
    if not isinstance(tensor, Tensor) or tensor.shape != shape:
        got = f"one of {tuple(tensor.shape)}" if isinstance(tensor, Tensor) else "none"
        raise InputError(f"{path}: needed a tensor {name} of {tuple(shape)}, got {got}; fetch the file again.")
    return tensor.float()
