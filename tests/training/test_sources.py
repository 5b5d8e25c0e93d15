"""Every kind of data gives the same kind of samples."""

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from panorama_fixtures import write_depth_image, write_grey
from panorama_formats import move, write_posed
from refusals import expect_error

from pansplat.inputs.folders import load_sets
from pansplat.inputs.views import collate
from pansplat.training.config import DataConfig
from pansplat.training.sources import PairSource, load_sources, read_game_maps, read_panogrf


def write_triplets(folder: Path, *names: str) -> PairSource:
    for name in names:
        for i in range(3):
            write_grey(folder / f"{name}_{i}.png", 0.2 * (i + 1))
            write_depth_image(folder / f"{name}_{i}_depth.png", 1000 * (i + 1))
        (folder / f"{name}.json").write_text(json.dumps({"c2w": [move(0), move(1), move(2)]}))
    return read_game_maps(folder)


def test_game_map_triplets_are_samples_with_depth(tmp_path: Path) -> None:
    source = write_triplets(tmp_path, "a", "b")
    samples = [source.sample(index, 8, 0) for index in range(len(source))]
    assert [sample.name for sample in samples] == ["a", "b"]
    batch = collate(samples)
    assert len(batch) == 2 and batch.names == ("a", "b")
    assert batch.images.shape == (2, 2, 3, 8, 16) and batch.target_images.shape == (2, 1, 3, 8, 16)
    assert batch.cam2world[0, :, 0, 3].tolist() == [0, 2] and batch.target_cam2world[0, :, 0, 3].tolist() == [1]
    assert batch.depths is not None and batch.depths[0, :, 0, 0].tolist() == [1, 3]
    assert samples[0].targets.depths is not None and samples[0].targets.depths.unique().tolist() == [2]
    assert torch.equal(batch.near, torch.full((2, 2), 0.45)) and torch.equal(batch.far, torch.full((2, 2), 10.0))
    assert batch.masks.all() and batch.target_masks.dtype == torch.bool
    moved = batch.to("cpu")
    assert torch.equal(moved.images, batch.images) and moved.names == batch.names


def test_samples_of_different_shapes_cannot_be_batched(tmp_path: Path) -> None:
    source = write_triplets(tmp_path, "a")
    expect_error(r"\(2, 3, 8, 16\)", lambda: collate([source.sample(0, 8, 0), source.sample(0, 4, 0)]))
    expect_error("at least one sample", collate, [])


def test_panogrf_scenes_are_read_by_stage_and_height(tmp_path: Path) -> None:
    for scene, i in itertools.product(range(2), range(3)):
        view = tmp_path / "png_render_val_1024x512_seq_len_3_m3d_dist_0.5" / f"{scene:08d}" / f"{i:02d}"
        write_grey(view / "rgb.png", 0.2 * (i + 1))
        np.savetxt(view / "rot.txt", np.eye(3))
        np.savetxt(view / "tran.txt", [0, 0, 0.5 * i])
    sample = read_panogrf(tmp_path, "val", 256).sample(1, 8, 0)
    assert sample.name == "00000001" and sample.context.cam2world[:, 1, 3].tolist() == [0, -1.0]
    expect_error("png_render_train_1024x512_seq_len_3_m3d", read_panogrf, tmp_path, "train", 512)
    expect_error(r"4096x2048_seq_len_3_m3d_dist_0\.5", read_panogrf, tmp_path, "val", 2048)


def test_pairs_need_targets_and_a_random_one_is_chosen(tmp_path: Path) -> None:
    write_posed(tmp_path, {f"{i}.png": np.full((8, 16, 3), 25 * i, np.uint8) for i in range(5)}, range(5))
    groups = {"pairs": [{"context": ["0.png", "4.png"], "target": ["1.png", "2.png", "3.png"]}]}
    (tmp_path / "pairs.json").write_text(json.dumps(groups))
    pairs = load_sets(tmp_path)
    chosen = {PairSource(pairs).sample(0, 8, seed).targets.names for seed in range(20)}
    assert chosen == {("1",), ("2",), ("3",)}
    expect_error("needed pairs with targets for training, got none", PairSource, [])


@pytest.mark.shared
def test_a_folder_of_triplets_is_read_as_triplets_and_as_pairs(shared: Path) -> None:
    root = shared / "data" / "bsp_demo"
    for kind in ("triplets", "pairs"):
        for source in load_sources(DataConfig(kind, root), 64, 0):
            assert isinstance(source, PairSource) and len(source) == 12
