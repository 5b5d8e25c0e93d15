"""GLSL sources of the viewer and of web pages, and their preprocessor. README.md describes each file."""

from __future__ import annotations

import re
from importlib import resources

from pansplat import constants

_INCLUDE = re.compile(r'^#include "([^"]+)"$', re.MULTILINE)

# Names in pansplat.constants that every shader gets as #define lines.
_CONSTANTS = ("ALPHA_CUT", "EXPOSURE_WAY", "MAX_ALPHA")


def load_shader(name: str, version: str, **defines: float | str) -> str:
    """Return the text of a shader with its includes, its `#version` line, and constants.

    Args:
        name: file of this package.
        version: of the language: "330 core", or "300 es" (WebGL 2), where all numbers get high precision.
        defines: constants in addition to those of `pansplat.constants`.
    """
    text = _INCLUDE.sub(lambda match: _read(match[1]), _read(name))
    lines = [f"#version {version}"]
    if version.endswith("es"):
        lines += [f"precision highp {kind};" for kind in ("float", "int", "sampler2D", "usampler2D")]
    shared = {constant: getattr(constants, constant) for constant in _CONSTANTS}
    lines += [f"#define {constant} {value}" for constant, value in (shared | defines).items()]
    return "\n".join([*lines, text])


def _read(name: str) -> str:
    return (resources.files("pansplat.shaders") / name).read_text("utf-8")
