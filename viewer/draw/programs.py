"""GLSL programs, compiled at first use from the sources in the package."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import moderngl

from pansplat.errors import InputError
from pansplat.shaders import load_shader

# Members of a record, in the order of shaders/project.vert and project.comp.
RECORD = ("quad_1", "quad_2", "row_a", "row_b", "row_l", "color")
RECORD_BYTES = 16 * len(RECORD)

DIGITS = 64  # of the radix sort, and its threads in a work group
TILE_SIZE = 1024  # keys or splats of a work group
COUNT_STEP = 1 / 256  # that one Gaussian adds to an image of counts, so that half floats hold its square


def choose_tier(ctx: moderngl.Context, tier: str) -> str:
    """Return `gl43` if the context has compute shaders and `tier` allows it, else `gl33`.

    Raises:
        InputError: `tier` is unknown, or `gl43` on a context without compute shaders.
    """
    if tier not in ("auto", "gl33", "gl43"):
        raise InputError(f"`tier` must be auto, gl33 or gl43, got {tier!r}")
    has_compute = ctx.version_code >= 430
    if tier == "gl43" and not has_compute:
        version = f"{ctx.version_code // 100}.{ctx.version_code // 10 % 10}"
        raise InputError(f"tier gl43 needs OpenGL 4.3, this context has {version}; use tier gl33 or auto")
    return "gl43" if has_compute and tier != "gl33" else "gl33"


def read_source(name: str, version: int, **defines: float | str) -> str:
    """Return the text of a shader for OpenGL `version` (330 or 430), with the displays that web pages do not have."""
    return load_shader(name, f"{version} core", INSPECT=1, COUNT_STEP=COUNT_STEP, **defines)


def set_uniforms(program: Any, **values: Any) -> None:
    """Set uniforms by name, except those that the compiler removed because nothing reads them."""
    for name, value in values.items():
        member = program.get(name, None)
        if member is None:
            continue
        if isinstance(value, bytes):
            member.write(value)
        else:
            member.value = value


class Resources:
    """GL objects that are freed together."""

    def __init__(self) -> None:
        """There are none yet."""
        self._kept: list[Any] = []

    def keep(self, resource: Any) -> Any:
        """Add an object; returns it."""
        self._kept.append(resource)
        return resource

    def release(self) -> None:
        """Free the objects."""
        while self._kept:
            self._kept.pop().release()


class Programs:
    """The viewer's programs on one context; each method compiles its program at the first call and returns it."""

    def __init__(self, ctx: moderngl.Context) -> None:
        """Create an empty cache."""
        self._ctx = ctx
        self._compiled: dict[str, Any] = {}

    def project(self) -> moderngl.Program:
        """Gaussians to records by transform feedback (GL 3.3)."""
        return self._compile(
            "project.vert",
            lambda: self._ctx.program(
                vertex_shader=read_source("project.vert", 330), varyings=RECORD, varyings_capture_mode="interleaved"
            ),
        )

    def project_compute(self) -> moderngl.ComputeShader:
        """Gaussians to records by a compute shader (GL 4.3)."""
        return self.compute("project.comp", PARTS=1)

    def compute(self, name: str, **defines: int) -> moderngl.ComputeShader:
        """The compute shader of this file (GL 4.3)."""
        defines = {"TILE_SIZE": TILE_SIZE, "DIGITS": f"{DIGITS}u"} | defines  # type: ignore[assignment]
        return self._compile(f"{name} {defines}", lambda: self._ctx.compute_shader(read_source(name, 430, **defines)))

    def splat(self) -> moderngl.Program:
        """Records to pixels of a layer."""
        return self._compile_pair("splat.vert", "splat.frag", PARTS=1)

    def accumulate(self, storage: int) -> moderngl.Program:
        """One weighted layer to the sum of layers; `storage` is a `LayerStorage`."""
        return self._compile_pair("screen.vert", "accumulate.frag", LAYER_STORAGE=int(storage))

    def resolve(self) -> moderngl.Program:
        """The sum of layers to the image."""
        return self._compile_pair("screen.vert", "resolve.frag")

    def arrange(self) -> moderngl.Program:
        """The images of two eyes to one image."""
        return self._compile_pair("screen.vert", "arrange.frag")

    def present(self) -> moderngl.Program:
        """The image, and a photograph next to it, to the screen."""
        return self._compile_pair("present.vert", "present.frag")

    def release(self) -> None:
        """Free all programs."""
        for program in self._compiled.values():
            program.release()
        self._compiled.clear()

    def _compile_pair(self, vertex: str, fragment: str, **defines: int) -> moderngl.Program:
        return self._compile(
            f"{fragment} {defines}",
            lambda: self._ctx.program(
                vertex_shader=read_source(vertex, 330), fragment_shader=read_source(fragment, 330, **defines)
            ),
        )

    def _compile(self, key: str, compile_program: Callable[[], Any]) -> Any:
        if key not in self._compiled:
            self._compiled[key] = compile_program()
        return self._compiled[key]
