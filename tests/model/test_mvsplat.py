"""The MVSplat baseline: agreement with the official code, symmetries of the fixed network."""

from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from pansplat.errors import InputError
from pansplat.gaussians.harmonics import rotate_harmonics
from pansplat.geometry.pose import rotations_from_quats
from pansplat.model.base import Prediction
from pansplat.model.feature_pyramid import TransformerConfig
from pansplat.model.heads import AdapterConfig, compute_harmonics_rotation
from pansplat.model.mvsplat import MVSplat, MVSplatConfig
from pansplat.model.network import NetworkPredictor
from pansplat.model.weights import convert_tensors

SMALL = MVSplatConfig(
    channels=16,
    candidates=8,
    width=32,
    refine_width=32,
    transformer=TransformerConfig(channels=16, blocks=2),
    adapter=AdapterConfig(degree=1),
)


@dataclass(frozen=True)
class OfficialRun:
    """Output of the official network, with inputs and outputs of its modules by name."""

    output: Prediction
    inputs: dict[str, Tensor]
    outputs: dict[str, Tensor]


@pytest.fixture(scope="module")
def expected(golden: Callable[[str], dict[str, Tensor]]) -> dict[str, Tensor]:
    return golden("mvsplat_64x128_fp32attn")


@pytest.fixture(scope="module")
def run(mvsplat_weights: dict[str, Tensor], as_lightning: Callable, expected: dict[str, Tensor]) -> OfficialRun:
    network = MVSplat(compat="official").eval()
    network.load_state_dict(convert_tensors(as_lightning(mvsplat_weights), "recipe"))
    inputs, outputs = {}, {}
    for name in ("features.transformer", "depth.refine.entry", "refine", "to_depth"):

        def keep(_: object, given: tuple, output: Tensor, name: str = name) -> None:
            inputs[name] = given[0]
            outputs[name] = torch.cat((outputs[name], output)) if name in outputs else output

        network.get_submodule(name).register_forward_hook(keep)
    with torch.no_grad():
        output = network(*(expected[f"in.{name}"] for name in ("image", "extrinsics", "near", "far")))
    return OfficialRun(output, inputs, outputs)


@pytest.mark.shared
def test_features_and_depth_match_the_official_code(run: OfficialRun, expected: dict[str, Tensor], error) -> None:
    for view in range(2):
        assert error(run.outputs["features.transformer"][:, view], expected[f"transformer.{view}"]) < 2e-4
    assert error(run.inputs["depth.refine.entry"], expected["unet_in"]) < 2e-4
    assert error(run.output.depths.levels[-1].logits[0], expected["logits"]) < 2e-4
    assert error(run.outputs["refine"][..., ::2, ::2], expected["refine_sub"]) < 2e-4
    assert error(run.outputs["to_depth"], expected["to_disparity"]) < 2e-4


