"""The original's names of layers, and ours: one table.

A row names a layer as the original does and as we do, and the tensors that belong to it. The original counts its
stages from the coarsest (0); our levels are the paper's, where 0 is the finest.

Source: OFFICIAL.md, sections 3 to 8, 15 and 16.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

Model = Literal["pansplat", "mvsplat"]
Row = tuple[str, str, tuple[str, ...]]  # the original's layer, our layer, its tensors

_BARE = ("weight",)
_FULL = ("weight", "bias")
_POINTWISE = ("weight squeezed", "bias")  # a 1-D convolution over tokens there, a linear layer here
_BATCH_NORM = ("weight", "bias", "running_mean", "running_var", "num_batches_tracked")


def tensor_names(row: Row) -> Iterator[tuple[str, str, bool]]:
    """The original's name, ours, and whether a last axis of 1 goes, for each tensor of a row."""
    theirs, ours, kinds = row
    for kind in kinds:
        tensor, _, squeezed = kind.partition(" ")
        yield f"{theirs}.{tensor}", f"{ours}.{tensor}", squeezed != ""


def rows(model: Model) -> Iterator[Row]:
    """The table's rows of a network."""
    if model == "mvsplat":
        yield from _mvsplat()
        return
    yield from _feature_pyramid()
    yield from _transformer("backbone.transformer", "features.transformer")
    yield from _mono_depth()
    yield from _cost_volume()
    yield from _heads()


def _feature_pyramid() -> Iterator[Row]:
    encoder = (
        ("conv00", "0.0"),
        ("conv01", "0.1"),
        ("downsample1", "1.0"),
        ("conv10", "1.1"),
        ("conv11", "1.2"),
        ("downsample2", "2.0"),
        ("conv20", "2.1"),
        ("conv21", "2.2"),
        ("downsample3", "3.0"),
        ("conv30", "3.1"),
        ("conv31", "3.2"),
    )
    for theirs, ours in encoder:
        yield f"backbone.encoder.{theirs}.conv", f"features.encoder.levels.{ours}.conv", _BARE
        yield f"backbone.encoder.{theirs}.bn", f"features.encoder.levels.{ours}.norm", _BATCH_NORM
    for stage in range(4):
        theirs, ours = f"backbone.decoder.out{stage}", f"features.decoder.outputs.{3 - stage}"
        yield f"{theirs}.0", f"{ours}.conv", _FULL
        yield f"{theirs}.1", f"{ours}.norm", _BATCH_NORM
    for stage in (1, 2, 3):
        yield f"backbone.decoder.inner{stage}", f"features.decoder.laterals.{3 - stage}", _FULL


def _transformer(theirs: str, ours: str) -> Iterator[Row]:
    for block in range(6):
        old, new = f"{theirs}.layers.{block}", f"{ours}.blocks.{block}"
        for layer, attention in (("self_attn", "within"), ("cross_attn_ffn", "across")):
            yield f"{old}.{layer}.q_proj", f"{new}.{attention}.query", _BARE
            yield f"{old}.{layer}.k_proj", f"{new}.{attention}.key", _BARE
            yield f"{old}.{layer}.v_proj", f"{new}.{attention}.value", _BARE
            yield f"{old}.{layer}.merge", f"{new}.{attention}.merge", _BARE
            yield f"{old}.{layer}.norm1", f"{new}.{attention}.norm", _FULL
        yield f"{old}.cross_attn_ffn.mlp.0", f"{new}.widen", _BARE
        yield f"{old}.cross_attn_ffn.mlp.2", f"{new}.narrow", _BARE
        yield f"{old}.cross_attn_ffn.norm2", f"{new}.norm", _FULL


