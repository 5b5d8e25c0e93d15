"""`pansplat predict`: the written scene, the chosen pair, refused arguments."""

from pathlib import Path

import pytest

from pansplat import pipeline
from pansplat.cli import run


def test_predict_writes_the_scene(scene: Path) -> None:
    loaded = pipeline.load(scene)
    assert len(loaded.gaussians) == 2 * 2 * 16**2
    assert loaded.names == ("a", "b") and loaded.model == "sphere"


def test_predict_writes_the_format_of_the_suffix(room: Path, tmp_path: Path) -> None:
    command = ["predict", str(room), "--model", "sphere", "--height", "64", "-o"]
    assert run([*command, str(tmp_path / "scene.splat")]) == 0
    assert (tmp_path / "scene.splat").stat().st_size == 32 * 2 * 2 * 16**2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["-o", "scene.obj"], "--out must end in .compressed.ply, .spz, .splat, .sog, .glb, .ply"),
        (["-o", "no/scene.ply"], "existing folder"),
        (["--model", "magic"], "must be one of default, sphere, sweep"),
        (["--near", "9", "--far", "3"], "0 < near < far"),
        (["--convention", "sideways"], "needed a known pose convention"),
        (["--precision", "bfloat16"], "`precision` is for networks, and sphere is not one"),
    ],
)
def test_invalid_arguments_are_refused_before_the_prediction(
    room: Path, tmp_path: Path, refusal, monkeypatch: pytest.MonkeyPatch, arguments: list[str], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert message in refusal("predict", room, "-o", "scene.ply", "--model", "sphere", *arguments)
    assert not list(tmp_path.glob("*.ply"))


def test_the_named_pair_of_a_folder_is_predicted_or_the_first(tmp_path: Path, write_room, refusal, capsys) -> None:
    for name in ("hall", "kitchen"):
        write_room(tmp_path / "pairs" / name)
    start = ["predict", str(tmp_path / "pairs"), "-o", str(tmp_path / "s.ply"), "--model", "sphere", "--height", "64"]
    assert run(start) == 0
    assert "holds 2 pairs, using the first (--pair takes: 1: hall, 2: kitchen)" in capsys.readouterr().err
    for choice in ("kitchen", "2"):
        assert run([*start, "--pair", choice]) == 0
        assert capsys.readouterr().err == ""
    assert "holds 1: hall, 2: kitchen" in refusal(*start, "--pair", "attic")
