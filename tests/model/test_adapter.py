"""From raw numbers to Gaussians in the world."""

import math
from collections.abc import Callable

import pytest
import torch

from pansplat.gaussians.harmonics import evaluate_harmonics, harmonics_basis, rotate_harmonics
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.equirect import directions_from_uv, uv_from_directions
from pansplat.geometry.pose import rotations_from_quats
from pansplat.model.heads import AdapterConfig, adapt_gaussians


def _random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def _pose(seed: int = 5) -> torch.Tensor:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotations_from_quats(_random(4, seed=seed))
    pose[:3, 3] = _random(3, seed=seed + 1)
    return pose


def _adapt(cam2world: torch.Tensor, compat="fixed", colors=None, parameters=None, degree: int = 4) -> Gaussians:
    config = AdapterConfig(degree=degree)
    count = 30
    return adapt_gaussians(
        _random(count, config.num_parameters) if parameters is None else parameters,
        _random(count, 2, seed=1).sigmoid(),
        _random(count, seed=2).exp(),
        _random(count, seed=3).sigmoid(),
        cam2world,
        map_height=64,
        colors=colors,
        level=2,
        view=1,
        config=config,
        compat=compat,
    )


def test_means_lie_at_their_depth_along_their_ray():
    pose = _pose()
    local = (_adapt(pose).means - pose[:3, 3]) @ pose[:3, :3]
    assert torch.allclose(local.norm(dim=-1), _random(30, seed=2).exp())
    assert torch.allclose(uv_from_directions(local), _random(30, 2, seed=1).sigmoid())


def test_labels_are_those_given():
    gaussians = _adapt(_pose())
    assert gaussians.levels.unique().tolist() == [2] and gaussians.views.unique().tolist() == [1]


def test_scales_span_a_tenth_to_three_pixels():
    depths = _random(30, seed=2).exp()[:, None]
    for raw, fifths in ((-50.0, 0.5), (50.0, 15.0)):
        parameters = torch.full((30, 82), raw, dtype=torch.float64)
        scales = _adapt(_pose(), parameters=parameters).scales
        assert torch.allclose(scales / depths, torch.full_like(scales, fifths * 0.2 * math.pi / 64))


def test_the_rotation_is_xyzw_in_camera_axes():
    parameters = torch.zeros(30, 82, dtype=torch.float64)
    parameters[:, 3:7] = torch.tensor((0.6, 0.0, 0.0, 0.8))  # about x
    angle = 2 * math.acos(0.8)
    about_x = torch.tensor(
        ((1, 0, 0), (0, math.cos(angle), -math.sin(angle)), (0, math.sin(angle), math.cos(angle)))
    ).double()
    pose = _pose()
    turned = rotations_from_quats(_adapt(pose, parameters=parameters).quats)
    assert torch.allclose(turned, (pose[:3, :3] @ about_x).expand_as(turned), atol=1e-7)


def test_a_base_colour_is_added_to_what_is_predicted():
    colors = _random(30, 3, seed=9).sigmoid()
    plain, based = _adapt(_pose()), _adapt(_pose(), colors=colors)
    difference = based.harmonics - plain.harmonics
    assert torch.allclose(difference[:, 0], 2 * colors - 1) and float(difference[:, 1:].abs().max()) < 1e-14


@pytest.mark.parametrize("degree", range(5))
def test_turning_the_world_turns_the_gaussians(degree: int):
    pose, world = _pose(), _pose(seed=11)
    before, after = _adapt(pose, degree=degree), _adapt(world @ pose, degree=degree)
    rotation = world[:3, :3]
    assert torch.allclose(after.means, before.means @ rotation.T + world[:3, 3], atol=1e-12)
    assert torch.allclose(after.covariances, rotation @ before.covariances @ rotation.T, atol=1e-14)
    assert torch.allclose(after.harmonics, rotate_harmonics(before.harmonics, rotation), atol=1e-13)
    assert torch.equal(after.scales, before.scales) and torch.equal(after.opacities, before.opacities)


def test_the_originals_harmonics_turn_wrongly_but_for_a_turn_about_y():
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotations_from_quats(torch.tensor((0.9, 0.0, -0.3, 0.0), dtype=torch.float64))
    assert torch.allclose(_adapt(pose, "official").harmonics, _adapt(pose, "fixed").harmonics, atol=1e-14)
    pose[:3, :3] = rotations_from_quats(torch.tensor((0.9, 0.3, 0.0, 0.0), dtype=torch.float64))
    assert float((_adapt(pose, "official").harmonics - _adapt(pose, "fixed").harmonics).abs().max()) > 0.01


