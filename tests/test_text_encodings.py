"""Text files are UTF-8 on every system: Windows would write and read them in a code page of the country."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("pansplat", "viewer")
# Position of the mode and of the encoding among the arguments; paths are arguments of functions only.
OPENERS = {"open": (1, 3), "TemporaryFile": (0, 2), "NamedTemporaryFile": (0, 2)}
RUNNERS = ("run", "Popen", "check_output")

pytestmark = pytest.mark.lint


def find_missing_encodings(text: str) -> Iterator[int]:
    """The lines of calls that read or write text without an encoding."""
    if not re.search(r"open\(|_text\(|TemporaryFile\(|text=|newlines=", text):
        return  # most modules; to parse them takes seconds
    for call in ast.walk(ast.parse(text)):
        if not isinstance(call, ast.Call):
            continue
        is_method = isinstance(call.func, ast.Attribute)
        name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
        options = {keyword.arg: keyword.value for keyword in call.keywords}
        if "encoding" in options:
            continue
        if name in ("read_text", "write_text") and is_method:
            missing = len(call.args) <= (name == "write_text")
        elif name in OPENERS and (not is_method or name != "open"):
            place, encoding = OPENERS[name]
            default = ast.Constant("r" if name == "open" else "w+b")
            mode = options.get("mode", call.args[place] if len(call.args) > place else default)
            missing = len(call.args) <= encoding and not (isinstance(mode, ast.Constant) and "b" in str(mode.value))
        else:
            missing = name in RUNNERS and bool({"text", "universal_newlines"} & options.keys())
        if missing:
            yield call.lineno


def test_every_text_file_has_an_encoding() -> None:
    files = [file for folder in FOLDERS for file in (ROOT / folder).rglob("*.py")]
    assert len(files) > 100
    missing = [f"{file}:{line}" for file in files for line in find_missing_encodings(file.read_text("utf-8"))]
    assert not missing


@pytest.mark.parametrize(
    "call",
    [
        "open(path)",
        "open(path, 'a', newline='')",
        "open(path, mode='w')",
        "path.read_text()",
        "f(x).write_text(text)",
        "NamedTemporaryFile('w')",
        "run(command, text=True)",
    ],
)
def test_a_missing_encoding_is_found(call: str) -> None:
    assert list(find_missing_encodings(call)) == [1]


def test_bytes_and_stated_encodings_are_fine() -> None:
    calls = ["open(path, 'rb')", "path.write_text(text, 'utf-8')", "path.read_text('utf-8')", "Image.open(path)"]
    calls += ["TemporaryFile()", "open(path, encoding='ascii')", "run(command, text=True, encoding='utf-8')"]
    assert not list(find_missing_encodings("\n".join(calls)))
