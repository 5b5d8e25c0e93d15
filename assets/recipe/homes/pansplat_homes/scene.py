"""Generated scenes: bodies, materials, rooms and lights as arrays for the ray tracer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pansplat_homes.bvh import BOX, CYLINDER, ELLIPSOID, GLASS, MESH, STACK_SIZE, Bodies, build_bvh
from pansplat_homes.library import FurnitureLibrary
from pansplat_homes.meshes import NO_MESH, NO_TEXTURE, Mesh, Texture, pack_meshes
from pansplat_homes.raytracer import FLOOR_CELL, LAMP, LIGHT_NUMBERS, PORTAL, SUN, SceneArrays, trace_panorama
from pansplat_homes.textures import GLOSS, IMAGE, KIND, MIRROR, NUMBERS, Pattern

Array = NDArray[np.float64]
Vector = Sequence[float] | Array


@dataclass(frozen=True, eq=False)
class GeneratedScene:
    """A scene as arrays. World axes: y down, the floor at y = 0, metres.

    Attributes:
        arrays: for `trace_panorama`.
        low, high: corners of the bodies' bounding boxes (body 3), metres.
    """

    arrays: SceneArrays
    low: Array
    high: Array

    def panorama(self, cam2world: Array, height: int, samples: int = 2) -> tuple[Array, Array]:
        """Linear light (H W 3) and radial depth (H W) in metres at a pose.

        Depth is that of the pixel centre, behind glass. It is 0, unknown, where a mirror is seen.

        Args:
            samples: pixels at edges get samples x samples rays, others one.
        """
        image, depth = np.zeros((height, 2 * height, 3)), np.zeros((height, 2 * height))
        bodies = self.arrays.bodies._replace(stack=np.empty(STACK_SIZE, np.int64))  # one for each thread
        pose = np.ascontiguousarray(cam2world, dtype=np.float64)
        trace_panorama(self.arrays._replace(bodies=bodies), pose, samples, image, depth)
        return image, depth

    def clearance(self, points: Array) -> Array:
        """Distances in metres from points (n 3) to the nearest box, or oriented bounding box of a round body."""
        maps, halves = self.arrays.bodies.maps.reshape(-1, 3, 4), self.arrays.halves
        local = np.abs(np.einsum("bij,nbj->nbi", maps[:, :, :3], points[:, None] - maps[:, :, 3]))
        return np.linalg.norm(np.maximum(local - 1, 0) * halves, axis=-1).min(axis=1)


def _floor_light(low: Array, high: Array, is_structure: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Fraction of the ambient light that reaches the floor around and below bodies, in cells of `FLOOR_CELL`.

    Args:
        is_structure: walls, floors and ceilings, which `ambient_visibility` takes into account, and bodies outdoors.

    Returns:
        Cells (z x), and the world x and z of the first corner.
    """
    extent = high - low
    stands = (high[:, 1] > -0.6) & (high[:, 1] < 0.1) & (low[:, 1] < -0.05) & (extent[:, ::2].max(axis=1) < 4)
    low, high = low[stands & ~is_structure], high[stands & ~is_structure]
    if len(low) == 0:
        return np.ones((1, 1)), np.zeros(2)
    start = low[:, ::2].min(axis=0) - 0.5
    cells = np.ceil((high[:, ::2].max(axis=0) + 0.5 - start) / FLOOR_CELL).astype(int)
    covered = np.zeros(cells[::-1])
    first = np.floor((low[:, ::2] - start) / FLOOR_CELL).astype(int)
    last = np.ceil((high[:, ::2] - start) / FLOOR_CELL).astype(int)
    for (x0, z0), (x1, z1), bottom in zip(first, last, -high[:, 1], strict=True):
        area = covered[z0:z1, x0:x1]
        np.maximum(area, 1 - max(bottom, 0.0) / 0.6, out=area)
    for _ in range(4):  # two box filters of 7 cells along each axis give about a Gaussian
        sums = np.cumsum(np.pad(covered, ((4, 3), (0, 0))), axis=0)
        covered = ((sums[7:] - sums[:-7]) / 7).T
    return 1 - 0.65 * covered, start


