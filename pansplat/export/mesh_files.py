"""Textured triangles, and their files: binary glTF (.glb), with y up.

Triangles are seen from the side of the camera that showed them: a program that
culls back faces, as glTF specifies for these materials, shows rooms from outside without the ceiling or wall in front.

Source: the glTF 2.0 specification, sections 3.7 (geometry), 3.8 (textures), 3.9 (materials), and its extension
KHR_materials_unlit, because the light is in the photographs.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from PIL import Image

from pansplat.errors import InputError
from pansplat.gaussians.gltf import write_glb
from pansplat.gaussians.scene_files import Y_UP
from pansplat.geometry.world import USER_FRAME, WorldFrame
from pansplat.system.files import SOFTWARE, is_written

_QUALITY = 92  # of textures
_HEAD = 1 << 16  # bytes in which a further file states the first one
_UNLIT = "KHR_materials_unlit"
_ARRAY_BUFFER, _ELEMENT_BUFFER = 34962, 34963
_FLOAT, _UINT = 5126, 5125
_LINEAR, _MIPMAPS, _REPEAT, _CLAMP = 9729, 9987, 10497, 33071


@dataclass(frozen=True, eq=False)
class MeshPart:
    """Triangles that one panorama shows.

    Attributes:
        name: of the panorama.
        positions: world, y down, metres.
        uv: places in the texture, u to the right and v down; u may exceed 1 by a part of a pixel, where it repeats.
        triangles: vertices; the normals (b - a) x (c - a) point to the camera.
        texture: makes the equirectangular picture, sRGB; one is in memory at a time.
    """

    name: str
    positions: Float[np.ndarray, "vertex 3"]
    uv: Float[np.ndarray, "vertex 2"]
    triangles: Int[np.ndarray, "triangle 3"]
    texture: Callable[[], UInt8[np.ndarray, "height width 3"]]


@dataclass(frozen=True, eq=False)
class Mesh:
    """A surface of textured parts.

    Attributes:
        parts: one of each panorama.
        frame: where their world is in the user's world, that of files.
        part_of: name of the file of which this is a further one; empty if it is the first.
    """

    parts: tuple[MeshPart, ...]
    frame: WorldFrame = USER_FRAME
    part_of: str = ""

    @property
    def num_triangles(self) -> int:
        """The number of triangles of all parts."""
        return sum(len(part.triangles) for part in self.parts)


def save_mesh(mesh: Mesh, path: Path) -> None:
    """Write a mesh atomically. Textures show only what triangles need of them: the rest has the colours around it."""
    if path.suffix.lower() != ".glb":
        raise InputError(f"cannot write {path}: a mesh must end in .glb; rename it")
    if not mesh.num_triangles:
        raise InputError(f"cannot write {path}: needed one or more triangles, got none; give a scene with surfaces")
    _save_glb(mesh, path)


def remove_old_meshes(path: Path, kept: Collection[Path]) -> None:
    """Remove the further files of an earlier mesh of this name, which state that name, other than those kept."""
    name = re.compile(rf"{re.escape(path.stem)}_\d+{re.escape(path.suffix)}")
    for file in path.parent.iterdir():
        if name.fullmatch(file.name) and file not in kept and is_written(file):
            with open(file, "rb") as stream:
                is_part = _state_part(path.name).encode() in stream.read(_HEAD)
            if is_part:
                with suppress(OSError):
                    file.unlink()


def _state_part(name: str) -> str:
    """What a further file states about the first one, in JSON."""
    return json.dumps({"part_of": name}, separators=(",", ":"))[1:-1]


def _encode_texture(part: MeshPart) -> bytes:
    """A JPEG without metadata of the photograph."""
    texture, stream = part.texture(), io.BytesIO()
    shown = _fill_unused(texture, _find_used_texels(part, *texture.shape[:2]))
    Image.fromarray(shown).save(stream, "JPEG", quality=_QUALITY, comment=SOFTWARE)
    return stream.getvalue()


def _find_used_texels(part: MeshPart, height: int, width: int) -> Bool[np.ndarray, "height width"]:
    """The texels that triangles cover, and the next ones, which bilinear filtering reads."""
    corners = part.uv[part.triangles] * (width, height) - 0.5
    beyond = max(int(np.ceil(corners[..., 0].max())) + 2 - width, 0)
    covered = np.zeros((height, width + beyond), np.uint8)
    cv2.fillPoly(covered, list(np.rint(16 * corners).astype(np.int32)), 1, shift=4)
    covered[:, :beyond] |= covered[:, width:]
    around = np.pad(covered[:, :width], ((0, 0), (1, 1)), "wrap")
    return cv2.dilate(around, np.ones((3, 3), np.uint8))[:, 1:-1] > 0


def _fill_unused(
    texture: UInt8[np.ndarray, "height width 3"], used: Bool[np.ndarray, "height width"]
) -> UInt8[np.ndarray, "height width 3"]:
    """The texture with the mean colour of used texels around in place of the others.

    Black would show at the edges of triangles: programs draw distant triangles with smaller sizes of the texture.
    """
    levels = [(texture * used[..., None].astype(np.float32), used.astype(np.float32))]
    while levels[-1][1].size > 1:
        height, width = levels[-1][1].shape
        size = (max(width // 2, 1), max(height // 2, 1))
        levels.append(tuple(cv2.resize(values, size, interpolation=cv2.INTER_AREA) for values in levels[-1]))
    filled = np.zeros((1, 1, 3), np.float32)
    for color, weight in reversed(levels):
        filled = cv2.resize(filled, weight.shape[::-1], interpolation=cv2.INTER_LINEAR)
        np.divide(color.reshape(filled.shape), weight[..., None], out=filled, where=weight[..., None] > 0)
    return np.where(used[..., None], texture, np.rint(filled).astype(np.uint8))


def _save_glb(mesh: Mesh, path: Path) -> None:
    blocks: list[bytes] = []
    # float32 does not hold large positions: they are relative to the origin.
    stated = {"origin": mesh.frame.origin} if any(mesh.frame.origin) else {}
    stated |= {"part_of": mesh.part_of} if mesh.part_of else {}
    extras = {"extras": {"pansplat": stated}} if stated else {}
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "pansplat", **extras},
        "extensionsUsed": [_UNLIT],
        "scene": 0,
        "scenes": [{"nodes": [*range(len(mesh.parts))]}],
        "samplers": [{"magFilter": _LINEAR, "minFilter": _MIPMAPS, "wrapS": _REPEAT, "wrapT": _CLAMP}],
    }
    lists: dict[str, list[dict[str, Any]]] = {
        key: [] for key in ("nodes", "meshes", "materials", "textures", "images", "accessors", "bufferViews")
    }

    def add_block(content: bytes, **more: Any) -> int:
        start = sum(map(len, blocks))
        lists["bufferViews"].append({"buffer": 0, "byteOffset": start, "byteLength": len(content), **more})
        blocks.append(content + bytes(-len(content) % 4))
        return len(lists["bufferViews"]) - 1

    def add_accessor(values: np.ndarray, kind: str, component: int, target: int, **more: Any) -> int:
        view = add_block(values.tobytes(), target=target)
        accessor = {"bufferView": view, "componentType": component, "count": len(values), "type": kind}
        lists["accessors"].append(accessor | more)
        return len(lists["accessors"]) - 1

    for number, part in enumerate(mesh.parts):
        positions = (mesh.frame.unit * part.positions @ Y_UP.numpy()).astype(np.float32)
        bounds = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
        primitive = {
            "attributes": {
                "POSITION": add_accessor(positions, "VEC3", _FLOAT, _ARRAY_BUFFER, **bounds),
                "TEXCOORD_0": add_accessor(part.uv.astype(np.float32), "VEC2", _FLOAT, _ARRAY_BUFFER),
            },
            "indices": add_accessor(part.triangles.astype(np.uint32).ravel(), "SCALAR", _UINT, _ELEMENT_BUFFER),
            "material": number,
        }
        surface = {"baseColorTexture": {"index": number}, "metallicFactor": 0.0, "roughnessFactor": 1.0}
        lists["nodes"].append({"mesh": number, "name": part.name})
        lists["meshes"].append({"primitives": [primitive]})
        lists["materials"].append({"pbrMetallicRoughness": surface, "extensions": {_UNLIT: {}}})
        lists["textures"].append({"sampler": 0, "source": number})
        lists["images"].append({"bufferView": add_block(_encode_texture(part)), "mimeType": "image/jpeg"})
    document |= lists | {"buffers": [{"byteLength": sum(map(len, blocks))}]}
    write_glb(document, blocks, path, f"{mesh.num_triangles:,} triangles", "reduce --triangles")
