"""Poses of other programs: each file is written by the formulas of its documentation, and its panoramas must agree."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy import ndarray as Array
from PIL import Image
from refusals import expect_error
from scipy.spatial.transform import Rotation

from pansplat.errors import InputWarning
from pansplat.inputs.folders import load_sets
from pansplat.inputs.panorama_sets import Panorama, PanoramaSet

NAMES = ("p1.png", "p2.png", "p3.png")


def load(folder: Path, *, arbitrary: bool = True) -> tuple[list[PanoramaSet], list[Panorama]]:
    """The pairs of a folder, and their panoramas by name; a warning states that the unit is arbitrary."""
    if arbitrary:
        with pytest.warns(InputWarning, match=r"unit of its poses is arbitrary.*scale\.txt"):
            pairs = load_sets(folder)
    else:
        pairs = load_sets(folder)
    views = {view.name: view for pair in pairs for view in pair.context}
    return pairs, [views[name] for name in sorted(views)]


def equirect_uv(local: Array, right: Array, up: Array, forward: Array) -> Array:
    """Panorama coordinates of points in a camera's frame, by the axes of the camera."""
    x, y, z = local @ right, local @ up, local @ forward
    return np.stack((np.arctan2(x, z) / (2 * np.pi) + 0.5, 0.5 - np.arctan2(y, np.hypot(x, z)) / np.pi), axis=-1)


X, Y, Z = np.eye(3)


def write_transforms(folder: Path, frames: list[dict], **fields: object) -> None:
    (folder / "transforms.json").write_text(json.dumps({**fields, "frames": frames}))


def opengl(pose: Array) -> Array:
    return pose @ np.diag((1.0, -1, -1, 1))


@pytest.fixture
def frames(tmp_path, cameras, write_panorama) -> list[dict]:
    """Of panoramas that are written into the folder of a test."""
    for name, pose in zip(NAMES, cameras, strict=True):
        write_panorama(tmp_path / "images" / name, pose)
    files = [f"images/{name}" for name in NAMES]
    return [{"file_path": f, "transform_matrix": opengl(p).tolist()} for f, p in zip(files, cameras, strict=True)]


def test_nerfstudio_equirectangular_cameras(tmp_path, cameras, points, frames, check_pixels) -> None:
    write_transforms(tmp_path, frames, camera_model="EQUIRECTANGULAR", w=128, h=64)
    pairs, panoramas = load(tmp_path)
    assert len(pairs) == 2 and [view.image.name for view in panoramas] == list(NAMES)
    for frame, panorama in zip(frames, panoramas, strict=True):
        matrix = np.array(frame["transform_matrix"])
        local = (points - matrix[:3, 3]) @ matrix[:3, :3]
        # nerfstudio.cameras.cameras: +y up, and z < 0 is the centre of the picture
        check_pixels(panorama, equirect_uv(local, X, Y, -Z))
        np.testing.assert_allclose(panorama.cam2world, cameras[NAMES.index(panorama.image.name)], atol=1e-12)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_points_that_nerfstudio_names_give_near_and_far(tmp_path, cameras, points, frames, kind) -> None:
    head = f"ply\nformat {kind} 1.0\nelement vertex {len(points)}\n"
    head += "".join(f"property {name}\n" for name in ("double x", "double y", "double z", "uchar red"))
    head += "element face 0\nproperty list uchar int vertex_indices\nend_header\n"
    table = np.zeros(len(points), [("xyz", ">f8" if kind == "binary_big_endian" else "<f8", 3), ("red", "u1")])
    table["xyz"] = points
    rows = "".join(f"{x} {y} {z} 0\n" for x, y, z in points).encode() if kind == "ascii" else table.tobytes()
    (tmp_path / "points.ply").write_bytes(head.encode() + rows)
    write_transforms(tmp_path, frames, camera_model="EQUIRECTANGULAR", ply_file_path="points.ply")
    distances = np.min([np.linalg.norm(points - pose[:3, 3], axis=1) for pose in cameras], axis=0)
    pair = load(tmp_path)[0][0]
    assert pair.near == pytest.approx(np.quantile(distances, 0.01) / 2, rel=0.01)
    assert pair.far == pytest.approx(np.quantile(distances, 0.99) * 2, rel=0.01)


