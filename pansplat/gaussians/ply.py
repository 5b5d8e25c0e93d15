"""Scenes as .ply files that any 3D Gaussian splatting tool opens, written at once or part by part.

The vertices have the binary layout of 3DGS: position, unused normals, `f_dc`, `f_rest` (channel by channel), logit
opacity, log scales, rotation to world axes (wxyz). Input cameras, the depth range, and the level and view of each
Gaussian are not part of that layout. One header comment holds them, `comment pansplat {json}`, which other tools skip.

The header holds the number of vertices. A file that is written part by part reserves space for its header and fills
it at the end.

Source: 3D Gaussian Splatting, the file that its training code writes.
"""

from __future__ import annotations

import json
import os
import shutil
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pansplat.atomic import replacing
from pansplat.errors import InputError, InputWarning
from pansplat.files import require_file
from pansplat.gaussians.harmonics import SH_0
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.geometry.world import MAX_POSITION, require_depth_range
from pansplat.strict_json import list_field, number_field, parse_json, require_object, text_field

OPACITY_EPSILON = 1e-6  # opacities are clamped to this distance from 0 and 1, where the logit is infinite
SCALE_EPSILON = 1e-12  # metres; smaller scales are clamped, so that the logarithm is finite

_COMMENT_PREFIX = "pansplat "
_MAX_RUNS = 4096  # the Gaussians are sorted if the header would list more runs, which take megabytes
_MAX_HEADER = 1 << 24
_RUNS_SPACE = 4096  # bytes for about 300 runs; some browser viewers need the header within 10,000 bytes
_READ_VERTICES = 1 << 17  # vertices that are read at a time
_DEFAULT_NEAR, _DEFAULT_FAR = 0.1, 100.0  # depth range, metres, for a file without one
_DEFAULT_HEIGHT = 512  # pixels, of the panoramas
_MAX_HEIGHT, _MAX_CAMERAS, _MAX_LEVEL = 1 << 16, 1 << 12, 255  # of the pansplat comment
_MAX_GAIN = 1e3
_MAX_PROPERTIES = 1 << 10  # of an element
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip


def save_ply(scene: Scene, path: str | Path) -> None:
    """Write a scene as a 3DGS .ply file, atomically, in float32.

    Gaussians with a non-finite value are left out with a warning. The order is kept, unless levels and views alternate
    more than a few thousand times: then the Gaussians are sorted by level and view.

    Raises:
        InputError: when the folder does not exist or cannot be written.
    """
    path = Path(path)
    gaussians = _sort_by_label(_select_finite(scene.gaussians, path))
    with replacing(path) as partial, open(partial, "wb") as file:
        file.write(_format_header(scene, _find_label_runs(gaussians), gaussians.harmonics.shape[1]))
        _build_vertex_table(gaussians).tofile(file)


def save_ply_parts(scene: Scene, parts: Iterable[Gaussians], path: str | Path) -> int:
    """Write parts one after another, atomically, with one part in memory at a time.

    Gaussians with a non-finite value are left out with a warning.

    Args:
        scene: cameras and names for the header; its own Gaussians are not written.
        parts: all of one degree.

    Returns:
        Number of Gaussians in the file.

    Raises:
        InputError: when the folder does not exist or cannot be written.
        ValueError: a part has another degree than the first.
    """
    path = Path(path)
    with replacing(path) as partial:
        rest = iter(parts)
        first = [next(rest, scene.gaussians.select(scene.gaussians.levels < 0))]
        coefficients = first[0].harmonics.shape[1]
        size = len(_format_header(scene, [], coefficients)) + _RUNS_SPACE
        with open(partial, "wb") as file:
            file.write(b" " * size)
            runs, dropped = _write_parts(_chain(first, rest), file, coefficients)
        _fill_header(partial, _format_header(scene, runs, coefficients, size=size), size)
    count = sum(run[2] for run in runs)
    if dropped:
        warnings.warn(
            f"{path}: left out {dropped} of {count + dropped} Gaussians that are not finite",
            InputWarning,
            stacklevel=2,
        )
    return count


def _chain(first: list[Gaussians], rest: Iterator[Gaussians]) -> Iterator[Gaussians]:
    """The first part and the rest; keeps no reference to a consumed part."""
    yield first.pop()
    yield from rest


