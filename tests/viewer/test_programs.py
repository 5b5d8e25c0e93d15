"""The GLSL sources: complete, documented, and agreeing with geometry/cubemap.py."""

import re
from importlib import resources

import pytest
import torch

from pansplat.geometry.cubemap import face_rotations
from pansplat_viewer.programs import Programs, source

FOLDER = resources.files("pansplat_viewer.shaders")
SOURCES = sorted(path.name for path in FOLDER.iterdir() if path.name.endswith((".glsl", ".vert", ".frag", ".comp")))


def test_readme_names_every_file_uniform_and_input():
    readme = (FOLDER / "README.md").read_text("utf-8")
    for name in SOURCES:
        text = (FOLDER / name).read_text("utf-8")
        names = re.findall(r"^uniform \w+ (\w+)", text, re.MULTILINE)
        if name.endswith(".vert"):
            names += re.findall(r"^in \w+ (\w+)", text, re.MULTILINE)
        missing = [each for each in (name, *names) if f"`{each}`" not in readme]
        assert not missing, f"{name}: {missing} not in shaders/README.md"


def test_includes_are_resolved_and_the_version_comes_first():
    for name in SOURCES:
        lines = source(name, 330, LAYER_STORAGE=2).splitlines()
        assert lines[0] == "#version 330 core" and "#define LAYER_STORAGE 2" in lines[1:8]
        assert f"#define ALPHA_CUT {1 / 255}" in lines[1:8]
        assert not any(line.startswith("#include") for line in lines)


def test_faces_are_those_of_the_cubemap():
    text = (FOLDER / "faces.glsl").read_text("utf-8")
    block = text[text.index("FACES[6]") : text.index("int face_of")]
    matrices = re.findall(r"mat3\(([-\d, ]+)\)", block)
    columns = torch.tensor([[float(number) for number in each.split(",")] for each in matrices])
    assert torch.equal(columns.reshape(6, 3, 3).transpose(1, 2), face_rotations(dtype=torch.float32))


@pytest.mark.gl
def test_every_program_compiles(ctx):
    programs = Programs(ctx)
    made = [programs.project(), programs.project_compute(), programs.splat(), programs.resolve()]
    made += [programs.accumulate(kept_as) for kept_as in range(3)]
    assert len({program.glo for program in made}) == 7
    assert programs.accumulate(1) is programs.accumulate(1)
    programs.release()
