"""No name is undefined. Ruff ignores F821: dimensions in the strings of jaxtyping annotations are no names."""

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("pansplat", "viewer", "tests", "assets")

pytestmark = pytest.mark.lint


def find_undefined_names(*folders: Path) -> list[str]:
    """The undefined names in Python files, outside of strings."""
    command = ["check", "--isolated", "--select", "F821", "--output-format", "json", *map(str, folders)]
    done = subprocess.run([Path(sys.executable).with_name("ruff"), *command], capture_output=True, text=True)
    found = []
    for row in json.loads(done.stdout):
        place = (row["location"]["row"], row["location"]["column"] - 1)
        nodes = ast.walk(ast.parse(Path(row["filename"]).read_text()))
        strings = [node for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)]
        spans = [((s.lineno, s.col_offset), (s.end_lineno, s.end_col_offset)) for s in strings]
        if not any(start <= place < end for start, end in spans):
            found.append(f"{row['filename']}:{place[0]}: {row['message']}")
    return found


def test_no_name_is_undefined() -> None:
    assert not find_undefined_names(*(ROOT / folder for folder in FOLDERS))


def test_an_undefined_name_is_found(tmp_path: Path) -> None:
    lines = ["from jaxtyping import Float", "def f(x: 'Float[Tensor, \"n\"]') -> None: ...", "print(number)"]
    (tmp_path / "module.py").write_text("\n".join(lines))
    (line,) = find_undefined_names(tmp_path)
    assert "`number`" in line
