"""What holds for all backends besides the contract: bad numbers, order, saturation, types, processes, gradients."""

import dataclasses
import math
import multiprocessing
import warnings
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from dense_renderer import (
    FIELDS,
    ORIGIN,
    POSE,
    Renderer,
    find_gradients,
    make_leaves,
    make_scene,
    make_spheres,
    measure_loss,
)
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from torch import Tensor

from pansplat.errors import InputError
from pansplat.gaussians.harmonics import harmonics_basis
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.pose import rotations_from_quats
from pansplat.rendering import Rendering


def assert_same_bits(got: Rendering, expected: Rendering) -> None:
    for name in ("color", "alpha", "depth"):
        assert torch.equal(getattr(got, name), getattr(expected, name)), name


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["equirect", "cubemap", "pinhole"])
def test_an_empty_scene_is_background_and_gradients_of_zero(layout: str, render: Renderer) -> None:
    full = make_spheres([(0, 0, 2.0), (1.0, 0, 1)])
    scenes = {
        "none": full.select(torch.zeros(2, dtype=torch.bool)),
        "transparent": dataclasses.replace(full, opacities=torch.zeros(2, dtype=torch.float64)),
        "too near": dataclasses.replace(full, means=0.01 * full.means),
        "not finite": dataclasses.replace(full, means=full.means * math.nan),
    }
    for name, scene in scenes.items():
        got = render(scene, layout=layout, background=(0.1, 0.25, 0.5))
        expected = torch.tensor((0.1, 0.25, 0.5), dtype=render.dtype)[:, None, None].expand(3, *render.size)
        assert torch.equal(got.color, expected), name
        assert float(got.alpha.abs().max()) == float(got.depth.abs().max()) == 0
        for field, gradient in find_gradients(render, scene, layout=layout).items():
            shape = (4, 4) if field == "pose" else getattr(scene, field).shape
            assert gradient.shape == shape and not gradient.any(), (name, field)


@pytest.mark.parametrize("field", FIELDS)
def test_a_number_that_is_not_finite_drops_only_its_gaussian(field: str, render: Renderer) -> None:
    scene, rest = make_scene(6, scale=0.3, degree=1).to(dtype=render.dtype), torch.tensor([0, 1, 3, 4, 5])
    clean = make_leaves(scene.select(rest))
    expected = render(clean, POSE)
    measure_loss(expected).backward()
    for poison in (math.nan,) if render.interpreted else (math.nan, math.inf, -math.inf, 1e38):
        value = getattr(scene, field).clone()
        value.reshape(6, -1)[2, -1] = poison
        poisoned = make_leaves(dataclasses.replace(scene, **{field: value}))
        got = render(poisoned, POSE)
        assert_same_bits(got, expected)
        measure_loss(got).backward()
        for name in FIELDS:
            found, reference = getattr(poisoned, name).grad, getattr(clean, name).grad
            assert not found[2].any() and torch.equal(found[rest], reference), (name, poison)


def test_scales_far_larger_than_the_distance_are_dropped_and_far_smaller_ones_vanish(render: Renderer) -> None:
    for sigma in (1e15, 1e-25):
        scene = make_spheres([(0, 0, 2.0), (0.5, 0.2, 1.0)], [sigma, 0.2])
        got = render(scene)
        assert torch.equal(got.color, render(scene.select(torch.tensor([1]))).color)
        for name, gradient in find_gradients(render, scene).items():
            assert torch.isfinite(gradient).all() and (name == "pose" or not gradient[0].any())


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("unit", [1.0, 300.0], ids=["near", "beyond 256 m"])
def test_half_precision_is_rendered_in_float32(dtype: torch.dtype, unit: float, render: Renderer) -> None:
    """300 m squared overflows float16, and the variance of a small Gaussian underflows."""
    if render.dtype == torch.float64 or (render.interpreted and unit == 1):
        pytest.skip("half precision is rendered in float32")
    scene = make_scene(8, scale=0.3, degree=1)
    scene = dataclasses.replace(scene, means=unit * scene.means, scales=unit * scene.scales).to(dtype=dtype)
    camera = POSE.clone()
    camera[:3, 3] *= unit
    half, single = make_leaves(scene), make_leaves(scene.to(dtype=torch.float32))
    got, expected = dataclasses.replace(render, dtype=dtype)(half, camera), render(single, camera)
    assert got.color.dtype == torch.float32 and torch.equal(got.color, expected.color)
    measure_loss(got).backward()
    measure_loss(expected).backward()
    for name in FIELDS:
        found, reference = getattr(half, name).grad, getattr(single, name).grad
        assert found.dtype == dtype and torch.equal(found, reference.to(dtype)), name