def test_every_raw_harmonic_changes_the_colour():
    for k in range(25):
        parameters = torch.zeros(30, 82, dtype=torch.float64)
        parameters[:, 3] = 1
        parameters[:, 7 + 25 + k] = 1000.0  # green
        colors = evaluate_harmonics(
            _adapt(_pose(), parameters=parameters).harmonics, directions_from_uv(_random(30, 2))
        )
        assert float((colors[:, 1] - 0.5).abs().max()) > 0.01
        assert torch.allclose(colors[:, 0], torch.full_like(colors[:, 0], 0.5), atol=1e-9)


def test_the_networks_basis_has_y_as_its_polar_axis():
    """The k-th raw coefficient is the colour B_k(d) that the original's rasteriser gives it (OFFICIAL.md, 10.3)."""
    directions = torch.nn.functional.normalize(_random(30, 3, seed=4), dim=-1)
    x, y, z = directions.T
    xx, yy, zz = x * x, y * y, z * z
    expected = [
        0.28209479 + 0 * x, -0.48860251 * x, 0.48860251 * y, -0.48860251 * z,
        1.09254843 * z * x, -1.09254843 * x * y, 0.31539157 * (2 * yy - zz - xx), -1.09254843 * z * y,
        0.54627422 * (zz - xx),
        -0.59004359 * x * (3 * zz - xx), 2.89061144 * z * x * y, -0.45704580 * x * (4 * yy - zz - xx),
        0.37317633 * y * (2 * yy - 3 * zz - 3 * xx), -0.45704580 * z * (4 * yy - zz - xx),
        1.44530572 * y * (zz - xx),  # the rasteriser reads z for this y: its defect, not the network's
        -0.59004359 * z * (zz - 3 * xx),
    ]  # fmt: skip
    for k, function in enumerate(expected):
        parameters = torch.zeros(30, 7 + 48, dtype=torch.float64)
        parameters[:, 7 + k] = 1 / (1.0 if k == 0 else 0.1 * 0.25 ** math.isqrt(k))
        harmonics = _adapt(torch.eye(4, dtype=torch.float64), parameters=parameters, degree=3).harmonics
        color = (harmonics_basis(directions, 3)[:, None] @ harmonics)[:, 0, 0]
        assert torch.allclose(color, function, atol=1e-7)


def test_gradients_reach_every_number():
    pose = _pose()

    def of(parameters: torch.Tensor, uv: torch.Tensor, depths: torch.Tensor, colors: torch.Tensor) -> tuple:
        gaussians = adapt_gaussians(
            parameters, uv, depths, torch.ones_like(depths), pose, map_height=8, colors=colors, level=0, view=0,
            config=AdapterConfig(degree=1), compat="fixed",
        )  # fmt: skip
        return gaussians.means, gaussians.scales, gaussians.quats, gaussians.harmonics

    inputs = (_random(3, 19), _random(3, 2).sigmoid(), _random(3).exp(), _random(3, 3).sigmoid())
    assert torch.autograd.gradcheck(of, [tensor.requires_grad_() for tensor in inputs])


@pytest.mark.shared
def test_the_originals_rotation_of_harmonics_is_reproduced(golden: Callable[[str], dict[str, torch.Tensor]]):
    units = golden("units")
    pose = torch.eye(4, dtype=torch.float64)
    y_z_x = torch.tensor(((0.0, 0, 1), (1, 0, 0), (0, 1, 0)), dtype=torch.float64)
    damping = torch.tensor([1.0] + [0.1 * 0.25 ** math.isqrt(k) for k in range(1, 25)], dtype=torch.float64)
    for raw, turned, rotation in zip(units["sh.in"], units["sh.out"], units["sh.rotations"], strict=True):
        pose[:3, :3] = rotation
        parameters = torch.zeros(30, 82, dtype=torch.float64)
        parameters[:, 7:] = (raw.double() / damping).flatten()
        harmonics = _adapt(pose, "official", parameters=parameters).harmonics[0]
        assert torch.allclose(rotate_harmonics(harmonics, y_z_x).T, turned.double(), atol=5e-5)
