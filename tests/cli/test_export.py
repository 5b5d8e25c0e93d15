"""`pansplat export`: files, refused arguments."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from synthetic_scenes import make_balls, place_cameras, see_box

from pansplat import pipeline
from pansplat.cli import export as export_module
from pansplat.cli import run
from pansplat.errors import InputError
from pansplat.export import page as page_module
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.geometry.world import WorldFrame
from pansplat.prediction_options import PredictOptions, ReadOptions
from pansplat.system.progress import show_progress
from pansplat_viewer.core.loader import find_entries


def test_a_scene_is_written_with_each_surface_once_or_as_it_is(scene, tmp_path, capsys, refusal) -> None:
    out = tmp_path / "out.ply"
    assert run(["export", str(scene), "-o", str(out), "--layers"]) == 0
    assert out.read_bytes() == scene.read_bytes()
    capsys.readouterr()
    assert run(["export", str(scene), "-o", str(out)]) == 0
    assert "each surface is kept once" in capsys.readouterr().err
    fused = pipeline.load(out)
    assert fused.joint and 100 < len(fused.gaussians) < 900
    assert "exported with --layers" in refusal("export", out, "-o", tmp_path / "plan.svg")
    assert run(["export", str(out), "-o", str(tmp_path / "again.ply")]) == 0
    assert capsys.readouterr().err == "" and (tmp_path / "again.ply").read_bytes() == out.read_bytes()


def test_exports_are_in_the_unit_and_at_the_place_of_the_poses(scene, tmp_path, capsys, refusal) -> None:
    frame = WorldFrame(1e3, (64e5, 0, 0))
    metres, given, points = pipeline.load(scene), tmp_path / "given.ply", tmp_path / "points.ply"
    pipeline.save(dataclasses.replace(metres, frame=frame), given)
    assert run(["export", str(given), "-o", str(points), "--points", "--layers"]) == 0
    header, body = points.read_bytes().split(b"end_header\n")
    assert b"property double x" in header, "an origin needs float64"
    table = np.frombuffer(body, [("position", "<f8", 3), ("color", "u1", 3)])
    colors = 255 * (0.5 + 0.28209479 * metres.gaussians.harmonics[:, 0].numpy())
    assert np.abs(table["color"] - colors.clip(0, 255)).max() <= 0.51
    expected = frame.globalize_places(metres.gaussians.means)
    assert np.allclose(table["position"], expected, rtol=0, atol=1e-6 * frame.unit)
    corners = frame.globalize_places(torch.tensor(((-9.0, -9, -9), (0.5, 9, 9)))).flatten().tolist()
    assert run(["export", str(given), "-o", str(points), "--layers", "--crop", *map(str, corners)]) == 0
    assert run(["export", str(scene), "-o", str(scene), "--layers", "--crop", *["-9"] * 3, "0.5", "9", "9"]) == 0
    left_out = r"crop: \d+ of 1,024 Gaussians left out, and 1 of 2 cameras\n"
    assert len(re.findall(left_out, capsys.readouterr().out)) == 2
    part, cropped = pipeline.load(points), pipeline.load(scene)
    assert part.names == ("a",) and len(part.gaussians) == len(cropped.gaussians) and part.frame == frame
    x = 50 * frame.unit + frame.origin[0]
    message = refusal("export", given, "-o", points, "--layers", "--crop", x, 0, 0, x + 1, 1, 1)
    assert f"got ({x:.2f}, 0.00, 0.00) to ({x + 1:.2f}, 1.00, 1.00) m and a scene from" in message
    assert run(["info", str(given)]) == 0
    shown = capsys.readouterr().out
    assert f"near {0.45 * frame.unit:g} m" in shown and "origin          at (" in shown
    assert run(["export", str(given), "-o", str(tmp_path / "scene.splat"), "--layers"]) == 0
    assert "positions are relative to (" in capsys.readouterr().err


@pytest.mark.parametrize("suffix", [".sog", ".glb"])
def test_every_format_is_described_and_opened(scene, tmp_path, suffix: str, capsys) -> None:
    out = tmp_path / f"out{suffix}"
    assert run(["export", str(scene), "-o", str(out), "--layers"]) == 0
    assert run(["info", str(out)]) == 0
    assert "1,024 Gaussians, SH degree 0" in capsys.readouterr().out
    (entry,) = find_entries(out, ReadOptions(), PredictOptions())
    assert entry.file == out


def test_a_page_of_panoramas_shows_them_and_a_crop_does_not(tmp_path, write_tour, refusal, capsys) -> None:
    house, out = write_tour(tmp_path / "house", height=64), tmp_path / "tour"
    command = ["export", str(house), "--model", "sphere", "--refine", "0", "--predict-height", "64", "-o"]
    for _ in range(2):  # a page of ours is replaced
        assert run([*command, str(out)]) == 0
    printed = capsys.readouterr()
    assert f"{out / 'index.html'} and 22 files in index_files/" in printed.out
    assert "a tour of 3 panoramas" in printed.err
    assert "3 photographs of 64 rows" in printed.out and '"folder": "index_files"' in (out / "index.html").read_text()
    assert '"edges": [[0, 1, 0], [1, 2, 1]]' in (out / "index.html").read_text()
    for options in (["--photo-height", "0"], ["--crop", "-9", "-9", "-9", "9", "9", "9"]):
        assert run([*command, str(tmp_path / "page.html"), *options]) == 0
        assert '"photographs": []' in (tmp_path / "page.html").read_text()
    assert "without photographs, which would show what is left out" in capsys.readouterr().err
    (out / "index.html").write_text("mine")
    assert "index.html" in refusal(*command, out), "a page of another program stays"
    assert "needed a scene file" in refusal(*command, tmp_path / "house.glb"), "predict makes scenes"


@pytest.mark.parametrize(("stated", "title"), [({"title": "Our <home>"}, "Our &lt;home&gt;"), ({}, "Villa St. Moritz")])
def test_the_page_of_a_web_tour_has_its_title_or_the_name_of_its_folder(stated, title, tmp_path, write_tour) -> None:
    (image,) = list(write_tour(tmp_path / "Villa_St._Moritz", height=64).glob("*0.png"))[:1]
    note = {"type": "info", "text": "a lamp"}
    tour, out = image.parent / "tour.json", tmp_path / "out.html"
    tour.write_text(json.dumps({**stated, "scenes": {"hall": {"panorama": image.name, "hotSpots": [note]}}}))
    options = ["--model", "sphere", "--refine", "0", "--predict-height", "64", "--photo-height", "0"]
    assert run(["export", str(tour), "-o", str(out), *options]) == 0
    assert f"<title>{title}</title>" in out.read_text() and '"text": "a lamp"' in out.read_text()
    assert run(["export", str(tour), "-o", str(out), *options, "--title", "Our home"]) == 0
    assert "<title>Our home</title>" in out.read_text()


def test_a_pair_is_merged_to_the_limit_of_its_page_before_its_refinement(tmp_path, write_tour, capsys, monkeypatch):
    monkeypatch.setattr(page_module, "merge", None)  # must not be called
    command = ["export", str(write_tour(tmp_path / "house", height=64)), "--model", "sphere", "--refine", "2"]
    out = tmp_path / "page.html"
    assert run([*command, "--predict-height", "64", "--pair", "2", "--gaussians", "2000", "-o", str(out)]) == 0
    count = int(capsys.readouterr().out.split(": ")[1].split(" Gaussians")[0].replace(",", ""))
    assert 1000 < count <= 2000


def test_photographs_without_a_pose_are_in_the_page_of_a_folder(tmp_path, write_tour, capsys, monkeypatch) -> None:
    monkeypatch.setattr(export_module, "_MIN_GAUSSIANS", 300_000)
    first, second = pipeline.load_sets(write_tour(tmp_path / "house", height=64))
    alone = dataclasses.replace(second.context[1], world=1, title="Attic")
    single = dataclasses.replace(second, context=(alone,))
    command = ["export", str(tmp_path / "house"), "--model", "sphere", "--refine", "0", "--predict-height", "64", "-o"]
    for name, pairs, note in (
        ("house", [first, single], "3 panoramas (2 placed, 1 not placed"),
        ("photo", [single], ""),
    ):
        monkeypatch.setattr(pipeline, "load_sets", lambda *args, pairs=pairs, **options: pairs)
        assert run([*command, str(tmp_path / f"{name}.html")]) == 0
        printed = capsys.readouterr().err
        assert note in printed and ("--gaussians 60000 shows more" in printed) == (name == "house")
    assert '"parts": [0, 0, 1]' in (page := (tmp_path / "house.html").read_text()) and '"name": "Attic"' in page
    assert '"groups": [[0]]' in (tmp_path / "photo.html").read_text()


def test_a_plan_states_rooms_and_uncertainty(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A room of 4 x 6 x 2.6 m."""
    low, high, here = torch.tensor((-2.0, -2.6, -3.0)), torch.tensor((2.0, 0.0, 3.0)), (0.3, -1.5, 0.2)
    gaussians = make_balls(see_box(low, high, torch.tensor(here), 20000), 0.02, 1.0)
    scene = tmp_path / "scene.ply"
    pipeline.save(Scene(gaussians, place_cameras(here), 0.5, 10.0, names=("Kitchen",)), scene)
    assert run(["export", str(scene), "-o", str(tmp_path / "plan.svg")]) == 0
    printed = capsys.readouterr().out
    assert "plan.svg: 1 room, 24.0 m² between the walls; scale: cameras 1.50 m over the floor" in printed
    assert "walls: of one panorama each" in printed
    assert ">Kitchen</text>" in (tmp_path / "plan.svg").read_text()


