"""Masks that are painted on photographs, and the bounds of scenes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pansplat.errors import InputError
from pansplat.geometry.equirect import pixel_directions
from pansplat.geometry.pose import rotations_from_quats
from pansplat.images.image_files import read_blur_mask, write_image
from pansplat.inputs.folders import load_pairs
from pansplat.inputs.pairs import Panorama
from pansplat_viewer.scene.cleaning import MaskPainter, measure_bounds


@pytest.fixture
def panorama(tmp_path: Path) -> Panorama:
    """A photograph of a camera that is turned."""
    write_image(tmp_path / "hall.png", torch.full((3, 16, 32), 0.5))
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotations_from_quats(torch.tensor((0.7, 0.3, -0.5, 0.2), dtype=torch.float64))
    return Panorama("hall", tmp_path / "hall.png", pose)


def _measure_angles(panorama: Panorama, height: int, direction: np.ndarray) -> np.ndarray:
    """Angles of the pixels of a photograph from a direction in world axes, radians."""
    rays = pixel_directions(height, 2 * height, dtype=torch.float64).numpy() @ panorama.cam2world[:3, :3].numpy().T
    return np.arccos(np.clip(rays @ direction, -1, 1))


@pytest.mark.parametrize("local", [(0.0, 0.0, 1.0), (0.01, 0.1, -1.0), (0.02, 1.0, 0.0)])
def test_a_brush_is_a_circle_on_the_sphere_also_at_the_seam_and_the_pole(
    panorama: Panorama, local: tuple[float, float, float]
) -> None:
    direction = panorama.cam2world[:3, :3].numpy() @ np.array(local) / np.linalg.norm(local)
    painter = MaskPainter(panorama)
    painter.paint(direction, 0.2)
    angles = _measure_angles(panorama, 512, direction)
    assert painter.is_changed and np.array_equal(painter.hidden, angles < 0.2)
    for outline in painter.list_outlines():
        from_center = np.arccos(np.clip(outline @ direction, -1, 1))
        at_seam = np.abs(outline @ panorama.cam2world[:3, 0].numpy()) < 0.02
        assert np.all((np.abs(from_center - 0.2) < 0.02) | at_seam | (from_center < 0.2))
    painter.paint(direction, 0.3, erase=True)
    assert not painter.hidden.any() and painter.list_outlines() == []


def test_a_fast_stroke_has_no_gaps(panorama: Panorama) -> None:
    painter = MaskPainter(panorama)
    ends = [np.array((np.sin(angle), 0.1, np.cos(angle))) for angle in (0.0, 1.0)]
    for end in ends:
        painter.paint(end / np.linalg.norm(end), 0.05)
    middle = np.array((np.sin(0.5), 0.1, np.cos(0.5)))
    assert painter.hidden[_measure_angles(panorama, 512, middle / np.linalg.norm(middle)) < 0.03].all()
    painter.lift()
    painter.clear()
    painter.paint(ends[0] / np.linalg.norm(ends[0]), 0.05)
    assert not painter.hidden[_measure_angles(panorama, 512, middle / np.linalg.norm(middle)) < 0.03].any()


def test_a_saved_mask_is_read_again_and_goes_on(panorama: Panorama, tmp_path: Path) -> None:
    painter = MaskPainter(panorama)
    painter.paint(np.array((1.0, 0.0, 0.0)), 0.2)
    assert painter.save() == tmp_path / "hall_blur.png" and not painter.is_changed
    assert np.array_equal(read_blur_mask(tmp_path / "hall_blur.png", 512), painter.hidden)
    again = MaskPainter(panorama)
    assert np.array_equal(again.hidden, painter.hidden) and not again.is_changed
    again.clear()
    assert again.is_changed
    again.save()
    assert not read_blur_mask(tmp_path / "hall_blur.png", 64).any()
    again.hidden[:] = True
    with pytest.raises(InputError, match=r"hall_blur\.png: needed a part of the photograph that is shown"):
        again.save()


def test_bounds_are_those_of_the_finite_gaussians(random_scene) -> None:
    scene = random_scene()
    means = scene.gaussians.means.clone()
    means[3, 0] = torch.inf
    rest = means[torch.arange(len(means)) != 3]
    bounds = measure_bounds(replace(scene, gaussians=replace(scene.gaussians, means=means)))
    assert bounds == pytest.approx((*rest.amin(0).tolist(), *rest.amax(0).tolist()))
    nothing = replace(scene, gaussians=scene.gaussians.select(torch.arange(0)))
    assert measure_bounds(nothing) == (-1, -1, -1, 1, 1, 1)


def test_painting_goes_on_with_masks_of_pictures_and_of_other_capitals(tmp_path: Path) -> None:
    for face in "frblud":
        write_image(tmp_path / f"hall_{face}.png", np.full((48, 48, 3), 99, np.uint8))
    white = np.zeros((48, 48, 3), np.uint8)
    white[16:32, 16:32] = 255
    write_image(tmp_path / "hall_f_blur.png", white)
    white = np.zeros((64, 128, 3), np.uint8)
    white[50:] = 255
    write_image(tmp_path / "hall_Blur.PNG", white)
    panorama = load_pairs(tmp_path)[0].context[0]
    painter = MaskPainter(panorama)
    assert painter.hidden[256, 512] and painter.hidden[420].all() and not painter.hidden[256, 700]
    assert painter.save() == tmp_path / "hall_Blur.PNG", "one mask of the panorama"
    assert np.array_equal(MaskPainter(panorama).hidden, painter.hidden)
