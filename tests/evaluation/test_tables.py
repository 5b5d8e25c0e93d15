"""The paper's tables with our rows."""

import io

import pytest
from rich.console import Console

from pansplat.evaluation.tables import DEPTH_LAYOUT, LAYOUTS, TableRow, markdown_table, rich_table


def print_table(layout, ours) -> str:
    console = Console(width=160, record=True, file=io.StringIO())
    console.print(rich_table(layout, ours))
    return console.export_text()


def test_the_papers_rows_have_its_values() -> None:
    def value(protocol: str, method: str, name: str, metric: str) -> float:
        (row,) = (row for row in LAYOUTS[protocol].rows if row.method == method)
        return row.values[name, metric]

    assert value("m3d", "PanSplat", "M3D 1.0 m", "ws_psnr") == 28.81
    assert value("m3d", "PanSplat", "M3D 2.0 m", "lpips") == 0.265
    assert value("m3d", "PanoGRF", "M3D 1.5 m", "ssim") == 0.811
    assert value("narrow", "PanSplat", "M3D 0.5 m", "ws_psnr") == 31.42
    assert value("replica", "PanSplat", "Replica 1.0 m", "lpips") == 0.069
    assert value("residential", "PanoGRF", "Residential 0.3 m", "ws_psnr") == 31.03
    assert value("360loc", "PanSplat + deferred blending", "360Loc", "psnr") == 27.35
    assert value("insta360", "PanSplat + deferred blending", "Insta360", "ws_psnr") == 25.68
    assert value("ablation", "Base", "M3D 1.0 m", "gaussians") == 1_049_000


@pytest.mark.parametrize("layout", [*LAYOUTS.values(), DEPTH_LAYOUT])
def test_every_value_has_a_column_and_is_plausible(layout) -> None:
    ranges = {"psnr": (10, 40), "ws_psnr": (10, 40), "gaussians": (1e5, 1e7)}
    for row in layout.rows:
        assert set(row.values) <= set(layout.columns)
        for (_, metric), value in row.values.items():
            low, high = ranges.get(metric, (0, 1))
            assert low < value < high, (row.method, metric)


@pytest.mark.parametrize("text", [print_table, markdown_table])
def test_our_rows_are_last_and_missing_values_are_dashes(text) -> None:
    layout = LAYOUTS["m3d"]
    ours = TableRow("ours, sweep", {("M3D 1.0 m", "ws_psnr"): 21.5, ("M3D 1.0 m", "ssim"): 0.75})
    lines = [line for line in text(layout, [ours]).splitlines() if line.strip()]
    (place,) = (i for i, line in enumerate(lines) if "ours, sweep" in line)
    assert place > max(i for i, line in enumerate(lines) if "PanSplat" in line)
    cells = [word.strip("* ") for word in lines[place].replace("│", "|").split("|")]
    assert [cell for cell in cells if cell][1:] == ["21.50", "0.750"] + 7 * ["-"]


def test_numbers_of_gaussians_are_integers() -> None:
    assert "1,049,000" in markdown_table(LAYOUTS["ablation"], [])


def test_every_row_of_markdown_has_all_columns() -> None:
    for layout in LAYOUTS.values():
        rows = [line for line in markdown_table(layout, []).splitlines() if line.startswith("|")]
        assert {row.count("|") for row in rows} == {len(layout.columns) + 2}
