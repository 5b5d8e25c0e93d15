"""Errors of results whose errors are known."""

import math

import pytest
import torch

from pansplat.bench.fidelity import clamped_psnr, measure_fidelity, relative_depth_errors, relative_deviation, seam_jump
from pansplat.geometry.cubemap import face_of
from pansplat.geometry.equirect import pixel_directions

HEIGHT = 64
DIRECTIONS = pixel_directions(HEIGHT, 2 * HEIGHT, dtype=torch.float64)
FACES = face_of(DIRECTIONS.reshape(-1, 3)).reshape(HEIGHT, 2 * HEIGHT)


@pytest.fixture
def reference():
    """An image with edges of its own."""
    return torch.rand(3, HEIGHT, 2 * HEIGHT, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def test_the_reference_has_no_error(reference):
    found = measure_fidelity(reference, reference, panorama=True)
    assert (found.max_error, found.psnr_db, found.seam_jump, found.energy_error) == (0, math.inf, 0, 0)


def test_one_wrong_pixel_sets_the_largest_error_and_the_psnr(reference):
    wrong = reference.clone()
    wrong[1, 10, 20] += 0.25
    found = measure_fidelity(wrong, reference, panorama=True)
    assert found.max_error == pytest.approx(0.25)
    assert found.psnr_db == pytest.approx(-10 * math.log10(0.25**2 / reference.numel()))


def test_energy_error_is_the_relative_error_of_the_sum(reference):
    assert measure_fidelity(1.01 * reference, reference, panorama=True).energy_error == pytest.approx(0.01)
    assert measure_fidelity(0.9 * reference, reference, panorama=False).energy_error == pytest.approx(-0.1)


def test_energy_weighs_pixels_by_their_solid_angle(reference):
    flat = torch.ones_like(reference)
    top = flat.clone()
    top[:, 0] += 1
    expected = (1 - math.cos(math.pi / HEIGHT)) / 2  # of the sphere
    assert measure_fidelity(top, flat, panorama=True).energy_error == pytest.approx(expected, rel=1e-2)


def test_an_offset_of_one_face_is_a_seam(reference):
    wrong = reference + 0.1 * (FACES == 5)
    expected = measure_fidelity(wrong, reference, panorama=True).seam_jump
    assert expected is not None and 0.03 < expected < 0.1  # only some of the borders belong to that face


def test_an_image_without_seams_has_no_seam_jump(reference):
    smooth = DIRECTIONS.permute(2, 0, 1) * 0.3  # an error without borders
    assert seam_jump(smooth) < 1e-3 * float(smooth.max())
    assert measure_fidelity(reference + 0.2, reference, panorama=True).seam_jump == pytest.approx(0, abs=1e-12)


def test_edges_of_the_reference_are_not_seams():
    faces = FACES.double().expand(3, -1, -1)
    assert measure_fidelity(faces + 0.01, faces, panorama=True).seam_jump == pytest.approx(0, abs=1e-12)


def test_pinhole_images_have_no_seam_jump(reference):
    assert measure_fidelity(reference, reference, panorama=False).seam_jump is None


def test_images_of_different_sizes_are_refused(reference):
    with pytest.raises(ValueError, match="reference's shape"):
        measure_fidelity(reference[:, :-1], reference, panorama=True)


def test_depth_errors_are_relative_to_the_reference():
    reference = torch.tensor([1.0, 2.0, 4.0])
    errors = relative_depth_errors(torch.tensor([1.0, 2.2, 3.0]), reference)
    assert errors == (pytest.approx(0.1), pytest.approx(0.25))


def test_clamped_psnr_ignores_colours_outside_the_unit_interval():
    image = torch.tensor([0.5, 1.0])
    assert clamped_psnr(image, image) == math.inf
    assert clamped_psnr(torch.tensor([0.6, 1.5]), image) == pytest.approx(10 * math.log10(2 / 0.01))


def test_deviation_of_tensors_is_relative_to_the_reference():
    reference = {"a": torch.tensor([3.0, 0.0]), "b": torch.tensor([4.0])}
    result = {"a": torch.tensor([3.0, 0.3]), "b": torch.tensor([4.0])}
    assert relative_deviation(result, reference, together=True) == pytest.approx(0.06)
    assert relative_deviation(result, reference, together=False) == pytest.approx(0.1)
    with pytest.raises(ValueError, match="must hold"):
        relative_deviation({"a": result["a"]}, reference, together=True)
