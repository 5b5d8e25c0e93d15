"""The documents: commands, calls, links and pose files of the README work; the notebook runs; sources are described."""

import base64
import io
import re
import shlex
import subprocess
import sys
from pathlib import Path

import cv2
import nbformat
import numpy as np
from PIL import Image

import pansplat
from pansplat.cli import _COMMANDS, parse

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text("utf-8")
BLOCKS = "\n".join(re.findall(r"^```\w*\n(.*?)^```", README, flags=re.DOTALL | re.MULTILINE))
COMMANDS = re.findall(r"^(?:\.venv/bin/)?pansplat (.+?)(?:\s+#.*)?$", BLOCKS, flags=re.MULTILINE)
COMMANDS += re.findall(r"`pansplat ([^`]+)`", README)  # those of the table
SHADERS = ROOT / "shaders"
NOTEBOOK = ROOT / "docs" / "notebook.ipynb"


def test_commands_of_the_readme_are_valid_and_all() -> None:
    for command in COMMANDS:
        assert type(parse(shlex.split(command))).__name__.lower() == command.split()[0]
    commands = "predict refine render export batch evaluate check info convert bench pose"
    assert {command.split()[0] for command in COMMANDS} == set(commands.split())


def test_calls_of_the_readme_exist() -> None:
    calls = set(re.findall(r"pansplat\.(\w+)\(", README))
    assert calls >= {"predict", "render", "load_model", "rasterize", "save", "load"} and calls <= set(pansplat.__all__)
    assert all(callable(getattr(pansplat, name)) for name in pansplat.__all__)
    pictures = re.findall(r"^(?:image|picture) = pansplat\.(\w+)\(.*\)\.color", README, re.MULTILINE)
    assert pictures == ["render", "rasterize"], "a tensor, not a `Rendering`"


def test_the_promise_names_every_command_and_public_name() -> None:
    _, _, commands, names, _ = re.split(
        r"^\*\*.*?\*\*", (ROOT / "docs/promise.md").read_text("utf-8"), flags=re.MULTILINE
    )
    assert set(_COMMANDS) <= set(re.findall(r"`([\w-]+)`", commands))
    assert set(re.findall(r"`(\w+)`", names)) == {"pansplat", *pansplat.__all__}


def test_links_of_the_readme_exist_and_lead_to_every_document() -> None:
    targets = re.findall(r"\]\(([^)#]+)\)", README) + re.findall(r'src="([^"]+)"', README)
    local = {target for target in targets if not target.startswith("http")}
    assert not [target for target in local if not (ROOT / target).exists()]
    assert {f"docs/{file.name}" for file in (ROOT / "docs").glob("*.md")} <= local


def test_tables_have_no_gaps_and_named_sections_exist() -> None:
    documents = [ROOT / "README.md", ROOT / "CHANGELOG.md", *(ROOT / "docs").rglob("*.md")]
    texts = {
        file: re.sub(r"^```.*?^```", "", file.read_text("utf-8"), flags=re.DOTALL | re.MULTILINE) for file in documents
    }
    headings = {file: re.findall(r"^#+ (.+)$", text, re.MULTILINE) for file, text in texts.items()}
    wrong = [
        f"{file.name}: {row}"
        for file, text in texts.items()
        for row in re.findall(r"^[^|\n].*\n(\|.*)", text, re.MULTILINE)
    ]
    cited = re.findall(r'\((\S+\.md), "(.+?)"\)', (ROOT / "Dockerfile").read_text("utf-8"))
    wrong += [f"{name}: {title}" for name, title in cited if title not in headings.get(ROOT / name, ())]
    for file, text in texts.items():
        for name, anchor in re.findall(r"\]\((?!http)([^)#]*)#([^)]+)\)", text):
            titles = headings[(file.parent / name).resolve() if name else file]
            if anchor not in {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}:
                wrong.append(f"{file.name}: {name}#{anchor}")
    assert cited and not wrong


