"""GLSL programs: sources read from the package, includes resolved, compiled when first used."""

from __future__ import annotations

import re
from importlib import resources
from typing import Any

import moderngl

from pansplat import constants

_INCLUDE = re.compile(r'^#include "([^"]+)"$', re.MULTILINE)

_SHARED = ("ALPHA_CUT", "MAX_ALPHA", "EWA_NEAR_FACTOR", "EWA_CLAMP")

# The members of one record, in the order of shaders/project.vert and project.comp.
RECORD = ("quad_1", "quad_2", "response_a", "response_b", "response_l", "color")
RECORD_BYTES = 16 * len(RECORD)


def source(name: str, version: int, **defines: float) -> str:
    """A shader file's text with its includes, constants and `#version` line for GL `version` (330 or 430).

    Args:
        defines: further constants, beside those of `pansplat.constants` that shaders share.
    """
    defines = {key: getattr(constants, key) for key in _SHARED} | defines
    folder = resources.files("pansplat_viewer.shaders")
    text = _INCLUDE.sub(lambda match: (folder / match[1]).read_text("utf-8"), (folder / name).read_text("utf-8"))
    lines = "".join(f"#define {key} {value}\n" for key, value in defines.items())
    return f"#version {version} core\n{lines}{text}"


def set_uniforms(program: Any, **values: Any) -> None:
    """Set uniforms by name; those the compiler removed because nothing reads them are passed over."""
    for name, value in values.items():
        member = program.get(name, None)
        if member is None:
            continue
        if isinstance(value, bytes):
            member.write(value)
        else:
            member.value = value


class Programs:
    """The viewer's programs on one context."""

    def __init__(self, ctx: moderngl.Context) -> None:
        """Nothing is compiled yet."""
        self._ctx = ctx
        self._made: dict[str, Any] = {}

    def project(self) -> moderngl.Program:
        """Gaussians to records by transform feedback (GL 3.3)."""
        if "project" not in self._made:
            self._made["project"] = self._ctx.program(
                vertex_shader=source("project.vert", 330),
                varyings=RECORD,
                varyings_capture_mode="interleaved",
            )
        return self._made["project"]

    def project_compute(self) -> moderngl.ComputeShader:
        """Gaussians to records by a compute shader (GL 4.3)."""
        if "compute" not in self._made:
            self._made["compute"] = self._ctx.compute_shader(source("project.comp", 430))
        return self._made["compute"]

    def splat(self) -> moderngl.Program:
        """Records to pixels."""
        return self._pair("splat.vert", "splat.frag")

    def gather(self, kept_as: int) -> moderngl.Program:
        """A layer, weighted; `kept_as` is SOURCE of gather.frag."""
        return self._pair("screen.vert", "gather.frag", SOURCE=kept_as)

    def finish(self) -> moderngl.Program:
        """The added layers to the picture."""
        return self._pair("screen.vert", "finish.frag")

    def _pair(self, vertex: str, fragment: str, **defines: int) -> moderngl.Program:
        key = f"{fragment} {defines}"
        if key not in self._made:
            self._made[key] = self._ctx.program(
                vertex_shader=source(vertex, 330), fragment_shader=source(fragment, 330, **defines)
            )
        return self._made[key]

    def release(self) -> None:
        """Free all programs."""
        for program in self._made.values():
            program.release()
        self._made.clear()
