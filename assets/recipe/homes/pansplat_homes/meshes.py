"""Triangle meshes of generated scenes, their image textures, a reader of Wavefront OBJ files, and simplification."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pansplat_homes.bvh import build_bvh
from pansplat_homes.textures import mip_levels

Floats = NDArray[np.float32]
_LEAF = 4  # triangles


@dataclass(frozen=True, eq=False)
class Texture:
    """An image (H W 4), sRGB with opacity."""

    pixels: NDArray[np.uint8]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.pixels.shape[1], self.pixels.shape[0]

    @cached_property
    def texels(self) -> NDArray[np.uint8]:
        """All levels of the image, see `textures.mip_levels`."""
        return mip_levels(self.pixels)

    @cached_property
    def has_holes(self) -> bool:
        """Whether parts of the image are transparent."""
        return bool((self.pixels[..., 3] < 128).mean() > 0.002)


@dataclass(frozen=True, eq=False)
class MeshMaterial:
    """A reflectance (red, green, blue) in linear light, or a texture that it multiplies."""

    color: tuple[float, float, float]
    texture: Texture | None = None
    gloss: float = 0.0


class MeshTree(NamedTuple):
    """Triangles of a mesh in the order of the leaves of its BVH, see `raytracer.Bodies`."""

    bounds: NDArray[np.float32]
    links: NDArray[np.int32]
    triangles: Floats
    normals: Floats
    texcoords: Floats
    material_ids: NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in the box [-1, 1]^3.

    Attributes:
        corners, normals: (n 3 3), the three corners of each triangle. Normals are those of the box's space.
        texcoords: (n 3 2), image coordinates; v points up.
        material_ids: (n), material of each triangle.
        materials: materials of the mesh.
    """

    corners: Floats
    normals: Floats
    texcoords: Floats
    material_ids: NDArray[np.int32]
    materials: tuple[MeshMaterial, ...]

    @cached_property
    def tree(self) -> MeshTree:
        """The mesh with a BVH, which is built at the first use."""
        corners = self.corners.astype(np.float64)
        bounds, links, order = build_bvh(corners.min(axis=1), corners.max(axis=1), _LEAF)
        bounds += np.repeat([-1e-6, 1e-6], 3)  # more than the rounding error
        first = self.corners[order, 0]
        edges = self.corners[order, 1:] - first[:, None]
        return MeshTree(
            bounds.astype(np.float32),
            links.astype(np.int32),
            np.concatenate((first, edges.reshape(-1, 6)), axis=1),
            self.normals[order].reshape(-1, 9),
            self.texcoords[order].reshape(-1, 6),
            self.material_ids[order],
        )


NO_TEXTURE = Texture(np.zeros((1, 1, 4), np.uint8))
NO_MESH = Mesh(
    np.full((1, 3, 3), 9, np.float32),
    np.ones((1, 3, 3), np.float32),
    np.zeros((1, 3, 2), np.float32),
    np.zeros(1, np.int32),
    (MeshMaterial((0, 0, 0)),),
)
"""The first texture and mesh of each scene, which no body shows. Arrays of a scene are therefore never empty."""