def test_pose_files_of_the_readme_are_read(tmp_path: Path) -> None:
    (poses,) = re.findall(r"```json\n(.+?)```", README, flags=re.DOTALL)
    (tmp_path / "poses.json").write_text(poses)
    for name in ("left.jpg", "right.jpg"):
        cv2.imwrite(str(tmp_path / name), np.zeros((8, 16, 3), np.uint8))
    (pair,) = pansplat.load_sets(tmp_path)
    assert [panorama.image.name for panorama in pair.context] == ["left.jpg", "right.jpg"]
    assert (pair.near, pair.far) == (0.45, 10.0)


def test_the_two_commands_are_those_of_ci_and_setup() -> None:
    assert "bash setup.sh && .venv/bin/pansplat-view assets/living_room" in README
    assert "bash setup.sh --dev && .venv/bin/pytest" in README
    ci = (ROOT / ".ci" / "run").read_text()
    assert "bash setup.sh --dev" in ci and ".venv/bin/pytest" in ci
    assert "assets/living_room" in (ROOT / "setup.sh").read_text()


def test_the_architecture_names_every_module() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text("utf-8")
    rows = {names: row for row in text.splitlines() for names in re.findall(r"^\| `([a-z_/]+)/`", row)}
    missing = []
    for source in (*(ROOT / "pansplat").rglob("*.py"), *(ROOT / "viewer").rglob("*.py")):
        folder = source.relative_to(ROOT).parent.as_posix().removeprefix("pansplat/")
        parts = [row for name, row in rows.items() if folder == name or folder.startswith(f"{name}/")]
        described = "".join(parts) or (text if folder == "pansplat" else "")
        if source.name != "__init__.py" and not re.search(rf"\b{source.stem}\b", described):
            missing.append(source.relative_to(ROOT).as_posix())
    assert not missing


def test_the_readme_of_the_shaders_names_every_file_uniform_and_input():
    readme = (SHADERS / "README.md").read_text("utf-8")
    for name in sorted(path.name for path in SHADERS.iterdir() if path.suffix in (".glsl", ".vert", ".frag")):
        text = (SHADERS / name).read_text("utf-8")
        names = re.findall(r"^uniform (?:highp )?\w+ (\w+)", text, re.MULTILINE)
        if name.endswith(".vert"):
            names += re.findall(r"^in \w+ (\w+)", text, re.MULTILINE)
        missing = [each for each in (name, *names) if f"`{each}`" not in readme]
        assert not missing, f"{name}: {missing} not in shaders/README.md"


def test_only_one_module_decodes_pictures_of_users() -> None:
    decoders = re.compile(r"\bImage\.open\(|\bimread\(|\bimdecode\(")
    found = {
        file.relative_to(ROOT).as_posix()
        for part in ("pansplat", "viewer")
        for file in (ROOT / part).rglob("*.py")
        if decoders.search(file.read_text(encoding="utf-8"))
    }
    assert found == {"pansplat/images/image_files.py"}


def test_all_cells_of_the_notebook_run_and_show_the_stored_pictures(tmp_path: Path) -> None:
    out = tmp_path / "notebook.ipynb"
    command = [sys.executable, str(Path(__file__).with_name("run_notebook.py")), str(out)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    ran, stored = (
        [
            (cell.source, [set(output.get("data", {output.output_type: None})) for output in cell.outputs])
            for cell in nbformat.read(path, as_version=4).cells
            if cell.cell_type == "code"
        ]
        for path in (out, NOTEBOOK)
    )
    assert ran == stored, f"run {' '.join(command[:2])} to store new outputs"
    assert NOTEBOOK.stat().st_size < 1_000_000 and "tensor(" not in NOTEBOOK.read_text("utf-8")
    cells = nbformat.read(NOTEBOOK, as_version=4).cells
    outputs = [output for cell in cells for output in cell.get("outputs", [])]
    assert not [output for output in outputs if output.get("name") == "stderr"]
    pictures = [output.data["image/jpeg"] for output in outputs if "image/jpeg" in output.get("data", {})]
    assert len(pictures) >= 5
    for picture in pictures:
        with Image.open(io.BytesIO(base64.b64decode(picture))) as image:
            assert image.width >= 512 and image.convert("L").getextrema()[1] > 128
