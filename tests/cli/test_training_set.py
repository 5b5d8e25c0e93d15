"""`pansplat export` to a folder, and that no export repeats the metadata of the photographs."""

from __future__ import annotations

import base64
import gzip
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image
from refusals import expect_error

from pansplat import pipeline
from pansplat.cli import run
from pansplat.inputs.folders import find_panorama_folders, load_panoramas, load_sets

OPTIONS = ["--model", "sphere", "--refine", "0", "--predict-height", "64"]


def test_a_folder_to_train_from_has_the_poses_and_gaussians_of_the_scene_where_the_poses_are(room, tmp_path, capsys):
    source, out, origin = room / "poses.json", tmp_path / "sets" / "room", (5e6, -4e5, 64.0)
    content = json.loads(source.read_text())
    for entry in content["poses"].values():
        for row, x in zip(entry["cam2world"], origin, strict=False):
            row[3] += x
    source.write_text(json.dumps(content))
    assert run(["export", str(room), "-o", str(out), "--training-set", *OPTIONS]) == 0
    scene = pipeline.predict(pipeline.load_sets(room)[0], "sphere", height=64, joint=True)
    assert f"12 cube faces of 2 panoramas, {len(scene.gaussians)} points" in capsys.readouterr().out
    names = ["images", "points.ply", "scale.txt", "sparse", "transforms.json"]
    assert sorted(path.name for path in out.iterdir()) == names
    lines = (out / "sparse/0/points3D.txt").read_text().splitlines()[1:]
    points = np.array([line.split()[1:4] for line in lines], float)
    expected = scene.frame.globalize_places(scene.gaussians.means)
    np.testing.assert_allclose(points, expected, rtol=0, atol=2e-3)
    _, body = (out / "points.ply").read_bytes().split(b"end_header\n")
    table = np.frombuffer(body, [("position", "<f8", 3), ("color", "u1", 3)])
    x, y, z = points.T
    np.testing.assert_allclose(table["position"], np.stack((x, z, -y), axis=1), rtol=0, atol=2e-3)  # z up
    (pair,) = pipeline.load_sets(out)
    for view, pose in zip(pair.context, scene.cam2world, strict=True):
        np.testing.assert_allclose(view.frame.globalize(view.cam2world), scene.frame.globalize(pose), rtol=0, atol=0.01)


def test_an_export_into_a_folder_of_photographs_does_not_hide_them(tmp_path, write_room, recwarn) -> None:
    room = write_room(tmp_path / "room", target=False)
    out = room / "exports" / "training_set"
    assert run(["export", str(room), "-o", str(out), "--training-set", *OPTIONS]) == 0
    for name in ("poses.json", "pairs.json"):
        (room / name).unlink()
    recwarn.clear()
    expect_error("needed poses", load_sets, room)
    assert [panorama.image for panorama in load_panoramas(room)] == [room / f"{n}.png" for n in "abc"]
    assert find_panorama_folders(tmp_path) == [room]
    for folder in (out, out.parent):
        images = [view.image for pair in load_sets(folder) for view in pair.context]
        assert images and all(out in image.parents for image in images), "alone, it is a scene"
    shutil.move(out, tmp_path / "set")
    assert find_panorama_folders(tmp_path) == [room]
    room.rename(tmp_path / ".room")
    assert find_panorama_folders(tmp_path) == [tmp_path / "set"]


def test_no_export_repeats_the_metadata_of_the_photographs(tmp_path: Path, write_room: Callable[..., Path]) -> None:
    room = write_room(tmp_path / "room", target=False)
    exif = Image.Exif()
    exif[0x010F] = "SECRET maker"
    gps = exif.get_ifd(0x8825)
    gps[1], gps[2], gps[29] = "N", (47.0, 22.0, 11.0), "SECRET date"
    content = json.loads((room / "poses.json").read_text())
    for name in ("a", "b"):
        with Image.open(room / f"{name}.png") as image:
            image.save(room / f"{name}.jpg", exif=exif, xmp=b"<x>SECRET packet</x>", comment=b"SECRET comment")
        (room / f"{name}.png").unlink()
        content["poses"][f"{name}.jpg"] = content["poses"].pop(f"{name}.png")
    del content["poses"]["c.png"]
    (room / "c.png").unlink()
    (room / "pairs.json").unlink()
    (room / "poses.json").write_text(json.dumps(content))
    out = tmp_path / "out"
    out.mkdir()
    options = ["--model", "sphere", "--height", "64", "--refine", "0"]
    assert run(["predict", str(room), "-o", str(out / "s.ply"), *options]) == 0
    for name in ("s.glb", "s.spz", "s.html", "page", "set"):
        kind = ["--training-set"] if name == "set" else []
        source = out / "s.ply" if name in ("s.glb", "s.spz") else room
        options = OPTIONS if source == room else []
        assert run(["export", str(source), "-o", str(out / name), *kind, *options]) == 0
    for name in ("r.png", "r.jpg", "r.webp", "r.exr", "r.mp4"):
        assert run(["render", str(out / "s.ply"), "-o", str(out / name), "--height", "32"]) == 0
    files = [path for path in sorted(out.rglob("*")) if path.is_file()]
    assert len(files) > 20
    for path in files:
        parts = [path.read_bytes()]
        for text in re.findall(rb"[A-Za-z0-9+/]{64,}={0,2}", parts[0]) if path.suffix in (".html", ".js") else ():
            parts.append(base64.b64decode(text + b"=" * (-len(text) % 4)))
        parts += [gzip.decompress(part) for part in parts if part.startswith(b"\x1f\x8b")]
        assert not any(b"SECRET" in part or str(tmp_path).encode() in part for part in parts), path
        if path.suffix in (".png", ".jpg", ".webp"):
            with Image.open(path) as image:
                assert not image.getexif()
    shutil.rmtree(out)
