"""Reading poses in a named convention, and converting them to cam2world with OpenCV axes (docs/conventions.md).

There are four conventions: the matrix maps camera points to the world (`cam2world`) or world points to the camera
(`world2cam`); the camera axes are those of OpenCV (x right, y down, z forward) or OpenGL (x right, y up, z backward;
also Habitat, Blender and NeRF data). The world axes are not changed.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.errors import InputError
from pansplat.geometry.pose import invert_pose, orthonormal_error, rotations_from_quats
from pansplat.geometry.world import MAX_POSITION
from pansplat.system.files import read_file

CONVENTIONS = ("cam2world opencv", "cam2world opengl", "world2cam opencv", "world2cam opengl")

_DIRECTIONS = {
    "cam2world": r"cam(era)?[ _-]?(2|to)[ _-]?world|\bc2w\b",
    "world2cam": r"world[ _-]?(2|to)[ _-]?cam(era)?|\bw2c\b",
}
_AXES = {"opencv": r"opencv|colmap", "opengl": r"opengl|habitat|blender|nerf"}
_MAX_NUMBERS_BYTES, _MAX_TEXT_BYTES = 1 << 16, 1 << 30  # of a text file with one number, and of a trajectory
_EXACT = 1e-9  # error of a rotation that is kept
_RIGID_TOLERANCE = 1e-2  # for files with 4 to 6 decimals; errors of wrong matrices are far larger
_OPENGL_TO_OPENCV = torch.diag(torch.tensor((1.0, -1.0, -1.0, 1.0), dtype=torch.float64))


class Trajectory(NamedTuple):
    """Poses of a trajectory file.

    Attributes:
        kind: "kitti" or "tum".
        poses: in file order; cam2world, OpenCV axes, metres.
    """

    kind: str
    poses: tuple[Float[Tensor, "4 4"], ...]


def parse_convention(text: str | None, source: Path | str) -> str:
    """The member of `CONVENTIONS` that a free text names. `source` is the file or argument that error messages name."""
    names = ", ".join(f'"{name}"' for name in CONVENTIONS)
    advice = f"write one of {names} (habitat is the same as opengl); `pansplat check` finds the one that fits."
    if not isinstance(text, str) or not text.strip():
        raise InputError(f'{source}: needed a pose "convention", got none; {advice}')
    lowered = text.lower()
    directions = [name for name, pattern in _DIRECTIONS.items() if re.search(pattern, lowered)]
    axes = [name for name, pattern in _AXES.items() if re.search(pattern, lowered)]
    if len(directions) != 1 or len(axes) != 1:
        raise InputError(f"{source}: needed a known pose convention, got {text!r}; {advice}")
    return f"{directions[0]} {axes[0]}"


def rigid_matrix(values: Any, source: str) -> Float[Tensor, "4 4"]:
    """The rigid 4x4 matrix, float64, nearest to nested lists of 3x4 or 4x4 numbers."""
    if values is None:
        raise InputError(f"{source}: needed a pose, got none; add its 4x4 matrix or remove the image.")
    try:
        matrix = torch.tensor(values, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise InputError(f"{source}: needed a pose of 4x4 numbers, got {str(values)[:60]!r}; correct it.") from error
    if tuple(matrix.shape) == (3, 4):
        matrix = torch.cat((matrix, torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)))
    if tuple(matrix.shape) != (4, 4):
        raise InputError(
            f"{source}: needed a pose of 4x4 (or 3x4) numbers, got shape {tuple(matrix.shape)}; correct it."
        )
    error = orthonormal_error(matrix)
    if error > _RIGID_TOLERANCE:
        raise InputError(
            f"{source}: needed a rigid pose (rotation and translation), got {_describe_error(matrix, error)}"
        )
    farthest = float(matrix[:3, 3].abs().max())
    if farthest > MAX_POSITION:
        raise InputError(
            f"{source}: needed a position of at most {MAX_POSITION:g} metres from the origin, got {farthest:g}; "
            "correct it."
        )
    return _nearest_rigid(matrix) if error > _EXACT else matrix


def _describe_error(matrix: Float[Tensor, "4 4"], error: float) -> str:
    """What is wrong with a matrix that is not rigid, and what to do."""
    if not torch.isfinite(matrix).all():
        return "NaN or infinite numbers; remove the image or estimate its pose again."
    bottom = torch.tensor((0.0, 0.0, 0.0, 1.0), dtype=torch.float64)
    if (matrix[3] - bottom).abs().max() > _RIGID_TOLERANCE:
        row = [round(float(x), 4) for x in matrix[3]]
        if (matrix[:, 3] - bottom).abs().max() <= _RIGID_TOLERANCE:
            return f"a transposed one (the translation is in the last row, {row}); transpose the matrix."
        return f"the bottom row {row}; it must be 0 0 0 1."
    rotation = matrix[:3, :3]
    determinant = float(torch.linalg.det(rotation))
    scale = abs(determinant) ** (1 / 3)
    if determinant < 0:
        return (
            f"a mirrored one (determinant {determinant:.3f}): one axis is flipped or two axes are "
            "exchanged; flip one axis so that the system is right-handed."
        )
    unscaled = matrix.clone()
    unscaled[:3, :3] /= scale
    if scale > 0 and orthonormal_error(unscaled) <= _RIGID_TOLERANCE:
        return f"a rotation scaled by {scale:.4g}; divide its 3x3 part by this number."
    return f"a 3x3 part that is no rotation (R R' differs from 1 by {error:.3g}); check the order of the numbers."


def _nearest_rigid(matrices: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """The matrices with their 3x3 parts replaced by the nearest rotations; removes the rounding errors of files."""
    u, _, vt = torch.linalg.svd(matrices[..., :3, :3])
    rigid = matrices.clone()
    rigid[..., :3, :3] = u @ vt
    rigid[..., 3, :] = torch.tensor((0.0, 0.0, 0.0, 1.0), dtype=torch.float64)
    return rigid


def to_cam2world(matrix: Float[Tensor, "4 4"], convention: str) -> Float[Tensor, "4 4"]:
    """Convert a rigid matrix from one of `CONVENTIONS` to cam2world with OpenCV camera axes."""
    direction, axes = convention.split()
    cam2world = invert_pose(matrix) if direction == "world2cam" else matrix
    return cam2world @ _OPENGL_TO_OPENCV if axes == "opengl" else cam2world


def from_cam2world(matrix: Float[Tensor, "4 4"], convention: str) -> Float[Tensor, "4 4"]:
    """The inverse of `to_cam2world`."""
    direction, axes = convention.split()
    matrix = matrix @ _OPENGL_TO_OPENCV if axes == "opengl" else matrix
    return invert_pose(matrix) if direction == "world2cam" else matrix


def read_number(path: Path) -> float:
    """The one positive number in a text file, such as a scale."""
    text = read_file(path, limit=_MAX_NUMBERS_BYTES).decode(errors="replace").strip()
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 < number < math.inf:
        raise InputError(f"{path}: needed one positive number, got {text[:40]!r}; correct it or remove the file.")
    return number


def parse_numbers(text: str, count: int, source: object) -> Float[Tensor, "count"]:
    """Exactly `count` numbers of a text; `source` is the file or entry that error messages name."""
    try:
        values = np.array(text.split(), np.float64)
    except ValueError as error:
        raise InputError(f"{source}: needed {count} numbers, got other text ({error!s:.200}); correct it.") from error
    if values.size != count:
        raise InputError(f"{source}: needed {count} numbers, got {values.size}; correct it.")
    return torch.from_numpy(values)


def read_trajectory(
    path: Path, convention: str | None = None, expected: str | None = None, scale: float = 1.0
) -> Trajectory:
    """Poses of a KITTI (12 numbers per line) or TUM (8 numbers per line) trajectory file.

    KITTI: rows of a 3x4 matrix. TUM: timestamp tx ty tz qx qy qz qw. Both are cam2world with OpenCV axes by default.
    Empty lines and lines that start with # are skipped.

    Args:
        path: text file; numbers separated by spaces or commas.
        convention: one of `CONVENTIONS`; overrides the default.
        expected: "kitti" or "tum" to refuse the other format; None to accept both.
        scale: metres per unit of the file.
    """
    rows = _number_rows(path)
    if not rows:
        raise InputError(f"{path}: needed one pose per line, got an empty file; export the trajectory again.")
    count = len(rows[0][1])
    kind = {12: "kitti", 8: "tum"}.get(count)
    if kind is None:
        raise InputError(
            f"{path}, line {rows[0][0]}: needed 12 numbers (KITTI: 3x4 matrix) or 8 (TUM: timestamp, "
            f"translation, quaternion), got {count}; export the trajectory in one of these formats."
        )
    if expected is not None and kind != expected:
        formats = {"kitti": "KITTI (12 numbers per line)", "tum": "TUM (8 numbers per line)"}
        raise InputError(
            f"{path}: needed {formats[expected]} according to its name, got {formats[kind]}; "
            f"rename it to {path.stem}.{kind}, or convert it."
        )
    ragged = next(((line, numbers) for line, numbers in rows if len(numbers) != count), None)
    if ragged is not None:
        raise InputError(
            f"{path}, line {ragged[0]}: needed {count} numbers as in the other lines, got {len(ragged[1])}; "
            "correct the line."
        )
    lines, numbers = [line for line, _ in rows], torch.from_numpy(np.array([row for _, row in rows], np.float64))
    matrices = _kitti_matrices(numbers) if kind == "kitti" else _tum_matrices(numbers, lines, path)
    cam2world = to_cam2world(_rigid_matrices(matrices, lines, path), convention or "cam2world opencv")
    cam2world[:, :3, 3] *= scale
    return Trajectory(kind, cam2world.unbind())


def _rigid_matrices(matrices: Float[Tensor, "n 4 4"], lines: list[int], path: Path) -> Float[Tensor, "n 4 4"]:
    """`rigid_matrix` of many matrices at once; those that are not exactly rigid are checked one by one."""
    rotations = matrices[:, :3, :3]
    gram = rotations @ rotations.transpose(1, 2) - torch.eye(3, dtype=torch.float64)
    error = torch.where(torch.linalg.det(rotations) > 0, gram.abs().amax(dim=(1, 2)), torch.inf)
    suspect = ~((error <= _RIGID_TOLERANCE) & (matrices[:, :3, 3].abs().amax(dim=1) <= MAX_POSITION))
    for index in suspect.nonzero()[:1, 0].tolist():
        rigid_matrix(matrices[index].tolist(), f"{path}, line {lines[index]}")
    inexact = error > _EXACT
    matrices[inexact] = _nearest_rigid(matrices[inexact])
    return matrices


def _number_rows(path: Path) -> list[tuple[int, list[float]]]:
    """Line number (from 1) and numbers of each line that is neither empty nor a comment."""
    rows = []
    try:
        lines = read_file(path, "a readable text file", limit=_MAX_TEXT_BYTES).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: needed a readable text file, got '{error}'; check it.") from error
    for number, line in enumerate(lines, start=1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            rows.append((number, [float(word) for word in words]))
        except ValueError as error:
            raise InputError(
                f"{path}, line {number}: needed numbers, got {line[:60]!r}; correct or remove it."
            ) from error
    return rows


def _kitti_matrices(numbers: Float[Tensor, "n 12"]) -> Float[Tensor, "n 4 4"]:
    """Matrices of rows of 3x4 numbers."""
    matrices = torch.eye(4, dtype=torch.float64).repeat(len(numbers), 1, 1)
    matrices[:, :3] = numbers.reshape(-1, 3, 4)
    return matrices


def _tum_matrices(numbers: Float[Tensor, "n 8"], lines: list[int], path: Path) -> Float[Tensor, "n 4 4"]:
    """Matrices of rows of a timestamp, tx ty tz, and qx qy qz qw."""
    norm = torch.linalg.vector_norm(numbers[:, 4:], dim=1)
    for index in (~((norm - 1).abs() < _RIGID_TOLERANCE)).nonzero()[:1, 0].tolist():
        raise InputError(
            f"{path}, line {lines[index]}: needed a unit quaternion qx qy qz qw as the last four numbers, got length "
            f"{float(norm[index]):.4g}; check the order of the columns."
        )
    matrices = torch.eye(4, dtype=torch.float64).repeat(len(numbers), 1, 1)
    matrices[:, :3, :3] = rotations_from_quats(numbers[:, [7, 4, 5, 6]])
    matrices[:, :3, 3] = numbers[:, 1:4]
    return matrices
