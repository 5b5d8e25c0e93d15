"""The folder to train from: pycolmap and nerfstudio's rules read it, and so does pansplat, with equal poses."""

from __future__ import annotations

import contextlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy import ndarray as Array
from PIL import Image

from pansplat.export.training_set import write_dataset
from pansplat.images.image_files import read_panorama
from pansplat.inputs.folders import load_sets
from pansplat.inputs.panorama_sets import Panorama
from pansplat.inputs.reconstructions.nerfstudio import Z_UP

pycolmap = pytest.importorskip("pycolmap")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory, cameras: list[Array], points: Array, write_panorama) -> Path:
    views, tmp_path = [], tmp_path_factory.mktemp("rooms")
    for number, pose in enumerate(cameras):
        image = tmp_path / f"p {number}.png"
        write_panorama(image, pose)
        mask = None
        if number == 1:
            mask = tmp_path / "m.png"
            white = np.full((64, 128), 255, np.uint8)
            white[50:] = 0
            Image.fromarray(white).save(mask)
        views.append(Panorama(image.stem, image, torch.from_numpy(pose), mask))
    folder = tmp_path / "set"
    folder.mkdir()
    colors = np.arange(3 * len(points)).reshape(-1, 3).astype(np.uint8)
    assert write_dataset(folder, views, (), points, colors) == 18
    return folder


def test_pycolmap_reads_cameras_rigs_and_points(dataset: Path, cameras: list[Array], points: Array) -> None:
    model = pycolmap.Reconstruction(dataset / "sparse" / "0")
    assert (model.num_rigs(), model.num_frames(), model.num_reg_images()) == (1, 3, 18)
    assert model.is_valid()
    for number, pose in enumerate(cameras):
        image = model.find_image_with_name(f"{number:04d}_p_{number}_front.png")
        world = np.vstack((image.cam_from_world().matrix(), (0, 0, 0, 1)))
        np.testing.assert_allclose(np.linalg.inv(world), pose, atol=1e-9)
        assert (dataset / "images" / image.name).is_file()
    assert np.allclose(sorted(p.xyz[0] for p in model.points3D.values()), sorted(points[:, 0]), atol=1e-4)
    # A rig composes to the poses that images.txt states.
    frame = model.frame(2)
    for image_id in (image.id for image in frame.image_ids):
        image = model.image(image_id)
        rows = [line.split() for line in (dataset / "sparse/0/images.txt").read_text().splitlines()]
        stated = next(np.array(row[5:8], float) for row in rows if row and row[-1] == image.name)
        np.testing.assert_allclose(image.cam_from_world().translation, stated, atol=1e-9)


def test_both_files_project_a_point_to_the_same_pixel(dataset: Path, points: Array) -> None:
    """nerfstudio's rules: world with z up, OpenGL axes; the points file is in the same world."""
    model = pycolmap.Reconstruction(dataset / "sparse" / "0")
    content = json.loads((dataset / "transforms.json").read_text())
    assert content["ply_file_path"] == "points.ply" and len(content["frames"]) == 18
    applied = np.vstack((content["applied_transform"], (0, 0, 0, 1)))
    np.testing.assert_array_equal(applied, Z_UP)
    world = points @ applied[:3, :3].T
    for frame in content["frames"]:
        matrix = np.array(frame["transform_matrix"])
        local = (world - matrix[:3, 3]) @ matrix[:3, :3] * (1, -1, -1)
        image = model.find_image_with_name(Path(frame["file_path"]).name)
        seen = local[:, 2] > 0.1
        x = frame["fl_x"] * local[:, 0] / local[:, 2] + frame["cx"]
        y = frame["fl_y"] * local[:, 1] / local[:, 2] + frame["cy"]
        pixels = np.array([image.project_point(point) for point in points[seen]])
        np.testing.assert_allclose(np.stack((x, y), axis=-1)[seen], pixels, atol=1e-6)
        with Image.open(dataset / frame["file_path"]) as picture, Image.open(dataset / frame["mask_path"]) as mask:
            assert picture.size == mask.size == (frame["w"], frame["h"])


@pytest.mark.parametrize("kind", ["nerfstudio", "colmap text", "colmap binary"])
def test_a_round_trip_keeps_poses_and_pictures(dataset, cameras, kind, check_colors, tmp_path) -> None:
    dataset = shutil.copytree(dataset, tmp_path / "set")
    if kind != "nerfstudio":
        (dataset / "transforms.json").unlink()
    if kind == "colmap binary":
        model = pycolmap.Reconstruction(dataset / "sparse" / "0")
        shutil.rmtree(dataset / "sparse" / "0")
        (dataset / "sparse" / "0").mkdir()
        model.write(dataset / "sparse" / "0")
    pairs = load_sets(dataset)  # scale.txt states metres: no note
    panoramas = {view.name: view for pair in pairs for view in pair.context}
    assert sorted(panoramas) == ["0000_p_0", "0001_p_1", "0002_p_2"]
    for number, pose in enumerate(cameras):
        view = panoramas[f"{number:04d}_p_{number}"]
        np.testing.assert_allclose(view.cam2world, pose, atol=1e-6)
        with pytest.warns(UserWarning, match="in no picture") if number == 1 else contextlib.nullcontext():
            image, shown = read_panorama(view.image, 64)
        if number == 1:
            assert shown[:48].all() and not shown[53:].any()
        else:
            check_colors(image, view.cam2world)