def test_the_gradient_of_a_colour_at_exactly_0_is_0(render: Renderer) -> None:
    """The coefficient is one whose colour is exactly 0 in the backend's type."""
    base = harmonics_basis(torch.tensor([[0.0, 0.0, 1.0]], dtype=render.dtype), 0)[0, 0]
    value = torch.tensor(-0.5, dtype=render.dtype) / base
    candidates = [value, torch.nextafter(value, value - 1), torch.nextafter(value, value + 1)]
    exact = [v for v in candidates if float(base * v + 0.5) == 0]
    assert exact
    scene = make_spheres((0, 0, 2.0), 1.0).to(dtype=render.dtype)
    scene = make_leaves(dataclasses.replace(scene, harmonics=exact[0].expand(1, 1, 3).clone()))
    got = render(scene)
    got.color.sum().backward()
    assert not got.color.any() and not scene.harmonics.grad.any()


EXTREMES = (math.nan, math.inf, -math.inf, 0.0, -0.0, -1.0)
EXTREMES += (1e-45, 1e-38, 1e-20, 1e-6, 1e6, 1e12, 1e18, 1e29, -1e29, 1e38)
QUIET = settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])


@st.composite
def draw_options(draw) -> dict:
    """Options of an image; some combinations are errors."""
    return {
        "layout": draw(st.sampled_from(("equirect", "cubemap", "pinhole"))),
        "size": (draw(st.integers(1, 9)), draw(st.integers(1, 17))),
        "kernel": draw(st.sampled_from(("ray", "ewa"))),
        "near": draw(st.sampled_from((1e-10, 0.05, 1.0, 1e10))),
        "vertical_fov_degrees": draw(st.sampled_from((0.1, 60.0, 90.0, 179.0))),
        "face_size": draw(st.sampled_from((None, 1, 2, 5))),
    }


@st.composite
def draw_scene(draw) -> Gaussians:
    """A few Gaussians with some extreme numbers."""
    count, channels, degree = draw(st.integers(0, 6)), draw(st.sampled_from((1, 3, 4))), draw(st.integers(0, 4))
    generator = torch.Generator().manual_seed(draw(st.integers(0, 1000)))
    fields = {
        "means": torch.randn(count, 3, generator=generator),
        "scales": 0.3 * torch.exp(torch.randn(count, 3, generator=generator)),
        "quats": torch.randn(count, 4, generator=generator),
        "opacities": torch.rand(count, generator=generator),
        "harmonics": torch.randn(count, (degree + 1) ** 2, channels, generator=generator),
    }
    for _ in range(draw(st.integers(0, 4)) if count else 0):
        flat = fields[draw(st.sampled_from(FIELDS))].view(-1)
        flat[draw(st.integers(0, len(flat) - 1))] = draw(st.sampled_from(EXTREMES) | st.floats(width=32))
    label = torch.zeros(count, dtype=torch.int64)
    return Gaussians(**fields, levels=label, views=label)


DISTANT = make_spheres([0.0, -0.3, 1e12], opacity=1e29)
"""Its gradients were not finite."""


@pytest.mark.slow
@settings(QUIET, max_examples=30)
@given(scene=draw_scene(), options=draw_options())
@example(scene=DISTANT, options={"layout": "pinhole", "size": (1, 14), "vertical_fov_degrees": 0.1})
def test_extreme_numbers_give_finite_images_and_gradients(render: Renderer, scene: Gaussians, options: dict) -> None:
    if render.interpreted:
        options = {**options, "size": (3, 6), "face_size": 3}
    inputs = make_leaves(scene.to(dtype=render.dtype))
    pose, channels = ORIGIN.clone().requires_grad_(), inputs.harmonics.shape[2]
    try:
        got = render(inputs, pose, background=(0.5,) * channels, **options)
    except InputError:
        return
    assert got.color.shape == (channels, *options["size"])
    assert all(torch.isfinite(getattr(got, name)).all() for name in ("color", "alpha", "depth"))
    alpha = got.alpha.detach()
    assert float(alpha.min()) >= 0 and float(alpha.max()) <= 1 and float(got.depth.detach().min()) >= 0
    if got.color.requires_grad:
        (got.color.sum() + got.alpha.sum() + (got.depth * got.alpha).sum()).backward()
    for name, leaf in {**vars(inputs), "pose": pose}.items():
        assert leaf is None or leaf.grad is None or torch.isfinite(leaf.grad).all(), name


