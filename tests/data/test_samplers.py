"""Frames are chosen as the original chooses them, and within bounds."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from pansplat.data.sequences import BoundedSampler, FramePair
from pansplat.errors import InputError


@pytest.mark.shared
@pytest.mark.parametrize(("name", "count", "most"), [("360loc.n50", 50, 5), ("insta360.n400", 400, 30)])
def test_evaluation_draws_are_the_originals(golden: Callable, name: str, count: int, most: int) -> None:
    draws = BoundedSampler(2, most).evaluation(count)
    rows = [[d.left, d.right, d.targets[0], d.targets[-1], len(d.targets)] for d in draws]
    assert torch.equal(torch.tensor(rows), golden("units")[f"sampler.{name}"])


def test_training_gaps_reach_from_the_smallest_to_the_largest() -> None:
    generator = np.random.default_rng(0)
    draws = [BoundedSampler(2, 5).training(20, generator) for _ in range(400)]
    assert {draw.right - draw.left for draw in draws} == {2, 3, 4, 5}
    assert {draw.left for draw in draws} >= {0, 17}
    assert all(0 <= draw.left <= draw.targets[0] <= draw.right < 20 for draw in draws)
    assert {draw.targets[0] - draw.left for draw in draws if draw.right - draw.left == 3} == {0, 1, 2, 3}


def test_the_originals_training_gap_is_always_the_smallest() -> None:
    generator = np.random.default_rng(0)
    sampler = BoundedSampler(2, 30, training_gap="original")
    assert {draw.right - draw.left for draw in (sampler.training(400, generator) for _ in range(100))} == {2}


def test_short_sequences_are_used_as_far_as_they_go() -> None:
    sampler = BoundedSampler(2, 30)
    assert sampler.training(2, np.random.default_rng(0)).right == 1
    assert sampler.evaluation(5, 1) == [FramePair(0, 4, (0, 1, 2, 3, 4))]
    with pytest.raises(InputError, match="two or more posed frames, got 1"):
        sampler.evaluation(1)


def test_gaps_out_of_order_are_refused() -> None:
    with pytest.raises(InputError, match="got 3 and 2"):
        BoundedSampler(3, 2)
