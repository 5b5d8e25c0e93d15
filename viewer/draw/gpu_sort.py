"""Sorting, culling and projection of splats on the GPU by compute shaders (OpenGL 4.3).

The order by distance is computed for a position and serves every part of every layer there (all cube faces, all
views): a part keeps the splats that it can show in that order, projects them, and draws them by an indirect draw.
The numbers of splats stay on the GPU.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence

import moderngl
import numpy as np
from jaxtyping import Bool

from pansplat_viewer.draw.programs import DIGITS, TILE_SIZE, Programs, Resources, set_uniforms
from pansplat_viewer.scene.camera import Pinhole
from pansplat_viewer.scene.settings import DrawSettings

_KEY_BITS = 32
_GROUP_SIZE = 64  # local size of sort_keys.comp and project.comp
_MAX_GROUPS = 1 << 14  # in one dimension, below the limit of every implementation
_MAX_MASKS = 8
_DRAW_BYTES, _DISPATCH_BYTES = 20, 12
MAX_PARTS = 6  # of a layer: cube faces
_PLANES = 5  # at most, of a part


def count_groups(count: int, size: int) -> int:
    """Number of work groups of a size that cover `count` items."""
    return -(-count // size)


class RadixSort:
    """A stable sort of 32-bit keys with 32-bit values, by digits of log2 DIGITS bits from the lowest on."""

    def __init__(self, ctx: moderngl.Context, programs: Programs, resources: Resources, capacity: int) -> None:
        """Allocate the buffers.

        Args:
            ctx: the current context, OpenGL 4.3.
            programs: of the context.
            resources: that the buffers belong to.
            capacity: largest number of keys.
        """
        self._ctx, self._programs = ctx, programs
        size, keep = 4 * max(capacity, 1), resources.keep
        self.keys, self.values, *self._spare = (keep(ctx.buffer(reserve=size)) for _ in range(4))
        self._counts = keep(ctx.buffer(reserve=4 * DIGITS * max(count_groups(capacity, TILE_SIZE), 1)))
        self._total = keep(ctx.buffer(reserve=4))

    def sort(self, count: int) -> None:
        """Sort the first `count` of `keys` in ascending order, and `values` with them; equal keys keep their order."""
        num_tiles, source, target = count_groups(count, TILE_SIZE), (self.keys, self.values), self._spare
        if not num_tiles:
            return
        bits = DIGITS.bit_length() - 1
        for shift in range(0, _KEY_BITS, bits):
            numbers = {"count": count, "shift": shift, "num_tiles": num_tiles}
            _run(self._ctx, self._programs.compute("sort_count.comp"), num_tiles, (source[0], self._counts), **numbers)
            scan = self._programs.compute("scan.comp")
            _run(self._ctx, scan, 1, (self._counts, self._total), count=DIGITS * num_tiles)
            buffers = *source, self._counts, *target
            _run(self._ctx, self._programs.compute("sort_scatter.comp"), num_tiles, buffers, **numbers)
            source, target = target, source
        self.keys, self.values = source
        self._spare = list(target)


class GpuSplats:
    """Order, culling and projection of the splats of one scene."""

    def __init__(
        self,
        ctx: moderngl.Context,
        programs: Programs,
        resources: Resources,
        geometry: moderngl.Buffer,
        colors: moderngl.Buffer,
        records: moderngl.Buffer,
        count: int,
        capacity: int,
    ) -> None:
        """Allocate the buffers.

        Args:
            ctx: the current context, OpenGL 4.3.
            programs: of the context.
            resources: that the buffers belong to.
            geometry, colors: of the splats.
            records: written, `capacity` splats at once.
            count: number of splats.
            capacity: splats in a chunk that is projected and drawn together.
        """
        self._ctx, self._programs, self._count, self._capacity = ctx, programs, count, capacity
        self._geometry, self._colors, self._records = geometry, colors, records
        self._resources, keep = resources, resources.keep
        programs.compile_compute()
        self._sort = RadixSort(ctx, programs, resources, count)
        self._order_key: Hashable = None
        self._num_chunks = max(count_groups(MAX_PARTS * count, capacity), 1)
        self._counts = keep(ctx.buffer(reserve=4 * MAX_PARTS * max(count_groups(count, TILE_SIZE), 1)))
        self._visible = keep(ctx.buffer(reserve=4 * MAX_PARTS * max(count, 1)))
        self._total, self._drawn = keep(ctx.buffer(reserve=4)), keep(ctx.buffer(np.zeros(1, np.uint32)))
        self._dispatches = keep(ctx.buffer(reserve=_DISPATCH_BYTES * self._num_chunks))
        self._draws = keep(ctx.buffer(reserve=_DRAW_BYTES * self._num_chunks))
        self._masks: dict[Hashable, moderngl.Buffer] = {}

    def draw(
        self,
        quads: moderngl.VertexArray,
        cameras: Sequence[Pinhole],
        position: tuple[float, float, float],
        selected: Bool[np.ndarray, "n"],
        selection: Hashable,
        settings: DrawSettings,
        filter_variance: float,
    ) -> None:
        """Draw the selected splats that each camera sees, back to front; other uniforms and blending are the caller's.

        Args:
            quads: draws the records.
            cameras: of the parts of a layer; one if the order is by depth.
            position: of the order by distance.
            selected: the splats of the layer.
            selection: identifies `selected`.
            settings: draw settings.
            filter_variance: of the low-pass filter, image-plane units squared.
        """
        if not self._count:
            return
        self._update_order(cameras[0], position, settings)
        self._list_visible(cameras, self._get_mask(selected, selection), settings, filter_variance)
        arguments = self._programs.compute("arguments.comp")
        buffers = self._total, self._dispatches, self._draws, self._drawn
        num_chunks = max(count_groups(len(cameras) * self._count, self._capacity), 1)
        _run(self._ctx, arguments, 1, buffers, num_chunks=num_chunks, capacity=self._capacity)
        project = self._programs.project_compute()
        rotations = np.zeros((MAX_PARTS, 3, 3), np.float32)
        rotations[: len(cameras)] = [camera.rotation for camera in cameras]
        set_uniforms(project, rotations=rotations.tobytes())  # GLSL reads columns: of the inverse
        for chunk in range(num_chunks):
            set_uniforms(project, first=chunk * self._capacity, capacity=self._capacity)
            for binding, buffer in enumerate((self._geometry, self._colors, self._visible, self._records, self._total)):
                buffer.bind_to_storage_buffer(binding)
            project.run_indirect(self._dispatches, _DISPATCH_BYTES * chunk)
            self._ctx.memory_barrier()
            quads.render_indirect(self._draws, moderngl.TRIANGLE_STRIP, count=1, first=chunk)
            self._ctx.memory_barrier()  # the next chunk overwrites the records that this draw reads

    def take_drawn(self) -> int:
        """Number of splats drawn since the last call; waits for the GPU."""
        drawn = int(np.frombuffer(self._drawn.read(), np.uint32)[0])
        self._drawn.write(np.zeros(1, np.uint32))
        return drawn

    def read_order(self) -> np.ndarray:
        """The indices of all splats in the order of the last draw, front to back."""
        return np.frombuffer(self._sort.values.read(4 * self._count), np.uint32)

    def _update_order(self, camera: Pinhole, position: tuple[float, float, float], settings: DrawSettings) -> None:
        """Sort all splats by distance from the position, or by depth along the camera's axis."""
        by_depth = not settings.is_exact
        forward = tuple(float(x) for x in camera.rotation[:, 2])
        key = (position, forward) if by_depth else (position,)
        if key == self._order_key:
            return
        groups = count_groups(self._count, _GROUP_SIZE)
        program = self._programs.compute("sort_keys.comp")
        set_uniforms(program, count=self._count, position=position, forward=forward, by_depth=by_depth)
        for binding, buffer in enumerate((self._geometry, self._sort.keys, self._sort.values)):
            buffer.bind_to_storage_buffer(binding)
        program.run(min(groups, _MAX_GROUPS), count_groups(groups, _MAX_GROUPS))
        self._ctx.memory_barrier()
        self._sort.sort(self._count)
        self._order_key = key

    def _list_visible(
        self, cameras: Sequence[Pinhole], mask: moderngl.Buffer, settings: DrawSettings, filter_variance: float
    ) -> None:
        """List the splats that touch the parts, part by part, in the order of the sort."""
        bounded = settings.is_exact  # the linearised response of preset 3dgs ends outside the ball
        planes, num_planes = np.zeros((MAX_PARTS, _PLANES, 4), np.float32), 0
        for part, camera in enumerate(cameras):
            normals = camera.compute_side_normals() if bounded else camera.rotation[:, 2][None]
            num_planes = len(normals)
            planes[part, :num_planes] = np.column_stack((normals, normals @ np.asarray(camera.position)))
        num_tiles, num_parts = count_groups(self._count, TILE_SIZE), len(cameras)
        uniforms = {
            "count": self._count,
            "position": cameras[0].position,
            "planes": planes.tobytes(),
            "num_planes": num_planes,
            "deviation": 1.001 * math.sqrt(filter_variance),
            "bounded": bounded,
        }
        buffers = self._geometry, mask, self._sort.values, self._counts, self._visible
        groups = num_tiles, num_parts
        _run(self._ctx, self._programs.compute("cull.comp", WRITE=0), groups, buffers, **uniforms)
        scan = self._programs.compute("scan.comp")
        _run(self._ctx, scan, 1, (self._counts, self._total), count=num_parts * num_tiles)
        _run(self._ctx, self._programs.compute("cull.comp", WRITE=1), groups, buffers, **uniforms)

    def _get_mask(self, selected: Bool[np.ndarray, "n"], selection: Hashable) -> moderngl.Buffer:
        """A buffer with one bit for each splat."""
        if selection not in self._masks:
            padded = np.zeros(32 * count_groups(len(selected), 32), bool)
            padded[: len(selected)] = selected
            bits = np.packbits(padded, bitorder="little")
            if len(self._masks) < _MAX_MASKS:
                self._masks[selection] = self._resources.keep(self._ctx.buffer(bits))
            else:  # all have the same size
                buffer = self._masks.pop(next(iter(self._masks)))
                buffer.write(bits)
                self._masks[selection] = buffer
        return self._masks[selection]


def _run(
    ctx: moderngl.Context,
    program: moderngl.ComputeShader,
    groups: int | tuple[int, int],
    buffers: tuple[moderngl.Buffer, ...],
    **uniforms: object,
) -> None:
    """Run a compute shader on storage buffers 0, 1, ... and make its results visible to what follows."""
    set_uniforms(program, **uniforms)
    for binding, buffer in enumerate(buffers):
        buffer.bind_to_storage_buffer(binding)
    program.run(*(groups if isinstance(groups, tuple) else (groups,)))
    ctx.memory_barrier()
