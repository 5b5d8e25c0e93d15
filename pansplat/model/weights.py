"""Weights on disk: safetensors files of pansplat, PyTorch checkpoints, conversion of official checkpoints.

A weights file is a .safetensors file with four metadata entries: `pansplat_format` (a number), `model` (the network's
name), `config` (its architecture, JSON) and `compat` (the mode of its training). Checkpoints are read without executing
code in them. Conversion is strict: a tensor that is missing, unknown or not finite is an error.

Source: docs/official.md, sections 3 to 8 and 15.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import pickle
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import msgspec
import safetensors
import safetensors.torch
import torch
from torch import Tensor

from pansplat.errors import InputError
from pansplat.geometry.cubemap import strip_lookup
from pansplat.model.layers import Compat
from pansplat.system.atomic import replacing
from pansplat.system.files import require_file
from pansplat.system.strict_json import convert, parse_json

FORMAT = 1  # increased when tensor names or the meaning of the metadata change

CHECKPOINT_SUFFIXES = (".ckpt", ".pt", ".pth")
WEIGHTS_SUFFIXES = (".safetensors", *CHECKPOINT_SUFFIXES)
COMPATS: dict[str, Compat] = {"official": "official", "fixed": "fixed"}

ModelName = Literal["pansplat", "depth", "depth_sharpening"]

_T = TypeVar("_T")
_Layer = tuple[str, str, tuple[str, ...]]  # official name, our name, tensors
_BARE = ("weight",)
_FULL = ("weight", "bias")
_BATCH_NORM = ("weight", "bias", "running_mean", "running_var", "num_batches_tracked")
_PREFIX = "encoder."  # prefix of the network's tensors in a Lightning checkpoint
_AUXILIARY_PREFIX = "losses.2.gaussian_head."
_GRID_HEIGHTS = {f"mono_depth.c2e.{scale}.sample_grid": 512 >> scale for scale in (5, 4, 3, 2, 1)}
"""Heights of the panoramas of the stored lookup grids, which are recomputed here."""
_MAX_NAMES = 4  # names that an error message lists


class UnsafeCheckpointError(InputError):
    """A checkpoint contains code, which was not executed."""


@dataclass(frozen=True)
class WeightsFile:
    """Content of a weights file.

    Attributes:
        model: name of the network, such as "pansplat".
        config: settings of its architecture.
        compat: mode of its training.
        tensors: weights by name.
    """

    model: str
    config: dict[str, Any]
    compat: Compat
    tensors: dict[str, Tensor]


def pack_weights(model: ModelName, config: object, tensors: dict[str, Tensor], *, compat: Compat) -> WeightsFile:
    """Pack a network's tensors with its settings; `config` is a dataclass."""
    assert dataclasses.is_dataclass(config) and not isinstance(config, type)
    settings = json.loads(json.dumps(dataclasses.asdict(config)))  # lists instead of tuples, as read from a file
    return WeightsFile(model, settings, compat, tensors)


def save_weights(path: str | Path, weights: WeightsFile) -> None:
    """Write a .safetensors file atomically; an InputError for another suffix, or if it cannot be written."""
    path = Path(path)
    if path.suffix.lower() != ".safetensors":
        raise InputError(f"{path}: a weights file must end in .safetensors, got {path.suffix or 'no suffix'!r}")
    metadata = {
        "pansplat_format": str(FORMAT),
        "model": weights.model,
        "config": json.dumps(weights.config),
        "compat": weights.compat,
    }
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in weights.tensors.items()}
    with replacing(path, failures=(safetensors.SafetensorError,)) as partial:
        safetensors.torch.save_file(tensors, partial, metadata)


def load_weights(path: str | Path) -> WeightsFile:
    """Read a weights file; an InputError if it is missing, damaged, or was not written by pansplat."""
    path = Path(path)
    _require_file(path)
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            # Copies: the tensors are maps of the file, which Windows could not replace and a writer would change.
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118  # not a dict
    except (safetensors.SafetensorError, OSError, ValueError, AttributeError) as error:  # torch lacks some types
        raise InputError(f"{path}: needed a whole .safetensors file, got '{error}'; {_suggest_remedy(path)}") from error
    if not {"pansplat_format", "model", "config", "compat"} <= metadata.keys():
        raise InputError(
            f"{path}: needed weights that `pansplat convert` or `pansplat-train` wrote, got a .safetensors file "
            "without their metadata; convert the official checkpoint"
        )
    if metadata["pansplat_format"] != str(FORMAT):
        raise InputError(
            f"{path}: needed format {FORMAT} of weights files, got {metadata['pansplat_format']}; "
            "use the pansplat version that wrote it, or convert the official checkpoint again"
        )
    if metadata["compat"] not in COMPATS:
        needed = " or ".join(COMPATS)
        raise InputError(f"{path}: needed compat {needed} in its metadata, got {metadata['compat']!r:.60}")
    config = convert(parse_json(metadata["config"], f"{path}: config"), dict[str, Any], f"{path}: config")
    return WeightsFile(metadata["model"], config, COMPATS[metadata["compat"]], as_float32(tensors, path))


