"""Run docs/notebook.ipynb and write it with its outputs: `python .ci/tools/run_notebook.py [FILE]`, default: in place.

The frames of scenes are left out of the file; programs show the pictures beside them until the cells are run.
"""

import asyncio
import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOK = ROOT / "docs" / "notebook.ipynb"
CELL_SECONDS = 300  # limit of a cell


def run_notebook(out: Path) -> None:
    """Execute all cells in the folder of the notebook and write the result."""
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    client = NotebookClient(
        notebook, timeout=CELL_SECONDS, kernel_name="python3", resources={"metadata": {"path": str(NOTEBOOK.parent)}}
    )
    asyncio.run(client.async_execute())
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)  # times
        outputs = cell.get("outputs", [])
        for output in outputs:
            output.pop("transient", None)
            if "iframe" in output.get("data", {}).get("text/html", ""):
                del output["data"]["text/html"]
        cell_outputs = [output for output in outputs if output.get("data", {}).get("text/html") != ""]
        if cell.cell_type == "code":
            cell["outputs"] = cell_outputs
    notebook.metadata = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    nbformat.write(notebook, out)


if __name__ == "__main__":
    run_notebook(Path(sys.argv[1]) if len(sys.argv) > 1 else NOTEBOOK)
