"""Reading poses in a named convention, and converting them to cam2world with OpenCV axes (docs/conventions.md).

There are four conventions: the matrix maps camera points to the world (`cam2world`) or world points to the camera
(`world2cam`); the camera axes are those of OpenCV (x right, y down, z forward) or OpenGL (x right, y up, z backward;
also Habitat, Blender and NeRF data). The world axes are not changed.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.errors import InputError
from pansplat.geometry.pose import invert_pose, orthonormal_error
from pansplat.geometry.world import MAX_POSITION
from pansplat.system.files import read_file

CONVENTIONS = ("cam2world opencv", "cam2world opengl", "world2cam opencv", "world2cam opengl")

_DIRECTIONS = {
    "cam2world": r"cam(era)?[ _-]?(2|to)[ _-]?world|\bc2w\b",
    "world2cam": r"world[ _-]?(2|to)[ _-]?cam(era)?|\bw2c\b",
}
_AXES = {"opencv": r"opencv|colmap", "opengl": r"opengl|habitat|blender|nerf"}
_MAX_NUMBER_BYTES = 1 << 16  # bytes of a text file that should hold one number
_ROUNDING_ERROR = 1e-9  # a rotation with a larger error is replaced by the nearest exact one
_RIGID_TOLERANCE = 1e-2  # for files with 4 to 6 decimals; errors of wrong matrices are far larger
_OPENGL_TO_OPENCV = torch.diag(torch.tensor((1.0, -1.0, -1.0, 1.0), dtype=torch.float64))


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
    return _nearest_rigid(matrix) if error > _ROUNDING_ERROR else matrix


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


def _nearest_rigid(matrix: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
    """The matrix with its 3x3 part replaced by the nearest rotation; removes the rounding errors of files."""
    u, _, vt = torch.linalg.svd(matrix[:3, :3])
    rigid = matrix.clone()
    rigid[:3, :3] = u @ vt
    rigid[3] = torch.tensor((0.0, 0.0, 0.0, 1.0), dtype=torch.float64)
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
    text = read_file(path, limit=_MAX_NUMBER_BYTES).decode(errors="replace").strip()
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
