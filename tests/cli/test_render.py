"""`pansplat render`: images and videos of scenes and pairs, camera poses, refused arguments."""

import json
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from PIL import Image

from pansplat import pipeline
from pansplat.cli import run
from pansplat.geometry.equirect import rotate_equirect
from pansplat.geometry.level import level_axes
from pansplat.images.image_files import read_depth
from pansplat.rendering import Rendering
from pansplat.tours.graph import find_tours

HEIGHT = 64


def render(path: Path, out: Path, *arguments: object) -> np.ndarray:
    """Render and read an image."""
    assert run(["render", str(path), "-o", str(out), *map(str, arguments)]) == 0
    with Image.open(out) as image:
        return np.array(image).astype(int)


def test_a_scene_and_its_pair_give_the_same_image(scene: Path, room: Path, tmp_path: Path) -> None:
    first = render(scene, tmp_path / "a.png", "--at", 0.5)
    second = render(room, tmp_path / "b.png", "--model", "sphere", "--predict-height", HEIGHT, "--refine", 0)
    assert first.shape == (HEIGHT, 2 * HEIGHT, 3) and first.std() > 5
    assert np.abs(first - second).max() <= 1  # the .ply stores float32 logits and logarithms


def test_the_height_sets_the_size_of_each_layout(scene: Path, tmp_path: Path) -> None:
    for layout, width in (("equirect", 40), ("cubemap", 40), ("perspective", 36)):
        shape = render(scene, tmp_path / "x.png", "--layout", layout, "--height", 20).shape
        assert shape == (20, width, 3), layout


def test_an_exr_holds_depth(scene: Path, tmp_path: Path) -> None:
    assert run(["render", str(scene), "--at", "0", "-o", str(tmp_path / "x.exr"), "--blend", "view0"]) == 0
    depth = read_depth(tmp_path / "x.exr", HEIGHT)
    assert float(depth.median()) == pytest.approx(2.0, abs=0.01)


def test_the_pose_of_a_file_is_drawn(scene: Path, tmp_path: Path) -> None:
    pose = pipeline.load(scene).pose_between(0.25)
    (tmp_path / "pose.json").write_text(json.dumps(pose.tolist()))
    image = render(scene, tmp_path / "image.png", "--pose", tmp_path / "pose.json")
    assert np.abs(image - render(scene, tmp_path / "expected.png", "--at", 0.25)).max() <= 1


@pytest.mark.parametrize(("out", "option"), [("x.png", "--pose"), ("x.mp4", "--path")])
def test_a_scene_without_cameras_needs_a_pose_or_a_path(out: str, option: str, scene: Path, tmp_path, refusal) -> None:
    pipeline.save(pipeline.load(scene), tmp_path / "bare.splat")
    message = refusal("render", tmp_path / "bare.splat", "-o", tmp_path / out)
    assert "bare.splat: needed input cameras" in message and option in message


def test_a_video_moves_between_the_cameras(scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.mp4"
    assert run(["render", str(scene), "-o", str(out), "--height", "18", "--seconds", "0.5", "--fps", "8"]) == 0
    with av.open(str(out)) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert len(frames) == 4 and frames[0].shape == (18, 32, 3)
    assert np.abs(frames[0].astype(int) - frames[-1]).mean() > 1


@pytest.mark.parametrize("options", [(), ("--blend", "deferred")])
def test_a_video_of_panoramas_begins_with_the_photograph(options, room: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.mp4"
    arguments = ["--model", "sphere", "--predict-height", str(HEIGHT), "--refine", "0", "--layout", "equirect"]
    arguments += ["--height", str(HEIGHT), "--seconds", "0.5", "--fps", "8", *options]
    assert run(["render", str(room), "-o", str(out), *arguments]) == 0
    with av.open(str(out)) as video:
        frame = next(video.decode(video=0)).to_ndarray(format="rgb24")
    (pair,) = pipeline.load_sets(room)
    axes = torch.from_numpy(level_axes(torch.stack([view.cam2world for view in pair.context])))
    photograph = rotate_equirect(pair.load_context(HEIGHT).images[0], axes)
    likeness = np.corrcoef(frame.mean(axis=2).ravel(), photograph.mean(dim=0).ravel())[0, 1]
    assert (likeness > 0.5) == (not options), "a chosen blend shows the Gaussians"


@pytest.mark.parametrize(("layout", "size"), [("perspective", (1080, 1920)), ("equirect", (1440, 2880))])
def test_a_video_has_the_size_that_it_is_looked_at(layout, size, scene: Path, tmp_path: Path, monkeypatch) -> None:
    sizes = []

    def record(scene, pose, **options):
        sizes.append(options["size"])
        return Rendering(torch.zeros(3, 4, 8), torch.zeros(4, 8), torch.zeros(4, 8))

    monkeypatch.setattr(pipeline.drawing, "render", record)
    arguments = ["--layout", layout, "--seconds", "0.1", "--fps", "20"]
    assert run(["render", str(scene), "-o", str(tmp_path / "x.mp4"), *arguments]) == 0
    assert set(sizes) == {size}


@pytest.fixture
def parted_scene(room: Path, tmp_path: Path) -> Path:
    """The scene of two panoramas in one part and one in another part, far away."""
    (pair,) = pipeline.load_sets(room)
    alone = replace(pair, context=(replace(pair.targets[0], world=1),), targets=())
    (tour,) = find_tours([replace(pair, targets=()), alone])
    pipeline.save(pipeline.predict(tour, "sphere", height=HEIGHT, cache=False), tmp_path / "tour.ply")
    return tmp_path / "tour.ply"


def test_the_camera_stays_at_the_panoramas_of_parts_and_fades_between_them(parted_scene, tmp_path, monkeypatch) -> None:
    places, seen = pipeline.load(parted_scene).cam2world[:, :3, 3], []
    draw = pipeline.render

    def record(scene, pose, **options):
        seen.append(torch.as_tensor(pose)[:3, 3])
        return draw(scene, pose, **options)

    monkeypatch.setattr(pipeline.drawing, "render", record)
    for fraction in (None, 0.3, 0.9):
        render(parted_scene, tmp_path / "x.png", *([] if fraction is None else ["--at", fraction]))
    assert run(["render", str(parted_scene), "-o", str(tmp_path / "x.mp4"), "--height", "18", "--fps", "6"]) == 0
    with av.open(str(tmp_path / "x.mp4")) as video:
        count = sum(1 for _ in video.decode(video=0))
    assert len(seen) > 3 + count, "the frames of the fade mix two images"
    distances = (torch.stack(seen)[:, None] - places).norm(dim=2)
    assert distances.min(dim=1).values.max() < 1.01 and set(distances.argmin(dim=1).tolist()) == {0, 1, 2}


def test_stereo_panoramas_have_the_left_eye_above_the_right(scene: Path, tmp_path: Path) -> None:
    stereo = render(scene, tmp_path / "x.png", "--stereo", "--ipd", 0.2, "--height", 20)
    assert stereo.shape == (40, 40, 3) and np.abs(stereo[:20].astype(int) - stereo[20:]).mean() > 1
    arguments = ["--stereo", "--height", "18", "--seconds", "0.5", "--fps", "4"]
    assert run(["render", str(scene), "-o", str(tmp_path / "x.mp4"), *arguments]) == 0
    with av.open(str(tmp_path / "x.mp4")) as video:
        frame = next(video.decode(video=0))
    assert frame.to_ndarray(format="rgb24").shape == (36, 36, 3)
    assert {"SPHERICAL", "STEREO3D"} <= {data.type.name for data in frame.side_data}
