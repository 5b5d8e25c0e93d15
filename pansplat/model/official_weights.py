"""Conversion of the weights of official checkpoints.

It is strict: a tensor that is missing, unknown or not finite is an error.

Source: docs/official.md, sections 3 to 8 and 15.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping

import torch
from torch import Tensor

from pansplat.errors import InputError
from pansplat.geometry.cubemap import strip_lookup
from pansplat.networks.weights import as_float32, get_state_dict, join_names

_Layer = tuple[str, str, tuple[str, ...]]  # official name, our name, tensors
_BARE = ("weight",)
_FULL = ("weight", "bias")
_BATCH_NORM = ("weight", "bias", "running_mean", "running_var", "num_batches_tracked")
_PREFIX = "encoder."  # prefix of the network's tensors in a Lightning checkpoint
_AUXILIARY_PREFIX = "losses.2.gaussian_head."
_GRID_HEIGHTS = {f"mono_depth.c2e.{scale}.sample_grid": 512 >> scale for scale in (5, 4, 3, 2, 1)}
"""Heights of the panoramas of the stored lookup grids, which are recomputed here."""


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
        f"{problem} {join_names(names)}"
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
    names = join_names(list(state)) if state else "none"
    if any(name.startswith("encoder.backbone.backbone.") for name in state):
        names = f"{names} of its MVSplat baseline, which has no Gaussian heads"
    raise InputError(f"{source}: needed a checkpoint of the official PanSplat, got tensors {names}; use another file")


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
