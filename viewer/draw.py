"""Splats to pixels: visible Gaussians become records, and records quads blended back to front."""

import moderngl
import numpy as np
from jaxtyping import UInt

from pansplat.constants import FILTER_VARIANCE
from pansplat.errors import InputError
from pansplat_viewer.pinhole import Pinhole
from pansplat_viewer.programs import RECORD, RECORD_BYTES, Programs, set_uniforms
from pansplat_viewer.settings import DrawSettings
from pansplat_viewer.splats import SplatBuffers

_CHUNK = 1 << 20  # records made and drawn at a time, which bounds their memory to 100 MB
_GROUP = 64  # local size of project.comp
_ROW = 1 << 14  # work groups in a row, well below GL's least limit


def choose_tier(ctx: moderngl.Context, tier: str) -> str:
    """`gl43` where compute shaders exist, else `gl33`.

    Raises:
        InputError: `gl43` was asked for and the context has no compute shaders.
    """
    if tier not in ("auto", "gl33", "gl43"):
        raise InputError(f"`tier` must be auto, gl33 or gl43, got {tier!r}")
    able = ctx.version_code >= 430
    if tier == "gl43" and not able:
        version = f"{ctx.version_code // 100}.{ctx.version_code // 10 % 10}"
        raise InputError(f"tier gl43 needs OpenGL 4.3, this context has {version}; use tier gl33 or auto")
    return "gl43" if able and tier != "gl33" else "gl33"


def filter_of(settings: DrawSettings, focal: float) -> tuple[float, float]:
    """(e^2, dilation) of docs/rendering.md, section 2, in image-plane units squared."""
    pixel = 1.0 / (focal * focal)
    variance = FILTER_VARIANCE[settings.lowpass] * pixel
    return (0.0, variance) if (settings.lowpass, settings.kernel) == ("3dgs", "ewa") else (variance, 0.0)


class SplatDrawer:
    """Draws one upload's splats; the tier only decides how records are made."""

    def __init__(self, ctx: moderngl.Context, programs: Programs, buffers: SplatBuffers, tier: str) -> None:
        """Allocate the buffers for indices and records."""
        self._ctx = ctx
        self._programs = programs
        self._buffers = buffers
        self._tier = tier
        capacity = max(min(_CHUNK, len(buffers.splats)), 1)
        self._capacity = capacity
        self._indices = ctx.buffer(reserve=4 * capacity, dynamic=True)
        self._records = ctx.buffer(reserve=RECORD_BYTES * capacity, dynamic=True)
        layout = " ".join(["4f"] * len(RECORD)) + " /i"
        self._quads = ctx.vertex_array(programs.splat(), [(self._records, layout, *RECORD)])
        self._points: moderngl.VertexArray | None = None
        if tier == "gl33":
            self._points = ctx.vertex_array(
                programs.project(),
                [
                    (buffers.geometry, "4f 4f 4f", "in_mean_opacity", "in_quat", "in_scale"),
                    (buffers.colors, "4f", "in_color"),
                ],
                index_buffer=self._indices,
                index_element_size=4,
                mode=moderngl.POINTS,
            )

    def draw(
        self,
        camera: Pinhole,
        back_to_front: UInt[np.ndarray, "n"],
        settings: DrawSettings,
        viewport: tuple[int, int, int, int],
    ) -> None:
        """Blend the splats at these indices into the bound framebuffer's `viewport`."""
        self._set_uniforms(camera, settings, viewport)
        self._ctx.enable_only(moderngl.BLEND)
        self._ctx.blend_func = moderngl.ONE, moderngl.ONE_MINUS_SRC_ALPHA
        for start in range(0, len(back_to_front), self._capacity):
            indices = np.ascontiguousarray(back_to_front[start : start + self._capacity], dtype=np.uint32)
            self._indices.write(indices)
            self._project(len(indices))
            self._quads.render(moderngl.TRIANGLE_STRIP, vertices=4, instances=len(indices))
        self._ctx.enable_only(moderngl.NOTHING)

    def _project(self, count: int) -> None:
        if self._points is not None:
            self._points.transform(self._records, moderngl.POINTS, vertices=count)
            return
        program = self._programs.project_compute()
        set_uniforms(program, count=count)
        buffers = (self._buffers.geometry, self._buffers.colors, self._indices, self._records)
        for binding, buffer in enumerate(buffers):
            buffer.bind_to_storage_buffer(binding)
        groups = -(-count // _GROUP)
        program.run(min(groups, _ROW), -(-groups // _ROW))
        self._ctx.memory_barrier()

    def _set_uniforms(self, camera: Pinhole, settings: DrawSettings, viewport: tuple[int, int, int, int]) -> None:
        variance, dilation = filter_of(settings, camera.focal)
        project = self._programs.project() if self._tier == "gl33" else self._programs.project_compute()
        set_uniforms(
            project,
            # GLSL reads columns, so the rows of camera-to-world are the columns of its inverse.
            world_to_camera=np.ascontiguousarray(camera.rotation, dtype=np.float32).tobytes(),
            position=camera.position,
            near=settings.near,
            kernel=int(settings.kernel == "ewa"),
            filter_variance=variance,
            compensate=settings.lowpass == "angular",
            dilation=dilation,
            half_size=camera.half_size,
            margin=0.02 / camera.focal,
        )
        x, y, width, height = viewport
        set_uniforms(
            self._programs.splat(),
            half_size=camera.half_size,
            principal=(x + 0.5 * width, y + 0.5 * height),
            focal=camera.focal,
        )

    def release(self) -> None:
        """Free the buffers and vertex arrays."""
        for thing in (self._quads, self._points, self._indices, self._records):
            if thing is not None:
                thing.release()