def _write_parts(parts: Iterable[Gaussians], file: BinaryIO, coefficients: int) -> tuple[list[list[int]], int]:
    """Write the vertices; return the runs of labels and the number of non-finite Gaussians."""
    runs: list[list[int]] = []
    dropped = 0
    for part in parts:
        if part.harmonics.shape[1] != coefficients:
            raise ValueError(f"`parts` must have {coefficients} harmonics each, got {part.harmonics.shape[1]}")
        finite = _finite_mask(part)
        kept = part if bool(finite.all()) else part.select(finite)
        dropped += len(part) - len(kept)
        for level, view, count in _find_label_runs(kept):
            if runs and runs[-1][:2] == [level, view]:
                runs[-1][2] += count
            else:
                runs.append([level, view, count])
        _build_vertex_table(kept).tofile(file)
        del part, kept
    return runs, dropped


def _fill_header(path: Path, content: bytes, size: int) -> None:
    """Write the header into the reserved `size` bytes; a longer header moves the vertices, in pieces."""
    if len(content) == size:
        with open(path, "r+b") as file:
            file.write(content)
        return
    with replacing(path) as longer, open(path, "rb") as vertices, open(longer, "wb") as file:
        file.write(content)
        vertices.seek(size)
        shutil.copyfileobj(vertices, file, 1 << 24)


def _format_header(scene: Scene, runs: list[list[int]], coefficients: int, *, size: int = 0) -> bytes:
    """All bytes before the first vertex; the Gaussians of `scene` are not used.

    Args:
        runs: see `_find_label_runs`.
        coefficients: number of harmonics coefficients, 1 to 25.
        size: minimum number of bytes; spaces after the comment fill the difference.
    """
    extras = {
        "version": 1,
        "model": scene.model,
        "height": scene.height,
        "near": scene.near,
        "far": scene.far,
        "names": [name.encode(errors="backslashreplace").decode() for name in scene.names],
        "cam2world": scene.cam2world.double().cpu().tolist(),
        **({"gains": scene.gains} if scene.gains else {}),
        "runs": runs,
    }
    comment = _COMMENT_PREFIX + json.dumps(extras, separators=(",", ":"))
    begin = f"ply\nformat binary_little_endian 1.0\ncomment {comment}"
    lines = [f"element vertex {sum(count for _, _, count in runs)}"]
    lines += [*(f"property float {name}" for name in _list_properties(coefficients)), "end_header\n"]
    end = "\n" + "\n".join(lines)
    return (begin + " " * (size - len(begin) - len(end)) + end).encode("ascii")


def save_points(gaussians: Gaussians, path: str | Path) -> None:
    """Write the means as a .ply point cloud, atomically: float32 positions in metres, 8-bit sRGB without direction."""
    path = Path(path)
    kept = _select_finite(gaussians, path).to(device="cpu")
    fields = [(name, "<f4") for name in ("x", "y", "z")] + [(name, "u1") for name in ("red", "green", "blue")]
    table = np.empty(len(kept), fields)
    colors = (kept.harmonics[:, 0] * SH_0 + 0.5).clamp(0, 1).mul(255).round().byte()
    for column, (name, _) in zip((*kept.means.unbind(1), *colors.unbind(1)), fields, strict=True):
        table[name] = column.numpy()
    kinds = {"<f4": "float", "u1": "uchar"}
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(kept)}"]
    lines += [*(f"property {kinds[kind]} {name}" for name, kind in fields), "end_header\n"]
    with replacing(path) as partial, open(partial, "wb") as file:
        file.write("\n".join(lines).encode())
        table.tofile(file)


def load_ply(path: str | Path) -> Scene:
    """Read a 3DGS .ply file of either byte order; unknown properties are skipped.

    A file of another tool gives a scene without cameras, with all Gaussians at level 0 of view 0. Gaussians with a
    non-finite value are left out with a warning.

    Raises:
        InputError: the file is missing, not a binary .ply of Gaussians, truncated, or has no finite Gaussian.
    """
    path = Path(path)
    require_file(path, "a .ply scene")
    try:
        with open(path, "rb") as file:
            header = _read_header(file, path)
            _seek_vertices(file, header, path)
            gaussians = _read_gaussians(file, header, path)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    extras = _parse_extras(header.comments, path)
    levels, views = _read_labels(extras, header.count, path)
    gaussians = _select_finite(replace(gaussians, levels=levels, views=views), path)
    if header.count and not len(gaussians):
        raise InputError(f"{path}: none of its {header.count} Gaussians is finite; write the file again")
    return Scene(
        gaussians,
        extras.cam2world,
        near=extras.near,
        far=extras.far,
        names=extras.names,
        model=extras.model,
        height=extras.height,
        gains=extras.gains,
    )