def test_radial_order_does_not_depend_on_the_cameras_rotation(render: Renderer) -> None:
    """Distances are computed before any rotation, so even adjacent float32 numbers keep their order."""
    base = torch.tensor((0.3, 0.2, 2.0), dtype=torch.float32)
    other = base.clone()
    other[2] = torch.nextafter(base[2], base[2] + 1)
    scene = make_spheres(torch.stack((other, base)), 0.5, 0.9, [[1.0, 0, 0], [0, 1.0, 0]])
    for turn in range(0, 360, 24):
        angle = math.radians(turn) / 2
        quat = torch.tensor((math.cos(angle), 0.3 * math.sin(angle), math.sin(angle), 0.1 * math.sin(angle)))
        pose = ORIGIN.clone()
        pose[:3, :3] = rotations_from_quats(torch.nn.functional.normalize(quat.double(), dim=0))
        color = render(scene, pose, size=(6, 12)).color
        seen = color.sum(dim=0) > 0.5
        assert seen.any() and (color[1] > color[0])[seen].all(), turn


def _stack(count: int, opacity: float) -> Gaussians:
    """Gaussians behind each other on the axis, with random colours."""
    far = 2 + 1e-6 * torch.arange(count, dtype=torch.float64)
    colours = torch.rand(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return make_spheres(torch.stack((0 * far, 0 * far, far), dim=1), 0.9, opacity, colours)


@pytest.mark.slow
def test_100_000_gaussians_in_one_pixel_give_the_weighted_mean_of_the_first(render: Renderer) -> None:
    if render.interpreted:
        pytest.skip("takes minutes; the next test saturates a pixel with fewer")
    got = render(_stack(100_000, 0.3), size=(1, 1), layout="pinhole")
    # The angular filter of this large pixel lowers the opacity by a known factor.
    own, wide = (0.9 / 2) ** 2, (0.9 / 2) ** 2 + 0.1 * 4
    opacity = 0.3 * own / wide
    weights = opacity * (1 - opacity) ** torch.arange(400, dtype=torch.float64)
    colours = torch.rand(100_000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)[:400]
    assert float(got.alpha) == pytest.approx(1, abs=1e-4)
    assert (got.color[:, 0, 0] - (weights[:, None] * colours).sum(dim=0)).abs().max() < 1e-4


def test_gradients_of_a_saturated_pixel_are_exactly_zero_behind_the_front(render: Renderer) -> None:
    scene = make_leaves(_stack(300 if render.interpreted else 3000, 0.95).to(dtype=render.dtype))
    got = render(scene, size=(1, 1), layout="pinhole", vertical_fov_degrees=10.0)  # the filter hides little
    got.color.sum().backward()
    assert torch.isfinite(got.color).all() and float(scene.opacities.grad[0].abs()) > 0.01
    for field in (scene.means, scene.opacities, scene.harmonics):
        gradient = field.grad.abs()
        assert torch.isfinite(gradient).all() and not gradient[100:].any()
        # Denormal numbers are slow; the last step of a backend may contain a few.
        assert int(((gradient > 0) & (gradient < torch.finfo(render.dtype).tiny)).sum()) <= 64
    assert (scene.harmonics.grad.abs().amax(dim=(1, 2))[:10] > 0.05**12).all()


def test_the_cubemap_and_the_direct_panorama_have_no_seam(render: Renderer) -> None:
    """A sphere on an edge of the cube and in the middle of a face gives the same image, up to the faces' pixels."""
    turn, half = ORIGIN.clone(), math.sqrt(0.5)
    turn[:3, :3] = torch.tensor([[half, 0, half], [0, 1, 0], [-half, 0, half]])
    for mean in ((0.0, 0.0, 2.0), (0.0, 1.4, 1.4), (1.1, 1.1, 1.1)):
        for layout, tolerance in (("equirect", 50 * render.image), ("cubemap", 0.06)):
            options = {"size": (8, 16), "layout": layout, "face_size": 12}
            still, turned = (render(make_spheres(mean, 0.7), pose, **options).alpha for pose in (None, turn))
            assert float(still.max()) > 0.3
            assert float((torch.roll(still, -2, dims=1) - turned).abs().max()) < tolerance, (mean, layout)


@pytest.mark.slow
@pytest.mark.parametrize(("kernel", "layout"), [("ray", "cubemap"), ("ray", "equirect"), ("ewa", "cubemap")])
def test_the_number_of_threads_changes_no_bit_of_image_or_gradients(kernel, layout, render, run_with_threads) -> None:
    """tests/rendering/cpu compares SIMD widths."""
    is_numba = render.name == "auto" and kernel == "ray"
    scene = make_scene(12 if render.interpreted else 20_000 if is_numba else 100, degree=1)
    options = {"kernel": kernel, "layout": "pinhole" if render.interpreted else layout, "face_size": 24}
    first, *others = run_with_threads(
        lambda: (render(scene, POSE, **options), find_gradients(render, scene, POSE, **options))
    )
    for image, found in others:
        assert_same_bits(image, first[0])
        assert all(torch.equal(found[name], expected) for name, expected in first[1].items())


def test_two_python_threads_render_at_the_same_time(render: Renderer) -> None:
    if render.interpreted:
        pytest.skip("Triton's interpreter runs in one thread")

    def run(scene: Gaussians) -> tuple[Tensor, Tensor]:
        return render(scene, POSE).color, find_gradients(render, scene, POSE)["means"]

    scenes = [make_scene(8, scale=0.3, degree=0, seed=seed) for seed in range(4)]
    alone = list(map(run, scenes))
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(run, scenes))
    for first, second in zip(alone, together, strict=True):
        assert all(map(torch.equal, first, second))


