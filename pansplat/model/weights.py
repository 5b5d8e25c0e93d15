"""From the original's weights to ours, strictly.

Every tensor of a checkpoint is used, or known to be of no use here, or an error; every tensor of ours is filled, or
that is an error. official_names.py has the table.

Source: OFFICIAL.md, section 15.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pansplat.errors import InputError
from pansplat.geometry.cubemap import strip_lookup
from pansplat.model.checkpoint import state_dict_of
from pansplat.model.official_names import Model, rows, tensor_names

_PREFIX = "encoder."  # what Lightning puts before the names of the network's tensors
_AUXILIARY = "losses.2.gaussian_head."
_SHOWN = 4  # names that an error lists


@dataclass(frozen=True)
class Report:
    """What became of a checkpoint's tensors.

    Attributes:
        model: which network they belong to.
        used: the original's name to ours.
        unused: reason to the names that are left out for it.
        surplus: names that nobody knows.
        missing: the original's names that are not there.
    """

    model: Model
    used: dict[str, str]
    unused: dict[str, list[str]]
    surplus: list[str]
    missing: list[str]

    def require_complete(self, source: object) -> None:
        """Refuse a checkpoint with anything missing or surplus.

        Raises:
            InputError: with the first names, and how many there are.
        """
        problems = []
        if self.missing:
            problems.append(f"lacked {_some(self.missing)}")
        if self.surplus:
            problems.append(f"found unknown {_some(self.surplus)}")
        if problems:
            raise InputError(
                f"{source}: needed exactly the tensors of the original {self.model}, {' and '.join(problems)}; "
                "take the checkpoint of an unmodified model"
            )


def convert(content: Mapping[str, object], source: object) -> dict[str, Tensor]:
    """The tensors of an original checkpoint under our names.

    Args:
        content: of the checkpoint, as `read_checkpoint` gives it.
        source: the file, for messages.

    Raises:
        InputError: when tensors are missing, surplus, of wrong shape, or not finite.
    """
    report = match(content, source)
    report.require_complete(source)
    state = state_dict_of(content, str(source))
    _compare_derived(state, source)
    tensors = {}
    for row in rows(report.model):
        for name, ours, squeezed in tensor_names(row):
            tensor = state[_PREFIX + name]
            tensor = tensor.squeeze(-1) if squeezed else tensor
            if tensor.is_floating_point():
                tensor = tensor.float()
                if not torch.isfinite(tensor).all():
                    raise InputError(f"{source}: needed finite numbers, got NaN or infinity in {name}; take another")
            tensors[ours] = tensor
    return tensors


def match(content: Mapping[str, object], source: object) -> Report:
    """What would become of a checkpoint's tensors, problems included.

    Raises:
        InputError: when it belongs to no network that is known.
    """
    state = state_dict_of(content, str(source))
    model = _model_of(state, source)
    expected = {_PREFIX + name: ours for row in rows(model) for name, ours, _ in tensor_names(row)}
    derived = {_PREFIX + name for name in _derived(model)}
    auxiliary = {_AUXILIARY + name for name in _auxiliary_names()}
    unused = {
        "computed anew": sorted(derived & state.keys()),
        "auxiliary heads, for training only": sorted(auxiliary & state.keys()),
        "state of the training": sorted(key for key in content if key != "state_dict"),
    }
    return Report(
        model=model,
        used={name: ours for name, ours in expected.items() if name in state},
        unused={reason: names for reason, names in unused.items() if names},
        surplus=[name for name in state if name not in expected.keys() | derived | auxiliary],
        missing=[name for name in (*expected, *sorted(derived)) if name not in state],
    )


def official_names(model: Model) -> dict[str, str]:
    """Our name of each of the original's tensors (without the prefix "encoder.") that is used."""
    return {name: ours for row in rows(model) for name, ours, _ in tensor_names(row)}


def require_shapes(tensors: Mapping[str, Tensor], expected: Mapping[str, Tensor], source: object) -> None:
    """Refuse tensors whose names or shapes are not those of a network.

    Raises:
        InputError: with the first names, and how many there are.
    """
    missing = [name for name in expected if name not in tensors]
    surplus = [name for name in tensors if name not in expected]
    wrong = [
        f"{name} {tuple(tensors[name].shape)} instead of {tuple(tensor.shape)}"
        for name, tensor in expected.items()
        if name in tensors and tensors[name].shape != tensor.shape
    ]
    problems = [
        f"{what} {_some(names)}"
        for what, names in (("lacked", missing), ("found unknown", surplus), ("got", wrong))
        if names
    ]
    if problems:
        raise InputError(f"{source}: its tensors do not fit the network: {'; '.join(problems)}; take another file")


# What is in checkpoints but not in the network


def _derived(model: Model) -> dict[str, int]:
    """Stored lookup grids that are computed here: name and height of the panorama."""
    if model == "mvsplat":
        return {}
    return {f"mono_depth.c2e.{scale}.sample_grid": 512 >> scale for scale in (5, 4, 3, 2, 1)}


def _auxiliary_names() -> Iterator[str]:
    for stage in range(3):
        for layer in (f"to_gaussians_list.{stage}.0", f"to_gaussians_list.{stage}.2", f"gaussians_mlp_list.{stage}.0"):
            yield f"{layer}.weight"
            yield f"{layer}.bias"


def _compare_derived(state: Mapping[str, Tensor], source: object) -> None:
    """Refuse a checkpoint whose stored grids are not the ones that are computed."""
    for name, height in _derived("pansplat").items():
        if _PREFIX + name not in state:
            continue
        stored = state[_PREFIX + name]
        x, y, face = strip_lookup(height).unbind(-1)
        computed = torch.stack((x, y, face / 2.5 - 1), dim=-1)[None, None]
        if stored.shape != computed.shape or (stored.double() - computed).abs().max() > 1e-4:
            raise InputError(f"{source}: needed the original's grid in {name}, got another; the model was modified")


def _model_of(state: Mapping[str, Tensor], source: object) -> Model:
    if any(name.startswith("encoder.gaussian_head.") for name in state):
        return "pansplat"
    if any(name.startswith("encoder.backbone.backbone.") for name in state):
        return "mvsplat"
    raise InputError(
        f"{source}: needed a checkpoint of the original PanSplat or its MVSplat baseline, got tensors "
        f"{_some(list(state)) if state else 'none'}"
    )


def _some(names: Sequence[str] | Iterable[str]) -> str:
    names = list(names)
    return f"{len(names)} ({', '.join(names[:_SHOWN])}{', ...' if len(names) > _SHOWN else ''})"
