"""State between frames: layers, cached cube faces, and the order from the worker thread."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from pansplat_viewer.draw.layers import SplatRasterizer, TargetStore
from pansplat_viewer.draw.renderer import DrawSettings, SplatRenderer

pytestmark = pytest.mark.gl

SIZE = (80, 60)
CACHED = DrawSettings(cached=True, background=(0.3, 0.2, 0.1))
STORAGES = (CACHED, replace(CACHED, cached=False))


def render_image(renderer, pose, settings, size=SIZE):
    renderer.render(pose, size, settings)
    return renderer.read_color()


@pytest.fixture
def drawn(monkeypatch) -> list[int]:
    """The number of splats of each part that is drawn."""
    counts, draw = [], SplatRasterizer._draw_in_order
    monkeypatch.setattr(
        SplatRasterizer, "_draw_in_order", lambda self, order: counts.append(len(order)) or draw(self, order)
    )
    return counts


@pytest.mark.parametrize(("mode", "color_bits"), [("joint", 16), ("deferred", 32)])
def test_cached_faces_give_image_and_depth_of_direct_drawing(make_renderer, random_scene, pose, turn, mode, color_bits):
    scene = random_scene(400, size=0.2)  # Gaussians of several pixels, which resampling hardly blurs
    scene = replace(scene, gaussians=replace(scene.gaussians, scales=scene.gaussians.scales.clamp_min(0.15)))
    kept, direct = make_renderer(scene, color_bits=color_bits, slot=1), make_renderer(scene)
    for degrees in (0, 40, 100, 170, 260):
        camera, settings = turn(pose, degrees), replace(CACHED, mode=mode)
        images = render_image(kept, camera, settings), render_image(direct, camera, replace(settings, cached=False))
        error = np.abs(images[0] - images[1])
        assert error.mean() < 4e-3 and error.max() < 0.05
        assert np.abs(kept.read_depth() - direct.read_depth()).mean() < 0.01


def test_rotation_draws_each_face_once(make_renderer, random_scene, pose, turn, drawn):
    renderer = make_renderer(random_scene())
    for degrees in range(0, 360, 30):
        renderer.render(turn(pose, degrees), SIZE, CACHED)
    renderer.render(turn(pose, 90), SIZE, CACHED)
    renderer.render(pose, SIZE, replace(CACHED, background=(1, 1, 1)))
    assert len(drawn) <= 6, "layers do not depend on the background"


def test_narrow_field_of_view_is_drawn_directly(make_renderer, random_scene, pose):
    renderer, narrow = make_renderer(random_scene()), replace(CACHED, vertical_fov_degrees=1.0)
    images = [render_image(renderer, pose, replace(narrow, cached=cached)) for cached in (True, False)]
    assert np.array_equal(*images)


def test_kept_layers_follow_settings_position_size_and_scene(make_renderer, random_scene, pose):
    scene, other, moved = random_scene(size=0.1), random_scene(seed=7), pose.copy()
    renderer, fresh = make_renderer(scene), make_renderer(scene, slot=1)
    moved[0, 3] += 0.2
    changes = {"mode": "view", "levels": frozenset({1, 2}), "near": 1.9, "pose": moved, "size": (50, 30)}
    for (name, value), settings in itertools.product(changes.items(), STORAGES):
        before = render_image(renderer, pose, settings)
        changed = settings if name in ("pose", "size") else replace(settings, **{name: value})
        view = moved if name == "pose" else pose, changed, value if name == "size" else SIZE
        after = render_image(renderer, *view)
        assert after.shape != before.shape or np.abs(after - before).max() > 1e-3, name
        assert np.array_equal(after, render_image(fresh, *view)), name
    renderer.upload(other)
    expected = render_image(make_renderer(other, slot=1), pose, CACHED)
    assert np.array_equal(render_image(renderer, pose, CACHED), expected)


def test_reading_depth_changes_nothing_else(make_renderer, random_scene, pose, drawn):
    renderer = make_renderer(random_scene())
    for settings in STORAGES:
        color, stats = render_image(renderer, pose, settings), renderer.stats
        first, count = renderer.read_depth(), len(drawn)
        assert renderer.stats == stats and np.array_equal(renderer.read_color(), color)
        renderer.render(pose, SIZE, settings)
        assert np.array_equal(renderer.read_depth(), first) and len(drawn) == count, "all layers are kept"


def test_unsettled_images_settle_to_the_sorted_one(make_renderer, random_scene, pose, wait_until):
    scene = random_scene(degree=2, size=0.1)
    renderer = make_renderer(scene)
    renderer.render(pose, SIZE, DrawSettings(), wait=False)
    assert renderer.stats.settled, "the first frame waits for its order"
    pose[:3, 3] += (0.5, 0.0, -0.4)
    renderer.render(pose, SIZE, DrawSettings(), wait=False)
    assert not renderer.stats.settled

    def render_again() -> bool:
        renderer.render(pose, SIZE, DrawSettings(), wait=False)
        return renderer.stats.settled

    wait_until(render_again, "settled image")
    assert np.array_equal(renderer.read_color(), render_image(make_renderer(scene, slot=1), pose, DrawSettings()))


def test_framebuffer_binding_of_the_caller_is_restored(ctx, make_renderer, random_scene, pose):
    renderer = make_renderer(random_scene())
    bound = ctx.framebuffer([ctx.texture((8, 8), 4)])
    bound.use()
    renderer.render(pose, SIZE, DrawSettings())
    assert ctx.fbo is bound
    renderer.read_depth()
    assert ctx.fbo is bound
    bound.clear(0.0, 1.0, 0.0, 1.0)
    assert bound.read(components=4)[:4] == bytes((0, 255, 0, 255))


def test_unused_targets_over_the_budget_are_freed(ctx):
    store = TargetStore(ctx, color_bits=32, budget_bytes=3 * 16 * 100)
    store.get("a", (10, 10), key="z").parts.add(0)
    assert [set(store.get("a", (10, 10), key=key).parts) for key in "za"] == [{0}, set()], "valid for its key only"
    targets = {name: store.get(name, (10, 10), key=name) for name in "abcd"}
    store.trim()
    assert all(store.get(name, (10, 10), key=name) is targets[name] for name in "abcd"), "all targets were in use"
    store.trim()
    store.get("a", (10, 10), key="a")
    store.trim()
    kept = [name for name in "acdb" if store.get(name, (10, 10), key=name) is targets[name]]
    assert kept == ["a", "c", "d"], "the least recently used target is freed, the budget holds three"
    store.release()


def test_splats_in_chunks_are_the_image_of_one_chunk_and_no_splat_is_none(ctx, random_scene, pose, monkeypatch, drawn):
    images = []
    for size in (300, 20):
        monkeypatch.setattr("pansplat_viewer.draw.layers._CHUNK_SIZE", size)
        renderer = SplatRenderer(ctx, color_bits=32)
        renderer.upload(random_scene())
        images.append(render_image(renderer, pose, DrawSettings()))
        assert drawn[-1] > 60, "more than three chunks"
        assert not render_image(renderer, pose, DrawSettings(levels=frozenset())).any() and drawn[-1] == 0
        renderer.release()
    assert images[0].max() > 0.4 and np.array_equal(*images)