def _select_finite(gaussians: Gaussians, path: Path) -> Gaussians:
    finite = _finite_mask(gaussians)
    dropped = len(gaussians) - int(finite.sum())
    if not dropped:
        return gaussians
    warnings.warn(
        f"{path}: left out {dropped} of {len(gaussians)} Gaussians that are not finite",
        InputWarning,
        stacklevel=3,
    )
    return gaussians.select(finite)


def _finite_mask(gaussians: Gaussians) -> Bool[Tensor, "n"]:
    """Mask of the Gaussians without NaN and infinite values."""
    finite = torch.isfinite(gaussians.opacities)
    for field in (gaussians.means, gaussians.scales, gaussians.quats, gaussians.harmonics.flatten(1)):
        # A finite sum has finite terms. Rows with a non-finite sum, which may be an overflow, are checked by term.
        suspect = ~torch.isfinite(field.sum(dim=1))
        finite[suspect] &= torch.isfinite(field[suspect]).all(dim=1)
    return finite


def _sort_by_label(gaussians: Gaussians) -> Gaussians:
    if len(_find_label_runs(gaussians)) <= _MAX_RUNS:
        return gaussians
    key = gaussians.levels.long() * (int(gaussians.views.max()) + 1) + gaussians.views.long()
    return gaussians.select(torch.sort(key, stable=True).indices)


def _find_label_runs(gaussians: Gaussians) -> list[list[int]]:
    """Runs of equal level and view as [level, view, count], in file order."""
    levels, views = gaussians.levels.long().cpu(), gaussians.views.long().cpu()
    if not len(gaussians):
        return []
    changes = ((levels[1:] != levels[:-1]) | (views[1:] != views[:-1])).nonzero()[:, 0] + 1
    starts = torch.cat((changes.new_zeros(1), changes))
    counts = torch.diff(starts, append=starts.new_tensor([len(gaussians)]))
    return torch.stack((levels[starts], views[starts], counts), dim=1).tolist()


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
    skipped_bytes: int  # of the elements before the vertices
    count: int
    dtype: np.dtype
    comments: list[str]


def _read_header(file: BinaryIO, path: Path) -> _Header:
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
                kind = None if words[1] == "list" else _TYPES[words[1]]
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


def _seek_vertices(file: BinaryIO, header: _Header, path: Path) -> None:
    start = file.tell() + header.skipped_bytes
    needed = header.count * header.dtype.itemsize
    available = file.seek(0, os.SEEK_END) - start
    if available < needed:
        raise InputError(
            f"{path} is truncated: {header.count} vertices need {needed} bytes, it holds {max(available, 0)}; "
            "copy or download it again"
        )
    file.seek(start)


def _read_gaussians(file: BinaryIO, header: _Header, path: Path) -> Gaussians:
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
        vertices = np.fromfile(file, header.dtype, rows.stop - start)
        if len(vertices) < rows.stop - start:
            raise InputError(f"{path} was truncated while it was read; read it again when it is complete")
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


@dataclass(frozen=True)
class _Extras:
    """Content of the pansplat comment; the defaults are those of a file of another tool."""

    cam2world: Float[Tensor, "view 4 4"]
    near: float = _DEFAULT_NEAR
    far: float = _DEFAULT_FAR
    names: tuple[str, ...] = ()
    model: str = ""
    height: int = _DEFAULT_HEIGHT
    gains: tuple[tuple[float, ...], ...] = ()
    runs: list[Any] | None = None


