"""The notebook of the documents runs, and its stored outputs are those of its cells."""

import base64
import io
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import nbformat
import pytest
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOK = ROOT / "docs" / "notebook.ipynb"
MAX_BYTES = 1_000_000


def list_outputs(notebook: nbformat.NotebookNode) -> Iterator[tuple[str, list[set[str]]]]:
    """The source of each cell with code, and the types of its outputs."""
    for cell in notebook.cells:
        if cell.cell_type == "code":
            yield cell.source, [set(output.get("data", {output.output_type: None})) for output in cell.outputs]


def test_the_stored_notebook_has_pictures_without_warnings_and_is_small() -> None:
    assert NOTEBOOK.stat().st_size < MAX_BYTES
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    pictures = [output.data["image/jpeg"] for output in outputs if "image/jpeg" in output.get("data", {})]
    assert len(pictures) >= 5
    for picture in pictures:
        with Image.open(io.BytesIO(base64.b64decode(picture))) as image:
            assert image.width >= 512 and image.convert("L").getextrema()[1] > 128
    assert not [output for output in outputs if output.get("name") == "stderr"]
    assert "tensor(" not in NOTEBOOK.read_text() and " object at 0x" not in NOTEBOOK.read_text()


@pytest.mark.slow
def test_all_cells_run_and_show_what_is_stored(tmp_path: Path) -> None:
    out = tmp_path / "notebook.ipynb"
    command = [sys.executable, str(ROOT / "tests" / "run_notebook.py"), str(out)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    ran, stored = (nbformat.read(path, as_version=4) for path in (out, NOTEBOOK))
    assert list(list_outputs(ran)) == list(list_outputs(stored)), f"run {' '.join(command[:2])} to store new outputs"
