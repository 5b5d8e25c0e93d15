"""The paper's evaluations: their sets, metrics and reports, and messages for missing data."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from synthetic_scenes import approx_of_8_bits

from pansplat.errors import InputError
from pansplat.evaluation.metrics import ws_psnr
from pansplat.evaluation.protocol import (
    ProtocolOptions,
    find_loc360_set,
    find_sets,
    list_methods,
    run_protocol,
)
from pansplat.evaluation.results import markdown_table
from pansplat.evaluation.tables import read_paper_tables, report_notes, rich_tables, write_report
from pansplat.model.network import NetworkPredictor

HEIGHT = 32
OPTIONS = ProtocolOptions(HEIGHT, pairs_per_sequence=3)
RADIUS = 2.0  # metres


class Network(NetworkPredictor):
    """A sphere as a network with depths from coarse to fine; only the finest is right."""

    name, fingerprint = "network", "1"

    def __init__(self, sphere) -> None:
        self.sphere = sphere

    def __call__(self, images, cam2world, near, far, *, masks=None):
        return self.sphere(images, cam2world, near, far)

    def predict_with_depths(self, images, cam2world, near, far, *, masks=None):
        depths = [torch.full((len(images), rows, 2 * rows), metres) for rows, metres in ((4, 9.0), (8, RADIUS))]
        return self(images, cam2world, near, far), depths


def write_panorama(path: Path, seed: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    blocks = np.random.default_rng(seed).integers(0, 255, (HEIGHT // 4, HEIGHT // 2, 3), dtype=np.uint8)
    Image.fromarray(blocks.repeat(4, 0).repeat(4, 1)).save(path)


def write_triplets(root: Path, kind: str, *, scenes: int = 2, depth_metres: float | None = None) -> Path:
    """PanoGRF's layout: `scenes` triplets half a metre apart."""
    folder = root / f"png_render_test_1024x512_seq_len_3_{kind}"
    for scene in range(scenes):
        for view in range(3):
            place = folder / f"{scene:08d}" / f"{view:02d}"
            write_panorama(place / "rgb.png", 10 * scene + view)
            np.savetxt(place / "rot.txt", np.eye(3))
            np.savetxt(place / "tran.txt", [0.5 * view, 0, 0])
            if depth_metres is not None:
                millimetres = np.full((HEIGHT, 2 * HEIGHT), round(1000 * depth_metres), np.uint16)
                Image.fromarray(millimetres).save(place / "depth.png")
    return folder


def write_loc360(root: Path, frames: int = 7) -> Path:
    folder = root / "atrium" / "mapping" / "daytime_360_0"
    poses = {}
    for frame in range(frames):
        write_panorama(folder / "image" / f"{frame:04d}.png", frame)
        pose = np.eye(4)
        pose[0, 3] = 0.2 * frame
        poses[f"{frame:04d}.png"] = pose.tolist()
    (folder / "camera_pose.json").write_text(json.dumps(poses))
    return folder


@pytest.fixture
def methods(sphere_predictor):
    """The methods of a predictor of Gaussians on a sphere of 2 m around each camera."""
    return lambda protocol="m3d": list_methods(sphere_predictor(), protocol)


def test_the_papers_values_are_plausible_and_the_sets_of_a_protocol_are_those_of_its_table(
    tmp_path: Path,
) -> None:
    ranges = {"psnr": (10, 40), "ws_psnr": (10, 40)}
    tables = read_paper_tables()
    for protocol, table in tables.items():
        if protocol != "depth":
            assert tuple(found.name for found in find_sets(protocol, tmp_path, OPTIONS)) == table.sets
        for row in table.rows:
            assert set(row.values) <= {column.value for column in table.columns}
            for name, value in row.values.items():
                low, high = ranges.get(name.split()[-1], (0, 1))
                assert low < value < high, (row.get("method"), name)
    page = markdown_table("", tables["narrow"].columns, tables["narrow"].rows)
    assert "| PanSplat | 32.88 | - | - | 31.42 | - | - |" in page


