"""Every convention gives the same camera, and invalid poses are refused with the reason."""

import math
from pathlib import Path

import pytest
import torch

from pansplat.errors import InputError
from pansplat.geometry.pose import quats_from_rotations, rotations_from_quats
from pansplat.inputs.poses import CONVENTIONS, parse_convention, read_trajectory, rigid_matrix, to_cam2world

_QUAT = torch.tensor((0.7, 0.3, -0.5, 0.4), dtype=torch.float64)


def _pose() -> torch.Tensor:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotations_from_quats(_QUAT)
    pose[:3, 3] = torch.tensor((1.0, -2.0, 0.5))
    return pose


def _in_convention(cam2world: torch.Tensor, convention: str) -> torch.Tensor:
    """The matrix that a user of the convention would have for an OpenCV cam2world pose."""
    flip = torch.diag(torch.tensor((1.0, -1.0, -1.0, 1.0), dtype=torch.float64))
    own = cam2world @ flip if convention.endswith("opengl") else cam2world
    return torch.linalg.inv(own) if convention.startswith("world2cam") else own


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_every_convention_gives_the_same_camera(convention: str) -> None:
    matrix = rigid_matrix(_in_convention(_pose(), convention).tolist(), "test")
    assert torch.allclose(to_cam2world(matrix, convention), _pose(), atol=1e-12)


@pytest.mark.parametrize(
    ("text", "meaning"),
    [
        ("cam2world opencv", "cam2world opencv"),
        (
            "cam2world 4x4, OpenCV axes (x right, y down, z forward), metres; the centre looks along +z",
            "cam2world opencv",
        ),
        ("c2w, Habitat", "cam2world opengl"),
        ("camera-to-world / OpenGL", "cam2world opengl"),
        ("world2cam COLMAP", "world2cam opencv"),
        ("World to Camera, NeRF axes", "world2cam opengl"),
    ],
)
def test_free_text_conventions_are_understood(text: str, meaning: str) -> None:
    assert parse_convention(text, "poses.json") == meaning


@pytest.mark.parametrize(
    "text", [None, "", "cam2world", "opencv", "cam2world or world2cam, opencv", "opencv opengl c2w", 3]
)
def test_unknown_conventions_are_refused_with_the_valid_names(text) -> None:
    with pytest.raises(InputError) as caught:
        parse_convention(text, "poses.json")
    assert str(caught.value).startswith("poses.json: needed")
    assert all(name in str(caught.value) for name in CONVENTIONS)


def test_a_pose_may_have_three_rows() -> None:
    assert torch.equal(rigid_matrix(_pose()[:3].tolist(), "test"), _pose())


def test_rounded_files_give_exact_rotations() -> None:
    rounded = (_pose() * 1e3).round() / 1e3
    rotation = rigid_matrix(rounded.tolist(), "test")[:3, :3]
    assert (rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max() < 1e-12
    assert (rotation - _pose()[:3, :3]).abs().max() < 1e-3


def _changed(**entries: float) -> list:
    pose = _pose()
    for key, value in entries.items():
        pose[int(key[1]), int(key[2])] = value
    return pose.tolist()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (None, "needed a pose, got none"),
        ("nothing", "needed a pose of 4x4 numbers, got 'nothing'"),
        ([[1, 2], [3]], "needed a pose of 4x4 numbers"),
        ([[1.0, 0.0], [0.0, 1.0]], r"got shape \(2, 2\)"),
        (_changed(m00=math.nan), "NaN or infinite"),
        (_changed(m03=math.inf), "NaN or infinite"),
        (_changed(m00=3.0), "no rotation"),
        (_changed(m33=2.0), "bottom row"),
        (_pose().T.tolist(), "transposed"),
        ((_pose() @ torch.diag(torch.tensor((1.0, 1.0, -1.0, 1.0), dtype=torch.float64))).tolist(), "mirrored"),
        ((_pose() @ torch.diag(torch.tensor((2.0, 2.0, 2.0, 1.0), dtype=torch.float64))).tolist(), "scaled by 2"),
    ],
)
def test_matrices_that_are_not_rigid_are_refused_with_the_reason(values, message: str) -> None:
    with pytest.raises(InputError, match=f"^poses.json, 'a.png': .*{message}"):
        rigid_matrix(values, "poses.json, 'a.png'")


def _kitti(poses: list[torch.Tensor]) -> str:
    return "\n".join(" ".join(f"{x:.9f}" for x in pose[:3].flatten()) for pose in poses) + "\n"


def _tum(poses: list[torch.Tensor]) -> str:
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for i, pose in enumerate(poses):
        w, x, y, z = quats_from_rotations(pose[:3, :3]).tolist()
        lines.append(" ".join(f"{n:.9f}" for n in (0.1 * i, *pose[:3, 3].tolist(), x, y, z, w)))
    return "\n".join(lines)


@pytest.mark.parametrize("convention", [None, *CONVENTIONS])
@pytest.mark.parametrize(("kind", "text"), [("kitti", _kitti), ("tum", _tum)])
def test_read_trajectories_equal_written_ones(tmp_path: Path, kind: str, text, convention: str | None) -> None:
    poses = [torch.eye(4, dtype=torch.float64), _pose()]
    (tmp_path / "a.txt").write_text(text([_in_convention(pose, convention or CONVENTIONS[0]) for pose in poses]))
    read = read_trajectory(tmp_path / "a.txt", convention)
    assert read.kind == kind
    assert (torch.stack(read.poses) - torch.stack(poses)).abs().max() < 1e-8


@pytest.mark.parametrize(
    ("text", "expected", "message"),
    [
        (
            _tum([_pose()]),
            "kitti",
            r"needed KITTI \(12 numbers per line\) according to its name, got TUM .* rename it to a\.tum",
        ),
        (_kitti([_pose()]), "tum", "needed TUM .* got KITTI"),
        ("1 " * 17, None, "line 1: needed 12 numbers .* or 8 .*got 17"),
        ("", None, "empty file"),
        ("frame one\n", None, "line 1: needed numbers, got 'frame one'"),
        (_kitti([_pose()]) + "1 2 3\n", None, "line 2: needed 12 numbers as in the other lines, got 3"),
        ("0 1 2 3 0 0 0 0", None, "needed a unit quaternion .*got length 0"),
        ("0 1 2 3 5 0 0 1", None, "needed a unit quaternion .*check the order"),
        ("1 0 0 0 0 1 0 0 0 0 9 0", None, "line 1: needed a rigid pose"),
        *(
            (f"1 0 0 {x} 0 1 0 0 0 0 1 0", None, "line 1: needed a (rigid pose|position)")
            for x in ("1e30", "1e400", "nan")
        ),
        ("0 1e30 0 0 0 0 0 1", None, "line 1: needed a position of at most"),
        ("0 0 0 0 1e200 0 0 1e200", None, "needed a unit quaternion"),
    ],
)
def test_invalid_trajectories_are_refused(tmp_path: Path, text: str, expected: str | None, message: str) -> None:
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(InputError, match=message):
        read_trajectory(tmp_path / "a.txt", expected=expected)