def _mono_depth() -> Iterator[Row]:
    yield "mono_depth", "mono_depth", ("max_depth",)
    yield from _resnet18("mono_depth.equi_encoder", "mono_depth.panorama_encoder")
    yield from _resnet18("mono_depth.cube_encoder", "mono_depth.face_encoder")
    theirs, ours = "mono_depth.equi_decoder", "mono_depth.decoder"
    for scale in (5, 4, 3, 2, 1):
        yield f"{theirs}.fusion_{scale}.res_conv1", f"{ours}.fuse.{scale}.conv1", _BARE
        yield f"{theirs}.fusion_{scale}.res_bn1", f"{ours}.fuse.{scale}.norm1", _BATCH_NORM
        yield f"{theirs}.fusion_{scale}.res_conv2", f"{ours}.fuse.{scale}.conv2", _BARE
        yield f"{theirs}.fusion_{scale}.res_bn2", f"{ours}.fuse.{scale}.norm2", _BATCH_NORM
        yield f"{theirs}.fusion_{scale}.conv", f"{ours}.fuse.{scale}.join", _BARE
    for scale in (5, 4, 3, 2):
        yield f"{theirs}.upconv_{scale}.conv.conv", f"{ours}.up.{scale}", _FULL
        yield f"{theirs}.deconv_{scale - 1}.conv.conv", f"{ours}.merge.{scale - 1}", _FULL
    yield f"{theirs}.upconv_1.conv.conv", f"{ours}.head.0", _FULL
    yield f"{theirs}.deconv_0.conv.conv", f"{ours}.head.3", _FULL
    yield f"{theirs}.depthconv_0.conv", f"{ours}.head.5", _FULL


def _resnet18(theirs: str, ours: str) -> Iterator[Row]:
    yield f"{theirs}.conv1", f"{ours}.stem", _BARE
    yield f"{theirs}.bn1", f"{ours}.stem_norm", _BATCH_NORM
    for stage in range(4):
        for block in (0, 1):
            old, new = f"{theirs}.layer{stage + 1}.{block}", f"{ours}.stages.{stage}.{block}"
            for layer in (1, 2):
                yield f"{old}.conv{layer}", f"{new}.conv{layer}", _BARE
                yield f"{old}.bn{layer}", f"{new}.norm{layer}", _BATCH_NORM
        if stage > 0:
            old, new = f"{theirs}.layer{stage + 1}.0.downsample", f"{ours}.stages.{stage}.0"
            yield f"{old}.0", f"{new}.shortcut_conv", _BARE
            yield f"{old}.1", f"{new}.shortcut_norm", _BATCH_NORM


def _cost_volume() -> Iterator[Row]:
    for stage in range(3):
        ours = f"cost_volume.levels.{3 - stage}"
        yield from _refinement(f"depth_predictor.corr_refine_nets.{stage}", f"{ours}.refine", scales=3)
        yield f"depth_predictor.regressor_residuals.{stage}", f"{ours}.shortcut", _FULL
        yield f"depth_predictor.depth_heads.{stage}.0", f"{ours}.head.0", _FULL
        yield f"depth_predictor.depth_heads.{stage}.2", f"{ours}.head.2", _FULL


def _refinement(theirs: str, ours: str, scales: int) -> Iterator[Row]:
    yield f"{theirs}.0", f"{ours}.entry", _FULL
    yield f"{theirs}.1", f"{ours}.norm", _FULL
    yield from _unet(f"{theirs}.3", f"{ours}.unet", scales)
    yield f"{theirs}.4", f"{ours}.exit", _FULL