def test_missing_data_and_a_missing_root_are_named(tmp_path: Path, methods) -> None:
    with pytest.raises(InputError) as error:
        run_protocol("m3d", tmp_path, methods(), tmp_path / "out", options=OPTIONS)
    for distance in ("0.5", "0.75", "1.0"):
        folder = f"png_render_test_1024x512_seq_len_3_m3d_dist_{distance}"
        assert str(tmp_path / "pano_grf" / folder) in str(error.value)
    with pytest.raises(InputError, match=r"360Loc: needed .*atrium"):
        run_protocol("360loc", tmp_path, methods(), tmp_path / "out", options=OPTIONS)
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="needed the folder that holds the test data"):
        find_sets("m3d", tmp_path / "nowhere", OPTIONS)


@pytest.mark.parametrize("inside", [".", "pano_grf", "datasets/pano_grf"])
def test_data_is_found_in_the_official_folders(tmp_path: Path, inside: str) -> None:
    write_triplets(tmp_path / inside, "residential_dist_0.15", scenes=1)
    (found,) = find_sets("residential", tmp_path, OPTIONS)
    assert [case.name for case in found.cases] == ["00000000"]
    (larger,) = find_sets("residential", tmp_path, ProtocolOptions(height=1024))
    assert not larger.cases and "png_render_test_2048x1024_seq_len_3_residential_dist_0.15" in larger.missing


def test_pairs_of_a_sequence_are_spread_evenly(tmp_path: Path) -> None:
    """docs/official.md, section 2.5: the inputs of 360Loc are three frames apart."""
    write_loc360(tmp_path, frames=7)
    found = find_loc360_set(tmp_path, pairs_per_sequence=3)
    names = [case.name[-13:] for case in found.cases]
    assert names == ["000000-000003", "000001-000004", "000003-000006"]
    sample = found.cases[1].read(HEIGHT)
    assert sample.context.names == ("0001", "0004")
    assert sample.targets.names == ("0001", "0002", "0003", "0004")


def test_the_value_of_a_set_is_the_mean_over_its_images_which_are_written(tmp_path: Path, methods) -> None:
    write_loc360(tmp_path)
    result = run_protocol("360loc", tmp_path, methods("360loc"), tmp_path / "out", options=OPTIONS)
    (row,) = result.means()
    assert len(result.rows) == 3 * 4
    assert row.get("ws_psnr") == pytest.approx(sum(score.get("ws_psnr") for score in result.rows) / 12)
    first, *_ = sorted((tmp_path / "out").rglob("*_target.png"))
    (drawn,) = first.parent.glob(f"{first.name[:5]}*blending.png")
    target, rendered = (
        torch.from_numpy(np.array(Image.open(path)) / np.float32(255)).permute(2, 0, 1) for path in (first, drawn)
    )
    assert result.rows[0].get("ws_psnr") == approx_of_8_bits(ws_psnr(rendered, target))
    stored = json.loads((tmp_path / "out" / "results.json").read_text())
    assert stored["results"][0]["ws_psnr"] == pytest.approx(row.get("ws_psnr"))
    assert stored["results"][0]["images"] == 12 and stored["protocol"] == "360loc"


def test_methods_with_the_same_predictor_share_its_prediction(tmp_path: Path, sphere_predictor) -> None:
    write_loc360(tmp_path)
    predictor = sphere_predictor()
    both = [*list_methods(predictor, "360loc", "joint"), *list_methods(predictor, "360loc", "deferred")]
    result = run_protocol("360loc", tmp_path, both, tmp_path / "out", options=OPTIONS)
    assert predictor.calls == 1 + 3  # one for the warm-up
    network = Network(predictor)
    assert [method.blend for method in list_methods(network, "m3d")] == ["joint"]
    assert [method.blend for method in list_methods(network, "360loc")] == ["joint", "deferred"], "of real scenes"
    joint, deferred = result.means()
    assert joint.get("ws_psnr") != deferred.get("ws_psnr") and joint.get("images") == deferred.get("images") == 12


