"""Beyond its borders a panorama goes on: over the seam and over the poles."""

import pytest
import torch

from pansplat.geometry.equirect import directions_from_uv, pixel_directions, sample_equirect
from pansplat.geometry.wrap import pad, resize


def _uv(height, width, margin=0):
    u = (torch.arange(-margin, width + margin, dtype=torch.float64) + 0.5) / width
    v = (torch.arange(-margin, height + margin, dtype=torch.float64) + 0.5) / height
    return torch.stack((u.expand(len(v), -1), v[:, None].expand(-1, len(u))), dim=-1)


def _noise(*shape, dtype=torch.float64):
    return torch.randn(shape, generator=torch.Generator().manual_seed(1), dtype=dtype)


@pytest.mark.parametrize("margin", [1, 3, 6])
def test_a_padded_panorama_of_directions_shows_the_directions_beyond(margin):
    rays = pixel_directions(6, 12, dtype=torch.float64).movedim(-1, 0)
    beyond = directions_from_uv(_uv(6, 12, margin)).movedim(-1, 0)
    assert torch.allclose(pad(rays[None], margin, "sphere")[0], beyond, atol=1e-14)


def test_wrapped_columns_have_zeros_beyond_the_poles_and_no_seam():
    maps = _noise(2, 3, 4, 8)
    padded = pad(maps, 2, "wrapped_columns")
    assert padded.shape == (2, 3, 8, 12)
    assert not padded[..., :2, :].any() and not padded[..., -2:, :].any()
    assert torch.equal(padded[..., 2:-2, :2], maps[..., -2:])
    assert torch.equal(padded[..., 2:-2, -2:], maps[..., :2])
    assert torch.equal(padded[..., 2:-2, 2:-2], maps)


def test_zeros_are_zeros_all_around():
    padded = pad(torch.ones(1, 1, 2, 4), 1, "zeros")
    assert float(padded.sum()) == 8 and float(padded[..., 1:-1, 1:-1].sum()) == 8


@pytest.mark.parametrize("border", ["sphere", "wrapped_columns", "zeros"])
def test_no_margin_changes_nothing(border):
    maps = _noise(1, 2, 4, 8)
    assert torch.equal(pad(maps, 0, border), maps)


@pytest.mark.parametrize("border", ["sphere", "wrapped_columns"])
def test_padding_keeps_channels_last(border):
    maps = _noise(2, 4, 6, 12).contiguous(memory_format=torch.channels_last)
    assert pad(maps, 1, border).is_contiguous(memory_format=torch.channels_last)


@pytest.mark.parametrize(("border", "shape"), [("sphere", (4, 8)), ("wrapped_columns", (9, 4))])
def test_a_margin_larger_than_the_map_is_refused(border, shape):
    with pytest.raises(ValueError, match=r"a margin of 5 needs a map at least as large, got \dx\d"):
        pad(torch.zeros(1, 1, *shape), 5, border)


def test_an_odd_width_cannot_go_on_over_the_poles():
    with pytest.raises(ValueError, match="even width"):
        pad(torch.zeros(1, 1, 4, 7), 1, "sphere")


@pytest.mark.parametrize("height", [16, 12, 8, 6, 4, 2, 5])
def test_resizing_samples_the_sphere_at_the_new_pixel_centres(height):
    maps = _noise(2, 3, 8, 16)
    truth = torch.stack([sample_equirect(image, _uv(height, 2 * height)) for image in maps])
    assert torch.allclose(resize(maps, (height, 2 * height)), truth, atol=1e-12)


def test_resizing_to_the_same_size_is_the_identity():
    maps = _noise(1, 2, 4, 8)
    assert torch.equal(resize(maps, (4, 8)), maps)


def test_halving_averages_four_pixels():
    maps = _noise(1, 2, 8, 16)
    assert torch.allclose(resize(maps, (4, 8)), torch.nn.functional.avg_pool2d(maps, 2), atol=1e-15)


@pytest.mark.parametrize("columns", [1, 5, 8])
def test_rolling_before_doubling_is_rolling_twice_as_far_after(columns):
    maps = _noise(1, 2, 8, 16, dtype=torch.float32)
    assert torch.equal(resize(maps.roll(columns, -1), (16, 32)), resize(maps, (16, 32)).roll(2 * columns, -1))


def test_resizing_keeps_a_constant():
    assert torch.allclose(resize(torch.full((1, 1, 6, 12), 3.0), (16, 32)), torch.tensor(3.0))


def test_padding_and_resizing_have_the_right_gradient():
    maps = _noise(1, 2, 4, 8).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: pad(x, 2, "sphere"), maps)
    assert torch.autograd.gradcheck(lambda x: pad(x, 2, "wrapped_columns"), maps)
    assert torch.autograd.gradcheck(lambda x: resize(x, (6, 12)), maps)


def test_another_shape_is_refused():
    with pytest.raises(ValueError, match="must keep the shape of 4x8, got 4x4"):
        resize(torch.zeros(1, 1, 4, 8), (4, 4))