def as_float32(tensors: Mapping[str, Tensor], source: object) -> dict[str, Tensor]:
    """The tensors with floating-point numbers in float32; an InputError if a number is not finite."""
    converted = {}
    for name, tensor in tensors.items():
        converted[name] = tensor.float() if tensor.is_floating_point() else tensor
        if tensor.is_floating_point() and not torch.isfinite(converted[name]).all():
            raise InputError(f"{source}: needed finite numbers, got NaN or infinity in {name}; use another file")
    return converted


def read_model_name(path: Path) -> str | None:
    """Name of the network in the metadata of a weights file; None if it has none."""
    if not path.is_file():
        return None
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            return (file.metadata() or {}).get("model")
    except (safetensors.SafetensorError, OSError, ValueError):
        return None


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read the tensors and plain values of a PyTorch (Lightning) checkpoint, without executing code in it.

    Raises:
        UnsafeCheckpointError: the file contains code.
    """
    path = Path(path)
    _require_file(path)
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        code = re.search(r"(?:GLOBAL|global|class|function) ([\w.]+\.[\w.]+)", str(error))
        if code is None:
            raise InputError(
                f"{path}: needed a PyTorch checkpoint, got other contents; {_suggest_remedy(path)}"
            ) from error
        raise UnsafeCheckpointError(
            f"{path}: needed a checkpoint of tensors and plain values, got one that calls {code[1]}; the call was not "
            "executed. If you trust the source of the file, keep only its `state_dict`: "
            "torch.save({'state_dict': torch.load(PATH, weights_only=False)['state_dict']}, NEW_PATH)"
        ) from error
    except MemoryError:
        raise
    except Exception as error:  # damaged bytes raise many kinds of error in the zip and pickle readers
        raise InputError(
            f"{path}: needed a whole PyTorch checkpoint, got a damaged one; {_suggest_remedy(path)}"
        ) from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: needed a checkpoint with a `state_dict`, got a {type(content).__name__}")
    return content


def get_state_dict(content: Mapping[str, Any], path: str | Path) -> dict[str, Tensor]:
    """The tensors of a Lightning checkpoint; an InputError without a `state_dict` of tensors only."""
    state = content.get("state_dict")
    if not isinstance(state, Mapping):
        keys = ", ".join(str(key) for key in list(content)[:5])
        raise InputError(f"{path}: needed a checkpoint with a `state_dict`, got one with {keys or 'nothing'}")
    odd = [str(name) for name, value in state.items() if not isinstance(value, Tensor)]
    if odd:
        raise InputError(f"{path}: needed a `state_dict` of tensors, got other values at {', '.join(odd[:3])}")
    return {str(name): value for name, value in state.items()}


def config_from_dict(kind: type[_T], values: Mapping[str, Any], where: str = "config") -> _T:
    """A nested dataclass from the JSON of its `asdict`; an InputError for any other field, type or range."""
    config = convert(values, kind, where)
    known, given = _list_leaves(msgspec.to_builtins(config), where), _list_leaves(values, where)
    if known != given:
        unknown, missing = sorted(given - known), sorted(known - given)
        raise InputError(
            f"{where}: needed the settings of this version, got unknown {unknown} and lacked {missing}; use the "
            "pansplat version that wrote the file, or convert the official checkpoint again"
        )
    return config


def _list_leaves(value: Any, name: str) -> set[str]:
    """The names of the numbers and texts in nested settings."""
    if not isinstance(value, (dict, list, tuple)):
        return {name}
    items = value.items() if isinstance(value, dict) else enumerate(value)
    return {leaf for key, item in items for leaf in _list_leaves(item, f"{name}.{key}")}


def build_on_meta(build: Callable[[], _T], model: str, source: object) -> _T:
    """Build a network without memory and random numbers; an InputError if its settings fit no network."""
    try:
        with torch.device("meta"):
            return build()
    except InputError:
        raise
    except Exception as error:
        cause = f"{type(error).__name__}: {error}".splitlines()[0]
        raise InputError(f"{source}: needed settings of a {model} network, got '{cause}'; use another file") from error


def _require_file(path: Path) -> None:
    if not os.path.lexists(path):
        raise InputError(f"{path}: needed a file of weights, got no file")
    require_file(path, "a file of weights")
    if path.stat().st_size == 0:
        raise InputError(f"{path}: needed a file of weights, got an empty file; download or copy it again")


def _suggest_remedy(path: Path) -> str:
    """Suggest what to do about an unreadable file, from its first bytes."""
    with open(path, "rb") as file:
        start = file.read(64).lstrip().lower()
    if start.startswith((b"<!doctype", b"<html", b"<?xml", b"<head")):
        return "it is a web page: download the file itself, not the page about it"
    if start.startswith(b"version https://git-lfs"):
        return "it is a Git LFS pointer: run `git lfs pull`"
    return "download or copy it again"


def convert_tensors(content: Mapping[str, object], source: object) -> dict[str, Tensor]:
    """Convert the tensors of an official checkpoint to our names, and floating-point numbers to float32.

    Args:
        content: result of `read_checkpoint`.
        source: the file, for messages.
    """
    match_tensors(content, source)
    state, names = get_state_dict(content, str(source)), map_official_names()
    _require_official_grids(state, source)
    official = as_float32({name: state[_PREFIX + name] for name in names}, source)
    # 1-D convolutions are linear layers here.
    return {ours: t.squeeze(-1) if (t := official[name]).ndim == 3 else t for name, ours in names.items()}


def match_tensors(content: Mapping[str, object], source: object) -> dict[str, list[str]]:
    """Names of the tensors and entries of an official checkpoint that are not used, by reason.

    Raises:
        InputError: the checkpoint is that of another network, or tensors are missing or unknown.
    """
    state = get_state_dict(content, str(source))
    _require_pansplat(state, source)
    used = {_PREFIX + name for name in map_official_names()}
    grids = {_PREFIX + name for name in _GRID_HEIGHTS}
    auxiliary = {_AUXILIARY_PREFIX + name for name in _list_auxiliary_names()}
    missing = sorted((used | grids) - state.keys())
    unknown = [name for name in state if name not in used | grids | auxiliary]
    problems = [
        f"{problem} {_join_names(names)}"
        for problem, names in (("lacked", missing), ("found unknown", unknown))
        if names
    ]
    if problems:
        raise InputError(
            f"{source}: needed exactly the tensors of the official PanSplat, {' and '.join(problems)}; "
            "use the checkpoint of an unmodified model"
        )
    unused = {
        "recomputed grids": sorted(grids),
        "auxiliary heads, for training only": sorted(auxiliary & state.keys()),
        "training state": sorted(key for key in content if key != "state_dict"),
    }
    return {reason: names for reason, names in unused.items() if names}


def map_official_names() -> dict[str, str]:
    """Map the official name, without the prefix "encoder.", of each tensor that is used to our name.

    The official code counts stages from coarse to fine; our levels are the paper's, where 0 is the finest.
    """
    layers = itertools.chain(_feature_pyramid(), _transformer(), _mono_depth(), _cost_volume(), _heads())
    return {f"{official}.{tensor}": f"{ours}.{tensor}" for official, ours, tensors in layers for tensor in tensors}


def require_shapes(tensors: Mapping[str, Tensor], expected: Mapping[str, Tensor], source: object) -> None:
    """Raise an InputError that counts and names the tensors without the names and shapes of a network's tensors."""
    missing = [name for name in expected if name not in tensors]
    unexpected = [name for name in tensors if name not in expected]
    wrong = [
        f"{name} {tuple(tensors[name].shape)} instead of {tuple(tensor.shape)}"
        for name, tensor in expected.items()
        if name in tensors and tensors[name].shape != tensor.shape
    ]
    wrong += [
        f"{name} of {str(tensors[name].dtype).removeprefix('torch.')}"
        for name, tensor in expected.items()
        if name in tensors and tensors[name].is_floating_point() != tensor.is_floating_point()
    ]
    problems = [
        f"{problem} {_join_names(names)}"
        for problem, names in (("lacked", missing), ("found unknown", unexpected), ("got", wrong))
        if names
    ]
    if problems:
        raise InputError(f"{source}: its tensors do not fit the network: {'; '.join(problems)}; use another file")


