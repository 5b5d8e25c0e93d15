"""Projections and stereo of stills and films."""

import itertools
import json
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from av.sidedata.sidedata import Type

import pansplat
from pansplat.errors import InputError
from pansplat_viewer import run
from pansplat_viewer.draw.cpu_renderer import CpuRenderer
from pansplat_viewer.draw.renderer import SplatRenderer
from pansplat_viewer.draw.stereo import _GRID, ImageFormat, arrange_eyes, move_eye, render_image
from pansplat_viewer.draw.window_renderer import StereoRenderer, get_eye_size
from pansplat_viewer.scene.settings import DrawSettings

SIZE = (48, 24)


@pytest.fixture(scope="module")
def renderer(random_scene):
    renderer = CpuRenderer(None, exact=True)
    renderer.upload(random_scene())
    yield renderer
    renderer.release()


def draw(renderer, pose, size, **options):
    settings = {name: options.pop(name) for name in list(options) if name in ("mode", "background")}
    return render_image(renderer, pose, size, DrawSettings(**settings), ImageFormat(**options))[0]


def test_the_eyes_of_a_perspective_image_are_the_distance_apart(renderer, pose):
    both = draw(renderer, pose, SIZE, stereo="side-by-side", eye_distance=0.2)
    left, right = both[:, : SIZE[0]], both[:, SIZE[0] :]
    moved = pose.copy()
    moved[:3, 3] -= 0.1 * pose[:3, 0]
    assert np.array_equal(left, draw(renderer, moved, SIZE))
    assert np.array_equal(right, draw(renderer, move_eye(pose, 0.1), SIZE))
    assert np.abs(left - right).mean() > 0.01
    assert np.array_equal(draw(renderer, pose, SIZE, stereo="top-bottom", eye_distance=0.2), np.vstack((left, right)))


@pytest.mark.parametrize("mode", ["joint", "deferred"])
def test_stereo_panoramas_are_those_of_pansplat_render(renderer, random_scene, pose, mode):
    image = draw(renderer, pose, SIZE, projection="equirect", stereo="top-bottom", eye_distance=0.2, mode=mode)
    expected = pansplat.render(random_scene(), pose, blend=mode, size=SIZE[::-1], eye_distance=0.2).color
    error = np.abs(image - expected.permute(1, 2, 0).clamp(0, 1).numpy())
    assert error.shape == (2 * SIZE[1], SIZE[0], 3)
    assert error.mean() < 1e-4 and error.max() < 5e-3


def test_swapping_the_sign_of_the_distance_exchanges_the_eyes(renderer, pose):
    for projection, size in (("equirect", SIZE), ("perspective", SIZE), ("cubemap", (24, 16))):
        first, second = (
            draw(renderer, pose, size, projection=projection, stereo="side-by-side", eye_distance=distance)
            for distance in (0.2, -0.2)
        )
        left, right = np.split(first, 2, axis=1)
        assert np.array_equal(second, np.hstack((right, left)))
        image_format = ImageFormat(projection, "side-by-side")
        color, depth = render_image(renderer, pose, size, DrawSettings(), image_format, with_depth=True)
        assert depth.shape == color.shape[:2] == first.shape[:2] and depth.min() >= 0 and 0.5 < depth.max() < 20


def test_the_faces_of_a_cubemap_are_where_players_read_them(renderer, pose):
    """FFmpeg's filter v360 turns the cubemap (`c3x2`) into a panorama."""
    smooth = DrawSettings(background=(0.5, 0.5, 0.5))
    for stereo in ("mono", "top-bottom"):
        cubes = render_image(renderer, pose, (192, 128), smooth, ImageFormat("cubemap", stereo, 0.1))[0]
        panoramas = render_image(renderer, pose, (256, 128), smooth, ImageFormat("equirect", stereo, 0.1))[0]
        count = 1 if stereo == "mono" else 2
        for cube, panorama in zip(np.split(cubes, count), np.split(panoramas, count), strict=True):
            graph = av.filter.Graph()
            frame = av.VideoFrame.from_ndarray((255 * cube + 0.5).astype(np.uint8), format="rgb24")
            source = graph.add_buffer(width=192, height=128, format="rgb24", time_base="1/1")
            turned = graph.add("v360", "input=c3x2:output=e:w=256:h=128")
            shown, sink = graph.add("format", "rgb24"), graph.add("buffersink")
            graph.link_nodes(source, turned, shown, sink).configure()
            graph.push(frame)
            error = np.abs(graph.pull().to_ndarray() / 255.0 - panorama)
            assert error.mean() < 0.02


