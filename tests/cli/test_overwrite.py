"""Files of the user are replaced with --overwrite only; those that pansplat wrote, always."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pansplat.cli import run
from pansplat.errors import InputError
from pansplat.evaluation.results import write_json
from pansplat.images.image_files import write_depth, write_image
from pansplat.images.video import write_video
from pansplat.system.files import is_written, require_replaceable

OWN = b"of the user"
SPHERE = ["--model", "sphere", "--refine", "0"]
EXPORT = ["export", *SPHERE, "--predict-height", "64"]
COMMANDS = {
    "scene.ply": ["predict", "{room}", *SPHERE, "--height", "64"],
    "again.ply": ["refine", "{room}", "--model", "sphere", "--height", "64", "--steps", "1"],
    "view.png": ["render", "{scene}", "--height", "16"],
    "film.mp4": ["render", "{scene}", "--height", "16", "--seconds", "0.1"],
    "scene.spz": ["export", "{scene}"],
    "points.ply": ["export", "{scene}", "--points"],
    "plan.png": [*EXPORT, "{room}"],
}


def write_own(file: Path) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(OWN)
    return file


@pytest.mark.parametrize("name", COMMANDS)
def test_a_file_of_the_user_needs_overwrite_and_our_own_does_not(room, scene, tmp_path, name: str, refusal) -> None:
    file = write_own(tmp_path / "out" / name)
    command = [part.format(room=room, scene=scene) for part in COMMANDS[name]]
    if name == "plan.png":  # the sphere of the predictor has no floor to draw
        write_image(file.with_name("ours.png"), np.zeros((9, 7, 3)))
        assert "--overwrite" in refusal(*command, "-o", file) and file.read_bytes() == OWN
        assert is_written(file.with_name("ours.png"))
        return
    assert f"--out: needed names of new files, got {file}" in refusal(*command, "-o", file)
    assert [path for path in file.parent.iterdir()] == [file] and file.read_bytes() == OWN
    assert run([*command, "-o", str(file), "--overwrite"]) == 0
    assert is_written(file)
    assert run([*command, "-o", str(file)]) == 0, "pansplat wrote it"


@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("report.jsonl", ["batch", "{room}", "--model", "sphere"]),
        ("results.json", ["evaluate", "{room}", "--model", "sphere"]),
        ("room/target.png", ["evaluate", "{room}", "--model", "sphere"]),
        ("raster.json", ["bench", "raster", "--quick"]),
    ],
)
def test_files_of_the_user_in_a_folder_need_overwrite(room, tmp_path, name: str, command: list[str], refusal) -> None:
    own = write_own(tmp_path / "out" / name)
    message = refusal(*(part.format(room=room) for part in command), "-o", tmp_path / "out")
    assert f"got {own}, which pansplat did not write; choose another name, or replace them with --overwrite" in message
    assert own.read_bytes() == OWN


def test_converted_weights_need_overwrite(tmp_path: Path, refusal: Callable[..., str]) -> None:
    command = ["convert", tmp_path / "official.ckpt", "-o", write_own(tmp_path / "model.safetensors")]
    assert "--overwrite" in refusal(*command)


def test_reports_and_pictures_of_all_kinds_are_marked(tmp_path: Path) -> None:
    grey = np.full((8, 16, 3), 0.5, np.float32)
    for suffix in (".png", ".jpg", ".webp", ".exr"):
        for panorama in (False, True):
            write_image(tmp_path / f"{panorama}{suffix}", grey, panorama=panorama)
    write_depth(tmp_path / "depth.png", grey[..., 0])
    write_json([{"a": 1}], tmp_path / "list.json")
    write_json({"a": 1}, tmp_path / "object.json")
    noise = np.random.default_rng(0).integers(0, 255, (3, 256, 512, 3), dtype=np.uint8)
    write_video(tmp_path / "film.mp4", noise, 8.0)  # longer than what is searched at each end
    files = list(tmp_path.iterdir())
    assert len(files) == 12 and all(map(is_written, files))


def test_other_files_are_not_taken_for_ours(tmp_path: Path) -> None:
    texts = ("", "notes on pansplat", '{"path": "/home/pansplat/a.jpg"}', "# I like pansplat", "software: other")
    for number, text in enumerate(texts):
        (tmp_path / f"{number}.txt").write_text(text)
    Image.new("RGB", (8, 4)).save(tmp_path / "p.png")
    assert not any(map(is_written, tmp_path.iterdir())) and not is_written(tmp_path / "missing")
    require_replaceable("--out", [tmp_path / "0.txt", tmp_path / "missing"])
    with pytest.raises(InputError, match=r"1\.txt, .*2\.txt, .*3\.txt and 1 more"):
        require_replaceable("--out", [tmp_path / f"{number}.txt" for number in range(5)])
