import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from pansplat.errors import InputError
from pansplat.images.image_files import write_image
from pansplat_homes import shards
from pansplat_homes.shards import ShardReader, TourSettings, pack_triplets, render_tour, write_shards

_SETTINGS = TourSettings(seed=3, height=32, cameras=2, samples=1)


@pytest.fixture(autouse=True)
def small_shards(monkeypatch):
    monkeypatch.setattr(shards, "TOURS_PER_SHARD", 2)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two shards of two tours."""
    folder = tmp_path_factory.mktemp("shards")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shards, "TOURS_PER_SHARD", 2)
        assert write_shards(folder, 3, _SETTINGS) == 2
    return folder


@pytest.mark.slow
def test_shards_hold_the_rendered_tours(folder):
    reader, tour = ShardReader([folder]), render_tour(_SETTINGS, 3)
    assert len(reader) == 4
    read = reader.read(3)
    assert np.abs(np.sqrt(read.light) - np.sqrt(tour.light)).max() < 1e-4
    assert np.abs(read.depth - tour.depth).max() < 1e-3
    np.testing.assert_array_equal(read.cam2world, tour.cam2world)
    np.testing.assert_array_equal(read.camera_height, tour.camera_height)


def test_tours_are_exposed_and_stand_on_the_floor(folder):
    tour = ShardReader([folder]).read(0)
    assert tour.light.shape == (2, 32, 64, 3) and tour.depth.shape == (2, 32, 64)
    assert np.median(tour.light) == pytest.approx(0.2, rel=1e-2)
    np.testing.assert_allclose(tour.camera_height, -tour.cam2world[:, 1, 3])
    assert (tour.camera_height > 0.5).all()


def test_shards_that_are_there_are_kept_and_those_of_other_settings_refused(folder):
    times = {path: path.stat().st_mtime_ns for path in folder.glob("*.npz")}
    tours = []
    assert write_shards(folder, 4, _SETTINGS, progress=tours.append) == 0
    assert sum(tours) == 4
    assert times == {path: path.stat().st_mtime_ns for path in folder.glob("*.npz")}
    with pytest.raises(InputError, match=r"same settings"):
        write_shards(folder, 4, replace(_SETTINGS, seed=4))


def test_missing_and_damaged_shards_are_named(folder, tmp_path):
    with pytest.raises(InputError, match=r"pansplat-homes homes"):
        ShardReader([tmp_path])
    (tmp_path / "shard_00000.npz").write_bytes((folder / "shard_00000.npz").read_bytes()[:-2000])
    with pytest.raises(InputError, match=r"shard_00000.*make it again"):
        ShardReader([tmp_path]).read(0)


def test_triplets_become_tours(tmp_path):
    source, out = tmp_path / "maps", tmp_path / "out"
    source.mkdir()
    for name in ("a", "b", "c"):
        poses = np.tile(np.eye(4), (3, 1, 1))
        poses[:, 0, 3] = (0, 0.5, 1)
        (source / f"{name}.json").write_text(json.dumps({"c2w": poses.tolist()}))
        for n in range(3):
            write_image(source / f"{name}_{n}.png", np.full((64, 128, 3), 0.25 * (n + 1), np.float32))
            depth = np.full((64, 128), 1000 * (n + 1), np.uint16)
            assert cv2.imwrite(str(source / f"{name}_{n}_depth.png"), depth)
    assert pack_triplets(source, out, 32) == 2
    tour = ShardReader([out]).read(1)
    np.testing.assert_allclose(tour.depth, np.broadcast_to(np.array((1, 2, 3))[:, None, None], (3, 32, 64)))
    np.testing.assert_allclose(tour.camera_height, (1, 2, 3))
    np.testing.assert_array_equal(tour.cam2world[:, 0, 3], (0, 0.5, 1))
    ratio = tour.light[2].mean() / tour.light[0].mean()
    assert ratio == pytest.approx((0.75 / 0.25) ** 2.2, rel=0.1)
    with pytest.raises(InputError, match=r"at least 2 rendered triplets"):
        pack_triplets(tmp_path, out, 32)
