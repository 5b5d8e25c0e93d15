"""Memory and errors of calls; rows that a run prints and writes, though it is interrupted."""

import json
import math
import subprocess
import sys

import pytest
import torch
from matplotlib.figure import Figure

from pansplat.bench import harness
from pansplat.bench.harness import Suite, announce, compare_images
from pansplat.evaluation.results import Column, Row
from pansplat.system.files import is_written

CPU = torch.device("cpu")


@pytest.mark.skipif(sys.platform != "linux", reason="the high-water mark is Linux's")
def test_peak_memory_is_the_memory_that_the_call_holds_at_once():
    # In a process of its own: a kernel may take back pages that this one has not used for minutes.
    program = """
import numpy as np, torch
from pansplat.bench.harness import measure_peak_memory
before = np.ones(50_000_000, np.uint8)  # held during the call
hold = lambda: sum(map(np.sum, [np.ones(10_000_000, np.uint8) for _ in range(6)]))
print(*measure_peak_memory(hold, torch.device("cpu"))[0].values(), hold(), len(before))
"""
    output = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True, encoding="utf-8").stdout
    peak, total, _ = map(float, output.split())
    assert total == 60_000_000 and 58 <= peak <= 80  # other threads may allocate a little


def test_one_wrong_pixel_sets_the_largest_error_and_the_psnr():
    reference = torch.rand(3, 8, 16, generator=torch.Generator().manual_seed(0))
    wrong = reference.clone()
    wrong[1, 5, 2] += 0.25
    assert compare_images(reference, reference) == {"psnr_db": math.inf, "max_error": 0}
    expected = -10 * math.log10(0.25**2 / reference.numel())
    assert compare_images(wrong, reference) == pytest.approx({"psnr_db": expected, "max_error": 0.25}, rel=1e-5)


def test_an_interrupted_run_is_printed_and_written_and_one_without_rows_writes_nothing(tmp_path, capsys):
    suite = Suite(
        "speed",
        (Column("height", "height", "d"), Column("seconds", "seconds", ".1f")),
        lambda row: f"room: {row.get('height')}",
        lambda rows, header: Figure(),
        lambda rows: [f"{len(rows)} rows."],
    )

    def measure():
        announce("the first row")
        row = Row({"height": 16}, {"seconds": 2.0})
        yield row
        row.values["seconds"] = math.inf  # measured again
        yield row
        raise KeyboardInterrupt

    assert harness.run(suite, [], {}, out=tmp_path) == [] and not list(tmp_path.iterdir())
    with pytest.raises(KeyboardInterrupt):
        harness.run(suite, measure(), {"setting": "small"}, out=tmp_path)
    content = json.loads((tmp_path / "speed.json").read_text())
    assert content["rows"] == [{"height": 16, "seconds": None}] and content["setting"] == "small"
    assert (tmp_path / "speed.md").read_text().splitlines()[1:] == [
        *("* 1 rows.", "", "### Room: 16", ""),
        *("| height | seconds |", "| ---: | ---: |", "| 16 | exact |"),
    ]
    names = ["speed.json", "speed.md", "speed.png"]
    assert all(is_written(tmp_path / name) for name in names)
    printed, steps = capsys.readouterr()
    assert "GPU: none" in printed and "room: 16" in printed and steps.startswith("the first row\n")
    assert printed.split()[-3:] == [str(tmp_path / name) for name in names]
