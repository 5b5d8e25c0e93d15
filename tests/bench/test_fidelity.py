"""Error figures on pictures whose errors are known."""

import math

import pytest
import torch

from pansplat.bench.fidelity import fidelity, seam_jump
from pansplat.geometry.cubemap import face_of
from pansplat.geometry.equirect import pixel_directions

HEIGHT = 64
DIRECTIONS = pixel_directions(HEIGHT, 2 * HEIGHT, dtype=torch.float64)
FACES = face_of(DIRECTIONS.reshape(-1, 3)).reshape(HEIGHT, 2 * HEIGHT)


@pytest.fixture
def truth():
    """A picture with edges of its own."""
    return torch.rand(3, HEIGHT, 2 * HEIGHT, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def test_the_truth_has_no_error(truth):
    found = fidelity(truth, truth, panorama=True)
    assert (found.max_error, found.psnr_db, found.seam_jump, found.energy_error) == (0, math.inf, 0, 0)


def test_one_wrong_pixel_is_the_largest_error_and_the_whole_noise(truth):
    wrong = truth.clone()
    wrong[1, 10, 20] += 0.25
    found = fidelity(wrong, truth, panorama=True)
    assert found.max_error == pytest.approx(0.25)
    assert found.psnr_db == pytest.approx(-10 * math.log10(0.25**2 / truth.numel()))


def test_energy_is_the_relative_sum_of_colour(truth):
    assert fidelity(1.01 * truth, truth, panorama=True).energy_error == pytest.approx(0.01)
    assert fidelity(0.9 * truth, truth, panorama=False).energy_error == pytest.approx(-0.1)


def test_energy_counts_pixels_by_their_solid_angle(truth):
    flat = torch.ones_like(truth)
    top = flat.clone()
    top[:, 0] += 1
    expected = (1 - math.cos(math.pi / HEIGHT)) / 2  # of the sphere
    assert fidelity(top, flat, panorama=True).energy_error == pytest.approx(expected, rel=1e-2)


def test_an_offset_of_one_face_is_a_seam(truth):
    wrong = truth + 0.1 * (FACES == 5)
    expected = fidelity(wrong, truth, panorama=True).seam_jump
    assert expected is not None and 0.03 < expected < 0.1  # only some of all borders are that face's


def test_a_seamless_picture_has_no_jump(truth):
    smooth = DIRECTIONS.permute(2, 0, 1) * 0.3  # an error that knows nothing of faces
    assert seam_jump(smooth) < 1e-3 * float(smooth.max())
    assert fidelity(truth + 0.2, truth, panorama=True).seam_jump == pytest.approx(0, abs=1e-12)


def test_edges_of_the_truth_are_no_seam():
    faces = FACES.double().expand(3, -1, -1)
    assert fidelity(faces + 0.01, faces, panorama=True).seam_jump == pytest.approx(0, abs=1e-12)


def test_a_pinhole_picture_has_no_seams(truth):
    assert fidelity(truth, truth, panorama=False).seam_jump is None


def test_sizes_must_agree(truth):
    with pytest.raises(ValueError, match="truth's shape"):
        fidelity(truth[:, :-1], truth, panorama=True)