def test_blended_views_leave_no_seams_between_the_faces_of_a_cubemap(renderer, random_scene, pose):
    """Half-way between the views, where their weights in a perspective image depend most on its direction."""
    pose = pose.copy()
    pose[:3, 3] = random_scene().cam2world[:, :3, 3].mean(dim=0)
    image = draw(renderer, pose, (384, 256), projection="cubemap", mode="deferred")
    faces = dict(
        zip(np.ravel(_GRID), [face for row in np.split(image, 2) for face in np.split(row, 3, axis=1)], strict=True)
    )
    inside, seams = [], []
    for left, right in itertools.pairwise(("front", "right", "back", "left", "front")):
        inside.append(np.abs(faces[left][:, -1] - faces[left][:, -2]).mean())
        seams.append(np.abs(faces[left][:, -1] - faces[right][:, 0]).mean())
    assert np.mean(seams) < 1.2 * np.mean(inside)


@pytest.mark.gl
def test_omnidirectional_stereo_needs_the_exact_preset_and_the_processor(make_renderer, random_scene, pose):
    settings = DrawSettings(layout="equirect", eye_offset=0.03)
    with pytest.raises(InputError, match="use `CpuRenderer`"):
        make_renderer(random_scene(), "gl").render(pose, (32, 16), settings)
    with pytest.raises(InputError, match="needs preset exact, got 3dgs"):
        ImageFormat("equirect", "top-bottom").check((64, 32), "3dgs")
    with pytest.raises(InputError, match="needs layout equirect and preset exact"):
        DrawSettings(eye_offset=0.03)
    with pytest.raises(InputError, match="`eye_offset` must be a distance"):
        DrawSettings(layout="equirect", eye_offset=float("nan"))
    assert arrange_eyes([np.zeros((2, 3, 1))], "mono").shape == (2, 3, 1)