def pack_meshes(
    meshes: list[Mesh], texture_index: dict[Texture, int]
) -> tuple[MeshTree, NDArray[np.int32], NDArray[np.int64]]:
    """All meshes in one tree, the texture that cuts holes into each triangle or -1, and the root of each mesh."""
    roots, parts, cutouts = [], [], []
    nodes, triangles = 0, 0
    for mesh in meshes:
        tree = mesh.tree
        links = tree.links.copy()
        links[:, 0] += np.where(links[:, 1] == 0, nodes, triangles).astype(np.int32)
        parts.append(tree._replace(links=links))
        roots.append(nodes)
        holes = [texture_index[m.texture] if m.texture and m.texture.has_holes else -1 for m in mesh.materials]
        cutouts.append(np.array(holes, np.int32)[tree.material_ids])
        nodes, triangles = nodes + len(links), triangles + len(tree.material_ids)
    merged = MeshTree._make(np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return merged, np.concatenate(cutouts), np.array(roots)


class Triangles(NamedTuple):
    """Triangles as read from a file: corners (n 3 3), normals (n 3 3), image coordinates (n 3 2), material (n)."""

    corners: NDArray[np.float64]
    normals: NDArray[np.float64]
    texcoords: NDArray[np.float64]
    material_ids: NDArray[np.int64]

    def select(self, kept: NDArray) -> Triangles:
        """The triangles for which `kept` is true."""
        return Triangles._make(array[kept] for array in self)


def read_obj(text: str) -> tuple[Triangles, list[str]]:
    """Triangles of a Wavefront OBJ file and the names of their materials; polygons become fans of triangles.

    Missing normals are computed: edges of more than about 40 degrees are sharp.
    """
    vertices, texcoords, normals = [], [(0.0, 0.0)], [(0.0, 0.0, 0.0)]
    names: dict[str, int] = {}
    rows: list[tuple[int, ...]] = []
    material_id = names.setdefault("", 0)
    for line in text.splitlines():
        words = line.split()
        if not words:
            continue
        kind = words[0]
        if kind == "v":
            vertices.append((float(words[1]), float(words[2]), float(words[3])))
        elif kind == "vt":
            texcoords.append((float(words[1]), float(words[2]) if len(words) > 2 else 0.0))
        elif kind == "vn":
            normals.append((float(words[1]), float(words[2]), float(words[3])))
        elif kind == "usemtl":
            material_id = names.setdefault(line.split(None, 1)[1].strip() if len(words) > 1 else "", len(names))
        elif kind == "f":
            fan = []
            for word in words[1:]:
                parts = word.split("/")
                v = int(parts[0])
                t = int(parts[1]) if len(parts) > 1 and parts[1] else 0
                n = int(parts[2]) if len(parts) > 2 and parts[2] else 0
                fan.append(
                    (
                        v - 1 if v > 0 else len(vertices) + v,
                        t if t >= 0 else len(texcoords) + t,
                        n if n >= 0 else len(normals) + n,
                    )
                )
            rows += [(*fan[0], *fan[k], *fan[k + 1], material_id) for k in range(1, len(fan) - 1)]
    table = np.array(rows, np.int64).reshape(-1, 10)
    places, indices = np.array(vertices).reshape(-1, 3), table[:, :9].reshape(-1, 3, 3)
    triangles = Triangles(
        places[indices[..., 0]], np.array(normals)[indices[..., 2]], np.array(texcoords)[indices[..., 1]], table[:, 9]
    )
    return _with_normals(triangles), list(names)


def _with_normals(triangles: Triangles) -> Triangles:
    """Triangles of more than no area, with unit normals at all corners."""
    edges = triangles.corners[:, 1:] - triangles.corners[:, :1]
    faces = np.cross(edges[:, 0], edges[:, 1])
    area = np.linalg.norm(faces, axis=-1)
    kept = area > 1e-12 * np.square(np.ptp(triangles.corners, axis=(0, 1)).max(initial=1e-30))
    triangles, faces, area = triangles.select(kept), faces[kept], area[kept]
    _, vertex = np.unique(triangles.corners.reshape(-1, 3), axis=0, return_inverse=True)
    sums = np.zeros((vertex.max(initial=0) + 1, 3))
    np.add.at(sums, vertex.ravel(), np.repeat(faces, 3, axis=0))
    flat = np.repeat((faces / area[:, None])[:, None], 3, axis=1)
    smooth = (sums / (np.linalg.norm(sums, axis=-1, keepdims=True) + 1e-30))[vertex].reshape(-1, 3, 3)
    smooth = np.where(((smooth * flat).sum(axis=-1) > 0.77)[..., None], smooth, flat)
    size = np.linalg.norm(triangles.normals, axis=-1, keepdims=True)
    normals = np.where(size > 0.5, triangles.normals / (size + 1e-30), smooth)
    return triangles._replace(normals=normals)


def simplify(triangles: Triangles, limit: int) -> Triangles:
    """At most `limit` triangles: vertices in a cell of a grid become one, and triangles without area are removed.

    Source: Rossignac and Borrel, Multi-resolution 3D approximations for rendering complex scenes, 1993. The cell size
    is the smallest of a bisection. Corners keep their own normals and image coordinates.
    """
    if len(triangles.material_ids) <= limit:
        return triangles
    points = triangles.corners.reshape(-1, 3)
    low, extent = points.min(axis=0), np.ptp(points, axis=0).max()
    fine, coarse = 0.0, 0.25
    best = triangles.select(np.zeros(len(triangles.material_ids), bool))
    for _ in range(9):
        size = (fine + coarse) / 2 if fine else coarse / 16
        cells = np.floor((points - low) / (size * extent)).astype(np.int64)
        _, cell = np.unique(cells @ (1, 1 << 20, 1 << 40), return_inverse=True)
        counts = np.bincount(cell)
        means = np.stack([np.bincount(cell, points[:, k]) / counts for k in range(3)], axis=-1)
        corners = cell.reshape(-1, 3)
        ordered = np.sort(corners, axis=1)
        kept = (ordered[:, 0] != ordered[:, 1]) & (ordered[:, 1] != ordered[:, 2])
        _, first = np.unique(ordered, axis=0, return_index=True)
        kept &= np.isin(np.arange(len(kept)), first)
        if kept.sum() <= limit:
            best, coarse = triangles._replace(corners=means[corners]).select(kept), size
        else:
            fine = size
    return best


def make_mesh(triangles: Triangles, materials: tuple[MeshMaterial, ...], turn: NDArray | None = None) -> Mesh:
    """A mesh whose triangles fill the box [-1, 1]^3.

    Args:
        turn: rotation (3 3) of the triangles.
    """
    corners, normals = triangles.corners, triangles.normals
    if turn is not None:
        corners, normals = corners @ turn.T, normals @ turn.T
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    half = np.maximum((high - low) / 2, 1e-6)
    normals = normals * half
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True) + 1e-30
    return Mesh(
        ((corners - (low + high) / 2) / half).astype(np.float32),
        normals.astype(np.float32),
        triangles.texcoords.astype(np.float32),
        triangles.material_ids.astype(np.int32),
        materials,
    )


def select_triangles(mesh: Mesh, kept: NDArray[np.bool_]) -> Mesh:
    """A part of a mesh."""
    return Mesh(mesh.corners[kept], mesh.normals[kept], mesh.texcoords[kept], mesh.material_ids[kept], mesh.materials)