def _list_auxiliary_names() -> Iterator[str]:
    for stage in range(3):
        for layer in (f"to_gaussians_list.{stage}.0", f"to_gaussians_list.{stage}.2", f"gaussians_mlp_list.{stage}.0"):
            yield f"{layer}.weight"
            yield f"{layer}.bias"


def _require_official_grids(state: Mapping[str, Tensor], source: object) -> None:
    """Check that stored lookup grids equal the computed ones."""
    for name, height in _GRID_HEIGHTS.items():
        if _PREFIX + name not in state:
            continue
        stored = state[_PREFIX + name]
        x, y, face = strip_lookup(height).unbind(-1)
        computed = torch.stack((x, y, face / 2.5 - 1), dim=-1)[None, None]
        if stored.shape != computed.shape or (stored.double() - computed).abs().max() > 1e-4:
            raise InputError(f"{source}: needed the official grid in {name}, got another; use an unmodified model")


def _require_pansplat(state: Mapping[str, Tensor], source: object) -> None:
    if any(name.startswith("encoder.gaussian_head.") for name in state):
        return
    names = _join_names(list(state)) if state else "none"
    if any(name.startswith("encoder.backbone.backbone.") for name in state):
        names = f"{names} of its MVSplat baseline, which has no Gaussian heads"
    raise InputError(f"{source}: needed a checkpoint of the official PanSplat, got tensors {names}; use another file")


