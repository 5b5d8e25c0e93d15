"""GLSL programs, compiled at first use from the sources in the package."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator
from typing import Any

import moderngl

from pansplat.shaders import load_shader

# Members of a record, in the order of shaders/project.vert.
RECORD = ("quad_1", "quad_2", "row_a", "row_b", "row_l", "color")
RECORD_BYTES = 16 * len(RECORD)
_UNIFORM = re.compile(r"^uniform \w+ (\w+)", re.MULTILINE)
_MAX_ERRORS = 8  # largest number of errors that OpenGL reports at once


def read_source(name: str, **defines: float | str) -> str:
    """Return the text of a shader for OpenGL 3.3, with the displays that web pages do not have."""
    return load_shader(name, "330 core", INSPECT=1, **defines)


@contextlib.contextmanager
def checking_memory(ctx: moderngl.Context) -> Iterator[None]:
    """Raise an error if OpenGL reports one for the calls in the block: moderngl returns buffers without memory.

    Raises:
        MemoryError: the GPU's memory is exhausted.
        moderngl.Error: another error of OpenGL.
    """
    _take_errors(ctx)  # those of calls before the block
    try:
        yield
    except moderngl.Error as error:  # such as a framebuffer whose texture has no memory
        if "GL_OUT_OF_MEMORY" in _take_errors(ctx):
            raise MemoryError(f"the GPU's memory is exhausted: {error}") from error
        raise
    errors = _take_errors(ctx)
    if "GL_OUT_OF_MEMORY" in errors:
        raise MemoryError("the GPU's memory is exhausted")
    if errors:
        raise moderngl.Error(f"OpenGL reports {', '.join(errors)}")


def _take_errors(ctx: moderngl.Context) -> list[str]:
    """The errors since the last call; a context that is lost reports its loss for ever."""
    errors: list[str] = []
    while len(errors) < _MAX_ERRORS and (error := ctx.error) != "GL_NO_ERROR":
        errors.append(error)
    return errors


def set_uniforms(program: Any, **values: Any) -> None:
    """Set uniforms by name, except those that the compiler removed because nothing reads them.

    Raises:
        KeyError: the source of the program, which `Programs` keeps in `extra`, has no uniform of this name.
    """
    for name, value in values.items():
        member = program.get(name, None)
        if member is None:
            if name not in program.extra:
                raise KeyError(f"the program has no uniform {name!r}; it has {', '.join(sorted(program.extra))}")
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
        self._compiled: dict[tuple[object, ...], Any] = {}

    def project(self) -> moderngl.Program:
        """Gaussians to records by transform feedback."""
        capture: Any = {"varyings": RECORD, "varyings_capture_mode": "interleaved"}
        return self._compile(lambda source: self._ctx.program(vertex_shader=source, **capture), "project.vert")

    def splat(self) -> moderngl.Program:
        """The program that draws records into a layer."""
        return self._compile_pair("splat.vert", "splat.frag")

    def accumulate(self, has_faces: bool) -> moderngl.Program:
        """One weighted layer, an image or cube faces, to the sum of layers."""
        return self._compile_pair("screen.vert", "accumulate.frag", LAYER_STORAGE=int(has_faces))

    def resolve(self) -> moderngl.Program:
        """The sum of layers to the image."""
        return self._compile_pair("screen.vert", "resolve.frag")

    def present(self) -> moderngl.Program:
        """The image, or a photograph, to the screen."""
        return self._compile_pair("present.vert", "present.frag")

    def release(self) -> None:
        """Free all programs."""
        for program in self._compiled.values():
            program.release()
        self._compiled.clear()

    def _compile_pair(self, vertex: str, fragment: str, **defines: int) -> moderngl.Program:
        def compile_pair(*sources: str) -> moderngl.Program:
            return self._ctx.program(vertex_shader=sources[0], fragment_shader=sources[1])

        return self._compile(compile_pair, vertex, fragment, **defines)

    def _compile(self, compile_sources: Callable[..., Any], *files: str, **defines: int) -> Any:
        """The program of these files; `extra` is the set of its uniforms, for `set_uniforms`."""
        key = (*files, *defines.items())
        if key not in self._compiled:
            sources = [read_source(file, **defines) for file in files]
            program = self._compiled[key] = compile_sources(*sources)
            program.extra = {name for source in sources for name in _UNIFORM.findall(source)}
        return self._compiled[key]
