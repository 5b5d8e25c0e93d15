"""Frame pairs of sequences are those of the official sampler."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from panorama_fixtures import write_grey
from panorama_formats import move
from refusals import expect_error

from pansplat.training.sequences import BoundedSampler, FramePair, read_loc360
from pansplat.training.sources import RandomFramePairs


@pytest.mark.shared
@pytest.mark.parametrize(("name", "count", "max_gap"), [("360loc.n50", 50, 5), ("insta360.n400", 400, 30)])
def test_evaluation_pairs_equal_the_official_ones(golden: Callable, name: str, count: int, max_gap: int) -> None:
    pairs = BoundedSampler(2, max_gap).evaluation(count)
    rows = [[p.left, p.right, p.targets[0], p.targets[-1], len(p.targets)] for p in pairs]
    assert torch.equal(torch.tensor(rows), golden("units")[f"sampler.{name}"])


def test_training_gaps_cover_the_whole_range() -> None:
    generator = np.random.default_rng(0)
    pairs = [BoundedSampler(2, 5).training(20, generator) for _ in range(400)]
    assert {pair.right - pair.left for pair in pairs} == {2, 3, 4, 5}
    assert {pair.left for pair in pairs} >= {0, 17}
    assert all(0 <= pair.left <= pair.targets[0] <= pair.right < 20 for pair in pairs)
    assert {pair.targets[0] - pair.left for pair in pairs if pair.right - pair.left == 3} == {0, 1, 2, 3}


def test_gaps_are_limited_by_the_length_of_the_sequence() -> None:
    sampler = BoundedSampler(2, 30)
    assert sampler.training(2, np.random.default_rng(0)).right == 1
    assert sampler.evaluation(5, 1) == [FramePair(0, 4, (0, 1, 2, 3, 4))]
    expect_error("two or more posed frames, got 1", sampler.evaluation, 1)


def write_loc360(folder: Path, count: int = 9) -> None:
    for i in range(count):
        write_grey(folder / "image" / f"{i}.png", i / 10)
    (folder / "camera_pose.json").write_text(json.dumps({f"{i}.png": move(i) for i in range(count)}))


def test_360loc_has_separate_locations_for_training_and_validation(tmp_path: Path) -> None:
    for location in ("concourse", "hall", "piatrium"):
        write_loc360(tmp_path / location / "mapping" / "daytime_360_0")
    write_loc360(tmp_path / "hall" / "query_360" / "night_360_1", 5)
    (tmp_path / "hall" / "query_360" / "night_pinhole").mkdir()
    sequences = read_loc360(tmp_path, "train")
    names = [sequence.name for sequence in sequences]
    assert names == ["concourse-daytime_360_0", "hall-daytime_360_0", "hall-night_360_1", "piatrium-daytime_360_0"]
    expect_error(r"atrium: needed 360Loc sequences .* for val, got none", read_loc360, tmp_path, "val")
    source = RandomFramePairs(sequences, BoundedSampler(2, 5), draws=10)
    assert len(source) == 40
    first, again = source.sample(3, 8, 7), source.sample(3, 8, 7)
    assert first.name == again.name and torch.equal(first.context.images, again.context.images)
    assert len({source.sample(3, 8, seed).name for seed in range(8)}) > 1
    assert source.sample(25, 8, 0).name.startswith("hall-night_360_1")
    gap = float((first.context.cam2world[1] - first.context.cam2world[0])[0, 3])
    assert 2 <= gap <= 5 and first.context.far == 50