def test_the_transform_and_scale_that_nerfstudio_applied_are_undone(tmp_path, cameras, frames) -> None:
    applied = np.array(((0, 1, 0, 0.3), (0, 0, -1, 2), (-1, 0, 0, 0), (0, 0, 0, 1.0)))
    for frame in frames:
        matrix = applied @ frame["transform_matrix"]
        matrix[:3, 3] *= 0.25
        frame["transform_matrix"] = matrix.tolist()
    fields = {"camera_model": "EQUIRECTANGULAR", "applied_transform": applied[:3].tolist(), "applied_scale": 0.25}
    write_transforms(tmp_path, frames, **fields)
    for panorama, pose in zip(load(tmp_path)[1], cameras, strict=True):
        np.testing.assert_allclose(panorama.cam2world, pose, atol=1e-9)


@pytest.mark.parametrize("rolls", [{}, {"up": 90, "left": 180, "down": -90}, {"up": 20}])
def test_nerfstudio_cube_faces_are_joined_to_panoramas(
    tmp_path: Path, cameras: list[Array], rolls: dict[str, float], write_view, face_cameras, check_colors
) -> None:
    frames, size = [], 48
    for name, pose in zip(("a", "b"), cameras, strict=False):
        for face, turned in face_cameras(pose).items():
            file = f"images/{name}_{face}.png"
            turned[:3, :3] @= Rotation.from_euler("Z", rolls.get(face, 0), degrees=True).as_matrix()
            write_view(tmp_path / file, turned, (size / 2,) * 4, size, size)
            frames.append({"file_path": file, "transform_matrix": opengl(turned).tolist()})
    write_transforms(tmp_path, frames, camera_model="OPENCV", fl_x=24, fl_y=24, cx=24, cy=24, w=48, h=48)
    (pair,), panoramas = load(tmp_path)
    assert [view.name for view in panoramas] == ["a", "b"] and pair.name == tmp_path.name
    assert panoramas[0].image.parents[1].name == ".pansplat" and pair.image_height == 76
    if 20 in rolls.values():  # no cube: two corners show nothing
        with pytest.warns(InputWarning, match="in no picture"):
            views = pair.load_context(64)
        assert 0.95 < views.masks.float().mean() < 1
        views = dataclasses.replace(views, images=torch.where(views.masks[:, None], views.images, torch.nan))
    else:
        views = pair.load_context(64)
        assert views.masks.all()
    for image, found, pose in zip(views.images, views.cam2world, cameras, strict=False):
        np.testing.assert_allclose(found, pose, atol=1e-6)
        check_colors(image, found)


def test_a_rig_without_down_faces_is_masked_there(tmp_path, cameras, write_view, check_colors) -> None:
    """Eight upright pictures of 80 x 100 degrees, one with a mask; their mean down axis is the panorama's."""
    width, height, fx, fy = 80, 96, 40 / np.tan(np.radians(40)), 48 / np.tan(np.radians(50))
    pose, frames = cameras[0], []
    for number in range(8):
        turned = pose.copy()
        turned[:3, :3] = pose[:3, :3] @ Rotation.from_euler("Y", 45 * number, degrees=True).as_matrix()
        write_view(tmp_path / f"v_{number}.png", turned, (fx, fy, 40, 48), width, height)
        frames.append({"file_path": f"v_{number}.png", "transform_matrix": opengl(turned).tolist()})
    Image.new("L", (80, 96), 0).save(tmp_path / "hidden.png")
    frames[2]["mask_path"] = "hidden.png"
    write_transforms(tmp_path, frames, fl_x=fx, fl_y=fy, cx=40, cy=48, w=width, h=height)
    (pair,), (panorama,) = load(tmp_path)
    np.testing.assert_allclose(panorama.cam2world, pose, atol=1e-9)
    with pytest.warns(InputWarning, match="is in no picture; these pixels are masked"):
        views = pair.load_context(64)
    mask = views.masks[0].numpy()
    assert not mask[:8].any() and not mask[-8:].any() and mask[24:40, :80].all()
    assert not mask[32, 94:98].any() and mask[32, 120]  # the third picture looks to the right
    check_colors(torch.where(views.masks[0], views.images[0], torch.nan), panorama.cam2world)


