"""Every kind of data becomes the same samples."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from pansplat.data.generated.triplets import GeneratedTriplets
from pansplat.data.images import write_image
from pansplat.data.layouts import load_pairs
from pansplat.data.sequences import BoundedSampler, read_loc360
from pansplat.data.sources import (
    ConcatSource,
    FixedFramePairs,
    PairSource,
    RandomFramePairs,
    TripletSource,
    read_game_maps,
    read_panogrf,
)
from pansplat.data.views import collate
from pansplat.errors import InputError


def _pose(x: float) -> list[list[float]]:
    return [[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


def _picture(path: Path, value: float = 0.5) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, torch.full((3, 16, 32), value))


def _game_map(folder: Path, name: str) -> None:
    for i in range(3):
        _picture(folder / f"{name}_{i}.png", 0.2 * (i + 1))
        cv2.imwrite(str(folder / f"{name}_{i}_depth.png"), np.full((16, 32), 1000 * (i + 1), np.uint16))
    (folder / f"{name}.json").write_text(json.dumps({"c2w": [_pose(0), _pose(1), _pose(2)]}))


def _panogrf(root: Path, kind: str, scenes: int = 2, stage: str = "test") -> None:
    for scene in range(scenes):
        for i in range(3):
            view = root / f"png_render_{stage}_1024x512_seq_len_3_{kind}" / f"{scene:08d}" / f"{i:02d}"
            _picture(view / "rgb.png", 0.2 * (i + 1))
            np.savetxt(view / "rot.txt", np.eye(3))
            np.savetxt(view / "tran.txt", [0, 0, 0.5 * i])


def _loc360(root: Path, location: str, part: str, name: str, count: int = 9) -> None:
    folder = root / location / part / name
    for i in range(count):
        _picture(folder / "image" / f"{i}.png", i / 10)
    poses = {f"{i}.png": _pose(i) for i in range(count)}
    (folder / "camera_pose.json").write_text(json.dumps(poses))


def test_game_map_triplets_are_samples_with_depth(tmp_path: Path) -> None:
    _game_map(tmp_path, "a")
    _game_map(tmp_path, "b")
    source = TripletSource(read_game_maps(tmp_path))
    samples = [source.sample(index, 8, 0) for index in range(len(source))]
    assert [sample.name for sample in samples] == ["a", "b"]
    batch = collate(samples)
    assert len(batch) == 2 and batch.names == ("a", "b")
    assert batch.images.shape == (2, 2, 3, 8, 16) and batch.target_images.shape == (2, 1, 3, 8, 16)
    assert batch.cam2world[0, :, 0, 3].tolist() == [0, 2] and batch.target_cam2world[0, :, 0, 3].tolist() == [1]
    assert batch.depths is not None and batch.depths[0, :, 0, 0].tolist() == [1, 3]
    assert batch.target_depths is not None and batch.target_depths.unique().tolist() == [2]
    assert torch.equal(batch.near, torch.full((2, 2), 0.45)) and torch.equal(batch.far, torch.full((2, 2), 10.0))
    assert batch.masks.all() and batch.target_masks.dtype == torch.bool
    moved = batch.to("cpu")
    assert torch.equal(moved.images, batch.images) and moved.names == batch.names


def test_samples_with_and_without_depth_share_a_batch(tmp_path: Path) -> None:
    _game_map(tmp_path, "a")
    _game_map(tmp_path, "b")
    for depth in tmp_path.glob("b_*_depth.png"):
        depth.unlink()
    source = TripletSource(read_game_maps(tmp_path))
    batch = collate([source.sample(index, 8, 0) for index in range(len(source))])
    assert batch.depths is not None
    assert (batch.depths[0] > 0).all() and (batch.depths[1] == 0).all()


def test_samples_of_two_shapes_are_no_batch(tmp_path: Path) -> None:
    _game_map(tmp_path, "a")
    source = TripletSource(read_game_maps(tmp_path))
    with pytest.raises(InputError, match=r"cannot batch a with a: needed context of shape \(2, 3, 8, 16\)"):
        collate([source.sample(0, 8, 0), source.sample(0, 4, 0)])
    with pytest.raises(InputError, match="at least one sample"):
        collate([])


def test_panogrf_sets_are_read_by_stage_and_missing_ones_named(tmp_path: Path) -> None:
    _panogrf(tmp_path, "m3d_dist_0.5")
    _panogrf(tmp_path, "m3d_dist_1.0", 1)
    with pytest.warns(UserWarning, match=r"no PanoGRF scenes in .*m3d_dist_0\.1.*replica_dist_0\.5; these sets"):
        sets = read_panogrf(tmp_path, "test", 256)
    assert [(s.name, len(s.sources)) for s in sets if s.sources] == [("m3d_dist_0.5", 2), ("m3d_dist_1.0", 1)]
    assert len(sets) == 7
    sample = TripletSource(sets[2]).sample(1, 8, 0)
    assert sample.name == "00000001"
    assert sample.context.images[:, 0, 0, 0].tolist() == pytest.approx([0.2, 0.6], abs=3e-3)
    # A file's +z is the world's -y (docs/official.md, section 2.1).
    assert sample.context.cam2world[:, 1, 3].tolist() == [0, -1.0]
    with pytest.raises(InputError, match=r"scenes for train, got none in .*png_render_train_1024x512_seq_len_3_m3d"):
        read_panogrf(tmp_path, "train", 512)
    with pytest.raises(InputError, match=r"4096x2048_seq_len_3_m3d_dist_0\.5"):
        read_panogrf(tmp_path, "test", 2048, [("m3d", 0.5)])


def test_360loc_trains_on_some_halls_and_tests_on_another(tmp_path: Path) -> None:
    for location in ("concourse", "hall", "piatrium"):
        _loc360(tmp_path, location, "mapping", "daytime_360_0")
    _loc360(tmp_path, "hall", "query_360", "night_360_1", 5)
    (tmp_path / "hall" / "query_360" / "night_pinhole").mkdir()
    sequences = read_loc360(tmp_path, "train")
    names = [sequence.name for sequence in sequences]
    assert names == ["concourse-daytime_360_0", "hall-daytime_360_0", "hall-night_360_1", "piatrium-daytime_360_0"]
    with pytest.raises(InputError, match=r"atrium: needed 360Loc sequences .* for test, got none"):
        read_loc360(tmp_path, "test")
    source = RandomFramePairs(sequences, BoundedSampler(2, 5), draws=10)
    assert len(source) == 40
    first, again = source.sample(3, 8, 7), source.sample(3, 8, 7)
    assert first.name == again.name and torch.equal(first.context.images, again.context.images)
    assert len({source.sample(3, 8, seed).name for seed in range(8)}) > 1
    assert source.sample(25, 8, 0).name.startswith("hall-night_360_1")
    gap = float((first.context.cam2world[1] - first.context.cam2world[0])[0, 3])
    assert 2 <= gap <= 5 and first.context.far == 50


def test_360loc_is_evaluated_on_all_frames_between(tmp_path: Path) -> None:
    _loc360(tmp_path, "atrium", "mapping", "daytime_360_0", 9)
    source = FixedFramePairs(read_loc360(tmp_path, "test"), BoundedSampler(2, 5).evaluation)
    assert len(source) == 100
    last = source.sample(99, 8, 0)
    assert last.context.names == ("5", "8") and last.targets.names == ("5", "6", "7", "8")
    assert torch.equal(last.context.images[0], last.targets.images[0])
    assert last.targets.cam2world[:, 0, 3].tolist() == [5, 6, 7, 8]


def test_pair_folders_need_targets_and_draw_among_them(tmp_path: Path) -> None:
    names = [f"{i}.png" for i in range(5)]
    for i, name in enumerate(names):
        _picture(tmp_path / name, i / 10)
    poses = {name: _pose(i) for i, name in enumerate(names)}
    (tmp_path / "poses.json").write_text(json.dumps({"convention": "cam2world opencv", "poses": poses}))
    with pytest.raises(InputError, match="needed 1 target panorama"):
        PairSource(load_pairs(tmp_path))
    cases = {"pairs": [{"context": ["0.png", "4.png"], "target": ["1.png", "2.png", "3.png"]}]}
    (tmp_path / "pairs.json").write_text(json.dumps(cases))
    pairs = load_pairs(tmp_path)
    assert PairSource(pairs).sample(0, 8, 0).targets.names == ("1", "2", "3")
    drawn = {PairSource(pairs, targets=1).sample(0, 8, seed).targets.names for seed in range(20)}
    assert drawn == {("1",), ("2",), ("3",)}
    with pytest.raises(InputError, match="needed 4 target"):
        PairSource(pairs, targets=4)


def test_joined_sources_follow_one_another(tmp_path: Path) -> None:
    _game_map(tmp_path, "a")
    _game_map(tmp_path, "b")
    maps, homes = TripletSource(read_game_maps(tmp_path)), GeneratedTriplets(count=3, samples=1)
    joined = ConcatSource([maps, homes, maps])
    assert len(joined) == 7
    names = [joined.sample(i, 8, 0).name for i in range(7)]
    homes_names = [f"generated_0_{i:06d}" for i in range(3)]
    assert names == ["a", "b", *homes_names, "a", "b"]


@pytest.mark.shared
def test_the_shared_renderings_are_read(shared: Path) -> None:
    (triplets,) = read_panogrf(shared / "data" / "mp3d_sample", "test", 256, [("m3d", 0.5)])
    sample = TripletSource(triplets).sample(0, 64, 0)
    assert sample.context.names == ("00", "02") and sample.targets.names == ("01",)
    assert sample.context.depths is not None
    source = TripletSource(read_game_maps(shared / "data" / "bsp_demo"))
    assert len(source) == 12
    assert source.sample(0, 64, 0).targets.depths is not None
