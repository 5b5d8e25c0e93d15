"""With converted weights, each stage of the network equals the official code, in its standard deviations."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

from pansplat.gaussians.harmonics import rotate_harmonics
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.pose import rotations_from_quats
from pansplat.model.feature_pyramid import encode_positions, make_shift_mask

pytestmark = pytest.mark.shared
ROUNDED = 5e-2
"""With bfloat16 attention float32 rounding flips some roundings, which grow to 3e-2."""


def list_stages(run: Any, truth: dict[str, Tensor]) -> Iterator[tuple[str, Tensor]]:
    """What the modules of PanSplat return, by the name in the fixture."""
    outputs = run.outputs
    panoramas, strips = run.network.mono_depth.prepare_inputs(truth["in.image"][0])
    features = outputs["mono_depth"]
    yield "in.mono_image_sub", panoramas[..., ::8, ::8][None]
    yield "in.cube_image_sub", strips[..., ::8, ::8][None]
    yield "mono.feat_sub", features[..., ::16, ::16]
    yield "mono.pred_depth_sub", run.network.mono_depth.depth(features)[..., ::8, ::8]
    for stage in range(4):
        yield f"backbone.feat.{stage}", outputs["features"][stage]
        yield f"backbone.cnn.{stage}", outputs["features.encoder"][3 - stage][None]
    for view in range(2):
        yield f"transformer.{view}", outputs["features.transformer"][:, view]
    for stage, level in enumerate(outputs["cost_volume"].levels):
        refine = f"cost_volume.levels.{level.level}.refine"
        yield f"s{stage}.unet_in", run.inputs[refine][0]
        yield f"s{stage}.unet_out", outputs[refine][0]
        yield f"s{stage}.logits", level.logits
        if stage:
            yield f"s{stage}.candidates", level.candidates


def list_depths(run: Any) -> Iterator[tuple[str, Tensor]]:
    for stage, level in enumerate(run.outputs["cost_volume"].levels):
        yield f"s{stage}.disp", level.inverse_depth
        yield f"s{stage}.depth", level.depth
        yield f"s{stage}.pdf_max", level.confidence[0][:, None]


def list_gaussians(gaussians: Gaussians, truth: dict[str, Tensor]) -> Iterator[tuple[str, Tensor]]:
    y_z_x = torch.tensor(((0.0, 0, 1), (1, 0, 0), (0, 1, 0)))
    for stage in range(4):
        for view in range(2):
            part = gaussians.select((gaussians.levels == 3 - stage) & (gaussians.views == view))
            for name in ("means", "opacities", "scales", "covariances"):
                yield f"g.s{stage}.v{view}.{name}", getattr(part, name)
            harmonics = rotate_harmonics(part.harmonics, y_z_x).transpose(1, 2)
            yield f"g.s{stage}.v{view}.harmonics", harmonics
            quats = truth[f"g.s{stage}.v{view}.rotations"].roll(1, dims=-1)  # compared as matrices, in the camera
            in_camera = truth["in.extrinsics"][0, view, :3, :3] @ rotations_from_quats(quats)
            yield f"rotations of g.s{stage}.v{view}", rotations_from_quats(part.quats) - in_camera


def test_pansplat(run_official: Callable, golden: Callable, error: Callable) -> None:
    """From a converted checkpoint, images and poses to Gaussians."""
    truth, run = golden("pansplat_64x128_fp32attn"), run_official()
    found = [*list_stages(run, truth), *list_depths(run), *list_gaussians(run.gaussians, truth)]
    errors = {n: error(x, truth[n]) if n in truth else float(x.abs().max()) / 0.57 for n, x in found}
    assert max(errors.values()) < 2e-4, errors
    assert not run.outputs["mono_depth"].requires_grad


@pytest.mark.slow
def test_pansplat_with_bfloat16_attention(run_official: Callable, golden: Callable, error: Callable) -> None:
    truth, run = golden("pansplat_64x128_bf16attn"), run_official(attention="bfloat16")
    found = [*list_depths(run), *list_gaussians(run.gaussians, golden("pansplat_64x128_fp32attn"))]
    errors = {
        n: error(x, truth[n]) for n, x in found if n.endswith(("disp", "depth", "max", "means", "ties", "scales"))
    }
    assert len(errors) == 9 + 24 and max(errors.values()) < ROUNDED, errors
    for ours, exact in zip(run.outputs["cost_volume"].depth, run_official().outputs["cost_volume"].depth, strict=True):
        assert error(ours, exact) > 2e-3, "attention is rounded"


def test_parts_that_no_stage_shows_alone(golden: Callable) -> None:
    units = golden("units")
    assert (encode_positions(4, 8, 128) - units["posenc.4x8"][0]).abs().max() < 1e-6
    assert torch.equal(make_shift_mask(8, 16, 2, "official"), units["shiftmask.8x16"])