def _join_names(names: Sequence[str]) -> str:
    return f"{len(names)} ({', '.join(names[:_MAX_NAMES])}{', ...' if len(names) > _MAX_NAMES else ''})"


# Layers of the official code and ours


def _pair(official: str, ours: str, children: Mapping[str, str], tensors: tuple[str, ...]) -> Iterator[_Layer]:
    """The children of a layer, our names by official ones."""
    for theirs, name in children.items():
        yield f"{official}.{theirs}", f"{ours}.{name}", tensors


def _feature_pyramid() -> Iterator[_Layer]:
    for level in range(4):
        names = ("conv00", "conv01") if level == 0 else (f"downsample{level}", f"conv{level}0", f"conv{level}1")
        for index, name in enumerate(names):
            official, ours = f"backbone.encoder.{name}", f"features.encoder.levels.{level}.{index}"
            yield f"{official}.conv", f"{ours}.conv", _BARE
            yield f"{official}.bn", f"{ours}.norm", _BATCH_NORM
    for stage in range(4):
        official, ours = f"backbone.decoder.out{stage}", f"features.decoder.outputs.{3 - stage}"
        yield f"{official}.0", f"{ours}.conv", _FULL
        yield f"{official}.1", f"{ours}.norm", _BATCH_NORM
    laterals = {f"inner{stage}": f"laterals.{3 - stage}" for stage in (1, 2, 3)}
    yield from _pair("backbone.decoder", "features.decoder", laterals, _FULL)


def _transformer() -> Iterator[_Layer]:
    official, ours = "backbone.transformer", "features.transformer"
    projections = {"q_proj": "query", "k_proj": "key", "v_proj": "value", "merge": "merge"}
    for block in range(6):
        old, new = f"{official}.layers.{block}", f"{ours}.blocks.{block}"
        for layer, attention in (("self_attn", "within"), ("cross_attn_ffn", "across")):
            yield from _pair(f"{old}.{layer}", f"{new}.{attention}", projections, _BARE)
            yield f"{old}.{layer}.norm1", f"{new}.{attention}.norm", _FULL
        yield from _pair(f"{old}.cross_attn_ffn.mlp", new, {"0": "widen", "2": "narrow"}, _BARE)
        yield f"{old}.cross_attn_ffn.norm2", f"{new}.norm", _FULL


def _mono_depth() -> Iterator[_Layer]:
    yield "mono_depth", "mono_depth", ("max_depth",)
    yield from _resnet18("mono_depth.equi_encoder", "mono_depth.panorama_encoder")
    yield from _resnet18("mono_depth.cube_encoder", "mono_depth.face_encoder")
    official, ours = "mono_depth.equi_decoder", "mono_depth.decoder"
    for scale in (5, 4, 3, 2, 1):
        old, new = f"{official}.fusion_{scale}", f"{ours}.fuse.{scale}"
        yield from _pair(old, new, {"res_conv1": "conv1", "res_conv2": "conv2", "conv": "join"}, _BARE)
        yield from _pair(old, new, {"res_bn1": "norm1", "res_bn2": "norm2"}, _BATCH_NORM)
    for scale in (5, 4, 3, 2):
        children = {f"upconv_{scale}": f"up.{scale}", f"deconv_{scale - 1}": f"merge.{scale - 1}"}
        yield from _pair(official, ours, {f"{theirs}.conv.conv": name for theirs, name in children.items()}, _FULL)
    head = {"upconv_1.conv.conv": "0", "deconv_0.conv.conv": "3", "depthconv_0.conv": "5"}
    yield from _pair(official, f"{ours}.head", head, _FULL)


