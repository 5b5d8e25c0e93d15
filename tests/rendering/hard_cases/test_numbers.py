"""Hard cases 21, 22, 24, 25 and 26: extreme numbers, units and types."""

import dataclasses
import math

import pytest
import torch

from pansplat.errors import InputError

_FIELDS = ("means", "scales", "quats", "opacities", "harmonics")


@pytest.mark.hard_case(21)
def test_quaternions_of_any_length_are_rotations_and_zero_is_the_identity(render, make_scene, pose, leaves, loss_of):
    scene = make_scene(8, scale=0.3, degree=0)
    scene = dataclasses.replace(scene, quats=torch.nn.functional.normalize(scene.quats, dim=1))
    expected = render(scene, pose).color
    for factor in (-1.0, 2.0, 1e-6, 1e6):
        got = render(dataclasses.replace(scene, quats=factor * scene.quats), pose).color
        assert (got - expected).abs().max() < 10 * render.image
    upright = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).expand(8, 4)
    zero = render(dataclasses.replace(scene, quats=0 * scene.quats), pose).color
    assert torch.equal(zero, render(dataclasses.replace(scene, quats=upright), pose).color)
    quats = scene.quats.clone()
    quats[0] = 0
    inputs = leaves(dataclasses.replace(scene, quats=quats).to(dtype=render.dtype))
    loss_of(render(inputs, pose)).backward()
    gradient = inputs.quats.grad
    assert torch.isfinite(gradient).all()
    radial = (gradient * inputs.quats.detach()).sum(dim=1).abs()[1:]
    assert float(radial.max()) < 1e-4 * float(gradient.norm(dim=1)[1:].max())  # tangential


@pytest.mark.slow
@pytest.mark.hard_case(22)
@pytest.mark.parametrize("field", _FIELDS)
@pytest.mark.parametrize("poison", [math.nan, math.inf, -math.inf, 1e38])
def test_a_number_that_is_not_finite_drops_only_its_gaussian(field, poison, render, make_scene, pose, leaves, loss_of):
    render.skip_interpreted(not math.isnan(poison))
    scene = make_scene(6, scale=0.3, degree=1).to(dtype=render.dtype)
    value = getattr(scene, field).clone()
    value.reshape(6, -1)[2, -1] = poison
    poisoned = leaves(dataclasses.replace(scene, **{field: value}))
    rest = torch.tensor([0, 1, 3, 4, 5])
    clean = leaves(scene.select(rest))
    got, expected = render(poisoned, pose), render(clean, pose)
    assert got.info is not None and got.info.dropped == 1
    for name in ("color", "alpha", "depth"):
        assert torch.equal(getattr(got, name), getattr(expected, name))
    loss_of(got).backward()
    loss_of(expected).backward()
    for name in _FIELDS:
        found, reference = getattr(poisoned, name).grad, getattr(clean, name).grad
        assert not found[2].any() and torch.equal(found[rest], reference), name
    with pytest.raises(InputError, match=r"1 of 6 that do not .*number 2.*strict=False"):
        render(poisoned, pose, strict=True)


def _scaled(scene, unit: float):
    return dataclasses.replace(scene, means=unit * scene.means, scales=unit * scene.scales)


@pytest.mark.slow
@pytest.mark.hard_case(24)
@pytest.mark.hard_case(25)
@pytest.mark.parametrize("unit", [1e-18, 1e-9, 1e-3, 1e4, 1e9, 1e18])
@pytest.mark.parametrize("kernel", ["ray", "ewa"])
def test_images_do_not_depend_on_the_unit_of_length(unit, kernel, render, make_scene, pose, gradients):
    render.skip_interpreted(unit not in (1e-18, 1e18) or kernel == "ewa")
    scene = make_scene(10, scale=0.5, degree=0)
    scene = scene.select((scene.means - pose[:3, 3]).norm(dim=1) > 0.2)
    camera = pose.clone()
    camera[:3, 3] *= unit
    options = {"kernel": kernel, "layout": "cubemap" if kernel == "ewa" else "equirect"}
    before = render(scene, pose, near=0.05, **options)
    after = render(_scaled(scene, unit), camera, near=0.05 * unit, **options)
    assert float(before.alpha.mean()) > 0.05
    assert torch.isfinite(after.color).all() and torch.isfinite(after.depth).all()
    # A unit that is not a power of two changes the rounding: a pixel at a cut may flip.
    off = (before.color - after.color).abs()
    assert float(off.max()) < 1 / 200 and float((off > 20 * render.image).double().mean()) < 0.02
    seen = before.alpha > 0.05
    assert torch.allclose((before.depth * unit)[seen], after.depth[seen], rtol=1e-3)
    for name, gradient in gradients(render, _scaled(scene, unit), camera, near=0.05 * unit, **options).items():
        assert torch.isfinite(gradient).all() and gradient.any(), name