class SceneBuilder:
    """Collects the parts of a scene; `rng` supplies all random numbers, `library` optional furniture."""

    def __init__(self, rng: np.random.Generator, library: FurnitureLibrary | None = None) -> None:
        self.rng, self.library = rng, library
        self.kinds: list[int] = []
        self.maps: list[Array] = []
        self.halves: list[Array] = []
        self.faces: list[list[int]] = []
        self.low: list[Array] = []
        self.high: list[Array] = []
        self.materials: list[Array] = []
        self.rooms: list[Array] = []
        self.lights: list[Array] = []
        self.meshes: dict[Mesh, int] = {NO_MESH: 0}
        self.roots: list[int] = []
        self.mesh_materials: list[int] = []
        self.textures: dict[Texture, int] = {NO_TEXTURE: 0}

    def add_material(
        self,
        pattern: Pattern,
        a: Vector,
        b: Vector | None = None,
        c: Vector | None = None,
        *,
        size: float | tuple[float, float] = 0.5,
        fraction: float = 0.1,
        mottle: float = 0.2,
        glow: float = 0.0,
        gloss: float = 0.0,
        mirror: float = 0.0,
    ) -> int:
        """Add a material and return its index.

        Args:
            a, b, c: reflectances (red, green, blue); their meaning depends on the pattern, see `textures`.
            size: width and height of the pattern, metres; one number if they are equal.
            fraction: of joints, stripes or veins in the pattern.
            mottle: strength of irregular wear.
            glow: emitted light, relative to the reflectance.
            gloss: from 0 to 1, strength of the weak reflection of varnish, tiles and stone (about 0.3 to 1).
            mirror: reflectance of a mirror; depth is unknown there.
        """
        sides = size if isinstance(size, tuple) else (size, size)
        row = np.zeros(NUMBERS)
        row[:16] = [pattern, *a, *(b or a), *(c or a), *sides, fraction, mottle, self.rng.integers(1 << 20), glow]
        row[GLOSS], row[MIRROR] = gloss, mirror
        self.materials.append(row)
        return len(self.materials) - 1

    def add_image_material(self, texture: Texture, tint: Vector = (1, 1, 1), *, gloss: float = 0.0) -> int:
        """Add a material that shows an image on meshes, multiplied by `tint` (red, green, blue); return its index."""
        index = self.textures.setdefault(texture, len(self.textures))
        material = self.add_material(Pattern.PLAIN, tint, size=(index, 0), mottle=0, gloss=gloss)
        self.materials[material][KIND] = IMAGE
        return material

    def add_mesh(self, mesh: Mesh, centre: Vector, half: Vector, materials: Sequence[int], yaw: float = 0) -> None:
        """Add a mesh that fills a box.

        Args:
            half: half the size of the box, metres.
            materials: one for each material of the mesh.
        """
        for texture in filter(None, (material.texture for material in mesh.materials)):
            self.textures.setdefault(texture, len(self.textures))
        number = self.meshes.setdefault(mesh, len(self.meshes))
        self._add_body(MESH, centre, half, len(self.mesh_materials), yaw, 0, number)
        self.mesh_materials += materials

    def add_box(
        self, centre: Vector, half: Vector, material: int | Sequence[int], yaw: float = 0, pitch: float = 0
    ) -> None:
        """Add a box with one material, or with six: left right (x), up down (y), back front (z)."""
        self._add_body(BOX, centre, half, material, yaw, pitch)

    def add_ellipsoid(self, centre: Vector, half: Vector, material: int, yaw: float = 0) -> None:
        """Add an ellipsoid with the given half axes."""
        self._add_body(ELLIPSOID, centre, half, material, yaw, 0)

    def add_cylinder(self, centre: Vector, radius: float, half_height: float, material: int, pitch: float = 0) -> None:
        """Add an upright cylinder."""
        self._add_body(CYLINDER, centre, (radius, half_height, radius), material, 0, pitch)

    def add_glass(self, centre: Vector, half: Vector) -> None:
        """Add a pane of clear glass, which neither depth nor shadows show."""
        self._add_body(GLASS, centre, half, 0, 0, 0)

    def add_light(self, position: Vector, color: Vector, size: float, *, sun: bool = False, group: int = -1) -> None:
        """Add a lamp at a position, or a sun in a direction; it lights the rooms of a light group, or all if -1."""
        self.lights.append(np.array((*position, *color, size, SUN if sun else LAMP, group, 0, 0, 0, 0), np.float64))

    def add_portal(
        self, centre: Vector, half: tuple[float, float], axis: int, color: Vector, group: int, *, shadows: bool = False
    ) -> None:
        """Add a luminous upright rectangle, seen from the rooms of one light group; `axis` is that of its normal."""
        self.lights.append(np.array((*centre, *color, 0, PORTAL, group, *half, axis, shadows), np.float64))

    def add_room(
        self,
        corners: Vector,
        materials: Sequence[int],
        panel_height: float,
        trim_height: float,
        height: float,
        ambient: Vector = (1.0, 1.0, 1.0),
        group: int = 0,
    ) -> None:
        """Add a room x0 z0 x1 z1 with its materials of wall, floor, ceiling, trim and panel, light and light group."""
        row = (*corners, *materials, panel_height, trim_height, height, *ambient, group)
        self.rooms.append(np.array(row, np.float64))

    def finish(self, ambient: Vector, outside: int, sky: int) -> GeneratedScene:
        """The scene; `ambient` is the light outdoors, `outside` and `sky` are indices of materials."""
        low, high = np.array(self.low), np.array(self.high)
        bounds, links, order = build_bvh(low, high, 2)
        tree, cutouts, roots = pack_meshes(list(self.meshes), self.textures)
        texels = [texture.texels for texture in self.textures]
        starts = np.cumsum([0] + [len(part) for part in texels])
        bodies = Bodies(
            kinds=np.array(self.kinds, np.int64)[order],
            maps=np.array(self.maps)[order],
            roots=roots[self.roots][order],
            bounds=bounds,
            links=links,
            mesh_bounds=tree.bounds,
            mesh_links=tree.links,
            triangles=tree.triangles,
            texcoords=tree.texcoords,
            cutouts=cutouts,
            texels=np.concatenate(texels),
            images=np.array([(start, *texture.size) for start, texture in zip(starts, self.textures, strict=False)]),
            stack=np.empty(STACK_SIZE, np.int64),
        )
        rooms = np.array(self.rooms)
        is_outside = (low[:, ::2] > rooms[:, 2:4].max(axis=0)) | (high[:, ::2] < rooms[:, :2].min(axis=0))
        is_structure = (np.array(self.faces)[:, 0] < 0) | is_outside.any(axis=1)
        floor_light, floor_start = _floor_light(low, high, is_structure)
        arrays = SceneArrays(
            bodies=bodies,
            halves=np.array(self.halves)[order],
            faces=np.array(self.faces, np.int64)[order],
            normals=tree.normals,
            triangle_materials=tree.material_ids,
            mesh_materials=np.array(self.mesh_materials, np.int64),
            materials=np.array(self.materials),
            rooms=rooms,
            floor_light=floor_light,
            floor_start=floor_start,
            lights=np.array(self.lights) if self.lights else np.zeros((0, LIGHT_NUMBERS)),
            ambient=np.array(ambient, np.float64),
            outside=outside,
            sky=sky,
        )
        return GeneratedScene(arrays, low, high)

    def _add_body(
        self,
        kind: int,
        centre: Vector,
        half: Vector,
        material: int | Sequence[int],
        yaw: float,
        pitch: float,
        mesh: int = 0,
    ) -> None:
        middle, reach = np.asarray(centre, np.float64), np.asarray(half, np.float64)
        cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
        rotation = np.array(((cy, 0, sy), (0, 1, 0), (-sy, 0, cy))) @ np.array(((1, 0, 0), (0, cp, -sp), (0, sp, cp)))
        extent = np.abs(rotation) @ reach
        self.kinds.append(kind)
        self.roots.append(mesh)
        self.maps.append(np.concatenate((rotation.T / reach[:, None], middle[:, None]), axis=1).ravel())
        self.halves.append(reach)
        self.faces.append([material] * 6 if isinstance(material, int) else list(material))
        self.low.append(middle - extent - 1e-6)
        self.high.append(middle + extent + 1e-6)