def _resnet18(official: str, ours: str) -> Iterator[_Layer]:
    yield f"{official}.conv1", f"{ours}.stem", _BARE
    yield f"{official}.bn1", f"{ours}.stem_norm", _BATCH_NORM
    for stage in range(4):
        for block in (0, 1):
            old, new = f"{official}.layer{stage + 1}.{block}", f"{ours}.stages.{stage}.{block}"
            yield from _pair(old, new, {"conv1": "conv1", "conv2": "conv2"}, _BARE)
            yield from _pair(old, new, {"bn1": "norm1", "bn2": "norm2"}, _BATCH_NORM)
        if stage > 0:
            old, new = f"{official}.layer{stage + 1}.0.downsample", f"{ours}.stages.{stage}.0"
            yield f"{old}.0", f"{new}.shortcut_conv", _BARE
            yield f"{old}.1", f"{new}.shortcut_norm", _BATCH_NORM


def _cost_volume() -> Iterator[_Layer]:
    for stage in range(3):
        official, ours = "depth_predictor", f"cost_volume.levels.{3 - stage}"
        yield from _refinement(f"{official}.corr_refine_nets.{stage}", f"{ours}.refine")
        yield f"{official}.regressor_residuals.{stage}", f"{ours}.shortcut", _FULL
        yield from _pair(f"{official}.depth_heads.{stage}", f"{ours}.head", {"0": "0", "2": "2"}, _FULL)


def _refinement(official: str, ours: str) -> Iterator[_Layer]:
    yield from _pair(official, ours, {"0": "entry", "1": "norm", "4": "exit"}, _FULL)
    yield from _unet(f"{official}.3", f"{ours}.unet")


def _unet(official: str, ours: str) -> Iterator[_Layer]:
    scales, last = 3, 2
    yield f"{official}.input_blocks.0.0", f"{ours}.stem", _FULL
    for scale in range(scales):
        yield from _res_block(f"{official}.input_blocks.{2 * scale + 1}.0", f"{ours}.encoder.{scale}.block")
    for scale in range(last):
        yield f"{official}.input_blocks.{2 * scale + 2}.0.op", f"{ours}.encoder.{scale}.downsample", _FULL
    yield from _attention(f"{official}.input_blocks.{2 * last + 1}.1", f"{ours}.encoder.{last}.attention")
    yield from _res_block(f"{official}.middle_block.0", f"{ours}.middle.0")
    yield from _res_block(f"{official}.middle_block.2", f"{ours}.middle.1")
    for scale in range(scales):
        for block in (0, 1):
            old = f"{official}.output_blocks.{2 * (last - scale) + block}"
            new = f"{ours}.decoder.{scale}"
            yield from _res_block(f"{old}.0", f"{new}.blocks.{block}")
            yield f"{old}.0.skip_connection", f"{new}.blocks.{block}.shortcut", _FULL
            if scale == last:
                yield from _attention(f"{old}.1", f"{new}.attentions.{block}")
        if scale > 0:
            position = 2 if scale == last else 1
            yield f"{old}.{position}.conv", f"{new}.upsample", _FULL
    yield from _pair(f"{official}.out", f"{ours}.exit", {"0": "conv", "1": "norm"}, _FULL)


def _res_block(official: str, ours: str) -> Iterator[_Layer]:
    yield from _pair(f"{official}.in_layers", f"{ours}.first", {"0": "conv", "1": "norm"}, _FULL)
    yield from _pair(f"{official}.out_layers", f"{ours}.second", {"0": "conv", "1": "norm"}, _FULL)


def _attention(official: str, ours: str) -> Iterator[_Layer]:
    yield from _pair(official, ours, {"qkv": "project_in", "proj_out": "project_out", "norm": "norm"}, _FULL)


def _heads() -> Iterator[_Layer]:
    for stage in range(4):
        old, new = f"gaussian_head.to_gaussians_list.{stage}", f"heads.levels.{stage}"
        yield from _pair(old, f"{new}.convs", {"0": "0", "2": "1", "4": "2"}, _FULL)
        yield f"gaussian_head.gaussians_mlp_list.{stage}.0", f"{new}.linear", _FULL