@pytest.mark.hard_case(24)
@pytest.mark.parametrize("unit", [2.0**-10, 2.0**13])
def test_gradients_are_inversely_proportional_to_the_unit(unit, render, make_scene, pose, leaves):
    """A unit that is a power of two changes no rounding."""
    scene = make_scene(8, scale=0.3, degree=0)
    camera = pose.clone()
    camera[:3, 3] *= unit
    pairs = []
    for inputs, eye, near in ((scene, pose, 0.0625), (_scaled(scene, unit), camera, 0.0625 * unit)):
        inputs = leaves(inputs.to(dtype=render.dtype))
        image = render(inputs, eye, near=near)
        image.color.sum().backward()
        pairs.append((inputs, image.color.detach()))
    (small, before), (large, after) = pairs
    assert (before - after).abs().max() <= render.image
    for name, power in (("means", -1), ("scales", -1), ("opacities", 0), ("harmonics", 0)):
        expected, found = getattr(small, name).grad * unit**power, getattr(large, name).grad
        assert float((found - expected).norm() / expected.norm()) < 1e-4, name


@pytest.mark.torch_float32
@pytest.mark.hard_case(24)
def test_a_scene_from_a_millimetre_to_ten_metres_equals_the_dense_renderer(render, balls, equals_dense):
    far = (1e-3, 1e-2, 1e-1, 1.0, 1e1)
    means = [(0.3 * r * (-1) ** i, 0.1 * r, r) for i, r in enumerate(far)]
    scene = balls(means, [0.15 * r for r in far], 0.5, torch.rand(5, 3, generator=torch.Generator().manual_seed(0)))
    equals_dense(render, scene, near=1e-4, fields=("means", "scales", "opacities", "harmonics"), slack=10)


@pytest.mark.hard_case(25)
def test_scales_far_larger_than_the_distance_are_dropped_and_far_smaller_ones_vanish(render, balls, gradients):
    for sigma, dropped in ((1e15, 1), (1e-25, 0)):
        scene = balls([(0, 0, 2.0), (0.5, 0.2, 1.0)], [sigma, 0.2])
        got = render(scene)
        assert got.info is not None and got.info.dropped == dropped
        assert torch.equal(got.color, render(scene.select(torch.tensor([1]))).color)
        for name, gradient in gradients(render, scene).items():
            assert torch.isfinite(gradient).all()
            assert name == "pose" or not gradient[0].any()


@pytest.mark.torch_float32
@pytest.mark.hard_case(26)
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("unit", [1.0, 300.0], ids=["near", "beyond 256 m"])
def test_half_precision_is_rendered_in_float32(dtype, unit, render, make_scene, pose, leaves, loss_of):
    """300 m squared overflows float16, and the variance of a small Gaussian underflows."""
    render.skip_interpreted(unit == 1)
    if render.name == "torch" and render.dtype == torch.float64:
        pytest.skip("half precision is rendered in float32")
    scene = _scaled(make_scene(8, scale=0.3, degree=1), unit).to(dtype=dtype)
    camera = pose.clone()
    camera[:3, 3] *= unit
    half, single = leaves(scene), leaves(scene.to(dtype=torch.float32))
    got = dataclasses.replace(render, dtype=dtype)(half, camera)
    expected = render(single, camera)
    assert got.color.dtype == torch.float32 and torch.equal(got.color, expected.color)
    loss_of(got).backward()
    loss_of(expected).backward()
    for name in _FIELDS:
        found, reference = getattr(half, name).grad, getattr(single, name).grad
        assert found.dtype == dtype and torch.equal(found, reference.to(dtype)), name