def test_a_plan_is_of_a_scene_that_is_not_refined_unless_asked(room, tmp_path, monkeypatch) -> None:
    steps = []

    def predict(source, *, options: PredictOptions) -> Scene:
        steps.append(options.refine_steps)
        raise InputError("enough")

    monkeypatch.setattr(pipeline, "predict", predict)
    for name, *stated in (("plan.svg",), ("refined.svg", "--refine", "3"), ("page.html",)):
        assert run(["export", str(room), "-o", str(tmp_path / name), *stated]) == 2
    assert steps == [0, 3, None]


def test_floaters_are_left_out_and_counted(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clean = pipeline.load(scene)
    added = dataclasses.replace(
        clean.gaussians.select(torch.arange(1)), means=torch.tensor([[0.2, 0.1, 0.7]]), scales=torch.full((1, 3), 0.03)
    )
    dirty = dataclasses.replace(clean, gaussians=Gaussians.cat([clean.gaussians, added]))
    pipeline.save(dirty, tmp_path / "dirty.ply")
    out = tmp_path / "out.ply"
    assert run(["export", str(tmp_path / "dirty.ply"), "-o", str(out), "--layers", "--remove-floaters"]) == 0
    assert "floaters: 1 of 1,025 Gaussians left out\n" in capsys.readouterr().out
    assert torch.equal(pipeline.load(out).gaussians.means, clean.gaussians.means)


def test_the_steps_of_a_command_are_stages_of_one_progress(room: Path, tmp_path: Path) -> None:
    calls: list[tuple[str, float]] = []
    arguments = ["--model", "sphere", "--predict-height", "64", "--refine", "1", "-o", str(tmp_path / "page.html")]
    with show_progress(lambda *call: calls.append(call)):
        assert run(["export", str(room), *arguments]) == 0
    steps = dict(reversed(calls))  # when each begins
    order = [steps[name] for name in ("predicting", "refining", "checking the scene", "compressing", "writing")]
    assert order == sorted(set(order)) and order[-1] < 1, "each begins after the one before"
