"""What is kept between frames: layers, cached cube faces, the order from the thread."""

import time
from dataclasses import replace

import numpy as np
import pytest

from pansplat_viewer.renderer import DrawSettings

pytestmark = pytest.mark.gl

SIZE = (80, 60)
CACHED = DrawSettings(cached=True, background=(0.3, 0.2, 0.1))


def turned(pose, degrees):
    """The camera turned to the right."""
    angle = np.radians(degrees)
    c, s = np.cos(angle), np.sin(angle)
    result = pose.copy()
    result[:3, :3] = pose[:3, :3] @ np.array(((c, 0, s), (0, 1, 0), (-s, 0, c)))
    return result


def smooth(scene):
    """The scene with Gaussians of several pixels, which resampling hardly blurs."""
    return replace(scene, gaussians=replace(scene.gaussians, scales=scene.gaussians.scales.clamp_min(0.15)))


@pytest.mark.parametrize("color_bits", [16, 32])
@pytest.mark.parametrize("mode", ["joint", "deferred", "difference"])
def test_turning_with_cached_faces_equals_drawing(renderer, random_scene, pose, mode, color_bits):
    scene = smooth(random_scene(150))
    kept, direct = renderer(scene, color_bits=color_bits), renderer(scene)
    for degrees in (0, 40, 100, 170, 260):
        camera = turned(pose, degrees)
        kept.render(camera, SIZE, replace(CACHED, mode=mode))
        direct.render(camera, SIZE, replace(CACHED, mode=mode, cached=False))
        error = np.abs(kept.read_color() - direct.read_color())
        assert error.mean() < 4e-3
        assert error.max() < 0.04


def test_depth_from_cached_faces_equals_drawing(renderer, random_scene, pose):
    scene = smooth(random_scene(400, size=0.2))
    kept, direct = renderer(scene), renderer(scene)
    kept.render(pose, SIZE, CACHED)
    direct.render(pose, SIZE, replace(CACHED, cached=False))
    assert np.abs(kept.read_depth() - direct.read_depth()).mean() < 0.01


def test_turning_draws_each_face_once(renderer, random_scene, pose):
    drawn = renderer(random_scene())
    for degrees in range(0, 360, 30):
        drawn.render(turned(pose, degrees), SIZE, CACHED)
    drawn.render(turned(pose, 90), SIZE, CACHED)
    assert drawn.stats.cached and drawn.stats.drawn == 0
    drawn.render(pose, SIZE, replace(CACHED, background=(1, 1, 1)))
    assert drawn.stats.cached  # the background lies behind the layers


def test_narrow_views_are_drawn_directly_rather_than_from_giant_faces(renderer, random_scene, pose):
    drawn = renderer(random_scene())
    narrow = replace(CACHED, vertical_fov_degrees=1.0)
    drawn.render(pose, SIZE, narrow)
    picture = drawn.read_color()
    drawn.render(pose, SIZE, replace(narrow, cached=False))
    assert np.array_equal(drawn.read_color(), picture)


@pytest.mark.parametrize(
    "change",
    [
        {"kernel": "ewa"},
        {"order": "z"},
        {"lowpass": "3dgs"},
        {"mode": "view"},
        {"levels": frozenset({1, 2})},
        {"opacity_threshold": 0.5},
        {"near": 1.9},
    ],
    ids=str,
)
def test_kept_layers_follow_every_setting(renderer, random_scene, pose, change):
    drawn, fresh = renderer(random_scene(size=0.1)), renderer(random_scene(size=0.1))
    for settings in (CACHED, replace(CACHED, cached=False), replace(CACHED, cached=False, layout="equirect")):
        drawn.render(pose, SIZE, settings)
        before = drawn.read_color()
        changed = replace(settings, **change)
        drawn.render(pose, SIZE, changed)
        fresh.render(pose, SIZE, changed)
        assert np.abs(drawn.read_color() - before).max() > 1e-3
        assert np.array_equal(drawn.read_color(), fresh.read_color())