def _colmap(folder: Path, cameras: list[Array], points: Array) -> None:
    """A model of equirectangular cameras made by pycolmap."""
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=3, model="EQUIRECTANGULAR", width=128, height=64, params=[128, 64])
    )
    for number, (name, pose) in enumerate(zip(NAMES, cameras, strict=True), start=5):
        world = np.linalg.inv(pose)
        motion = pycolmap.Rigid3d(pycolmap.Rotation3d(world[:3, :3]), world[:3, 3])
        model.add_image_with_trivial_frame(pycolmap.Image(name=name, camera_id=3, image_id=number), motion)
    for point in points:
        model.add_point3D(point, pycolmap.Track(), np.zeros(3, np.uint8))
    folder.mkdir(parents=True)
    model.write(folder)


@pytest.mark.parametrize("kind", ["binary", "text"])
def test_colmap_equirectangular_cameras_project_as_pycolmap_does(
    tmp_path: Path, cameras: list[Array], points: Array, kind: str, write_panorama, check_pixels
) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    for name, pose in zip(NAMES, cameras, strict=True):
        write_panorama(tmp_path / "images" / name, pose)
    model = tmp_path / "sparse" / "0"
    _colmap(model, cameras, points)
    if kind == "text":
        content = pycolmap.Reconstruction(model)
        shutil.rmtree(model)
        model.mkdir()
        content.write_text(model)
    content = pycolmap.Reconstruction(model)
    pairs, panoramas = load(tmp_path)
    assert len(pairs) == 2
    for panorama in panoramas:
        image = content.find_image_with_name(panorama.image.name)
        pixels = np.array([content.camera(3).img_from_cam(image.cam_from_world() * point) for point in points])
        check_pixels(panorama, pixels / (128, 64))
    near, far = pairs[0].near, pairs[0].far  # from the points
    distances = np.min([np.linalg.norm(points - pose[:3, 3], axis=1) for pose in cameras], axis=0)
    assert near == pytest.approx(np.quantile(distances, 0.01) / 2, rel=0.01)
    assert far == pytest.approx(np.quantile(distances, 0.99) * 2, rel=0.01)
    load(model / f"images.{'txt' if kind == 'text' else 'bin'}")


def test_openmvg_spherical_views(tmp_path, cameras, points, write_panorama, check_pixels) -> None:
    views, extrinsics = [], []
    for number, (name, pose) in enumerate(zip(NAMES, cameras, strict=True)):
        write_panorama(tmp_path / name, pose)
        data = {"local_path": "", "filename": name, "id_view": number, "id_intrinsic": 0, "id_pose": number + 7}
        views.append({"key": number, "value": {"polymorphic_id": 1 << 30, "ptr_wrapper": {"id": 1, "data": data}}})
        rotation = pose[:3, :3].T.tolist()
        extrinsics.append({"key": number + 7, "value": {"rotation": rotation, "center": pose[:3, 3].tolist()}})
    lens = {"polymorphic_id": (1 << 31) + 1, "polymorphic_name": "spherical", "ptr_wrapper": {"data": {}}}
    structure = [{"key": n, "value": {"X": point.tolist(), "observations": []}} for n, point in enumerate(points)]
    content = {
        "sfm_data_version": "0.3", "root_path": "/elsewhere/images", "views": views,
        "intrinsics": [{"key": 0, "value": lens}], "extrinsics": extrinsics, "structure": structure,
    }  # fmt: skip
    (tmp_path / "sfm_data.json").write_text(json.dumps(content))
    for panorama, item in zip(load(tmp_path)[1], extrinsics, strict=True):
        local = (points - item["value"]["center"]) @ np.array(item["value"]["rotation"]).T
        longitude = np.arctan2(local[:, 0], local[:, 2])
        latitude = np.arctan2(-local[:, 1], np.hypot(local[:, 0], local[:, 2]))
        # Camera_Spherical.hpp: cam2ima({lon / (2 pi), -lat / (2 pi)}), times the width, from the middle of the picture
        check_pixels(panorama, np.stack((longitude / (2 * np.pi) + 0.5, -latitude / (2 * np.pi) * 2 + 0.5), axis=-1))
    content["intrinsics"][0]["value"]["polymorphic_name"] = "pinhole"
    (tmp_path / "sfm_data.json").write_text(json.dumps(content))
    expect_error(r"sfm_data\.json: needed spherical views with poses, got 3 views, 3 poses and 0", load_sets, tmp_path)


