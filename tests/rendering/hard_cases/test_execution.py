"""Hard cases 36 and 37: threads, forks, no gradients, second derivatives."""

import multiprocessing
import warnings
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from pansplat.rendering import rasterize

_FIELDS = ("means", "scales", "quats", "opacities", "harmonics")


@pytest.mark.hard_case(36)
@pytest.mark.parametrize("kernel", ["ray", "ewa"])
def test_the_number_of_threads_changes_no_bit_of_image_or_gradients(kernel, draw, make_scene, pose, gradients):
    """tests/rendering/cpu compares SIMD widths."""
    count = 12 if draw.interpreted else 100
    scene = make_scene(count, scale=0.15, degree=1)
    layout = "pinhole" if draw.interpreted else "cubemap"
    options = {"kernel": kernel, "layout": layout, "face_size": 24}
    before, images, found = torch.get_num_threads(), [], []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            images.append(draw(scene, pose, **options))
            found.append(gradients(draw, scene, pose, **options))
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    for other in (1, 2):
        assert torch.equal(images[0].color, images[other].color)
        assert torch.equal(images[0].depth, images[other].depth)
        for name in (*_FIELDS, "pose"):
            assert torch.equal(found[0][name], found[other][name]), name


@pytest.mark.hard_case(37)
def test_two_python_threads_draw_at_once(draw, make_scene, pose, gradients):
    if draw.interpreted:
        pytest.skip("Triton's interpreter runs in one thread")
    scenes = [make_scene(8, scale=0.3, degree=0, seed=seed) for seed in range(4)]
    alone = [(draw(scene, pose).color, gradients(draw, scene, pose)["means"]) for scene in scenes]
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(lambda s: (draw(s, pose).color, gradients(draw, s, pose)["means"]), scenes))
    for (color, gradient), (other, other_gradient) in zip(alone, together, strict=True):
        assert torch.equal(color, other) and torch.equal(gradient, other_gradient)


def _draw_in_child(pipe, draw, scene, pose):
    pipe.send(draw(scene, pose).color.numpy())
    pipe.close()


@pytest.mark.hard_case(37)
def test_a_fork_after_use_draws_the_same(draw, make_scene, pose):
    if "fork" not in multiprocessing.get_all_start_methods():
        pytest.skip("this system has no fork")
    if draw.name == "triton":
        pytest.skip("a forked process cannot use CUDA")
    scene = make_scene(8, scale=0.3, degree=0)
    expected = draw(scene, pose).color
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe(duplex=False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # forking with threads may fail: this is the test
        child = context.Process(target=_draw_in_child, args=(theirs, draw, scene, pose))
        child.start()
    theirs.close()
    try:
        assert ours.poll(60), "the child draws nothing"
        assert torch.equal(torch.from_numpy(ours.recv()), expected)
        child.join(10)
    finally:
        child.kill()
    assert child.exitcode == 0


@pytest.mark.hard_case(37)
def test_without_gradients_the_image_is_the_same(draw, make_scene, pose, leaves):
    scene = make_scene(8, scale=0.3, degree=1).to(dtype=draw.dtype)
    asked = leaves(scene)
    with torch.no_grad():
        without = draw(asked, pose)
    with torch.inference_mode():
        inference = draw(scene, pose)
    attached = draw(asked, pose)
    assert not without.color.requires_grad and attached.color.requires_grad
    for image in (without, inference):
        for name in ("color", "alpha", "depth"):
            assert torch.equal(getattr(image, name), getattr(attached, name).detach()), name
    attached.color.sum().backward()  # possible after inference mode
    assert asked.means.grad.any()


@pytest.mark.hard_case(37)
def test_only_fields_that_require_gradients_get_them(draw, make_scene, pose, leaves):
    scene = make_scene(6, scale=0.3, degree=0).to(dtype=draw.dtype)
    everything = leaves(scene)
    draw(everything, pose).color.sum().backward()
    for name in _FIELDS:
        asked = leaves(scene)
        for other in _FIELDS:
            getattr(asked, other).requires_grad_(other == name)
        draw(asked, pose).color.sum().backward()
        found, expected = getattr(asked, name).grad, getattr(everything, name).grad
        assert float((found - expected).norm()) <= 1e-6 * float(expected.norm()), name
        assert all(getattr(asked, other).grad is None for other in _FIELDS if other != name)


@pytest.mark.hard_case(37)
def test_a_second_derivative_is_refused_clearly(draw, make_scene, pose, leaves):
    asked = leaves(make_scene(3, scale=0.5).to(dtype=draw.dtype))
    image = draw(asked, pose)
    with pytest.raises(RuntimeError, match="second derivatives"):
        torch.autograd.grad(image.color.sum(), asked.means, create_graph=True)


@pytest.mark.hard_case(37)
def test_an_image_names_its_backend(draw, balls):
    image = draw(balls((0, 0, 2.0)))
    assert image.info is not None and image.info.backend == draw.name
    assert image.color.dtype == image.alpha.dtype == image.depth.dtype == draw.dtype
    automatic = rasterize(balls((0, 0, 2.0)), torch.eye(4, dtype=torch.float64), size=(2, 4))
    assert automatic.info is not None and automatic.info.backend == "torch"  # for float64
