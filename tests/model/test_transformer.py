"""Attention within windows and across views."""

import math

import pytest
import torch

from pansplat.errors import InputError
from pansplat.model.feature_pyramid import (
    Transformer,
    TransformerConfig,
    merge_windows,
    position_encoding,
    shift_mask,
    split_windows,
)

_SMALL = TransformerConfig(channels=16, blocks=3, expansion=2)


def _noise(*shape):
    return torch.randn(shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)


@pytest.fixture(scope="module")
def small(randomize):
    def make(compat="fixed", **changes):
        return randomize(Transformer(TransformerConfig(**{**vars(_SMALL), **changes}), compat))

    return make


def test_the_position_encoding_is_the_originals(golden):
    assert (position_encoding(4, 8, 128) - golden("units")["posenc.4x8"][0]).abs().max() < 1e-6


def test_the_shift_mask_is_the_originals(golden):
    assert torch.equal(shift_mask(8, 16, 2, "official"), golden("units")["shiftmask.8x16"])


def test_shifted_windows_go_on_over_the_seam_but_not_over_the_poles():
    mask = shift_mask(8, 16, 2, "fixed")
    assert not mask[:2].any()  # the upper windows hold true neighbours only
    rows = torch.arange(4).repeat_interleave(8)  # of a lower window's tokens; half of them came around
    apart = (rows[:, None] < 2) != (rows[None] < 2)
    assert torch.equal(mask[2:] == -math.inf, apart.expand(2, -1, -1))


def test_merging_windows_undoes_splitting():
    tokens = _noise(2, 3, 8, 12, 5)
    windows = split_windows(tokens, 2)
    assert windows.shape == (2, 3, 4, 24, 5)
    assert torch.equal(windows[0, 0, 1, 0], tokens[0, 0, 0, 6])
    assert torch.equal(merge_windows(windows, 8, 12), tokens)


def test_half_a_turn_of_the_panoramas_turns_the_output(small):
    maps = _noise(1, 2, 16, 8, 16)
    turned = small()(maps.roll(8, -1))
    assert torch.allclose(turned, small()(maps).roll(8, -1), atol=1e-11)


def test_half_a_turn_does_not_turn_the_originals_output(small):
    maps, official = _noise(1, 2, 16, 8, 16), small("official")
    assert not torch.allclose(official(maps.roll(8, -1)), official(maps).roll(8, -1), atol=1e-3)


def test_a_quarter_turn_changes_which_tokens_meet(small):
    maps = _noise(1, 2, 16, 8, 16)
    assert not torch.allclose(small()(maps.roll(4, -1)), small()(maps).roll(4, -1), atol=1e-3)


def test_blocks_that_say_nothing_leave_each_token_in_its_place(small):
    network, maps = small(), _noise(1, 2, 16, 4, 8)
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            if "norm" in name:
                parameter.zero_()
    encoding = position_encoding(2, 4, 16).double().repeat(1, 2, 2)
    assert torch.allclose(network(maps), maps + encoding, atol=1e-6)


@pytest.mark.parametrize("views", [2, 3, 4])
def test_the_order_of_the_views_does_not_matter(small, views):
    maps, order = _noise(1, views, 16, 4, 8), torch.arange(views).flip(0)
    assert torch.allclose(small()(maps[:, order]), small()(maps)[:, order], atol=1e-12)


def test_a_view_twice_over_tells_no_more_than_once(small):
    network = small(blocks=1)
    maps = _noise(1, 2, 16, 4, 8)
    twice = network(torch.cat((maps, maps[:, 1:]), dim=1))
    assert torch.allclose(twice[:, 0], network(maps)[:, 0], atol=1e-12)


def test_each_view_sees_the_others(small):
    maps = _noise(1, 3, 16, 4, 8)
    before = small(blocks=1)(maps)
    maps[:, 2] += 1
    moved = (small(blocks=1)(maps) - before).abs().amax(dim=(2, 3, 4))
    assert (moved > 1e-3).all()


def test_batch_items_do_not_see_each_other(small):
    maps = _noise(2, 2, 16, 4, 8)
    assert torch.allclose(small()(maps)[1], small()(maps[1:])[0], atol=1e-12)


def test_gradient_reaches_every_parameter_and_the_maps(small):
    network, maps = small(), _noise(1, 2, 16, 4, 8).requires_grad_()
    network(maps).square().sum().backward()
    assert maps.grad.abs().min() > 0
    assert all(parameter.grad.abs().max() > 0 for parameter in network.parameters())


def test_a_map_that_windows_do_not_divide_is_refused(small):
    with pytest.raises(InputError, match="that 4 divides, got 6x12"):
        small()(_noise(1, 2, 16, 6, 12))
