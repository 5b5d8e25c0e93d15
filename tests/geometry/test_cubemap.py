"""Cube faces: proper rotations that look where their names say."""

from pathlib import Path

import pytest
import torch

from pansplat.geometry.cubemap import FACES, face_poses, face_rotations


def test_each_face_looks_where_its_name_says():
    forward = {
        "front": (0, 0, 1), "right": (1, 0, 0), "back": (0, 0, -1),
        "left": (-1, 0, 0), "up": (0, -1, 0), "down": (0, 1, 0),
    }  # fmt: skip
    rotations = face_rotations()
    for name, rotation in zip(FACES, rotations, strict=True):
        assert rotation[:, 2].tolist() == list(forward[name])
    assert torch.equal(torch.linalg.det(rotations), torch.ones(6, dtype=torch.float64))


def test_side_faces_stand_upright():
    assert (face_rotations()[:4, :, 1] == torch.tensor((0.0, 1, 0))).all()


def test_face_poses_share_the_panoramas_centre():
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor((1.0, 2, 3))
    poses = face_poses(pose)
    assert (poses[:, :3, 3] == pose[:3, 3]).all() and (poses[:, 3] == pose[3]).all()
    assert torch.equal(poses[:, :3, :3], face_rotations())


@pytest.mark.shared
def test_face_rotations_are_the_originals(shared: Path):
    from safetensors.torch import load_file

    expected = load_file(shared / "golden" / "units.safetensors")["cubemap.rotations"]
    assert torch.allclose(face_rotations(dtype=torch.float32), expected[..., :3, :3].float(), atol=1e-6)
