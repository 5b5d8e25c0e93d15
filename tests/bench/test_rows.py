"""The file of rows has the fields that were promised, and is whole at any moment."""

import json
import math

import pytest

from pansplat.bench.rows import Row, write_rows
from pansplat.errors import InputError

PROMISED = {
    "backend": str,
    "kernel": str,
    "order": str,
    "filter": str,
    "layout": str,
    "height": int,
    "num_gaussians": int,
    "threads": int,
    "forward_ms": float,
    "backward_ms": float,
    "peak_mb": float,
    "psnr_db": float,
    "max_error": float,
    "seam_jump": float,
}


@pytest.fixture
def row():
    return Row(
        suite="choices",
        scene="room",
        backend="torch",
        kernel="ray",
        order="radial",
        filter="angular",
        layout="equirect",
        height=16,
        face_size=None,
        stitching="seamless",
        precision="float32",
        num_gaussians=3,
        threads=1,
        forward_ms=1.0 / 3,
        backward_ms=2.0,
        peak_mb=1.5,
        psnr_db=30.0,
        max_error=0.1,
        seam_jump=0.0,
        stages_ms={"raster": 0.2},
    )


def test_rows_have_the_promised_fields(row, tmp_path):
    write_rows(tmp_path / "rows.json", {"cpu": "some"}, [row, row])
    content = json.loads((tmp_path / "rows.json").read_text())
    assert set(content) == {"machine", "rows"}
    assert content["machine"] == {"cpu": "some"}
    for written in content["rows"]:
        for name, kind in PROMISED.items():
            assert isinstance(written[name], kind), name


def test_what_is_not_measured_or_not_finite_is_null(row, tmp_path):
    row.psnr_db, row.backward_ms = math.inf, None
    row.stages_ms["sort"] = math.nan
    write_rows(tmp_path / "rows.json", {}, [row])
    (written,) = json.loads((tmp_path / "rows.json").read_text())["rows"]
    assert written["psnr_db"] is None and written["backward_ms"] is None and written["stages_ms"]["sort"] is None
    assert written["forward_ms"] == 0.333333


def test_a_failed_write_leaves_the_rows_of_before(row, tmp_path):
    file = tmp_path / "rows.json"
    write_rows(file, {}, [row])
    before = file.read_text()
    with pytest.raises(TypeError):
        write_rows(file, {"cpu": object()}, [row, row])
    assert file.read_text() == before
    assert list(tmp_path.iterdir()) == [file]


def test_a_folder_that_is_not_there_is_told(row, tmp_path):
    with pytest.raises(InputError, match="create it first"):
        write_rows(tmp_path / "no" / "rows.json", {}, [row])
