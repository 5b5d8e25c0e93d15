"""Scenes as .ply files that any 3D Gaussian splatting tool opens, written at once or part by part.

The vertices have the binary layout of 3DGS: position, unused normals, `f_dc`, `f_rest` (channel by channel), logit
opacity, log scales, rotation to world axes (wxyz). Input cameras, the depth range, and the level and view of each
Gaussian are not part of that layout. One header comment holds them, `comment pansplat {json}`, which other tools skip.

The header holds the number of vertices. Of a file that is written part by part, the vertices are first in a temporary
file of the same folder.

Source: 3D Gaussian Splatting, the file that its training code writes.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from io import BufferedIOBase
from operator import methodcaller
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from pansplat.errors import InputError, InputWarning
from pansplat.gaussians.harmonics import SH_0
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.gaussians.scene_files import (
    find_label_runs,
    finite_mask,
    format_entry,
    restore_scene,
    select_finite,
    sort_by_label,
)
from pansplat.system.atomic import replacing
from pansplat.system.files import PLY_TYPES, SOFTWARE, require_file

OPACITY_EPSILON = 1e-6  # opacities are clamped to this distance from 0 and 1, where the logit is infinite
SCALE_EPSILON = 1e-12  # metres; smaller scales are clamped, so that the logarithm is finite

COMMENT_PREFIX = "pansplat "  # start of the header's comment that holds the pansplat entry
_MAX_HEADER = 1 << 24  # bytes of the longest header that is read
_READ_VERTICES = 1 << 17  # vertices that are read at a time
_MAX_PROPERTIES = 1 << 10  # properties that an element may have
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


def save_ply(scene: Scene, path: str | Path) -> None:
    """Write a scene as a 3DGS .ply file, atomically, in float32.

    Gaussians with a non-finite value are left out with a warning. The order is kept, unless levels and views alternate
    more than a few thousand times: then the Gaussians are sorted by level and view.
    """
    path = Path(path)
    gaussians = sort_by_label(select_finite(scene.gaussians, path))
    with replacing(path) as partial, open(partial, "wb") as file:
        file.write(_format_header(scene, find_label_runs(gaussians), gaussians.harmonics.shape[1]))
        file.write(_build_vertex_table(gaussians).data)


def format_plain_ply(gaussians: Gaussians) -> bytes:
    """A whole 3DGS .ply file in memory, without a pansplat comment."""
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(gaussians)}"]
    lines += _list_property_lines(gaussians.harmonics.shape[1])
    return "\n".join(lines).encode() + _build_vertex_table(gaussians).tobytes()


def save_ply_parts(scene: Scene, parts: Iterable[Gaussians], path: str | Path) -> int:
    """Write parts one after another, atomically, in the user's unit, with one part in memory at a time.

    Gaussians with a non-finite value are left out with a warning.

    Args:
        scene: cameras and names for the header; its own Gaussians are not written.
        parts: all of one degree.

    Returns:
        Number of Gaussians in the file.

    Raises:
        ValueError: a part has another degree than the first.
    """
    path, unit = Path(path), scene.frame.unit
    with replacing(path) as partial, tempfile.TemporaryFile(dir=partial.parent) as vertices:
        runs, dropped, coefficients = _write_parts(map(methodcaller("scaled", unit), parts), vertices)
        vertices.seek(0)
        with open(partial, "wb") as file:
            file.write(_format_header(scene.scaled(unit), runs, coefficients))
            shutil.copyfileobj(vertices, file, 1 << 24)
    count = sum(run[2] for run in runs)
    if dropped:
        warnings.warn(
            f"{path}: left out {dropped} of {count + dropped} Gaussians that are not finite", InputWarning, stacklevel=2
        )
    return count


def _write_parts(parts: Iterable[Gaussians], file: BinaryIO) -> tuple[list[list[int]], int, int]:
    """Write the vertices; return the runs of labels, and the numbers of non-finite Gaussians and of harmonics."""
    runs: list[list[int]] = []
    dropped = coefficients = 0
    for part in parts:
        coefficients = coefficients or part.harmonics.shape[1]
        if part.harmonics.shape[1] != coefficients:
            raise ValueError(f"`parts` must have {coefficients} harmonics each, got {part.harmonics.shape[1]}")
        finite = finite_mask(part)
        kept = part if bool(finite.all()) else part.select(finite)
        dropped += len(part) - len(kept)
        for level, view, count in find_label_runs(kept):
            if runs and runs[-1][:2] == [level, view]:
                runs[-1][2] += count
            else:
                runs.append([level, view, count])
        file.write(_build_vertex_table(kept).data)
        del part, kept
    return runs, dropped, coefficients or 1


def _format_header(scene: Scene, runs: list[list[int]], coefficients: int) -> bytes:
    """All bytes before the first vertex; the Gaussians of `scene` are not used.

    Args:
        runs: see `find_label_runs`.
        coefficients: number of harmonics coefficients, 1 to 25.
    """
    comment = COMMENT_PREFIX + format_entry(scene, runs)
    lines = ["ply", "format binary_little_endian 1.0", f"comment {comment}"]
    lines += [f"element vertex {sum(count for _, _, count in runs)}", *_list_property_lines(coefficients)]
    return "\n".join(lines).encode("ascii")


def save_points(scene: Scene, path: str | Path) -> None:
    """Write the means as a .ply point cloud, atomically: positions in the user's world, 8-bit sRGB without direction.

    Positions are float32, or float64 if the world is not around its origin.
    """
    path, frame = Path(path), scene.frame
    kept = select_finite(scene.gaussians, path).to(device="cpu")
    kind = "<f8" if any(frame.origin) else "<f4"
    fields = [(name, kind) for name in ("x", "y", "z")] + [(name, "u1") for name in ("red", "green", "blue")]
    table = np.empty(len(kept), fields)
    colors = make_colors(kept)
    places = frame.globalize_places(kept.means)
    for column, (name, _) in zip((*places.unbind(1), *colors.unbind(1)), fields, strict=True):
        table[name] = column.detach().numpy()
    kinds = {"<f4": "float", "<f8": "double", "u1": "uchar"}
    lines = ["ply", "format binary_little_endian 1.0", f"comment {SOFTWARE}", f"element vertex {len(kept)}"]
    lines += [*(f"property {kinds[kind]} {name}" for name, kind in fields), "end_header\n"]
    with replacing(path) as partial, open(partial, "wb") as file:
        file.write("\n".join(lines).encode())
        file.write(table.data)


def make_colors(gaussians: Gaussians) -> UInt8[Tensor, "n 3"]:
    """The colours of Gaussians without direction, 8-bit sRGB."""
    return (gaussians.harmonics[:, 0] * SH_0 + 0.5).clamp(0, 1).mul(255).round().byte()


def load_ply(path: str | Path) -> Scene:
    """Read a 3DGS .ply file of either byte order; unknown properties are skipped.

    A file of another tool gives a scene without cameras, with all Gaussians at level 0 of view 0. Gaussians with a
    non-finite value are left out with a warning.
    """
    path = Path(path)
    require_file(path, "a .ply scene")
    try:
        with open(path, "rb") as file:
            gaussians, comments = read_ply(file, path)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    return restore_scene(gaussians, find_entry(comments), path)


def read_ply(file: BufferedIOBase, path: Path) -> tuple[Gaussians, list[str]]:
    """The Gaussians of a binary 3DGS .ply, with all labels 0, and the comments of its header.

    Args:
        file: the data, at its begin.
        path: the file that messages name.
    """
    header = _read_header(file, path)
    _seek_vertices(file, header, path)
    return _read_gaussians(file, header, path), header.comments


def find_entry(comments: list[str]) -> str | None:
    """The pansplat entry among the comments of a header."""
    found = (comment for comment in comments if comment.startswith(COMMENT_PREFIX))
    return next(found, "").removeprefix(COMMENT_PREFIX) or None


def _list_property_lines(coefficients: int) -> list[str]:
    """The lines of the header after the number of vertices."""
    return [*(f"property float {name}" for name in _list_properties(coefficients)), "end_header\n"]


def _list_properties(coefficients: int) -> list[str]:
    rest = [f"f_rest_{i}" for i in range(3 * (coefficients - 1))]
    scales, rotation = [f"scale_{i}" for i in range(3)], [f"rot_{i}" for i in range(4)]
    return [*("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"), *rest, "opacity", *scales, *rotation]


def _build_vertex_table(gaussians: Gaussians) -> np.ndarray:
    """All vertices with the properties in file order, little-endian float32."""
    g = gaussians.to(device="cpu")
    rest = g.harmonics[:, 1:].transpose(1, 2).flatten(1)
    # In float64: near 1 the logit is not accurate in float32.
    logits = torch.logit(g.opacities.double(), eps=OPACITY_EPSILON)[:, None]
    log_scales = g.scales.clamp_min(SCALE_EPSILON).log()
    parts = (g.means, torch.zeros(len(g), 3), g.harmonics[:, 0], rest, logits, log_scales, g.quats)
    columns = np.empty((len(g), sum(part.shape[1] for part in parts)), "<f4")
    start = 0
    for part in parts:
        columns[:, start : start + part.shape[1]] = part.detach().numpy()
        start += part.shape[1]
    return columns


@dataclass(frozen=True)
class _Header:
    order: str
    skipped_bytes: int  # bytes of the elements before the vertices
    count: int
    dtype: np.dtype
    comments: list[str]


def _read_header(file: BufferedIOBase, path: Path) -> _Header:
    if file.readline(16).strip() != b"ply":
        raise InputError(f"{path} is not a .ply file (it does not begin with `ply`); give a 3DGS .ply")
    order, comments, elements = "", [], []  # elements: [name, count, fields]
    left = _MAX_HEADER
    while True:
        line = file.readline(left)
        left -= len(line)
        words = line.decode("ascii", errors="replace").split()
        if not line.endswith(b"\n"):
            raise InputError(f"{path}: its header does not end; the file is truncated or not a .ply")
        if words == ["end_header"]:
            break
        try:
            if words[:1] == ["format"]:
                order = words[1]
            elif words[:1] == ["comment"]:
                comments.append(line.decode("utf-8", errors="replace").strip().removeprefix("comment").lstrip())
            elif words[:1] == ["element"]:
                elements.append((words[1], int(words[2]), []))
            elif words[:1] == ["property"]:
                kind = None if words[1] == "list" else PLY_TYPES[words[1]]
                elements[-1][2].append((words[-1], kind))
                if len(elements[-1][2]) > _MAX_PROPERTIES:
                    raise ValueError("too many properties")
        except (IndexError, KeyError, ValueError):
            raise InputError(f"{path}: cannot understand the header line {line[:80]!r}") from None
    if order not in _ORDERS:
        raise InputError(f"{path}: format {order or 'unknown'!r} is not read; save it as binary_little_endian")
    return _select_vertex_element(_ORDERS[order], elements, comments, path)


def _select_vertex_element(order: str, elements: list, comments: list[str], path: Path) -> _Header:
    skipped_bytes = 0
    for name, count, fields in elements:
        if count < 0:
            raise InputError(f"{path}: element `{name}` has a negative count {count}")
        names = [field for field, _ in fields]
        lists = [field for field, kind in fields if kind is None]
        if lists or len(set(names)) < len(names):
            problem = f"the list property `{lists[0]}`" if lists else "a property twice"
            raise InputError(f"{path}: element `{name}` has {problem}; save the file as a plain 3DGS .ply")
        dtype = np.dtype([(field, order + kind) for field, kind in fields])
        if name == "vertex":
            return _Header(order, skipped_bytes, count, dtype, comments)
        skipped_bytes += count * dtype.itemsize
    raise InputError(f"{path}: it has no `vertex` element; give a 3DGS .ply")


def _seek_vertices(file: BufferedIOBase, header: _Header, path: Path) -> None:
    start = file.tell() + header.skipped_bytes
    needed = header.count * header.dtype.itemsize
    available = file.seek(0, os.SEEK_END) - start
    if available < needed:
        raise InputError(
            f"{path} is truncated: {header.count} vertices need {needed} bytes, it holds {max(available, 0)}; "
            "copy or download it again"
        )
    file.seek(start)


def _read_gaussians(file: BufferedIOBase, header: _Header, path: Path) -> Gaussians:
    """The vertices at the file's position, with all labels 0; read in pieces to limit the memory."""
    coefficients = _count_coefficients(header.dtype.names or (), path)
    n, zeros = header.count, torch.zeros(header.count, dtype=torch.int64)
    gaussians = Gaussians(
        means=torch.empty(n, 3),
        scales=torch.empty(n, 3),
        quats=torch.empty(n, 4),
        opacities=torch.empty(n),
        harmonics=torch.empty(n, coefficients, 3),
        levels=zeros,
        views=zeros,
    )
    for start in range(0, n, _READ_VERTICES):
        rows = slice(start, min(start + _READ_VERTICES, n))
        data = file.read((rows.stop - start) * header.dtype.itemsize)
        if len(data) < (rows.stop - start) * header.dtype.itemsize:
            raise InputError(f"{path} was truncated while it was read; read it again when it is complete")
        vertices = np.frombuffer(data, header.dtype)
        gaussians.means[rows] = _stack_columns(vertices, "x", "y", "z")
        gaussians.scales[rows] = _stack_columns(vertices, "scale_0", "scale_1", "scale_2").exp()
        gaussians.quats[rows] = _stack_columns(vertices, "rot_0", "rot_1", "rot_2", "rot_3")
        gaussians.opacities[rows] = _stack_columns(vertices, "opacity").sigmoid()[:, 0]
        gaussians.harmonics[rows, 0] = _stack_columns(vertices, "f_dc_0", "f_dc_1", "f_dc_2")
        rest = _stack_columns(vertices, *(f"f_rest_{i}" for i in range(3 * (coefficients - 1))))
        gaussians.harmonics[rows, 1:] = rest.reshape(len(vertices), 3, coefficients - 1).transpose(1, 2)
    return gaussians


def _stack_columns(vertices: np.ndarray, *names: str) -> torch.Tensor:
    values = np.empty((len(vertices), len(names)), np.float32)
    for index, name in enumerate(names):
        values[:, index] = vertices[name]
    return torch.from_numpy(values)


def _count_coefficients(available: Sequence[str], path: Path) -> int:
    """Number of harmonics coefficients, 1 to 25, of vertices with these properties."""
    rest = sum(name.startswith("f_rest_") for name in available)
    if rest not in (0, 9, 24, 45, 72):
        raise InputError(f"{path}: {rest} f_rest properties fit no SH degree; 0, 9, 24, 45 or 72 are needed")
    needed = [name for name in _list_properties(rest // 3 + 1) if name not in ("nx", "ny", "nz")]
    missing = [name for name in needed if name not in available]
    if missing:
        hint = "a compressed .ply; uncompress it first" if "packed_position" in available else "not a 3DGS .ply"
        raise InputError(f"{path}: the vertices lack {', '.join(missing[:6])}: this is {hint}")
    return rest // 3 + 1
