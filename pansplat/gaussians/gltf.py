"""Scenes as binary glTF files (.glb) with the extension KHR_gaussian_splatting.

Scales and opacities are linear, rotations are xyzw, the harmonics have the order and signs of 3DGS, and y is up. The
pansplat entry is in `asset.extras`. Programs without the extension show the means as coloured points.

The container is a header, a JSON text and a block of numbers. It is read here and not by a library, because every
length and index of a foreign file must be checked.

Source: https://github.com/KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting, and the glTF 2.0
specification, sections 3.6 (buffers), 3.5 (nodes) and 4 (GLB).
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from msgspec import Meta

from pansplat.errors import InputError
from pansplat.gaussians.harmonics import SH_0
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.gaussians.scene_files import (
    Y_UP,
    find_label_runs,
    format_entry,
    limit_degree,
    restore_scene,
    select_finite,
    sort_by_label,
)
from pansplat.geometry.pose import rotations_from_quats
from pansplat.system.atomic import replacing
from pansplat.system.files import read_file
from pansplat.system.strict_json import convert, parse_json, read_field

_Object = dict[str, Any]
_Vector = tuple[float, float, float]
_EXTENSION = "KHR_gaussian_splatting"
_MAX_BYTES = (1 << 32) - 1  # bytes; a file states its lengths in 32 bits
_MAX_DEGREE = 3  # highest degree of the harmonics in KHR_gaussian_splatting
_MAX_JSON = 1 << 26  # bytes of the largest JSON part
_MAX_NODES = 1 << 14  # nodes of a scene, at most, so that a cycle of nodes ends
_MAGIC, _VERSION, _JSON, _BINARY = b"glTF", 2, 0x4E4F534A, 0x004E4942
_POINTS, _ARRAY_BUFFER = 0, 34962  # glTF's numbers of a primitive of points, and of a view of vertices
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}


def save_glb(scene: Scene, path: Path) -> None:
    """Write a scene as a .glb, atomically, in float32.

    Gaussians with a non-finite value and harmonics above degree 3 are left out with a warning.
    """
    gaussians = sort_by_label(limit_degree(select_finite(scene.gaussians, path), _MAX_DEGREE, path))
    if not len(gaussians):
        raise InputError(f"cannot write {path}: the format holds 1 or more Gaussians, got none; write a .ply")
    attributes = _list_attributes(gaussians)
    entry = format_entry(scene, find_label_runs(gaussians))
    text = json.dumps(_describe(attributes, entry), separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    size = sum(values.nbytes for values in attributes.values())
    total = 12 + 8 + len(text) + 8 + size
    if total > _MAX_BYTES:
        raise InputError(
            f"cannot write {path}: the format holds {_MAX_BYTES:,} bytes, {len(gaussians):,} Gaussians of degree "
            f"{gaussians.degree} need {total:,}; write a .ply, or reduce --degree"
        )
    with replacing(path) as partial, open(partial, "wb") as file:
        file.write(struct.pack("<4sIIII", _MAGIC, _VERSION, total, len(text), _JSON) + text)
        file.write(struct.pack("<II", size, _BINARY))
        for values in attributes.values():
            file.write(values.data)


def _list_attributes(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Values by attribute, (n, components) float32 or uint8; each takes a multiple of 4 bytes."""
    g = gaussians.rotated(Y_UP).to(device="cpu", dtype=torch.float32)
    color = torch.cat((g.harmonics[:, 0] * SH_0 + 0.5, g.opacities[:, None]), dim=1)
    quats = torch.nn.functional.normalize(g.quats, dim=1)
    values = {
        "POSITION": g.means,
        "COLOR_0": (color.clamp(0, 1) * 255).round().byte(),
        f"{_EXTENSION}:ROTATION": quats[:, [1, 2, 3, 0]],
        f"{_EXTENSION}:SCALE": g.scales,
        f"{_EXTENSION}:OPACITY": g.opacities.clamp(0, 1)[:, None],
    }
    values |= {name: g.harmonics[:, k] for k, name in enumerate(_name_harmonics(g.degree))}
    return {name: np.ascontiguousarray(value.detach().numpy()) for name, value in values.items()}


def _name_harmonics(degree: int) -> list[str]:
    """Attributes of the harmonics up to a degree, in the order of 3DGS."""
    return [f"{_EXTENSION}:SH_DEGREE_{band}_COEF_{n}" for band in range(degree + 1) for n in range(2 * band + 1)]


