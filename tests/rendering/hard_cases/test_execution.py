"""Hard cases 36 and 37: threads, forks, no gradients, second derivatives."""

import multiprocessing
import warnings
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

_FIELDS = ("means", "scales", "quats", "opacities", "harmonics")


@pytest.mark.slow
@pytest.mark.hard_case(36)
@pytest.mark.parametrize("kernel", ["ray", "ewa"])
def test_the_number_of_threads_changes_no_bit_of_image_or_gradients(
    kernel, render, make_scene, pose, gradients, with_threads
):
    """tests/rendering/cpu compares SIMD widths."""
    count = 12 if render.interpreted else 100
    scene = make_scene(count, scale=0.15, degree=1)
    layout = "pinhole" if render.interpreted else "cubemap"
    options = {"kernel": kernel, "layout": layout, "face_size": 24}
    (image, expected), *others = with_threads(
        lambda: (render(scene, pose, **options), gradients(render, scene, pose, **options))
    )
    for other, found in others:
        assert torch.equal(other.color, image.color) and torch.equal(other.depth, image.depth)
        for name in (*_FIELDS, "pose"):
            assert torch.equal(found[name], expected[name]), name


@pytest.mark.hard_case(37)
def test_two_python_threads_render_at_the_same_time(render, make_scene, pose, gradients):
    if render.interpreted:
        pytest.skip("Triton's interpreter runs in one thread")
    scenes = [make_scene(8, scale=0.3, degree=0, seed=seed) for seed in range(4)]
    alone = [(render(scene, pose).color, gradients(render, scene, pose)["means"]) for scene in scenes]
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(lambda s: (render(s, pose).color, gradients(render, s, pose)["means"]), scenes))
    for (color, gradient), (other, other_gradient) in zip(alone, together, strict=True):
        assert torch.equal(color, other) and torch.equal(gradient, other_gradient)


def _render_in_child(pipe, render, scene, pose):
    pipe.send(render(scene, pose).color.numpy())
    pipe.close()


@pytest.mark.hard_case(37)
def test_a_forked_process_renders_the_same_image(render, make_scene, pose):
    if "fork" not in multiprocessing.get_all_start_methods():
        pytest.skip("this system has no fork")
    if render.name == "triton":
        pytest.skip("a forked process cannot use CUDA")
    scene = make_scene(8, scale=0.3, degree=0)
    expected = render(scene, pose).color
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # forking with threads may fail: this is the test
        child = context.Process(target=_render_in_child, args=(sender, render, scene, pose))
        child.start()
    sender.close()
    try:
        assert receiver.poll(300), "the child renders nothing"
        assert torch.equal(torch.from_numpy(receiver.recv()), expected)
        child.join(300)
    finally:
        child.kill()
    assert child.exitcode == 0


@pytest.mark.hard_case(37)
def test_without_gradients_the_image_is_the_same(render, make_scene, pose, leaves):
    scene = make_scene(8, scale=0.3, degree=1).to(dtype=render.dtype)
    inputs = leaves(scene)
    with torch.no_grad():
        without = render(inputs, pose)
    with torch.inference_mode():
        inference = render(scene, pose)
    attached = render(inputs, pose)
    assert not without.color.requires_grad and attached.color.requires_grad
    for image in (without, inference):
        for name in ("color", "alpha", "depth"):
            assert torch.equal(getattr(image, name), getattr(attached, name).detach()), name
    attached.color.sum().backward()  # possible after inference mode
    assert inputs.means.grad.any()


@pytest.mark.hard_case(37)
def test_only_fields_that_require_gradients_have_them(render, make_scene, pose, leaves):
    scene = make_scene(6, scale=0.3, degree=0).to(dtype=render.dtype)
    everything = leaves(scene)
    render(everything, pose).color.sum().backward()
    for name in _FIELDS:
        inputs = leaves(scene)
        for other in _FIELDS:
            getattr(inputs, other).requires_grad_(other == name)
        render(inputs, pose).color.sum().backward()
        found, expected = getattr(inputs, name).grad, getattr(everything, name).grad
        assert float((found - expected).norm()) <= 1e-6 * float(expected.norm()), name
        assert all(getattr(inputs, other).grad is None for other in _FIELDS if other != name)


@pytest.mark.hard_case(37)
def test_a_second_derivative_is_an_error(render, make_scene, pose, leaves):
    inputs = leaves(make_scene(3, scale=0.5).to(dtype=render.dtype))
    image = render(inputs, pose)
    with pytest.raises(RuntimeError, match="second derivatives"):
        torch.autograd.grad(image.color.sum(), inputs.means, create_graph=True)