def test_the_true_depth_has_no_error(tmp_path: Path, methods, sphere_predictor) -> None:
    """The Gaussians lie on a sphere around each input: the rendered depth is its radius."""
    write_triplets(tmp_path, "m3d_dist_0.5", scenes=1, depth_metres=RADIUS)
    write_triplets(tmp_path, "m3d_dist_1.0", scenes=1, depth_metres=RADIUS)
    result = run_protocol("m3d", tmp_path, methods(), tmp_path / "out", options=OPTIONS)
    finest = run_protocol("m3d", tmp_path, list_methods(Network(sphere_predictor()), "m3d"), tmp_path, options=OPTIONS)
    assert finest.means()[0].get("rmse") == pytest.approx(0, abs=1e-6), "of the levels of a network"
    near, far = result.means()
    assert near.get("abs_rel") == pytest.approx(0, abs=0.01) and near.get("rmse") == pytest.approx(0, abs=0.02)
    assert far.get("abs_rel") is None  # the paper's code measures depth at 1.0 m only
    assert len(rich_tables(result)) == 2


def test_unreadable_cases_are_skipped_and_named_unless_all_are_unreadable(tmp_path: Path, methods) -> None:
    folder = write_triplets(tmp_path, "replica_dist_0.5", scenes=2)
    (folder / "00000001" / "02" / "tran.txt").unlink()
    result = run_protocol("replica", tmp_path, methods(), tmp_path / "out", options=OPTIONS)
    assert len(result.rows) == 1
    (line,) = result.skipped
    assert line.startswith("Replica 1.0 m, 00000001: ") and "tran.txt" in line
    assert any(line in note for note in report_notes(result))
    assert json.loads((tmp_path / "out" / "results.json").read_text())["skipped"] == [line]
    (folder / "00000000" / "02" / "tran.txt").unlink()
    with pytest.raises(InputError, match=r"none of the 2 cases can be used.*tran\.txt"):
        run_protocol("replica", tmp_path, methods(), tmp_path / "out", options=OPTIONS)


def test_limited_cases_are_spread_over_the_set(tmp_path: Path, methods) -> None:
    write_triplets(tmp_path, "replica_dist_0.5", scenes=5)
    options = ProtocolOptions(HEIGHT, limit=3, image_cases=1)
    result = run_protocol("replica", tmp_path, methods(), tmp_path / "out", options=options)
    assert [row.get("case") for row in result.rows] == ["00000000", "00000002", "00000004"]
    assert [path.name for path in (tmp_path / "out" / "replica_1.0_m").iterdir()] == ["00000000"]


def test_the_report_has_the_papers_rows_ours_and_the_missing_sets(tmp_path: Path, methods) -> None:
    write_triplets(tmp_path, "m3d_dist_0.5", scenes=1)
    result = run_protocol("m3d", tmp_path, methods(), tmp_path / "out", options=OPTIONS)
    path = write_report(result, tmp_path / "out")
    page = path.read_text()
    assert "| PanoGRF | 27.12 |" in page and "**ours, sphere + deferred blending**" in page
    assert f"**{result.means()[0].get('ws_psnr'):.2f}**" in page
    assert "m3d_dist_0.75" in page and "m3d_dist_1.0" in page and "M3D 1.0 m: 1 image" in page
    assert f"{HEIGHT}x{2 * HEIGHT}" in page


@pytest.mark.shared
def test_the_official_sample_is_a_case_of_m3d(shared: Path) -> None:
    found = find_sets("m3d", shared / "data" / "mp3d_sample", ProtocolOptions())
    assert [len(s.cases) for s in found] == [1, 0, 0]
    sample = found[0].cases[0].read(64)
    assert sample.name == "00000007" and sample.targets.names == ("01",) and sample.context.depths is not None
    centres = sample.context.cam2world[:, :3, 3]
    assert float((centres[0] - centres[1]).norm()) == pytest.approx(1.0, abs=1e-3)
