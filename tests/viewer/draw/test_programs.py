"""The GLSL sources have what GLSL 3.30 allows."""

import re
from types import SimpleNamespace

from pansplat_viewer.draw.programs import Programs


def test_qualifiers_of_layouts_are_signed_literals():
    """GLSL 3.30 has no other integers there; expressions and unsigned literals came with 4.40."""
    sources = []

    def compile_program(*stages, **options):
        sources.extend([*stages, *(text for name, text in options.items() if name.endswith("_shader"))])
        return SimpleNamespace()

    programs = Programs(SimpleNamespace(program=compile_program))
    for build in (programs.project, programs.splat, programs.resolve, programs.present):
        build()
    programs.accumulate(0)
    values = []
    for source in sources:
        defines = dict(re.findall(r"^#define (\w+) (.*)$", source, re.MULTILINE))
        for qualifiers in re.findall(r"^layout\(([^)]*)\)", source, re.MULTILINE):
            values += [defines.get(value, value) for value in re.findall(r"= *([^,]+)", qualifiers)]
    assert len(sources) == 9 and len(values) > 5
    assert all(re.fullmatch(r"\d+", value) for value in values), values