def _unet(theirs: str, ours: str, scales: int) -> Iterator[Row]:
    last = scales - 1
    yield f"{theirs}.input_blocks.0.0", f"{ours}.stem", _FULL
    for scale in range(scales):
        yield from _res_block(f"{theirs}.input_blocks.{2 * scale + 1}.0", f"{ours}.encoder.{scale}.block")
    for scale in range(last):
        yield f"{theirs}.input_blocks.{2 * scale + 2}.0.op", f"{ours}.encoder.{scale}.downsample", _FULL
    yield from _attention(f"{theirs}.input_blocks.{2 * last + 1}.1", f"{ours}.encoder.{last}.attention")
    yield from _res_block(f"{theirs}.middle_block.0", f"{ours}.middle.0")
    yield from _res_block(f"{theirs}.middle_block.2", f"{ours}.middle.1")
    for scale in range(scales):
        for block in (0, 1):
            old = f"{theirs}.output_blocks.{2 * (last - scale) + block}"
            new = f"{ours}.decoder.{scale}"
            yield from _res_block(f"{old}.0", f"{new}.blocks.{block}")
            yield f"{old}.0.skip_connection", f"{new}.blocks.{block}.shortcut", _FULL
            if scale == last:
                yield from _attention(f"{old}.1", f"{new}.attentions.{block}")
        if scale > 0:
            position = 2 if scale == last else 1
            yield f"{old}.{position}.conv", f"{new}.upsample", _FULL
    yield f"{theirs}.out.0", f"{ours}.exit.conv", _FULL
    yield f"{theirs}.out.1", f"{ours}.exit.norm", _FULL


def _res_block(theirs: str, ours: str) -> Iterator[Row]:
    yield f"{theirs}.in_layers.0", f"{ours}.first.conv", _FULL
    yield f"{theirs}.in_layers.1", f"{ours}.first.norm", _FULL
    yield f"{theirs}.out_layers.0", f"{ours}.second.conv", _FULL
    yield f"{theirs}.out_layers.1", f"{ours}.second.norm", _FULL


def _attention(theirs: str, ours: str) -> Iterator[Row]:
    yield f"{theirs}.qkv", f"{ours}.project_in", _POINTWISE
    yield f"{theirs}.proj_out", f"{ours}.project_out", _POINTWISE
    yield f"{theirs}.norm", f"{ours}.norm", _FULL


def _heads() -> Iterator[Row]:
    for stage in range(4):
        for layer in range(3):
            theirs = f"gaussian_head.to_gaussians_list.{stage}.{2 * layer}"
            yield theirs, f"heads.levels.{stage}.convs.{layer}", _FULL
        yield f"gaussian_head.gaussians_mlp_list.{stage}.0", f"heads.levels.{stage}.linear", _FULL


def _mvsplat() -> Iterator[Row]:
    yield from _mvsplat_encoder()
    yield from _transformer("backbone.transformer", "features.transformer")
    theirs, ours = "depth_predictor", "depth"
    yield from _refinement(f"{theirs}.corr_refine_net", f"{ours}.refine", scales=3)
    yield f"{theirs}.regressor_residual", f"{ours}.shortcut", _FULL
    yield f"{theirs}.depth_head_lowres.0", f"{ours}.head.0", _FULL
    yield f"{theirs}.depth_head_lowres.2", f"{ours}.head.2", _FULL
    yield f"{theirs}.upsampler.0", "upsampler", _FULL
    yield f"{theirs}.proj_feature", "project", _FULL
    yield f"{theirs}.refine_unet.0", "refine.entry", _FULL
    yield f"{theirs}.refine_unet.1", "refine.norm", _FULL
    yield from _unet(f"{theirs}.refine_unet.3", "refine.unet", scales=5)
    for layer in (0, 2):
        yield f"{theirs}.to_gaussians.{layer}", f"to_gaussians.{layer}", _FULL
        yield f"{theirs}.to_disparity.{layer}", f"to_depth.{layer}", _FULL


def _mvsplat_encoder() -> Iterator[Row]:
    theirs, ours = "backbone.backbone", "features.encoder"
    yield f"{theirs}.conv1", f"{ours}.stem", _BARE
    for stage in range(3):
        for block in (0, 1):
            for layer in (1, 2):
                old = f"{theirs}.layer{stage + 1}.{block}.conv{layer}"
                yield old, f"{ours}.blocks.{2 * stage + block}.conv{layer}", _BARE
        if stage > 0:
            yield f"{theirs}.layer{stage + 1}.0.downsample.0", f"{ours}.blocks.{2 * stage}.shortcut.0", _FULL
    yield f"{theirs}.conv2", f"{ours}.exit", _FULL
