"""Six faces side by side: the original's numbers, and there and back again."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from pansplat.geometry.cube_strip import equirect_from_strip, strip_directions, strip_from_equirect, strip_lookup
from pansplat.geometry.equirect import pixel_directions


def test_a_strip_is_the_originals(golden: Callable[[str], dict[str, Tensor]]) -> None:
    units = golden("units")
    strip = strip_from_equirect(units["e2c.in"].movedim(-1, 0), 32)
    assert (strip.movedim(0, -1) - units["e2c.out"]).abs().max() < 2e-5


@pytest.mark.parametrize("scale", [5, 4, 3, 2, 1])
def test_the_lookup_is_the_one_that_checkpoints_store(scale: int, recipe_weights: dict[str, Tensor]) -> None:
    stored = recipe_weights[f"mono_depth.c2e.{scale}.sample_grid"][0, 0].double()
    x, y, face = strip_lookup(512 >> scale).unbind(-1)
    assert (torch.stack((x, y, face / 2.5 - 1), dim=-1) - stored).abs().max() < 2e-6


def test_faces_look_front_right_back_left_up_down() -> None:
    centres = strip_directions(3)[1, 1::3]
    expected = [(0, 0, 1), (1, 0, 0), (0, 0, -1), (-1, 0, 0), (0, -1, 0), (0, 1, 0)]
    assert torch.equal(centres * 2, torch.tensor(expected, dtype=torch.float64))


def test_touching_faces_share_their_edge() -> None:
    rays = strip_directions(5)
    for right in range(4):
        left = (right - 1) % 4
        assert torch.equal(rays[:, 5 * left + 4], rays[:, 5 * right])
    assert torch.equal(rays[4, 20:25], rays[0, 0:5])  # the lower edge of up is the upper edge of front
    assert torch.equal(rays[0, 25:30], rays[4, 0:5])  # the upper edge of down is the lower edge of front


def test_a_panorama_returns_from_its_strip() -> None:
    panorama = pixel_directions(64, 128, dtype=torch.float64).movedim(-1, 0)  # smooth, and not the same twice
    strip = strip_from_equirect(panorama, 65)
    back = equirect_from_strip(strip[None], strip_lookup(64))[0]
    # Where whole rows decide on the face, a pixel beside is held to the edge: at most half a pixel's angle off.
    assert (back - panorama).abs().max() < 0.03
    assert (back - panorama).abs().mean() < 1e-3


def test_no_sample_mixes_two_faces() -> None:
    numbers = torch.arange(6.0).repeat_interleave(8).expand(1, 1, 8, 48).contiguous()
    back = equirect_from_strip(numbers, strip_lookup(32))[0, 0]
    assert (back - strip_lookup(32)[..., 2]).abs().max() < 1e-4