def test_opensfm_spherical_shots(tmp_path, cameras, points, write_panorama, check_pixels) -> None:
    shots = {}
    for name, pose in zip(NAMES, cameras, strict=True):
        write_panorama(tmp_path / "images" / name, pose)
        world = np.linalg.inv(pose)
        rotation = Rotation.from_matrix(world[:3, :3]).as_rotvec().tolist()
        shots[name] = {"rotation": rotation, "translation": world[:3, 3].tolist(), "camera": "c"}
    part = {
        "cameras": {"c": {"projection_type": "equirectangular", "width": 128, "height": 64}}, "shots": shots,
        "points": {str(n): {"coordinates": point.tolist(), "color": [0, 0, 0]} for n, point in enumerate(points)},
        "reference_lla": {"latitude": 47.1, "longitude": 8.5, "altitude": 0.0},
    }  # fmt: skip
    (tmp_path / "reconstruction.json").write_text(json.dumps([{"cameras": {}, "shots": {}}, part]))
    with pytest.warns(InputWarning, match="1 smaller reconstruction without.* left out"):
        _, panoramas = load(tmp_path, arbitrary=False)
    for panorama in panoramas:
        shot = shots[panorama.image.name]
        x, y, z = (Rotation.from_rotvec(shot["rotation"]).apply(points) + shot["translation"]).T
        u, v = np.arctan2(x, z) / (2 * np.pi), -np.arctan2(-y, np.hypot(x, z)) / (2 * np.pi)
        check_pixels(panorama, np.stack((u + 0.5, 2 * v + 0.5), axis=-1))  # normalised by the width
    part["cameras"]["c"]["projection_type"] = "perspective"
    (tmp_path / "reconstruction.json").write_text(json.dumps([part]))
    expect_error(r"reconstruction\.json: needed shots of a spherical camera, got none of 3", load_sets, tmp_path)


def test_metashape_spherical_cameras(tmp_path, cameras, points, write_panorama, check_pixels) -> None:
    turn, scale = Rotation.from_rotvec((0.3, -1, 0.2)).as_matrix(), 2.5
    rows = []
    for name, pose in zip(NAMES, cameras, strict=True):
        write_panorama(tmp_path / name, pose)
        matrix = pose.copy()  # in the frame of the chunk: world = scale turn chunk + translation
        matrix[:3, :3] = turn.T @ pose[:3, :3]
        matrix[:3, 3] = turn.T @ pose[:3, 3] / scale
        numbers = " ".join(f"{x:.15g}" for x in matrix.reshape(-1))
        rows.append(
            f'<camera id="{len(rows)}" sensor_id="0" label="{name[:-4]}"><transform>{numbers}</transform></camera>'
        )
    text = (
        '<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk label="c"><sensors next_id="1">'
        '<sensor id="0" label="x" type="spherical"><resolution width="128" height="64"/></sensor></sensors>'
        f'<cameras next_id="3"><group id="0">{rows[0]}</group>{"".join(rows[1:])}<camera id="9" sensor_id="0" '
        'label="unaligned"/></cameras><transform><rotation locked="true">'
        f"{' '.join(map(str, turn.reshape(-1)))}</rotation><translation>6378137 0 0</translation>"
        f"<scale>{scale}</scale></transform></chunk></document>"
    )
    (tmp_path / "cameras.xml").write_text(text)
    for panorama, pose in zip(load(tmp_path, arbitrary=False)[1], cameras, strict=True):
        np.testing.assert_allclose(panorama.cam2world, pose, atol=1e-9)
        check_pixels(panorama, equirect_uv((points - pose[:3, 3]) @ pose[:3, :3], X, -Y, Z))
    (tmp_path / "cameras.xml").write_text(text.replace('type="spherical"', 'type="frame"'))
    expect_error(r"cameras\.xml: needed aligned cameras of a spherical sensor, got 3 aligned", load_sets, tmp_path)
    (tmp_path / "cameras.xml").write_text(text[:-20])
    expect_error(r"cameras\.xml: needed cameras exported by Metashape.*Export Cameras", load_sets, tmp_path)


