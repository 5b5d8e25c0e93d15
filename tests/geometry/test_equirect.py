"""The panorama convention of docs/conventions.md, and sampling that knows the sphere."""

import math

import pytest
import torch

from pansplat.geometry.equirect import (
    directions_from_uv,
    pad_equirect,
    pixel_directions,
    rotate_equirect,
    row_weights,
    sample_equirect,
    uv_from_directions,
)
from pansplat.geometry.pose import rotations_from_quats

SIX = {
    "forward": ((0.5, 0.5), (0, 0, 1)),
    "right": ((0.75, 0.5), (1, 0, 0)),
    "back": ((0.0, 0.5), (0, 0, -1)),
    "left": ((0.25, 0.5), (-1, 0, 0)),
    "up": ((0.5, 0.0), (0, -1, 0)),
    "down": ((0.5, 1.0), (0, 1, 0)),
}


@pytest.mark.parametrize("name", SIX)
def test_each_of_the_six_directions_is_where_the_convention_says(name):
    uv, direction = (torch.tensor(v, dtype=torch.float64) for v in SIX[name])
    assert torch.allclose(directions_from_uv(uv), direction, atol=1e-15)
    back = uv_from_directions(3 * direction)
    assert torch.allclose(back[1], uv[1], atol=1e-15)
    if name not in ("up", "down"):  # longitude means nothing at the poles
        assert float((back[0] - uv[0]).remainder(1)) == pytest.approx(0, abs=1e-12)


def test_pixel_centres_are_at_half_integers():
    rays = pixel_directions(4, 8, dtype=torch.float64)
    uv = uv_from_directions(rays)
    assert torch.allclose(uv[..., 0], ((torch.arange(8, dtype=torch.float64) + 0.5) / 8).expand(4, 8))
    assert torch.allclose(uv[..., 1], ((torch.arange(4, dtype=torch.float64) + 0.5) / 4)[:, None].expand(4, 8))


def test_coordinates_of_any_direction_are_finite_even_for_zero():
    directions = torch.tensor([[0.0, 0, 0], [0, 1e-30, 0], [0, -1, 0], [1e30, 0, 0]])
    assert torch.isfinite(uv_from_directions(directions)).all()


def test_row_weights_are_the_solid_angle_of_the_rows():
    height = 64
    edges = torch.linspace(-math.pi / 2, math.pi / 2, height + 1, dtype=torch.float64).sin()
    exact = edges.diff() / 2
    weights = row_weights(height) / row_weights(height).sum()
    assert torch.allclose(weights, exact, rtol=2e-3)


def test_sampling_at_pixel_centres_returns_the_pixels():
    image = torch.rand(3, 6, 12, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    uv = uv_from_directions(pixel_directions(6, 12, dtype=torch.float64))
    assert torch.allclose(sample_equirect(image, uv), image, atol=1e-12)


def test_sampling_on_the_seam_is_the_mean_of_both_edges():
    image = torch.rand(1, 6, 12, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    row = torch.tensor(2.5 / 6, dtype=torch.float64)
    for u in (0.0, 1.0):
        value = sample_equirect(image, torch.stack((torch.tensor(u, dtype=torch.float64), row)))
        assert torch.allclose(value, (image[:, 2, 0] + image[:, 2, -1]) / 2)


def test_padding_continues_over_the_poles_half_a_turn_away():
    image = torch.arange(2 * 8.0).reshape(1, 2, 8)
    padded = pad_equirect(image, 1)
    assert torch.equal(padded[0, 0, 1:-1], image[0, 0].roll(4))
    assert torch.equal(padded[0, -1, 1:-1], image[0, -1].roll(4))
    assert torch.equal(padded[0, 1], torch.cat((image[0, 0, -1:], image[0, 0], image[0, 0, :1])))


def test_padding_refuses_an_odd_width():
    with pytest.raises(ValueError, match="even width"):
        pad_equirect(torch.zeros(1, 3, 7), 1)


def test_a_quarter_turn_to_the_right_rolls_the_panorama_left():
    image = torch.rand(3, 8, 16, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    turn = rotations_from_quats(torch.tensor((math.cos(math.pi / 4), 0, math.sin(math.pi / 4), 0), dtype=torch.float64))
    assert torch.allclose(turn[:, 2], torch.tensor((1.0, 0, 0), dtype=torch.float64), atol=1e-12)
    assert torch.allclose(rotate_equirect(image, turn), image.roll(-4, dims=-1), atol=1e-9)


def test_sampling_passes_gradcheck():
    image = torch.rand(1, 4, 8, dtype=torch.float64, requires_grad=True)
    uv = torch.tensor([[0.13, 0.4], [0.97, 0.08]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(sample_equirect, (image, uv))