def _parse_extras(comments: list[str], path: Path) -> _Extras:
    """Content of the pansplat comment; the defaults without one, and with a warning when it is damaged."""
    for comment in comments:
        if comment.startswith(_COMMENT_PREFIX):
            try:
                return _read_extras(parse_json(comment.removeprefix(_COMMENT_PREFIX), "comment"))
            except InputError as error:
                warnings.warn(
                    f"{path}: its pansplat comment is damaged ({error}); cameras, levels and views are ignored",
                    InputWarning,
                    stacklevel=3,
                )
    return _Extras(torch.zeros(0, 4, 4, dtype=torch.float64))


def _read_extras(content: Any) -> _Extras:
    """The fields of a pansplat comment.

    Raises:
        InputError: a field has another type, or is out of range.
    """
    content = require_object(content, "comment")
    near = number_field(content, "near", "comment")
    far = number_field(content, "far", "comment")
    near, far = _DEFAULT_NEAR if near is None else near, _DEFAULT_FAR if far is None else far
    require_depth_range(near, far, "comment")
    height = number_field(content, "height", "comment", low=1, high=_MAX_HEIGHT, whole=True)
    names = list_field(content, "names", "comment")
    poses = list_field(content, "cam2world", "comment")
    if len(poses) > _MAX_CAMERAS or len(names) > _MAX_CAMERAS:
        raise InputError(f"comment: needed at most {_MAX_CAMERAS} cameras, got {max(len(poses), len(names))}")
    return _Extras(
        torch.from_numpy(np.array([_read_pose(pose) for pose in poses], np.float64).reshape(-1, 4, 4)),
        near,
        far,
        tuple(str(name) for name in names),
        text_field(content, "model", "comment") or "",
        _DEFAULT_HEIGHT if height is None else int(height),
        _read_gains(list_field(content, "gains", "comment"), len(poses)),
        list_field(content, "runs", "comment"),
    )


def _read_gains(rows: list[Any], cameras: int) -> tuple[tuple[float, ...], ...]:
    """Three factors for each camera, or nothing."""
    numbers = [value for row in rows for value in (row if isinstance(row, list) else [None])]
    are_factors = all(type(value) in (int, float) and 0 < value < _MAX_GAIN for value in numbers)
    if rows and not (are_factors and len(rows) == cameras and all(len(row) == 3 for row in rows)):
        raise InputError(
            f"comment: needed three numbers above 0 and below {_MAX_GAIN:g} for each of the {cameras} cameras in "
            f"gains, got {rows!r:.60}"
        )
    return tuple(tuple(map(float, row)) for row in rows)


def _read_pose(rows: Any) -> np.ndarray:
    """A pose (4, 4) of the comment; the reader of JSON has refused numbers that are not finite."""
    try:
        pose = np.array(rows, np.float64)
    except (TypeError, ValueError):
        pose = np.zeros(0)
    if pose.shape != (4, 4) or np.abs(pose).max() > MAX_POSITION:
        raise InputError(f"comment: needed 4x4 numbers up to {MAX_POSITION:g} in cam2world, got {rows!r:.60}")
    return pose


def _read_labels(extras: _Extras, count: int, path: Path) -> tuple[Tensor, Tensor]:
    """Level and view of each vertex; zeros without labels, or with a warning when they do not fit `count`."""
    zeros = torch.zeros(count, dtype=torch.int64), torch.zeros(count, dtype=torch.int64)
    if extras.runs is None:
        return zeros
    if not _are_runs(extras.runs, count, max(len(extras.cam2world), 1)):
        warnings.warn(
            f"{path}: its levels and views do not fit its {count} Gaussians (edited by another tool?) and are ignored",
            InputWarning,
            stacklevel=3,
        )
        return zeros
    runs = torch.tensor(extras.runs, dtype=torch.int64).reshape(-1, 3)
    return torch.repeat_interleave(runs[:, 0], runs[:, 2]), torch.repeat_interleave(runs[:, 1], runs[:, 2])


def _are_runs(runs: list[Any], count: int, views: int) -> bool:
    """Whether the runs are [level, view, length] whose lengths sum to `count`, in Python's integers of any size."""
    for run in runs:
        if not isinstance(run, list) or len(run) != 3 or any(type(number) is not int or number < 0 for number in run):
            return False
        if run[0] > _MAX_LEVEL or run[1] >= views or run[2] > count:
            return False
    return sum(run[2] for run in runs) == count