def _describe(attributes: dict[str, np.ndarray], entry: str) -> dict[str, Any]:
    """The JSON document of a file with one primitive."""
    views, accessors, offset = [], [], 0
    for name, values in attributes.items():
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": values.nbytes, "target": _ARRAY_BUFFER})
        offset += values.nbytes
        accessor: dict[str, Any] = {
            "bufferView": len(accessors),
            "componentType": next(code for code, kind in _COMPONENTS.items() if np.dtype(kind) == values.dtype),
            "count": len(values),
            "type": _TYPES[values.shape[1]],
        }
        if values.dtype == np.uint8:
            accessor["normalized"] = True
        if name == "POSITION":
            accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        accessors.append(accessor)
    kernel = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    kernel |= {"projection": "perspective", "sortingMethod": "cameraDistance"}
    primitive = {
        "attributes": {name: index for index, name in enumerate(attributes)},
        "mode": _POINTS,
        "extensions": {_EXTENSION: kernel},
    }
    return {
        "asset": {"version": "2.0", "generator": "pansplat", "extras": {"pansplat": json.loads(entry)}},
        "extensionsUsed": [_EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": offset}],
        "bufferViews": views,
        "accessors": accessors,
    }


def load_glb(path: Path) -> Scene:
    """Read the Gaussians of a .glb where the nodes of its scene put them; an InputError if it is unusable."""
    content = read_file(path, "a .glb scene", limit=_MAX_BYTES)
    document, binary = _read_chunks(content, path)
    required = [name for name in read_field(document, "extensionsRequired", list[str], path, []) if name != _EXTENSION]
    if required:
        raise InputError(f"{path}: it requires the extension {required[0]!s:.60}, which is not read; export it without")
    parts = [
        _move(_read_primitive(document, primitive, binary, path), matrix, path)
        for primitive, matrix in _list_primitives(document, path)
    ]
    if not parts:
        raise InputError(f"{path}: its scene holds no Gaussians ({_EXTENSION}); give another file")
    if len({part.degree for part in parts}) > 1:
        raise InputError(f"{path}: needed Gaussians of one degree of harmonics, got several; export it again")
    extras = read_field(read_field(document, "asset", _Object, path, {}), "extras", _Object, path, {}).get("pansplat")
    entry = None if extras is None else json.dumps(extras)
    return restore_scene(Gaussians.cat(parts).rotated(Y_UP), entry, path)


def _read_chunks(content: bytes, path: Path) -> tuple[dict[str, Any], bytes]:
    """The JSON document and the first block of numbers."""
    if len(content) < 20 or content[:4] != _MAGIC:
        raise InputError(f"{path}: needed a binary glTF file, got one that starts with {content[:4]!r}; check it")
    _, version, total, length, kind = struct.unpack_from("<4sIIII", content)
    if version != _VERSION or kind != _JSON:
        raise InputError(f"{path}: needed glTF version 2, got version {version}; export it again")
    if total > len(content) or 20 + length > total or length > _MAX_JSON:
        raise InputError(f"{path} is truncated: its header says {total} bytes, it holds {len(content)}; copy it again")
    try:
        text = content[20 : 20 + length].decode()
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: needed JSON text in UTF-8, got another encoding; export it again") from error
    start = 20 + length
    binary = b""
    if start + 8 <= total:
        length, kind = struct.unpack_from("<II", content, start)
        if kind == _BINARY:
            binary = content[start + 8 : min(start + 8 + length, total)]
    return convert(parse_json(text, path), _Object, path), binary


def _list_primitives(document: dict[str, Any], path: Path) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    """All primitives with Gaussians of the default scene, and the matrix (4, 4) from each to the world."""
    root = _item(document, "scenes", document.get("scene", 0), path)
    pending = [(index, np.eye(4)) for index in read_field(root, "nodes", list, path, [])]
    visited = 0
    while pending:
        index, parent = pending.pop()
        visited += 1
        if visited > _MAX_NODES:
            raise InputError(f"{path}: needed at most {_MAX_NODES} nodes, got more, or a cycle; export it again")
        node = _item(document, "nodes", index, path)
        matrix = parent @ _read_transform(node, path)
        pending += [(child, matrix) for child in read_field(node, "children", list, path, [])]
        if "mesh" in node:
            for primitive in read_field(
                _item(document, "meshes", node["mesh"], path), "primitives", list[_Object], path, []
            ):
                if _EXTENSION in read_field(primitive, "extensions", _Object, path, {}):
                    yield primitive, matrix


def _read_transform(node: dict[str, Any], path: Path) -> np.ndarray:
    """The matrix (4, 4) of a node."""
    matrix = np.eye(4)
    if "matrix" in node:
        return np.array(read_field(node, "matrix", tuple[(float,) * 16], path)).reshape(4, 4).T
    x, y, z, w = read_field(node, "rotation", tuple[(float,) * 4], path, (0, 0, 0, 1))
    quat = torch.nn.functional.normalize(torch.tensor([w, x, y, z], dtype=torch.float64), dim=0)
    matrix[:3, :3] = rotations_from_quats(quat).numpy() * read_field(node, "scale", _Vector, path, (1, 1, 1))
    matrix[:3, 3] = read_field(node, "translation", _Vector, path, (0, 0, 0))
    return matrix


def _move(gaussians: Gaussians, matrix: np.ndarray, path: Path) -> Gaussians:
    """The Gaussians after a similarity transform."""
    if np.array_equal(matrix, np.eye(4)):
        return gaussians
    axes = matrix[:3, :3]
    with np.errstate(all="ignore"):
        factor = float(np.cbrt(np.linalg.det(axes)))
        error = np.abs(axes.T @ axes / factor**2 - np.eye(3)).max()
    if not factor > 0 or not error < 1e-3:
        raise InputError(f"{path}: needed nodes that rotate, move and scale all axes alike, got others; apply them")
    turned = gaussians.scaled(factor).rotated(torch.from_numpy(axes / factor))
    shift = torch.from_numpy(matrix[:3, 3]).to(turned.means)
    return replace(turned, means=turned.means + shift)


def _read_primitive(document: dict[str, Any], primitive: dict[str, Any], binary: bytes, path: Path) -> Gaussians:
    attributes = read_field(primitive, "attributes", _Object, path, {})
    if "extensions" in read_field(primitive["extensions"], _EXTENSION, _Object, path, {}):
        raise InputError(f"{path}: its Gaussians are compressed by an extension, which is not read; export it without")

    def read(name: str, components: int) -> torch.Tensor:
        if name not in attributes:
            raise InputError(f"{path}: needed the attribute {name} of the Gaussians, got none; export it again")
        return torch.from_numpy(_read_accessor(document, attributes[name], components, binary, path))

    means, quats = read("POSITION", 3), read(f"{_EXTENSION}:ROTATION", 4)
    scales, opacities = read(f"{_EXTENSION}:SCALE", 3), read(f"{_EXTENSION}:OPACITY", 1)
    degree = max(d for d in range(_MAX_DEGREE + 1) if d == 0 or f"{_EXTENSION}:SH_DEGREE_{d}_COEF_0" in attributes)
    harmonics = [read(name, 3) for name in _name_harmonics(degree)]
    counts = {len(values) for values in (means, quats, scales, opacities, *harmonics)}
    if len(counts) > 1:
        raise InputError(f"{path}: needed attributes of one length, got {sorted(counts)}; export it again")
    labels = torch.zeros(len(means), dtype=torch.int64)
    opacities = opacities[:, 0].clamp(0, 1)
    return Gaussians(
        means, scales.clamp_min(0), quats[:, [3, 0, 1, 2]], opacities, torch.stack(harmonics, dim=1), labels, labels
    )


def _read_accessor(document: dict[str, Any], index: Any, components: int, binary: bytes, path: Path) -> np.ndarray:
    """Values (count, components) of an accessor, float32."""
    accessor = _item(document, "accessors", index, path)
    code, kind = accessor.get("componentType"), accessor.get("type")
    if kind != _TYPES[components] or not isinstance(code, int) or code not in _COMPONENTS or "sparse" in accessor:
        raise InputError(
            f"{path}: needed plain {_TYPES[components]} numbers in accessor {index}, got type {kind!r:.20}, "
            f"component type {code!r:.20}; export it again"
        )
    dtype = np.dtype(_COMPONENTS[code])
    view = _item(document, "bufferViews", accessor.get("bufferView"), path)
    if view.get("buffer") != 0 or "uri" in _item(document, "buffers", 0, path):
        raise InputError(f"{path}: needed all numbers inside the .glb, got another file; export it as one .glb")

    def length(holder: dict[str, Any], key: str, default: int, low: int = 0) -> int:
        return read_field(holder, key, Annotated[int, Meta(ge=low, le=_MAX_BYTES)], path, default)

    item = components * dtype.itemsize
    count, stride = length(accessor, "count", 0, low=1), length(view, "byteStride", item, low=1)
    start = length(view, "byteOffset", 0) + length(accessor, "byteOffset", 0)
    end = length(view, "byteOffset", 0) + length(view, "byteLength", 0)
    if stride < item or not 0 < start + (count - 1) * stride + item <= min(end, len(binary)):
        raise InputError(
            f"{path} is truncated: accessor {index} needs {count} items of {item} bytes from {start}, the file holds "
            f"{min(end, len(binary))} bytes; copy or export it again"
        )
    values = np.ndarray((count, components), dtype, binary, start, (stride, dtype.itemsize)).astype(np.float32)
    if dtype.kind != "f" and accessor.get("normalized") is True:
        values = np.maximum(values / np.float32(np.iinfo(dtype).max), np.float32(-1))
    return values


def _item(document: dict[str, Any], key: str, index: Any, path: Path) -> dict[str, Any]:
    """An object of a list of the document."""
    items = read_field(document, key, list, path, [])
    if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(items):
        raise InputError(f"{path}: needed a number below {len(items)} of {key}, got {index!r:.20}; export it again")
    return convert(items[index], _Object, f"{path}, {key}[{index}]")
