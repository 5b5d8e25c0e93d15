"""The GLSL sources are complete, documented, and agree with geometry/cubemap.py and pansplat/constants.py."""

import re
from importlib import resources
from types import SimpleNamespace

import pytest
import torch

from pansplat.constants import ALPHA_CUT
from pansplat.geometry.cubemap import face_rotations
from pansplat_viewer.draw.programs import Programs, read_source

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


def test_source_has_the_version_first_then_constants_and_no_includes():
    for name in SOURCES:
        lines = read_source(name, LAYER_STORAGE=2).splitlines()
        defines = [line for line in lines if line.startswith("#define")]
        assert lines[: len(defines) + 1] == ["#version 330 core", *defines]
        assert {f"#define ALPHA_CUT {ALPHA_CUT}", "#define LAYER_STORAGE 2"} <= set(defines)
        assert not any(line.startswith("#include") for line in lines)


def test_faces_are_those_of_the_cubemap():
    text = (FOLDER / "faces.glsl").read_text("utf-8")
    block = text[text.index("FACES[6]") : text.index("int face_of")]
    matrices = re.findall(r"mat3\(([-\d, ]+)\)", block)
    columns = torch.tensor([[float(number) for number in each.split(",")] for each in matrices])
    assert torch.equal(columns.reshape(6, 3, 3).transpose(1, 2), face_rotations(dtype=torch.float32))


@pytest.mark.gl
def test_every_program_compiles_once(ctx):
    programs = Programs(ctx)
    compiled = [programs.project(), programs.splat(), programs.resolve()]
    compiled += [programs.present(), *(programs.accumulate(storage) for storage in range(3))]
    assert len({program.glo for program in compiled}) == 7
    assert programs.accumulate(1) is programs.accumulate(1)
    programs.release()


def test_qualifiers_of_layouts_are_signed_literals():
    """GLSL 3.30 has no other integers there; expressions and unsigned literals came with 4.40."""
    sources = []

    def compile_program(*stages, **options):
        sources.extend([*stages, *(text for name, text in options.items() if name.endswith("_shader"))])
        return SimpleNamespace()

    programs = Programs(SimpleNamespace(program=compile_program))
    for build in (programs.project, programs.splat, programs.resolve, programs.arrange, programs.present):
        build()
    programs.accumulate(0)
    values = []
    for source in sources:
        defines = dict(re.findall(r"^#define (\w+) (.*)$", source, re.MULTILINE))
        for qualifiers in re.findall(r"^layout\(([^)]*)\)", source, re.MULTILINE):
            values += [defines.get(value, value) for value in re.findall(r"= *([^,]+)", qualifiers)]
    assert len(sources) == 11 and len(values) > 5
    assert all(re.fullmatch(r"\d+", value) for value in values), values
