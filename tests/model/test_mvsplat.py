"""The MVSplat baseline: the original's numbers, and what the corrected network keeps."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from pansplat.errors import InputError
from pansplat.gaussians.harmonics import rotate_harmonics
from pansplat.geometry.pose import rotations_from_quats
from pansplat.model.feature_pyramid import TransformerConfig
from pansplat.model.heads import AdapterConfig, world_harmonics_rotation
from pansplat.model.mvsplat import MVSplat, MVSplatConfig, MVSplatOutput
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
TOLERANCE = 2e-4  # of the golden tensor's standard deviation


@pytest.fixture(scope="module")
def expected(golden: Callable[[str], dict[str, Tensor]]) -> dict[str, Tensor]:
    return golden("mvsplat_64x128_fp32attn")


@pytest.fixture(scope="module")
def seen(
    mvsplat_weights: dict[str, Tensor],
    as_lightning: Callable[[dict[str, Tensor]], dict[str, object]],
    expected: dict[str, Tensor],
) -> tuple[MVSplatOutput, dict[str, Tensor]]:
    """The output, and what went on inside: name of the module to its output."""
    network = MVSplat(compat="official").eval()
    network.load_state_dict(convert_tensors(as_lightning(mvsplat_weights), "recipe"))
    inside: dict[str, Tensor] = {}
    for name in ("features.transformer", "depth.refine.entry", "upsampler", "refine", "to_depth"):
        module = network.get_submodule(name)

        def keep(module: object, given: tuple, made: Tensor, name: str = name) -> None:
            inside[f"{name}.input"] = given[0]
            inside[name] = torch.cat((inside[name], made)) if name == "to_depth" and name in inside else made

        module.register_forward_hook(keep)
    with torch.no_grad():
        output = network(*(expected[f"in.{name}"] for name in ("image", "extrinsics", "near", "far")))
    return output, inside


def deviation(ours: Tensor, theirs: Tensor) -> float:
    assert ours.shape == theirs.shape
    return float((ours - theirs).abs().max() / theirs.std())


def test_features_and_depth_are_the_originals(
    seen: tuple[MVSplatOutput, dict[str, Tensor]], expected: dict[str, Tensor]
) -> None:
    output, inside = seen
    for view in range(2):
        ours = inside["features.transformer"][:, view]
        assert deviation(ours, expected[f"transformer.{view}"]) < TOLERANCE
    assert deviation(inside["depth.refine.entry.input"], expected["unet_in"]) < TOLERANCE
    assert deviation(output.depths.levels[-1].logits[0], expected["logits"]) < TOLERANCE
    assert deviation(inside["refine"][..., ::2, ::2], expected["refine_sub"]) < TOLERANCE
    assert deviation(inside["to_depth"], expected["to_disparity"]) < TOLERANCE


def test_gaussians_are_the_originals(
    seen: tuple[MVSplatOutput, dict[str, Tensor]], expected: dict[str, Tensor]
) -> None:
    gaussians = seen[0].gaussians[0]
    for view in range(2):
        own = gaussians.select(gaussians.views == view)
        for name in ("means", "covariances", "opacities", "scales"):
            assert deviation(getattr(own, name), expected[f"g.v{view}.{name}"]) < TOLERANCE, name
        assert deviation(own.harmonics[:, 0], expected[f"g.v{view}.harmonics_dc"]) < TOLERANCE


def test_colours_are_the_originals(seen: tuple[MVSplatOutput, dict[str, Tensor]], expected: dict[str, Tensor]) -> None:
    """Theirs are in the original's axes (OFFICIAL.md, 10.3): turned to the world's they are ours."""
    gaussians = seen[0].gaussians[0]
    for view in range(2):
        theirs = expected[f"g.v{view}.harmonics_sub"].transpose(-1, -2)
        axes = world_harmonics_rotation(torch.eye(3, dtype=torch.float64), "official")
        turned = rotate_harmonics(theirs.double(), axes)
        ours = gaussians.select(gaussians.views == view).harmonics[:: 8192 // len(theirs)]
        assert deviation(ours.double(), turned) < TOLERANCE


def _inputs(height: int = 64, views: int = 2, batch: int = 1) -> tuple[Tensor, ...]:
    generator = torch.Generator().manual_seed(1)
    poses = torch.eye(4, dtype=torch.float64).repeat(batch, views, 1, 1)
    quats = torch.randn(batch, views, 4, generator=generator, dtype=torch.float64)
    poses[..., :3, :3] = rotations_from_quats(quats)
    poses[..., :3, 3] = 0.3 * torch.randn(batch, views, 3, generator=generator, dtype=torch.float64)
    images = torch.rand(batch, views, 3, height, 2 * height, generator=generator, dtype=torch.float64)
    near, far = (torch.full((batch, views), bound, dtype=torch.float64) for bound in (0.5, 20.0))
    return images, poses, near, far


@pytest.fixture(scope="module")
def small(randomize: Callable[[torch.nn.Module], torch.nn.Module]) -> MVSplat:
    network = randomize(MVSplat(SMALL, "fixed").double()).eval()
    assert isinstance(network, MVSplat)
    return network


def test_rolling_the_panoramas_rolls_the_depth(small: MVSplat) -> None:
    images, poses, near, far = _inputs()
    turned = poses.clone()
    turned[..., :3, :3] = poses[..., :3, :3] * torch.tensor((-1.0, 1.0, -1.0))  # half a turn about the camera's y
    with torch.no_grad():
        before = small(images, poses, near, far)
        after = small(images.roll(64, dims=-1), turned, near, far)
    rolled = before.depths.inverse_depth[0].roll(16, dims=-1)
    assert torch.allclose(after.depths.inverse_depth[0], rolled, rtol=1e-8)
    means = before.gaussians[0].means.reshape(2, 64, 128, 3).roll(64, dims=2)
    assert torch.allclose(after.gaussians[0].means.reshape(2, 64, 128, 3), means, atol=1e-8)


def test_turning_the_world_turns_the_prediction(small: MVSplat) -> None:
    images, poses, near, far = _inputs()
    rotation = rotations_from_quats(torch.tensor((0.3, -0.5, 0.7, 0.2), dtype=torch.float64))
    world = torch.eye(4, dtype=torch.float64)
    world[:3, :3], world[:3, 3] = rotation, torch.tensor((1.0, -2.0, 3.0))
    with torch.no_grad():
        before = small(images, poses, near, far).gaussians[0]
        after = small(images, world @ poses, near, far).gaussians[0]
    assert torch.allclose(after.means, before.means @ rotation.T + world[:3, 3], atol=1e-8)
    assert torch.allclose(after.harmonics, rotate_harmonics(before.harmonics, rotation), atol=1e-8)


def test_a_batch_is_its_items(small: MVSplat) -> None:
    inputs = _inputs(height=32, batch=2, views=3)
    with torch.no_grad():
        together = small(*inputs).gaussians
        apart = [small(*(tensor[n : n + 1] for tensor in inputs)).gaussians[0] for n in range(2)]
    for ours, alone in zip(together, apart, strict=True):
        assert torch.equal(ours.views, torch.arange(3, dtype=torch.uint8).repeat_interleave(32 * 64))
        assert torch.allclose(ours.means, alone.means, atol=1e-9)
        assert torch.allclose(ours.opacities, alone.opacities, atol=1e-9)


def test_gradients_reach_every_weight(small: MVSplat) -> None:
    gaussians = small(*_inputs()).gaussians[0]
    loss = gaussians.means.square().mean() + gaussians.opacities.mean() + gaussians.harmonics.square().mean()
    loss = loss + gaussians.scales.mean() + gaussians.quats.sum(dim=0).square().mean()
    gradients = torch.autograd.grad(loss, list(small.parameters()))
    names = [name for name, _ in small.named_parameters()]
    still = [name for name, gradient in zip(names, gradients, strict=True) if not gradient.abs().max() > 0]
    assert not still


def test_the_predictor_masks_and_names_it(small: MVSplat) -> None:
    predictor = NetworkPredictor("mvsplat", small)
    images, poses, _, _ = (tensor[0] for tensor in _inputs())
    masks = torch.ones(2, 64, 128, dtype=torch.bool)
    masks[0, 32:] = False
    gaussians = predictor(images, poses, 0.5, 20.0, masks=masks)
    counts = [int((gaussians.views == view).sum()) for view in range(2)]
    assert counts[1] == 64 * 128 and 0.4 < counts[0] / counts[1] < 0.6
    assert predictor.fingerprint.startswith("mvsplat-fixed-")


def test_what_it_cannot_take_is_refused() -> None:
    network = MVSplat(SMALL, "official").double()
    with pytest.raises(InputError, match="exactly two views"):
        network(*_inputs(views=3))
    with pytest.raises(InputError, match="a height and a width that 16 divides, got 40x80"):
        network(*_inputs(height=40))
