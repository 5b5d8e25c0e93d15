"""Predict into memory or a file, render, save and load."""

import functools
import json
import shutil
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from refusals import expect_error

from pansplat import pipeline
from pansplat.cli import run
from pansplat.errors import InputWarning
from pansplat.gaussians.harmonics import official_harmonics
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.inputs.panorama_sets import PanoramaSet
from pansplat.model import network
from pansplat.model.pansplat import PanSplat
from pansplat.networks.weights import pack_weights, save_weights
from pansplat.pipeline import load, load_sets, predict, predict_to_file, render, save
from pansplat.prediction_options import PredictOptions
from pansplat.rendering import blend, rasterize
from pansplat.tours.graph import TourGraph, find_tours
from pansplat.tours.merge import select_views
from pansplat.tours.scene_views import choose_sources

HEIGHT = 16


@pytest.fixture
def scene(pair_folder: Path, sphere_predictor) -> Scene:
    return predict(pair_folder, sphere_predictor(), height=HEIGHT, cache=False)


def test_a_predicted_scene_holds_its_cameras_and_predictor_name(scene: Scene) -> None:
    assert len(scene.gaussians) == 2 * HEIGHT * 2 * HEIGHT
    assert scene.cam2world.dtype == torch.float64 and float(scene.cam2world[1, 0, 3]) == 0.5
    assert (scene.model, scene.height, scene.names) == ("sphere", HEIGHT, ("left", "right"))


def test_a_scene_of_one_panorama_keeps_its_title_and_start_view(pair_folder: Path, sphere_predictor) -> None:
    (pair,) = load_sets(pair_folder)
    single = replace(pair, context=(replace(pair.context[1], title="hall", start=(7.0, 0.1)),))
    for cache in (True, True, False):
        scene = predict(single, sphere_predictor(), height=HEIGHT, cache=cache)
        assert scene.names == ("hall",) and scene.starts == ((pytest.approx(7 - 2 * np.pi), 0.1),)


@pytest.mark.parametrize(
    ("photographs", "largest", "expected"), [(32, None, 64), (300, None, 300), (2048, None, 512), (2048, 1024, 1024)]
)
def test_the_default_height_is_that_of_the_smallest_photograph_within_the_predictors_limit(
    pair_folder: Path, sphere_predictor, photographs: int, largest: int | None, expected: int
) -> None:
    predictor, pair = sphere_predictor(), pipeline.load_sets(pair_folder)[0]
    if largest is not None:
        predictor.default_height = largest
    for panorama, height in zip(pair.context, (photographs, 2 * photographs), strict=True):
        Image.new("RGB", (2 * height, height), "red").save(panorama.image)
    assert pipeline.prediction.choose_height(pair, predictor) == expected
    if expected == 64:
        assert predict(pair_folder, predictor, cache=False).height == expected


def test_a_single_view_has_the_scale_of_its_camera_height(tmp_path: Path, sphere_predictor, write_pair) -> None:
    photograph = write_pair(tmp_path / "pair") / "left.png"
    usual, tall = (
        predict(load_sets(photograph, camera_height=height)[0], sphere_predictor(), height=64) for height in (1.5, 3.0)
    )
    assert torch.equal(tall.gaussians.means, 2 * usual.gaussians.means)  # its camera is at the origin
    assert torch.equal(tall.gaussians.scales, 2 * usual.gaussians.scales)
    assert torch.equal(tall.cam2world, usual.cam2world)
    expect_error("camera_height", load_sets, photograph, camera_height=0.0)


def test_photographs_that_are_shown_before_their_poses_are_estimated_have_the_camera_height(tmp_path, write_pair):
    folder = write_pair(tmp_path / "pair")
    (folder / "poses.json").unlink()
    shown: list[PanoramaSet] = []

    def stop(pairs: list[PanoramaSet]) -> None:
        shown.extend(pairs)
        raise InterruptedError

    with pytest.raises(InterruptedError):
        load_sets(folder, camera_height=3.0, on_unposed=stop)
    assert [view.camera_height for pair in shown for view in pair.context] == [3.0, 3.0]


