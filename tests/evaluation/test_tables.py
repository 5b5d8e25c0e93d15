"""The paper's tables."""

import pytest

from pansplat.evaluation.results import markdown_table
from pansplat.evaluation.tables import PaperTable, read_paper_tables

TABLES = read_paper_tables()


def test_the_papers_rows_have_its_values() -> None:
    def value(protocol: str, method: str, name: str) -> float:
        (row,) = (row for row in TABLES[protocol].rows if row.get("method") == method)
        return row.values[name]

    assert value("m3d", "PanSplat", "M3D 1.0 m ws_psnr") == 28.81
    assert value("m3d", "PanSplat", "M3D 2.0 m lpips") == 0.265
    assert value("m3d", "PanoGRF", "M3D 1.5 m ssim") == 0.811
    assert value("narrow", "PanSplat", "M3D 0.5 m ws_psnr") == 31.42
    assert value("replica", "PanSplat", "Replica 1.0 m lpips") == 0.069
    assert value("residential", "PanoGRF", "Residential 0.3 m ws_psnr") == 31.03
    assert value("360loc", "PanSplat + deferred blending", "360Loc psnr") == 27.35
    assert value("insta360", "PanSplat + deferred blending", "Insta360 ws_psnr") == 25.68
    assert value("ablation", "Base", "M3D 1.0 m gaussians") == 1_049_000


@pytest.mark.parametrize("table", TABLES.values(), ids=TABLES)
def test_every_value_has_a_column_and_is_plausible(table: PaperTable) -> None:
    ranges = {"psnr": (10, 40), "ws_psnr": (10, 40), "gaussians": (1e5, 1e7)}
    names = {column.value for column in table.columns}
    for row in table.rows:
        assert set(row.values) <= names
        for name, value in row.values.items():
            low, high = ranges.get(name.split()[-1], (0, 1))
            assert low < value < high, (row.get("method"), name)


def test_numbers_of_gaussians_are_integers_and_missing_values_dashes() -> None:
    table = TABLES["ablation"]
    page = markdown_table(table.title, table.columns, table.rows)
    assert "| Base | 1,049,000 | 27.07 |" in page and "| without monocular depth | - | 28.84 | - | - |" in page