def _render_in_child(pipe, render: Renderer, scene: Gaussians) -> None:
    pipe.send(render(scene, POSE).color.numpy())
    pipe.close()


def test_a_forked_process_renders_the_same_image(render: Renderer) -> None:
    if "fork" not in multiprocessing.get_all_start_methods() or render.name == "triton":
        pytest.skip("this system has no fork, or the process uses CUDA")
    scene = make_scene(8, scale=0.3, degree=0)
    expected = render(scene, POSE).color
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # forking with threads may fail: this is the test
        child = context.Process(target=_render_in_child, args=(sender, render, scene))
        child.start()
    sender.close()
    try:
        assert receiver.poll(300), "the child renders nothing"
        assert torch.equal(torch.from_numpy(receiver.recv()), expected)
        child.join(300)
    finally:
        child.kill()
    assert child.exitcode == 0


def test_only_what_requires_gradients_has_them_and_the_image_is_the_same(render: Renderer) -> None:
    scene = make_scene(8, scale=0.3, degree=1).to(dtype=render.dtype)
    everything = make_leaves(scene)
    attached = render(everything, POSE)
    with torch.no_grad():
        without = render(everything, POSE)
    with torch.inference_mode():
        inference = render(scene, POSE)
    assert not without.color.requires_grad and attached.color.requires_grad
    for image in (without, inference):
        assert_same_bits(image, attached)
    attached.color.sum().backward()  # possible after inference mode
    for name in FIELDS:
        inputs = make_leaves(scene)
        for other in FIELDS:
            getattr(inputs, other).requires_grad_(other == name)
        render(inputs, POSE).color.sum().backward()
        found, expected = getattr(inputs, name).grad, getattr(everything, name).grad
        assert float((found - expected).norm()) <= 1e-6 * float(expected.norm()), name
        assert all(getattr(inputs, other).grad is None for other in FIELDS if other != name)


def test_the_backward_may_run_twice_and_a_second_derivative_is_an_error(render: Renderer) -> None:
    inputs = make_leaves(make_scene(8, scale=0.3).to(dtype=render.dtype))
    total = render(inputs, POSE).color.sum()
    first = torch.autograd.grad(total, inputs.means, retain_graph=True)[0]
    render(inputs, POSE, size=(2, 4))  # must not reuse the memory that was saved
    assert torch.equal(torch.autograd.grad(total, inputs.means, retain_graph=True)[0], first)
    with pytest.raises(RuntimeError, match="second derivatives"):
        torch.autograd.grad(total, inputs.means, create_graph=True)