def test_the_options_of_a_command_are_keywords(pair_folder: Path, sphere_predictor, tmp_path: Path) -> None:
    options, named = PredictOptions(height=64, refine_steps=0, cache=False), {"height": 64, "cache": False}
    scenes = (
        predict(pair_folder, sphere_predictor(), options=options),
        predict(pair_folder, sphere_predictor(), **named),
    )
    assert torch.equal(*(scene.gaussians.means for scene in scenes))
    assert predict(pair_folder, sphere_predictor(), options=options, height=96).height == 96
    for call in (predict, lambda path, **words: predict_to_file(path, tmp_path / "x.ply", **words)):
        expect_error(r"got 'heigth' \(did you mean height\?\); they are model, .*, cache", call, pair_folder, heigth=64)


def test_predict_refuses_a_folder_of_several_pairs(tmp_path: Path, sphere_predictor, write_pair) -> None:
    for index in range(2):
        write_pair(tmp_path / "pairs" / f"room{index}", seed=index)
    expect_error("room0, room1", lambda: predict(tmp_path / "pairs", sphere_predictor(), height=HEIGHT))


def test_deferred_blending_at_an_input_pose_renders_that_view_where_it_is_opaque(scene: Scene) -> None:
    for view in range(2):
        alone = render(scene, scene.cam2world[view], blend=view)
        deferred = render(scene, scene.cam2world[view])
        opaque = alone.alpha > 1 - 1e-6
        assert opaque.any()
        torch.testing.assert_close(deferred.color[:, opaque], alone.color[:, opaque])


def test_at_an_input_pose_the_other_view_fills_a_hole(scene: Scene) -> None:
    background = (0.1, 0.7, 0.3)
    pose, gaussians = scene.cam2world[0], scene.gaussians
    below = (gaussians.means[:, 1] > pose[1, 3]) & (gaussians.views == 0)
    cut = replace(scene, gaussians=gaussians.select(~below))
    alone = render(cut, pose, blend=0, background=background)
    filled = render(cut, pose, background=background)
    hole = (alone.alpha == 0) & (render(cut, pose, blend=1).alpha > 0.999)
    assert hole.any()
    other = render(cut, pose, blend=1, background=background)
    torch.testing.assert_close(filled.color[:, hole], other.color[:, hole], atol=1e-3, rtol=0)


