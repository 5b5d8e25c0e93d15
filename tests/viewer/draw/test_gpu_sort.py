"""Sorting and culling by compute shaders: the order is that of the processor, and ties keep their order."""

import numpy as np
import pytest
import torch

from pansplat_viewer.draw.gpu_sort import GpuSplats, RadixSort
from pansplat_viewer.draw.layers import SplatRasterizer, compute_filter_variance
from pansplat_viewer.draw.programs import TILE_SIZE, Programs, Resources
from pansplat_viewer.draw.splats import Splats, sort_splats
from pansplat_viewer.scene.camera import Pinhole
from pansplat_viewer.scene.settings import DrawSettings

pytestmark = pytest.mark.gl


@pytest.fixture(scope="module")
def sorter(gl_context):
    with gl_context:
        programs, resources = Programs(gl_context), Resources()
        sort = RadixSort(gl_context, programs, resources, 4 * TILE_SIZE + 1)
    yield sort
    with gl_context:
        resources.release()
        programs.release()


def sort_values(sorter: RadixSort, keys: np.ndarray) -> np.ndarray:
    if len(keys):
        sorter.keys.write(keys.astype(np.uint32))
        sorter.values.write(np.arange(len(keys), dtype=np.uint32))
    sorter.sort(len(keys))
    values = np.frombuffer(sorter.values.read(), np.uint32)[: len(keys)]
    assert np.array_equal(np.frombuffer(sorter.keys.read(), np.uint32)[: len(keys)], keys[values])
    return values


@pytest.mark.parametrize(
    "count", [0, 1, 2, 63, 64, 65, 1023, TILE_SIZE, TILE_SIZE + 1, 2047, 2048, 2049, 4 * TILE_SIZE, 4 * TILE_SIZE + 1]
)
def test_the_sort_is_that_of_numpy_and_stable(ctx, sorter, count):
    random = np.random.default_rng(count)
    any_keys = random.integers(0, 2**32, count, dtype=np.uint32)
    few_keys = random.choice(np.array([0, 1, 2**31, 2**32 - 1], np.uint32), count)
    for keys in (any_keys, few_keys, np.zeros(count, np.uint32), np.arange(count, dtype=np.uint32)[::-1].copy()):
        assert np.array_equal(sort_values(sorter, keys), np.argsort(keys, kind="stable"))


@pytest.fixture(scope="module")
def splats(random_scene) -> Splats:
    """3000 splats, each of which coincides with another one."""
    scene = random_scene(1500, degree=0)
    twice = torch.arange(3000) % 1500
    return Splats.from_scene(type(scene)(scene.gaussians.select(twice), scene.cam2world, 0.45, 10.0, ("a", "b")))


@pytest.fixture
def target(ctx):
    target = ctx.simple_framebuffer((64, 48))
    yield target
    (ctx.screen or ctx.detect_framebuffer(0)).use()
    target.release()


@pytest.fixture
def make_rasterizer(ctx, splats):
    programs, made = Programs(ctx), []

    def make(tier: str = "gl43") -> SplatRasterizer:
        made.append(SplatRasterizer(ctx, programs, splats, tier))
        return made[-1]

    yield make
    for rasterizer in made:
        rasterizer.release()
    programs.release()


def draw(rasterizer: SplatRasterizer, target, splats: Splats, camera: Pinhole, selected, settings: DrawSettings) -> int:
    """Draw the selected splats to the cleared target; returns the number of those in view."""
    target.use()
    target.clear()
    parts = [(camera, (0, 0, 64, 48))]
    drawn = rasterizer.draw(target, parts, sort_splats(splats, camera.position), selected, None, settings)
    return drawn + rasterizer.take_drawn()


@pytest.mark.parametrize("preset", ["exact", "3dgs"])
def test_the_order_and_the_culling_are_the_processors(make_rasterizer, target, splats, pose, preset):
    camera = Pinhole(pose[:3, :3], tuple(pose[:3, 3]), 60.0, 64, 48)
    settings = DrawSettings(preset=preset)
    selected = splats.select((None, 0.0, None), None) & (np.arange(len(splats)) % 3 > 0)
    variance = compute_filter_variance(settings, camera.focal)
    expected = sort_splats(splats, camera.position)
    seen = expected.cull(camera, selected, variance, bounded=settings.is_exact)
    rasterizer = make_rasterizer()
    count, gpu = draw(rasterizer, target, splats, camera, selected, settings), rasterizer._gpu
    assert isinstance(gpu, GpuSplats)
    drawn = np.frombuffer(gpu._visible.read(), np.uint32)[:count]
    assert 0 < len(drawn) < selected.sum() and set(drawn) <= set(np.flatnonzero(selected))
    # The bounds are conservative, and rounded differently: few splats at the border may differ.
    assert len(set(drawn) ^ set(np.flatnonzero(seen))) <= 3
    both = seen & np.isin(np.arange(len(splats)), drawn)
    front_to_back = expected.sort_back_to_front(camera, both, by_depth=not settings.is_exact)[::-1]
    shown = drawn[both[drawn]]
    if settings.is_exact:
        assert np.array_equal(shown, front_to_back)
        assert np.array_equal(gpu.read_order(), expected.order)
    else:  # the products of depths are rounded differently; those that coincide keep their order
        depth = (splats.means.astype(np.float64) @ camera.rotation[:, 2])[shown]
        assert (np.diff(depth) > -1e-5).all()
        place = np.argsort(shown)
        pairs = [(a, a + 1500) for a in range(1500) if both[a] and both[a + 1500]]
        where = dict(zip(shown[place].tolist(), place.tolist(), strict=True))
        assert all(where[a] < where[b] for a, b in pairs)


@pytest.mark.parametrize("tier", ["gl33", "gl43"])
def test_splats_in_chunks_are_the_image_of_one_chunk_and_no_splat_is_none(
    make_rasterizer, target, splats, pose, tier, monkeypatch
):
    camera, settings = Pinhole(pose[:3, :3], tuple(pose[:3, 3]), 60.0, 64, 48), DrawSettings()
    everything, images, counts = np.ones(len(splats), bool), [], []
    for size in (len(splats), 100):
        monkeypatch.setattr("pansplat_viewer.draw.layers._CHUNK_SIZE", size)
        rasterizer = make_rasterizer(tier)
        counts.append(draw(rasterizer, target, splats, camera, everything, settings))
        images.append(np.frombuffer(target.read(components=4), np.uint8))
    assert counts[0] == counts[1] > 300, "more than three chunks"
    assert images[0].max() > 100 and np.array_equal(*images)
    nothing = DrawSettings(opacity_threshold=1.0)  # masks are kept by these settings
    assert draw(rasterizer, target, splats, camera, ~everything, nothing) == 0
    assert not np.frombuffer(target.read(components=4), np.uint8).any()
