"""The panorama convention of docs/conventions.md; sampling, padding and resizing on the sphere."""

import math

import pytest
import torch
from synthetic_scenes import draw_noise

from pansplat.geometry.equirect import (
    directions_from_uv,
    pad_equirect,
    pixel_directions,
    resize_equirect,
    rotate_equirect,
    row_weights,
    sample_equirect,
    uv_from_directions,
)
from pansplat.geometry.pose import rotations_from_quats


def _uv(height, width, margin=0):
    u = (torch.arange(-margin, width + margin, dtype=torch.float64) + 0.5) / width
    v = (torch.arange(-margin, height + margin, dtype=torch.float64) + 0.5) / height
    return torch.stack((u.expand(len(v), -1), v[:, None].expand(-1, len(u))), dim=-1)


DIRECTIONS = {
    "forward": ((0.5, 0.5), (0, 0, 1)),
    "right": ((0.75, 0.5), (1, 0, 0)),
    "back": ((0.0, 0.5), (0, 0, -1)),
    "left": ((0.25, 0.5), (-1, 0, 0)),
    "up": ((0.5, 0.0), (0, -1, 0)),
    "down": ((0.5, 1.0), (0, 1, 0)),
}


@pytest.mark.parametrize("name", DIRECTIONS)
def test_the_six_directions_follow_the_convention(name):
    uv, direction = (torch.tensor(v, dtype=torch.float64) for v in DIRECTIONS[name])
    assert torch.allclose(directions_from_uv(uv), direction, atol=1e-15)
    back = uv_from_directions(3 * direction)
    assert torch.allclose(back[1], uv[1], atol=1e-15)
    if name not in ("up", "down"):  # the longitude of a pole is arbitrary
        assert float((back[0] - uv[0]).remainder(1)) == pytest.approx(0, abs=1e-12)


def test_pixel_centres_are_at_half_integers():
    assert torch.allclose(uv_from_directions(pixel_directions(4, 8, dtype=torch.float64)), _uv(4, 8))


def test_coordinates_of_any_direction_are_finite_even_for_zero():
    directions = torch.tensor([[0.0, 0, 0], [0, 1e-30, 0], [0, -1, 0], [1e30, 0, 0]])
    assert torch.isfinite(uv_from_directions(directions)).all()


def test_row_weights_are_the_solid_angle_of_the_rows():
    height = 64
    edges = torch.linspace(-math.pi / 2, math.pi / 2, height + 1, dtype=torch.float64).sin()
    exact = edges.diff() / 2
    weights = row_weights(height) / row_weights(height).sum()
    assert torch.allclose(weights, exact, rtol=2e-3)


def test_a_quarter_turn_to_the_right_rolls_the_panorama_left():
    image = draw_noise(3, 8, 16)
    turn = rotations_from_quats(torch.tensor((math.cos(math.pi / 4), 0, math.sin(math.pi / 4), 0), dtype=torch.float64))
    assert torch.allclose(turn[:, 2], torch.tensor((1.0, 0, 0), dtype=torch.float64), atol=1e-12)
    assert torch.allclose(rotate_equirect(image, turn), image.roll(-4, dims=-1), atol=1e-9)


@pytest.mark.parametrize("margin", [1, 3, 6])
def test_padding_continues_the_directions_of_a_panorama(margin):
    rays = pixel_directions(6, 12, dtype=torch.float64).movedim(-1, 0)
    beyond = directions_from_uv(_uv(6, 12, margin)).movedim(-1, 0)
    assert torch.allclose(pad_equirect(rays[None], margin, "sphere")[0], beyond, atol=1e-14)


def test_wrapped_columns_have_zeros_beyond_the_poles():
    maps = draw_noise(2, 3, 4, 8)
    padded = pad_equirect(maps, 2, "wrapped_columns")
    assert padded.shape == (2, 3, 8, 12)
    assert not padded[..., :2, :].any() and not padded[..., -2:, :].any()
    assert torch.equal(padded[..., 2:-2, :2], maps[..., -2:])
    assert torch.equal(padded[..., 2:-2, -2:], maps[..., :2])
    assert torch.equal(padded[..., 2:-2, 2:-2], maps)
    padded = pad_equirect(torch.ones(1, 1, 2, 4), 1, "zeros")
    assert float(padded.sum()) == 8 and float(padded[..., 1:-1, 1:-1].sum()) == 8


@pytest.mark.parametrize(("border", "shape"), [("sphere", (4, 8)), ("wrapped_columns", (9, 4))])
def test_a_margin_larger_than_the_map_is_refused(border, shape):
    with pytest.raises(ValueError, match=r"at least as large as the margin of 5, got \dx\d"):
        pad_equirect(torch.zeros(1, 1, *shape), 5, border)


@pytest.mark.parametrize("height", [16, 12, 8, 6, 4, 2, 5])
def test_resizing_samples_the_sphere_at_the_new_pixel_centres(height):
    maps = draw_noise(2, 3, 8, 16)
    truth = torch.stack([sample_equirect(image, _uv(height, 2 * height)) for image in maps])
    assert torch.allclose(resize_equirect(maps, (height, 2 * height)), truth, atol=1e-12)


def test_padding_and_resizing_pass_gradcheck():
    maps = draw_noise(1, 2, 4, 8).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: pad_equirect(x, 2, "sphere"), maps)
    assert torch.autograd.gradcheck(lambda x: pad_equirect(x, 2, "wrapped_columns"), maps)
    assert torch.autograd.gradcheck(lambda x: resize_equirect(x, (6, 12)), maps)