def test_views_without_weight_are_drawn_only_where_holes_remain(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    counts, draw = [], rasterize

    def record(gaussians: Gaussians, *arguments: Any, **options: Any) -> Any:
        counts.append(len(gaussians))
        return draw(gaussians, *arguments, **options)

    monkeypatch.setattr("pansplat.pipeline.drawing.rasterize", record)
    half = replace(scene, gaussians=scene.gaussians.select(scene.gaussians.means[:, 1] < 0))
    for shown, at, number in ((scene, 0.0, 1), (scene, 0.5, 2), (half, 0.0, 2)):
        counts.clear()
        render(shown, shown.pose_between(at))
        assert len(counts) == number


def test_deferred_blending_equals_the_blend_of_single_views(scene: Scene) -> None:
    pose = scene.pose_between(0.25)
    renderings = [render(scene, pose, blend=view) for view in range(2)]
    weights = torch.tensor([0.75, 0.25])
    torch.testing.assert_close(render(scene, pose).color, blend(renderings, weights).color)


def test_the_path_of_a_tour_is_predicted_as_a_whole_unless_it_holds_pairs_beside_it(
    tmp_path: Path, write_tour: Callable[..., Path], write_pair: Callable[..., Path], sphere_predictor
) -> None:
    scene = predict(write_tour(tmp_path / "houses" / "house", 4), sphere_predictor(), height=64, cache=False)
    assert scene.names == ("p0", "p1", "p2", "p3") and len(scene.tour.overlaps) >= 3
    write_pair(tmp_path / "houses" / "pair")
    expect_error("needed one pair or one tour", lambda: predict(tmp_path / "houses", sphere_predictor()))


def test_in_a_tour_the_views_of_the_nearest_edge_are_blended_and_others_fill_their_holes(
    tmp_path: Path, write_tour: Callable[..., Path], sphere_predictor
) -> None:
    (tour,) = find_tours(load_sets(write_tour(tmp_path / "house", 4)))
    whole = predict(tour, sphere_predictor(), height=64, cache=False)
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = 0.4 * 0.5  # between the first two of four panoramas in a row, 0.5 m apart
    gaussians = whole.gaussians
    below = (gaussians.means[:, 1] > 1) & (gaussians.views <= 1)
    cut = replace(whole, gaussians=gaussians.select(~below))
    drawn, of_edge = (render(scene, pose, size=(32, 64)) for scene in (cut, select_views(cut, (0, 1))))
    seen, hole = of_edge.alpha > 0.999, of_edge.alpha == 0
    assert seen.any() and hole.any()
    colors = [(rendering.color / rendering.alpha)[:, seen] for rendering in (drawn, of_edge)]
    torch.testing.assert_close(*colors, atol=1e-5, rtol=0)
    others = render(select_views(cut, (2, 3)), pose, size=(32, 64))
    assert others.alpha[hole].min() > 0.9
    torch.testing.assert_close(drawn.alpha[hole], others.alpha[hole], atol=0.01, rtol=0)  # opaque enough is no hole
    assert not torch.allclose(of_edge.color, render(replace(cut, tour=None), pose, size=(32, 64)).color, atol=0.05)


@pytest.mark.parametrize("blending", ["deferred", "joint"])
def test_in_a_tour_of_parts_only_the_part_of_the_camera_is_drawn(tmp_path, write_tour, sphere_predictor, blending):
    pairs = load_sets(write_tour(tmp_path / "house", 3))
    alone = replace(pairs[1].context[1], world=1)
    (tour,) = find_tours([pairs[0], replace(pairs[1], context=(alone,))])
    whole = predict(tour, sphere_predictor(), height=64, cache=False)
    assert [edge[:2] for edge in whole.tour.overlaps] == [(0, 1), (2, 2)]
    options = {"size": (32, 64), "blend": blending}
    for views in ((0, 1), (2,)):
        pose = tour.cam2world[views[0]].clone()
        pose[2, 3] += 0.3
        gaussians = whole.gaussians
        cut = replace(whole, gaussians=gaussians.select((gaussians.means - pose[:3, 3].float())[:, 1] < 0.5))
        drawn = render(cut, pose, **options)
        assert (drawn.alpha == 0).any(), "the other part fills no hole"
        torch.testing.assert_close(drawn.color, render(select_views(cut, views), pose, **options).color)


def test_joint_rendering_equals_one_rasterisation(scene: Scene) -> None:
    pose = scene.pose_between(0.5)
    size = (HEIGHT, 2 * HEIGHT)
    joint = render(scene, pose, blend="joint")
    torch.testing.assert_close(joint.color, rasterize(scene.gaussians, pose, size=size).color)
    assert not torch.allclose(joint.color, render(scene, pose).color, atol=1e-3)


def test_a_scene_without_cameras_is_rendered_jointly(scene: Scene) -> None:
    foreign = Scene(scene.gaussians, scene.cam2world[:0], 0.1, 100.0, height=HEIGHT)
    pose = scene.pose_between(0.5)
    torch.testing.assert_close(render(foreign, pose).color, render(scene, pose, blend="joint").color)


def test_render_accepts_sizes_layouts_and_numpy_poses(scene: Scene) -> None:
    pose = scene.pose_between(0.5).numpy()
    assert render(scene, pose).color.shape == (3, HEIGHT, 2 * HEIGHT)
    assert render(scene, pose, layout="pinhole", size=(8, 12)).color.shape == (3, 8, 12)
    assert render(scene, pose, layout="cubemap", size=(8, 16)).depth.shape == (8, 16)


def test_original_drawing_uses_the_official_kernel_stitching_and_harmonics(scene: Scene) -> None:
    pose = scene.pose_between(0.5)
    rendered = render(scene, pose, blend="joint", size=(32, 64), drawing="original").color
    official = replace(scene.gaussians, harmonics=official_harmonics(scene.gaussians.harmonics))
    options = {"kernel": "ewa", "face_size": 16}
    expected = rasterize(official, pose, size=(32, 64), layout="cubemap", near=0.2 * scene.near, **options).color
    assert torch.equal(rendered, expected)
    assert not torch.allclose(rendered, render(scene, pose, blend="joint", size=(32, 64)).color, atol=1e-3)


def test_render_refuses_an_unknown_blend_and_conflicting_drawing_options(scene: Scene, unchecked: None) -> None:
    conflicts = [{"drawing": "original", "kernel": "ray"}, {"drawing": "original", "layout": "pinhole"}]
    for options in ({"drawing": "fast"}, *conflicts, *({"blend": value} for value in (2, -1, "view0", "mixed"))):
        expect_error("`drawing`|sets all|`blend` must be", render, scene, scene.pose_between(0.5), **options)


TILED_HEIGHT = 64


@pytest.fixture
def masked_pair(tmp_path: Path, write_pair) -> Path:
    """Two panoramas; the lower third of the first is masked."""
    folder = write_pair(tmp_path / "pair", height=TILED_HEIGHT)
    mask = np.full((TILED_HEIGHT, 2 * TILED_HEIGHT), 255, np.uint8)
    mask[40:] = 0
    Image.fromarray(mask).save(folder / "left_mask.png")
    return folder


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_config) -> Path:
    """Weights of a small network that cuts panoramas of 64 rows into four tiles; the command streams such panoramas."""
    monkeypatch.setattr(network, "_UNTILED_HEIGHT", TILED_HEIGHT // 2)
    monkeypatch.setattr(pipeline.calls, "_MAX_CACHED_HEIGHT", TILED_HEIGHT // 2)
    torch.manual_seed(0)
    path = tmp_path / "small.safetensors"
    save_weights(path, pack_weights("pansplat", small_config, PanSplat(small_config).state_dict(), compat="fixed"))
    return path


def _sorted_columns(gaussians: Gaussians) -> np.ndarray:
    fields = (gaussians.means, gaussians.scales, gaussians.quats, gaussians.opacities, gaussians.harmonics)
    labels = (gaussians.levels, gaussians.views)
    rows = torch.cat([field.reshape(len(gaussians), -1).float() for field in (*fields, *labels)], dim=1).numpy()
    return np.sort(rows, axis=0)  # each column by itself: rounding would decide an order of whole rows


@pytest.mark.slow
def test_predict_to_file_writes_the_gaussians_of_predict(masked_pair: Path, weights: Path, tmp_path: Path) -> None:
    scene = predict(masked_pair, weights, height=TILED_HEIGHT, cache=False)
    save(scene, tmp_path / "whole.ply")
    whole = load(tmp_path / "whole.ply")
    count = predict_to_file(masked_pair, tmp_path / "tiles.ply", weights, height=TILED_HEIGHT)
    tiles = load(tmp_path / "tiles.ply")
    assert count == len(tiles.gaussians) == len(scene.gaussians) > 1000
    assert count == predict_to_file(masked_pair, tmp_path / "tiles.glb", weights, height=TILED_HEIGHT)
    assert count == len(load(tmp_path / "tiles.glb").gaussians)
    assert 0 < int((tiles.gaussians.views == 0).sum()) < int((tiles.gaussians.views == 1).sum())  # masked
    np.testing.assert_allclose(_sorted_columns(tiles.gaussians), _sorted_columns(whole.gaussians), atol=1e-5)
    assert not torch.equal(tiles.gaussians.means, whole.gaussians.means)  # ordered by tile
    assert torch.equal(tiles.cam2world, whole.cam2world)
    assert all(getattr(tiles, name) == getattr(whole, name) for name in ("near", "far", "names", "model", "height"))


def test_photographs_for_a_refinement_have_twice_the_rows_if_the_files_do(tmp_path, write_pair, monkeypatch) -> None:
    (pair,) = load_sets(write_pair(tmp_path / "pair", height=64))
    for height, rows in ((16, 32), (48, 64), (64, 64)):
        assert pipeline.load_photographs(pair, height).images.shape[-2] == rows
    monkeypatch.setattr(pipeline.prediction, "DISPLAY_HEIGHT", 24)
    assert pipeline.load_photographs(pair, 16).images.shape[-2] == 24
    assert pipeline.load_photographs(pair, 48).images.shape[-2] == 48


@pytest.mark.slow
def test_the_predict_command_streams_large_predictions(masked_pair, weights, tmp_path, monkeypatch, capsys) -> None:
    command = ["predict", str(masked_pair), "--model", str(weights), "--height", str(TILED_HEIGHT), "--degree", "0"]
    monkeypatch.setattr(pipeline.calls, "predict_set", None)  # must not be called
    assert run([*command, "-o", str(tmp_path / "tiles.ply")]) == 0
    assert "Gaussians of 2 panoramas in" in capsys.readouterr().out
    monkeypatch.undo()
    assert run([*command, "-o", str(tmp_path / "whole.ply")]) == 0  # of a height that is cached
    tiles, whole = (load(tmp_path / name).gaussians for name in ("tiles.ply", "whole.ply"))
    assert tiles.degree == whole.degree == 0
    np.testing.assert_allclose(_sorted_columns(tiles), _sorted_columns(whole), atol=1e-5)


def test_predictions_are_written_in_the_format_of_the_suffix(pair_folder, tmp_path, sphere_predictor) -> None:
    predictor = sphere_predictor()
    scene = predict(pair_folder, predictor, cache=False)
    assert predict_to_file(pair_folder, tmp_path / "a.splat", predictor) == len(scene.gaussians)
    assert (tmp_path / "a.splat").stat().st_size == 32 * len(scene.gaussians)
    expect_error(r"got '\.obj'", predict_to_file, pair_folder, tmp_path / "a.obj", predictor)
    assert predictor.calls == 2, "a wrong suffix is refused before the work"


def test_the_scene_of_a_tour_holds_each_panorama_once(tmp_path, write_tour, sphere_predictor) -> None:
    (tour,) = find_tours(load_sets(write_tour(tmp_path / "house", 4)))
    predictor = sphere_predictor()
    scene = predict(tour, predictor, cache=False)
    assert predictor.calls == len(choose_sources(tour)) == 3
    assert scene.gaussians.views.bincount().tolist() == [64 * 128] * 4  # the smallest height
    assert scene.cam2world.equal(tour.cam2world) and scene.names == tuple(f"p{k}" for k in range(4))
    assert [edge[:2] for edge in scene.tour.overlaps] == list(tour.overlaps)
    distances = (scene.gaussians.means - scene.cam2world[scene.gaussians.views, :3, 3].float()).norm(dim=1)
    torch.testing.assert_close(distances, torch.full_like(distances, 2.0))
    predictor.calls, predictor.max_views = 0, 4
    at_once = predict(tour, predictor, cache=False)
    assert predictor.calls == 1 and at_once.gaussians.means.equal(scene.gaussians.means)


class PairsOnly:
    """A predictor that refuses a single view, as networks do."""

    name, min_views = "pairs", 2

    def __init__(self, predict: Callable[..., Gaussians]) -> None:
        self.predict, self.fingerprint = predict, "1"

    def __call__(self, images: torch.Tensor, *arguments: Any, **options: Any) -> Gaussians:
        assert len(images) >= 2
        return self.predict(images, *arguments, **options)


@pytest.fixture
def parted_tour(tmp_path: Path, write_tour: Callable[..., Path]) -> TourGraph:
    """Two panoramas that are a pair, and one of another part."""
    pairs = load_sets(write_tour(tmp_path / "house", 3))
    alone = replace(pairs[1], name="p2", context=(replace(pairs[1].context[1], world=1),))
    (tour,) = find_tours([pairs[0], alone])
    return tour


def test_single_views_of_a_tour_are_predicted_by_default_if_the_model_needs_two(
    parted_tour: TourGraph, sphere_predictor: type, monkeypatch: pytest.MonkeyPatch
) -> None:
    of_pairs, of_single_views = sphere_predictor(), sphere_predictor()
    monkeypatch.setitem(pipeline.models._MODELS, "default", lambda: of_single_views)
    with pytest.warns(InputWarning, match=r"house tour: 1 single view is predicted by default, because pairs needs 2"):
        scene = predict(parted_tour, PairsOnly(of_pairs), cache=False)
    assert len(scene.cam2world) == 3 and (of_pairs.calls, of_single_views.calls) == (1, 1)
    predict(parted_tour, of_pairs, cache=False)
    assert (of_pairs.calls, of_single_views.calls) == (3, 1), "without a warning"


def test_a_photograph_alone_is_refused_by_a_model_that_needs_two(pair_folder: Path, weights: Path) -> None:
    (single,) = load_sets(pair_folder / "left.png")
    message = r"left\.png: pansplat needed 2 or more panoramas of one room, got 1; choose the model default"
    for run_prediction in (predict, lambda pair, model: predict_to_file(pair, pair_folder / "x.ply", model)):
        expect_error(message, run_prediction, single, weights)
    expect_error(r"left: pansplat needed 2", lambda: predict(single.load_context(64), weights))


# Unit and origin of the poses in a file.
FRAMES = {"metres": (1.0, 0.0), "millimetres": (1e3, 0.0), "UTM": (1.0, 5e6), "UTM in millimetres": (1e3, 5e9)}


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """A function from a name of `FRAMES` to the folder of the living room in this frame.

    The places are multiples of 1/16 m: then no unit and no origin rounds them.
    """
    parent, sample = tmp_path_factory.mktemp("rooms"), Path(__file__).parents[1] / "assets" / "living_room"

    def write(name: str) -> Path:
        folder, (unit, origin) = parent / name, FRAMES[name]
        if not folder.exists():
            shutil.copytree(sample, folder)
            content = json.loads((folder / "poses.json").read_text())
            content["near"], content["far"] = unit * content["near"], unit * content["far"]
            for entry in content["poses"].values():
                for row, axis in zip(entry["cam2world"][:3], (1, -0.1, 0.01), strict=True):
                    row[3] = unit * round(16 * row[3]) / 16 + axis * origin
            (folder / "poses.json").write_text(json.dumps(content))
        return folder

    return write


@pytest.fixture(scope="module")
def predict_room(room: Callable[[str], Path]) -> Callable[..., Scene]:
    """Predict the room of a frame, its places moved in the working world, at 64 rows; each once."""

    @functools.cache
    def run_prediction(name: str, *moved: float) -> Scene:
        views = load_sets(room(name))[0].load_context(64)
        cam2world = views.cam2world.clone()
        cam2world[:, :3, 3] += torch.tensor(moved or (0.0, 0.0, 0.0), dtype=torch.float64)
        return predict(replace(views, cam2world=cam2world), "sweep")

    return run_prediction


@pytest.mark.parametrize("name", [name for name in FRAMES if name != "metres"])
def test_a_room_in_any_frame_is_that_in_metres_moved_to_the_working_world(name, room, predict_room) -> None:
    unit, origin = FRAMES[name]
    # An origin of the working world is a multiple of 64 m; that of the poses is not.
    expected, scene = predict_room("metres", *((0.0, 32.0, 16.0) if origin else ())), predict_room(name)
    assert torch.equal(scene.cam2world, expected.cam2world) and scene.frame.unit == unit
    assert (scene.near, scene.far) == (expected.near, expected.far)
    for field in fields(Gaussians):
        assert torch.equal(getattr(scene.gaussians, field.name), getattr(expected.gaussians, field.name)), field.name
    size = (64, 128)
    for at in (0.0, 0.5):
        pictures = (render(given, given.pose_between(at), size=size).color for given in (expected, scene))
        assert torch.equal(*pictures)


@pytest.mark.parametrize("name", [name for name in FRAMES if name != "metres"])
def test_a_scene_file_is_drawn_at_poses_of_the_users_frame(name, room, predict_room, tmp_path) -> None:
    folder, size, unit, scene = room(name), (64, 128), FRAMES[name][0], predict_room(name)
    ours = render(scene, scene.cam2world[0], size=size).color
    pose = json.loads((folder / "poses.json").read_text())["poses"]["left.jpg"]["cam2world"]
    users = torch.tensor(pose, dtype=torch.float64)
    coded = {"millimetres": ("compressed.ply", "sog"), "UTM": ("compressed.ply", "spz"), "UTM in millimetres": ()}
    for file in (f"scene.{suffix}" for suffix in ("ply", "glb", *coded[name])):
        save(scene, tmp_path / file)
        loaded = load(tmp_path / file)
        torch.testing.assert_close(loaded.frame.globalize(loaded.cam2world)[0], users, rtol=1e-12, atol=1e-7)
        again = render(loaded, loaded.frame.localize(users), size=size).color
        limit = 1e-4 if file in ("scene.ply", "scene.glb") else 1e-3
        assert float((again - ours).square().mean()) < limit, file
    entry = json.loads((tmp_path / "scene.ply").read_bytes().split(b"comment pansplat ", 1)[1].split(b"\n", 1)[0])
    assert entry["near"] == pytest.approx(0.45 * unit) and ("origin" in entry) == (FRAMES[name][1] > 0)
    (tmp_path / "pose.json").write_text(json.dumps(users.tolist()))
    command = ["render", str(tmp_path / "scene.ply"), "--pose", str(tmp_path / "pose.json"), "--height", "64"]
    assert run([*command, "-o", str(tmp_path / "view.png")]) == 0
    drawn = torch.from_numpy(np.array(Image.open(tmp_path / "view.png"))).permute(2, 0, 1) / 255
    assert float((drawn - ours.clamp(0, 1)).square().mean()) < 1e-4


def test_a_scene_file_is_refined_with_photographs_whose_frame_has_another_origin(room, predict_room) -> None:
    views, scene = load_sets(room("UTM"))[0].load_context(64), predict_room("UTM")
    x, y, z = scene.frame.origin
    frame = replace(scene.frame, origin=(x - 512.0, y, z))
    moved = replace(views, frame=frame, cam2world=frame.localize(scene.frame.globalize(scene.cam2world)))
    assert float((moved.cam2world - scene.cam2world).abs().max()) == 512
    refined = pipeline.refine(scene, moved, steps=1)
    assert refined.frame == scene.frame and torch.equal(refined.cam2world, scene.cam2world)


def test_views_of_arrays_and_of_bytes_are_those_of_tensors(pair_folder: Path, sphere_predictor) -> None:
    (pair,) = load_sets(pair_folder)
    views = pair.load_context(HEIGHT)
    expected = predict(views, sphere_predictor()).gaussians.harmonics
    arrays = replace(
        views,
        images=(views.images * 255).round().numpy().astype(np.uint8),
        cam2world=views.cam2world.numpy(),
        masks=views.masks.numpy(),
    )
    assert "masks show 100 %" in repr(arrays)
    assert torch.allclose(predict(arrays, sphere_predictor()).gaussians.harmonics, expected, atol=1e-5)
    expect_error("values up to 2", lambda: predict(replace(views, images=views.images * 255), sphere_predictor()))
    with pytest.warns(InputWarning, match="left, right: the cameras are at one place"):
        predict(replace(views, cam2world=views.cam2world[:1].repeat(2, 1, 1)), sphere_predictor())


def test_what_is_no_pose_is_named(scene: Scene) -> None:
    for call, message in (
        (lambda: scene.pose_between(50), "from 0, the first camera, to 1, the last one, got 50"),
        (lambda: render(scene, np.eye(3)), r"a pose \(4, 4\)"),
    ):
        expect_error(message, call)
