"""Any numbers in any field give an image without NaN and finite gradients."""

import dataclasses
import math

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians

_FIELDS = ("means", "scales", "quats", "opacities", "harmonics", "covariances")
_EXTREMES = (math.nan, math.inf, -math.inf, 0.0, -0.0, -1.0)
_EXTREMES += (1e-45, 1e-38, 1e-20, 1e-6, 1e6, 1e12, 1e18, 1e29, -1e29, 1e38)
_QUIET = settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])


@st.composite
def _images(draw) -> dict:
    """Options of an image; some combinations are errors."""
    layout = draw(st.sampled_from(("equirect", "cubemap", "pinhole")))
    return {
        "layout": layout,
        "size": (draw(st.integers(1, 9)), draw(st.integers(1, 17))),
        "kernel": draw(st.sampled_from(("ray", "ewa"))),
        "order": draw(st.sampled_from(("radial", "z"))),
        "lowpass": draw(st.sampled_from(("angular", "3dgs"))),
        "near": draw(st.sampled_from((1e-10, 0.05, 1.0, 1e10))),
        "vertical_fov_degrees": draw(st.sampled_from((0.1, 60.0, 90.0, 179.0))),
        "face_size": draw(st.sampled_from((None, 1, 2, 5))),
        "stitching": draw(st.sampled_from(("seamless", "seamless", "official"))),
        "strict": draw(st.sampled_from((False, False, False, True))),
    }


@st.composite
def _scenes(draw) -> tuple[Gaussians, torch.Tensor | None]:
    """A few Gaussians, with or without covariances, with some extreme numbers."""
    count, channels = draw(st.integers(0, 6)), draw(st.sampled_from((1, 3, 4)))
    degree = draw(st.integers(0, 4))
    generator = torch.Generator().manual_seed(draw(st.integers(0, 1000)))
    fields = {
        "means": torch.randn(count, 3, generator=generator),
        "scales": 0.3 * torch.exp(torch.randn(count, 3, generator=generator)),
        "quats": torch.randn(count, 4, generator=generator),
        "opacities": torch.rand(count, generator=generator),
        "harmonics": torch.randn(count, (degree + 1) ** 2, channels, generator=generator),
    }
    factor = torch.randn(count, 3, 3, generator=generator)
    fields["covariances"] = 0.1 * factor @ factor.transpose(1, 2)
    for _ in range(draw(st.integers(0, 4)) if count else 0):
        flat = fields[draw(st.sampled_from(_FIELDS))].view(-1)
        flat[draw(st.integers(0, len(flat) - 1))] = draw(st.sampled_from(_EXTREMES))
    covariances = fields.pop("covariances")
    label = torch.zeros(count, dtype=torch.int64)
    scene = Gaussians(**fields, levels=label, views=label)
    return scene, covariances if draw(st.booleans()) else None


def _check(render, leaves, given_scene, options: dict) -> None:
    scene, covariances = given_scene
    scene = leaves(scene.to(dtype=render.dtype))
    if covariances is not None:
        covariances = covariances.to(render.dtype).requires_grad_()
    pose = torch.eye(4, dtype=torch.float64, requires_grad=True)
    channels = scene.harmonics.shape[2]
    try:
        got = render(scene, pose, covariances=covariances, background=(0.5,) * channels, **options)
    except InputError:
        return
    assert got.color.shape == (channels, *options["size"])
    for name in ("color", "alpha", "depth"):
        assert torch.isfinite(getattr(got, name)).all(), name
    alpha = got.alpha.detach()
    assert float(alpha.min()) >= 0 and float(alpha.max()) <= 1 and float(got.depth.detach().min()) >= 0
    if not got.color.requires_grad:
        return
    (got.color.sum() + got.alpha.sum() + (got.depth * got.alpha).sum()).backward()
    inputs = {name: getattr(scene, name) for name in ("means", "scales", "quats", "opacities", "harmonics")}
    inputs = {**inputs, "covariances": covariances, "pose": pose}
    for name, leaf in inputs.items():
        if leaf is not None and leaf.grad is not None:
            assert torch.isfinite(leaf.grad).all(), name


@pytest.mark.slow
@pytest.mark.torch_float32
@settings(_QUIET, max_examples=60)
@given(scene=_scenes(), options=_images())
def test_extreme_numbers_give_finite_images_and_gradients(render, leaves, scene, options):
    if render.interpreted:
        pytest.skip("the next test has fewer and smaller images")
    _check(render, leaves, scene, options)


@pytest.mark.torch_float32
def test_a_distant_gaussian_of_a_huge_opacity_has_finite_gradients(render, leaves, balls):
    options = {"layout": "pinhole", "size": (1, 14), "lowpass": "3dgs", "vertical_fov_degrees": 0.1}
    _check(render, leaves, (balls([0.0, -0.3, 1e12], opacity=1e29), None), options)


@settings(_QUIET, max_examples=6)
@given(scene=_scenes(), options=_images())
def test_extreme_numbers_give_finite_small_images_under_the_interpreter(render, leaves, scene, options):
    if not render.interpreted:
        pytest.skip("the previous test has more and larger images")
    _check(render, leaves, scene, {**options, "size": (3, 6), "face_size": 3})


@settings(_QUIET, max_examples=30)
@given(scene=_scenes(), field=st.sampled_from(_FIELDS[:-1]), index=st.integers(0, 5), value=st.floats(width=32))
def test_any_float32_in_one_place_gives_an_image_without_nan(render, scene, field, index, value):
    render.skip_interpreted(True)
    gaussians, _ = scene
    values = getattr(gaussians, field).clone()
    if len(gaussians):
        values[index % len(gaussians)] = value
    got = render(dataclasses.replace(gaussians, **{field: values}), size=(4, 8))
    assert torch.isfinite(got.color).all() and torch.isfinite(got.depth).all()