def test_films_of_stereo_panoramas_state_their_layout(room, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    frames = [{"seconds": t, "position": [0, 0, t], "direction": [0, 0, 1]} for t in (0, 0.1)]
    Path("walk.json").write_text(json.dumps({"key_frames": frames}))
    arguments = [str(room), "--path", "walk.json", "--fps", "10", "--ipd", "0.1", "--out"]
    for projection, size, stereo, shape, kind in (
        ("equirect", "64x32", "top-bottom", (64, 64, 3), 2),
        ("equirect", "64x32", "side-by-side", (32, 128, 3), 1),
        ("cubemap", "48x32", "mono", (32, 48, 3), 0),
        ("perspective", "64x32", "top-bottom", (64, 64, 3), None),
    ):
        assert run([*arguments, "walk.mp4", "--projection", projection, "--size", size, "--stereo", stereo]) == 0
        with av.open("walk.mp4") as film:
            decoded = list(film.decode(video=0))
        data = {data.type: bytes(data) for data in decoded[0].side_data}
        assert len(decoded) == 2 and decoded[0].to_ndarray(format="rgb24").shape == shape
        assert (Type.SPHERICAL in data) == (projection != "perspective")
        assert (int.from_bytes(data[Type.STEREO3D][:4], "little") if Type.STEREO3D in data else None) == kind
    assert run([*arguments, "walk.exr", "--projection", "equirect", "--size", "64x32", "--stereo", "top-bottom"]) == 0
    assert [path.name for path in sorted(Path().glob("*.exr"))] == ["walk_0000.exr", "walk_0001.exr"]


# --- the window's images ---


@pytest.fixture
def stereo_renderer(ctx, random_scene):
    stereo = StereoRenderer(SplatRenderer(ctx, color_bits=32), ctx)
    stereo.upload(random_scene())
    yield stereo
    stereo.release()


def read_texture(texture) -> np.ndarray:
    kind = np.uint8 if texture.dtype == "f1" else np.float32
    pixels = np.frombuffer(texture.read(), kind).reshape(texture.height, texture.width, 4)[::-1]
    return pixels / 255 if texture.dtype == "f1" else pixels


@pytest.mark.gl
def test_the_window_shows_the_images_of_both_eyes(stereo_renderer, pose):
    for stereo in ("mono", "side-by-side", "top-bottom"):
        settings = DrawSettings(stereo=stereo, eye_distance=0.2)
        texture = stereo_renderer.render(pose, (48, 32), settings)
        shown, left = read_texture(texture), stereo_renderer.read_color()
        image_format = ImageFormat("perspective", stereo, 0.2)
        size = get_eye_size((48, 32), stereo)
        expected, _ = render_image(stereo_renderer, pose, size, settings, image_format)
        assert shown.shape == (32, 48, 4) and np.abs(shown[..., :3].clip(0, 1) - expected).max() < 0.003
        assert stereo_renderer.read_depth().shape == left.shape[:2] == size[::-1]


@pytest.mark.gl
def test_turning_reads_cached_faces_of_both_eyes_until_they_are_out_of_place(stereo_renderer, pose, turn):
    settings = DrawSettings(stereo="side-by-side", eye_distance=0.2, cached=True, vertical_fov_degrees=40)
    stereo_renderer.render(pose, (48, 32), settings)
    for degrees in (-15, 15):  # the first turns may need another face
        stereo_renderer.render(turn(pose, degrees), (48, 32), settings)
    for degrees in (5, -15, 15):
        stereo_renderer.render(turn(pose, degrees), (48, 32), settings)
        assert stereo_renderer.stats.cached and stereo_renderer.stats.drawn == 0
    stereo_renderer.render(turn(pose, 30), (48, 32), settings)
    assert not stereo_renderer.stats.cached
    moved = stereo_renderer.read_color()
    stereo_renderer.render(turn(pose, 30), (48, 32), replace(settings, cached=False))
    assert np.abs(stereo_renderer.read_color() - moved).mean() < 0.02


@pytest.mark.gl
def test_images_of_both_eyes_are_shown_when_both_are_finished(stereo_renderer, random_scene, pose, turn, wait_until):
    settings = DrawSettings(stereo="side-by-side", eye_distance=0.2)
    stereo_renderer.render(pose, (24, 16), DrawSettings(), wait=False)
    for place, size in ((pose, (24, 16)), (turn(pose, 20), (48, 32))):

        def finish(place: np.ndarray = place, size: tuple[int, int] = size) -> bool:
            stereo_renderer.render(place, size, settings, wait=False)
            return stereo_renderer.stats.settled

        wait_until(finish, "settled image")
        texture = stereo_renderer.render(place, size, settings, wait=False)
        shown = read_texture(texture)
        eye, image_format = get_eye_size(size, "side-by-side"), ImageFormat("perspective", "side-by-side", 0.2)
        expected = render_image(stereo_renderer, place, eye, settings, image_format)[0]
        assert texture.size == size and np.abs(shown[..., :3].clip(0, 1) - expected).max() < 0.003
    stereo_renderer.upload(random_scene(seed=1))
    assert stereo_renderer.stats.total == 300 and len(stereo_renderer._eyes) == 1
    with pytest.raises(InputError, match="stereo of a window is perspective"):
        stereo_renderer.render(pose, (48, 24), replace(settings, layout="equirect"))