@pytest.mark.shared
def test_gaussians_match_the_official_code(run: OfficialRun, expected: dict[str, Tensor], error) -> None:
    gaussians = run.output.gaussians[0]
    # The fixture's harmonics are in the axes of docs/official.md, section 10.3.
    to_world = compute_harmonics_rotation(torch.eye(3, dtype=torch.float64), "official")
    for view in range(2):
        part = gaussians.select(gaussians.views == view)
        for name in ("means", "opacities", "scales"):
            assert error(getattr(part, name), expected[f"g.v{view}.{name}"]) < 2e-4, name
        assert error(part.covariances, expected[f"g.v{view}.covariances"]) < 1e-3  # the fixture's own limit
        covariances = expected[f"g.v{view}.covariances"].flatten(1)
        # Relative to each one: the largest has 12 standard deviations, and its rounding depends on the processor.
        difference = (part.covariances.flatten(1) - covariances).norm(dim=1)
        assert (difference / covariances.norm(dim=1)).max() < 2e-4
        assert error(part.harmonics[:, 0], expected[f"g.v{view}.harmonics_dc"]) < 2e-4
        theirs = rotate_harmonics(expected[f"g.v{view}.harmonics_sub"].transpose(-1, -2).double(), to_world)
        assert error(part.harmonics[:: 8192 // len(theirs)].double(), theirs) < 2e-4


@pytest.fixture(scope="module")
def small(randomize: Callable[[torch.nn.Module], torch.nn.Module]) -> MVSplat:
    return randomize(MVSplat(SMALL, "fixed"))


def test_rolling_by_half_a_turn_rolls_the_prediction(small: MVSplat, make_inputs) -> None:
    images, poses, near, far = make_inputs(32)
    half_turn = torch.diag(torch.tensor((-1.0, 1.0, -1.0, 1.0), dtype=torch.float64))
    with torch.no_grad():
        before = small(images, poses, near, far)
        after = small(images.roll(32, dims=-1), poses @ half_turn, near, far)
    rolled = before.depths.inverse_depth[0].roll(8, dims=-1)
    assert torch.allclose(after.depths.inverse_depth[0], rolled, rtol=1e-8)
    means = before.gaussians[0].means.reshape(2, 32, 64, 3).roll(32, dims=2)
    assert torch.allclose(after.gaussians[0].means.reshape(2, 32, 64, 3), means, atol=1e-8)


def test_rotating_the_world_rotates_the_prediction(small: MVSplat, make_inputs) -> None:
    images, poses, near, far = make_inputs(32)
    rotation = rotations_from_quats(torch.tensor((0.3, -0.5, 0.7, 0.2), dtype=torch.float64))
    world = torch.eye(4, dtype=torch.float64)
    world[:3, :3], world[:3, 3] = rotation, torch.tensor((1.0, -2.0, 3.0))
    with torch.no_grad():
        before = small(images, poses, near, far).gaussians[0]
        after = small(images, world @ poses, near, far).gaussians[0]
    assert torch.allclose(after.means, before.means @ rotation.T + world[:3, 3], atol=1e-8)
    assert torch.allclose(after.harmonics, rotate_harmonics(before.harmonics, rotation), atol=1e-8)


def test_batch_items_are_independent(small: MVSplat, make_inputs) -> None:
    inputs = make_inputs(height=32, batch=2, views=3)
    with torch.no_grad():
        together = small(*inputs).gaussians
        apart = [small(*(tensor[n : n + 1] for tensor in inputs)).gaussians[0] for n in range(2)]
    for ours, alone in zip(together, apart, strict=True):
        assert torch.equal(ours.views, torch.arange(3, dtype=torch.uint8).repeat_interleave(32 * 64))
        assert torch.allclose(ours.means, alone.means, atol=1e-9)
        assert torch.allclose(ours.opacities, alone.opacities, atol=1e-9)


def test_gradients_reach_every_weight(small: MVSplat, make_inputs) -> None:
    gaussians = small(*make_inputs(32)).gaussians[0]
    loss = gaussians.means.square().mean() + gaussians.opacities.mean() + gaussians.harmonics.square().mean()
    loss = loss + gaussians.scales.mean() + gaussians.quats.sum(dim=0).square().mean()
    gradients = torch.autograd.grad(loss, list(small.parameters()))
    names = [name for name, _ in small.named_parameters()]
    without = [name for name, gradient in zip(names, gradients, strict=True) if not gradient.abs().max() > 0]
    assert not without


def test_an_mvsplat_predictor_applies_masks(small: MVSplat, make_inputs) -> None:
    predictor = NetworkPredictor("mvsplat", small)
    images, poses, _, _ = (tensor[0] for tensor in make_inputs())
    masks = torch.ones(2, 64, 128, dtype=torch.bool)
    masks[0, 32:] = False
    gaussians = predictor(images, poses, 0.5, 20.0, masks=masks)
    counts = [int((gaussians.views == view).sum()) for view in range(2)]
    assert counts[1] == 64 * 128 and 0.4 < counts[0] / counts[1] < 0.6
    assert predictor.fingerprint.startswith("mvsplat-fixed-")


def test_unusable_views_and_sizes_are_refused(make_inputs) -> None:
    network = MVSplat(SMALL, "official").double()
    with pytest.raises(InputError, match="exactly two views"):
        network(*make_inputs(views=3))
    with pytest.raises(InputError, match="a height and a width that 16 divides, got 40x80"):
        network(*make_inputs(height=40))