def test_only_the_largest_component_of_metashape_is_one_world(tmp_path, cameras, write_panorama) -> None:
    turn = " ".join(map(str, Rotation.from_rotvec((0, 0.5, 0)).as_matrix().reshape(-1)))
    rows = []
    for number, (name, pose) in enumerate(zip(NAMES, cameras, strict=True)):
        write_panorama(tmp_path / name, pose)
        rows.append(
            f'<camera id="{number}" sensor_id="0" component_id="{min(number, 1)}" label="{name[:-4]}"><transform>'
            f"{' '.join(map(str, pose.reshape(-1)))}</transform></camera>"
        )
    (tmp_path / "cameras.xml").write_text(
        '<document version="2.0.0"><chunk><sensors><sensor id="0" type="spherical"/></sensors><components>'
        f'<component id="0"><transform><rotation>{turn}</rotation><scale>7</scale></transform></component>'
        '<component id="1"><transform><scale>2</scale></transform></component></components>'
        f"<cameras>{''.join(rows)}</cameras></chunk></document>"
    )
    with pytest.warns(InputWarning) as notes:
        pairs = load_sets(tmp_path)
    assert any("cameras.xml: 1 smaller reconstruction without" in str(note.message) for note in notes)
    worlds = {view.name: view.world for pair in pairs for view in pair.context}
    alone, *others = (worlds[name[:-4]] for name in NAMES)
    assert len(worlds) == 3 and len(set(others)) == 1 and alone not in others, "a scene of its own"
    (pair,) = (pair for pair in pairs if len(pair.context) == 2)
    for view, pose in zip(pair.context, cameras[1:], strict=True):
        np.testing.assert_allclose(view.cam2world[:3, 3], 2 * pose[:3, 3], atol=1e-9)


def test_without_a_known_unit_near_and_far_follow_from_the_distances_of_cameras(tmp_path, frames) -> None:
    write_transforms(tmp_path, frames, camera_model="EQUIRECTANGULAR")
    assert load(tmp_path)[0][0].near == pytest.approx(0.01 * load(tmp_path)[0][0].far) != 0.45
    (tmp_path / "scale.txt").write_text("0.5")
    (pair, _), _ = load(tmp_path, arbitrary=False)
    assert (pair.near, pair.far) == (0.45, 10.0)


def test_a_file_that_cannot_be_used_is_named_with_what_to_do(tmp_path, cameras, write_panorama, write_view) -> None:
    source = tmp_path / "transforms.json"
    write_view(tmp_path / "v.png", cameras[0], (24,) * 4, 48, 48)
    frame = {"file_path": "v.png", "transform_matrix": cameras[0].tolist(), "fl_x": 24}
    for content, message in (
        ({}, '"frames"'),
        ({"frames": [frame]}, "17%"),
        ({"frames": [frame | {"k1": 0.1}]}, "frame 0: .*k1"),
        ({"frames": [frame | {"camera_model": "OPENCV_FISHEYE"}]}, "OPENCV_FISHEYE"),
        ({"frames": [frame | {"file_path": "gone.png"}]}, r"gone\.png"),
        ({"frames": [frame | {"mask_path": "masks/a.png"}]}, r"frame 0: .*masks/a\.png"),
        ({"frames": [frame | {"transform_matrix": [[1]]}]}, "4x4"),
        ({"frames": [{key: frame[key] for key in ("file_path", "transform_matrix")}]}, '"fl_x"'),
    ):
        source.write_text(json.dumps(content))
        expect_error(rf"transforms\.json.*{message}", load_sets, tmp_path)
    source.unlink()
    model = tmp_path / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("1 OPENCV 48 48 24 24 24 24 0.1 0 0 0\n")
    (model / "images.txt").write_text("1 1 0 0 0 0 0 0 1 v.png\n\n")
    expect_error(r"images\.txt, 'v\.png'.*OPENCV", load_sets, tmp_path)
    for name in ("cameras", "images"):
        (model / f"{name}.bin").write_bytes(b"\x05\0\0\0\0\0\0\0\1")
    expect_error(r"sparse.0.cameras\.bin: .* damaged", load_sets, tmp_path)
