"""The GLSL sources are documented, and have what GLSL 3.30 allows."""

import re
from importlib import resources
from types import SimpleNamespace

from pansplat_viewer.draw.programs import Programs

FOLDER = resources.files("pansplat.shaders")
SOURCES = sorted(path.name for path in FOLDER.iterdir() if path.name.endswith((".glsl", ".vert", ".frag")))


def test_readme_names_every_file_uniform_and_input():
    readme = (FOLDER / "README.md").read_text("utf-8")
    for name in SOURCES:
        text = (FOLDER / name).read_text("utf-8")
        names = re.findall(r"^uniform (?:highp )?\w+ (\w+)", text, re.MULTILINE)
        if name.endswith(".vert"):
            names += re.findall(r"^in \w+ (\w+)", text, re.MULTILINE)
        missing = [each for each in (name, *names) if f"`{each}`" not in readme]
        assert not missing, f"{name}: {missing} not in shaders/README.md"


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
