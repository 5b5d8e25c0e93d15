"""Cube faces are proper rotations that look where their names say; strips of faces equal the official ones."""

import pytest
import torch

from pansplat.geometry.cubemap import FACES, equirect_from_strip, face_rotations, strip_from_equirect, strip_lookup
from pansplat.geometry.equirect import pixel_directions


def test_faces_look_along_their_names():
    forward = {
        "front": (0, 0, 1), "right": (1, 0, 0), "back": (0, 0, -1),
        "left": (-1, 0, 0), "up": (0, -1, 0), "down": (0, 1, 0),
    }  # fmt: skip
    rotations = face_rotations()
    for name, rotation in zip(FACES, rotations, strict=True):
        assert rotation[:, 2].tolist() == list(forward[name])
    assert torch.equal(torch.linalg.det(rotations), torch.ones(6, dtype=torch.float64))


def test_face_rotations_equal_the_official_ones(golden):
    expected = golden("units")["cubemap.rotations"]
    assert torch.allclose(face_rotations(dtype=torch.float32), expected[..., :3, :3].float(), atol=1e-6)


def test_a_strip_equals_the_official_one(golden):
    units = golden("units")
    strip = strip_from_equirect(units["e2c.in"].movedim(-1, 0), 32)
    assert (strip.movedim(0, -1) - units["e2c.out"]).abs().max() < 2e-5


@pytest.mark.parametrize("scale", [5, 4, 3, 2, 1])
def test_the_lookup_equals_the_one_in_checkpoints(scale, recipe_weights):
    stored = recipe_weights[f"mono_depth.c2e.{scale}.sample_grid"][0, 0].double()
    x, y, face = strip_lookup(512 >> scale).unbind(-1)
    assert (torch.stack((x, y, face / 2.5 - 1), dim=-1) - stored).abs().max() < 2e-6


def test_a_panorama_is_restored_from_its_strip():
    panorama = pixel_directions(64, 128, dtype=torch.float64).movedim(-1, 0)  # smooth and injective
    strip = strip_from_equirect(panorama, 65)
    back = equirect_from_strip(strip[None], strip_lookup(64))[0]
    # Pixels outside their face are clamped to its edge: an error of at most half a pixel's angle.
    assert (back - panorama).abs().max() < 0.03
    assert (back - panorama).abs().mean() < 1e-3


def test_no_sample_mixes_two_faces():
    numbers = torch.arange(6.0).repeat_interleave(8).expand(1, 1, 8, 48).contiguous()
    back = equirect_from_strip(numbers, strip_lookup(32))[0, 0]
    assert (back - strip_lookup(32)[..., 2]).abs().max() < 1e-4