def test_kept_layers_follow_position_scene_and_size(renderer, random_scene, pose):
    drawn, fresh = renderer(random_scene()), renderer(random_scene())
    moved = pose.copy()
    moved[0, 3] += 0.2
    for settings in (CACHED, replace(CACHED, cached=False)):
        drawn.render(pose, SIZE, settings)
        drawn.render(moved, SIZE, settings)
        fresh.render(moved, SIZE, settings)
        assert not drawn.stats.cached
        assert np.array_equal(drawn.read_color(), fresh.read_color())
        drawn.render(moved, (50, 30), settings)
        fresh.render(moved, (50, 30), settings)
        assert drawn.read_color().shape == (30, 50, 4)
        assert np.array_equal(drawn.read_color(), fresh.read_color())
    other = random_scene(seed=7)
    drawn.upload(other)
    drawn.render(moved, SIZE, CACHED)
    assert np.array_equal(drawn.read_color(), _picture(renderer(other), moved, CACHED))


def _picture(drawn, pose, settings):
    drawn.render(pose, SIZE, settings)
    return drawn.read_color()


def test_reading_depth_changes_nothing_else(renderer, random_scene, pose):
    drawn = renderer(random_scene())
    for settings in (CACHED, replace(CACHED, cached=False), replace(CACHED, cached=False, layout="equirect")):
        drawn.render(pose, SIZE, settings)
        color, stats = drawn.read_color(), drawn.stats
        first = drawn.read_depth()
        assert drawn.stats == stats
        assert np.array_equal(drawn.read_color(), color)
        drawn.render(pose, SIZE, settings)
        assert drawn.stats.cached
        assert np.array_equal(drawn.read_depth(), first)


def test_unsettled_pictures_settle_to_the_sorted_one(renderer, random_scene, pose):
    scene = random_scene(degree=2, size=0.1)
    drawn = renderer(scene)
    drawn.render(pose, SIZE, DrawSettings(), wait=False)
    assert drawn.stats.settled  # nothing to show before the first order
    moved = pose.copy()
    moved[:3, 3] += (0.5, 0.0, -0.4)
    drawn.render(moved, SIZE, DrawSettings(), wait=False)
    assert not drawn.stats.settled
    deadline = time.monotonic() + 20
    while not drawn.stats.settled and time.monotonic() < deadline:
        time.sleep(0.002)
        drawn.render(moved, SIZE, DrawSettings(), wait=False)
    assert drawn.stats.settled
    assert np.array_equal(drawn.read_color(), _picture(renderer(scene), moved, DrawSettings()))


def test_framebuffer_of_the_caller_is_bound_again(ctx, renderer, random_scene, pose):
    drawn = renderer(random_scene())
    mine = ctx.framebuffer([ctx.texture((8, 8), 4)])
    mine.use()
    drawn.render(pose, SIZE, DrawSettings())
    assert ctx.fbo is mine
    drawn.read_depth()
    assert ctx.fbo is mine
    mine.clear(0.0, 1.0, 0.0, 1.0)
    assert mine.read(components=4)[:4] == bytes((0, 255, 0, 255))


def test_targets_beyond_the_budget_are_freed_but_those_in_use(ctx):
    from pansplat_viewer.layers import TargetStore

    store = TargetStore(ctx, color_bits=32, budget_bytes=3 * 16 * 100)
    for name in "abcd":
        store.get(name, (10, 10), key=name)
    store.trim()
    store.get("a", (10, 10), key="a")
    store.trim()
    assert store.get("a", (10, 10), key="a").key == "a"
    assert [store.get(name, (10, 10), key=None).key for name in "cd"] == [None, None]
    kept = store.get("a", (10, 10), key="a")
    kept.parts.add(0)
    assert store.get("a", (10, 10), key="a").parts == {0}
    assert store.get("a", (10, 10), key="z").parts == set()
    store.release()


def test_release_frees_while_the_context_lives_on(ctx, random_scene, pose):
    from pansplat_viewer.renderer import SplatRenderer

    for _ in range(2):
        drawn = SplatRenderer(ctx)
        drawn.upload(random_scene(10))
        drawn.render(pose, SIZE, CACHED)
        drawn.release()
        assert ctx.error == "GL_NO_ERROR"
