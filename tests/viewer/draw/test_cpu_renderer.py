"""Images drawn on the processor: pixels, cube faces of a position, work without waiting, and the choice of renderer."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from refusals import expect_error

from pansplat.rendering.cpu.display import MIN_TRANSMITTANCE
from pansplat_viewer.core.settings import DrawSettings
from pansplat_viewer.draw.cpu_renderer import CpuRenderer, choose_renderer, create_renderer

pytestmark = pytest.mark.gl

SIZE = (96, 64)
SETTINGS = DrawSettings(background=(0.1, 0.4, 0.7), mode="deferred")


@pytest.fixture
def renderer(ctx, small_scene):
    renderer = CpuRenderer(ctx)
    renderer.upload(small_scene)
    yield renderer
    renderer.release()


@pytest.fixture
def turned(pose, turn):
    """The same position, turned by 100 degrees."""
    return turn(pose, 100)


def read_pixels(texture) -> np.ndarray:
    """RGB of a texture, top row first."""
    return np.frombuffer(texture.read(), np.uint8).reshape(*texture.size[::-1], 4)[::-1, :, :3].astype(int)


@pytest.mark.parametrize("mode", ["joint", "view", "deferred"])
def test_pixels_are_the_image_of_opengl_within_two_steps(renderer, make_renderer, small_scene, pose, mode):
    settings = replace(SETTINGS, mode=mode)
    exact = make_renderer(small_scene)
    exact.render(pose, SIZE, settings)
    expected = 255 * np.clip(exact.read_color()[..., :3], 0, 1)
    error = np.abs(read_pixels(renderer.render(pose, SIZE, settings)) - expected)
    assert error.max() <= 2 and error.mean() <= 0.3  # rounding contributes 0.25


def test_transmittance_cut_changes_colors_by_at_most_its_value(renderer, random_scene, pose):
    exact = CpuRenderer(None, exact=True)
    scene = random_scene(1500, degree=0, size=0.3)
    opaque = replace(scene.gaussians, opacities=torch.full((1500,), 0.9))
    for each in (renderer, exact):
        each.upload(replace(scene, gaussians=opaque))
        each.render(pose, SIZE, SETTINGS)
    error = np.abs(renderer.read_color() - exact.read_color()).max()
    assert error <= 1.3 * MIN_TRANSMITTANCE  # colours are up to 1.25
    exact.release()


def test_image_from_faces_is_close_to_the_direct_image(renderer, pose, turned):
    settings = replace(SETTINGS, vertical_fov_degrees=50.0)
    for each in (pose, turned):
        renderer._faces.clear()  # they have the weights of the direction for which the first one was drawn
        direct = read_pixels(renderer.render(each, (192, 128), settings))
        depth = renderer.read_depth()
        error = np.abs(read_pixels(renderer.render(each, (192, 128), replace(settings, cached=True))) - direct)
        assert np.array_equal(renderer.read_depth(), depth)
        assert error.mean() < 2.5, "bilinear interpolation of the faces"


@pytest.mark.parametrize("cached", [False, True])
def test_an_image_drawn_at_a_smaller_scale_is_enlarged_to_its_size(renderer, pose, cached):
    settings = replace(SETTINGS, cached=cached)
    small = renderer.render(pose, (SIZE[0] // 2, SIZE[1] // 2), settings)
    channels = torch.from_numpy(read_pixels(small)).permute(2, 0, 1).double()[None]
    expected = torch.nn.functional.interpolate(channels, SIZE[::-1], mode="bilinear")[0].permute(1, 2, 0).numpy()
    texture = renderer.render(pose, SIZE, replace(settings, scale=0.5))
    assert texture.size == SIZE
    assert np.abs(read_pixels(texture) - expected).max() <= 3


def test_turning_draws_only_missing_faces(renderer, pose, turned):
    cached = replace(SETTINGS, cached=True, vertical_fov_degrees=40.0)
    assert not renderer.has_faces(pose, SIZE, cached)
    for camera, is_drawn in ((pose, True), (pose, False), (turned, True), (pose, False)):
        renderer.render(camera, SIZE, cached)
        assert ("faces" in renderer.stats.stages) == is_drawn and renderer.has_faces(camera, SIZE, cached)
    moved = pose.copy()
    moved[0, 3] += 0.01
    assert not renderer.has_faces(moved, SIZE, cached), "a new position needs new faces"
    assert not renderer.has_faces(pose, SIZE, replace(cached, levels=frozenset((0,))))


def test_without_waiting_the_last_image_is_shown_until_the_new_one_is_finished(renderer, pose, turned, wait_until):
    first = read_pixels(renderer.render(pose, SIZE, SETTINGS))

    def render() -> bool:
        texture = renderer.render(turned, SIZE, SETTINGS, wait=False)
        changed = not np.array_equal(read_pixels(texture), first)
        assert renderer.stats.settled == changed
        return changed

    wait_until(render, "image of the new pose")
    renderer.draw_faces(turned, SIZE, SETTINGS)
    wait_until(lambda: all(renderer.has_faces(each, SIZE, SETTINGS) for each in (pose, turned)), "faces all around")


def test_a_worker_without_opengl_draws_the_same_image(renderer, small_scene, pose):
    renderer.render(pose, SIZE, SETTINGS)
    plain = create_renderer(None)
    plain.upload(small_scene)
    assert plain.render(pose, SIZE, SETTINGS) is None
    assert np.array_equal(plain.read_color(), renderer.read_color())
    plain.release()


def test_software_opengl_is_replaced_by_the_processor_unless_chosen(ctx):
    gpu = SimpleNamespace(info={"GL_RENDERER": "NVIDIA H200"})
    software = SimpleNamespace(info={"GL_RENDERER": "llvmpipe (LLVM 15.0.6, 256 bits)"})
    assert [choose_renderer(each, "auto") for each in (gpu, software, None)] == ["gl", "cpu", "cpu"]
    assert choose_renderer(software, "gl") == "gl" and choose_renderer(gpu, "cpu") == "cpu"
    expect_error("needs an OpenGL context; use `cpu`", create_renderer, None, "gl")


def test_errors_in_the_worker_are_raised_and_drawing_goes_on(renderer, pose, monkeypatch):
    expected = read_pixels(renderer.render(pose, SIZE, SETTINGS))
    with monkeypatch.context() as patch:
        patch.setattr(renderer._scene, "rasterize", lambda *_, **__: (_ for _ in ()).throw(MemoryError("no memory")))
        with pytest.raises(MemoryError, match="no memory"):
            renderer.render(pose, (32, 32), SETTINGS)
    assert np.array_equal(read_pixels(renderer.render(pose, SIZE, SETTINGS)), expected)


def test_an_empty_selection_of_a_scene_without_cameras_is_the_background(renderer, small_scene, pose):
    renderer.upload(replace(small_scene, cam2world=torch.zeros(0, 4, 4, dtype=torch.float64), names=()))
    settings = DrawSettings(background=(1.0, 1.0, 1.0), levels=frozenset())
    assert read_pixels(renderer.render(pose, SIZE, settings)).min() == 255
    assert read_pixels(renderer.render(pose, SIZE, replace(settings, cached=True))).min() == 255
