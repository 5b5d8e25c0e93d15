"""Furniture of a catalogue has the catalogue's size, stands on the floor, and faces -z."""

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pansplat.errors import InputError
from pansplat_homes.bvh import MESH
from pansplat_homes.homes import build_home
from pansplat_homes.library import FREE, WALL, load_furniture
from pansplat_homes.scene import SceneBuilder
from pansplat_homes.textures import Pattern

CATALOGUE = """id=Test
name#1=Iron bed
category#1=Bedroom
model#1=/a/bed.obj
width#1=140
depth#1=200
height#1=50
creator#1=Ann
name#2=Truck
category#2=Vehicles
model#2=/a/bed.obj
width#2=1
depth#2=1
height#2=1
name#3=Chair
category#3=Living room
model#3=/a/bed.obj
width#3=40
depth#3=50
height#3=60
modelRotation#3=0 0 1 0 1 0 -1 0 0
creator#3=Bob
"""
FACES = (
    "f 1/1 2/1 3/1 4/1\nf 5/1 8/1 7/1 6/1\nf 1/1 5/1 6/1 2/1\nf 2/1 6/1 7/1 3/1\nf 3/1 7/1 8/1 4/1\nf 5/1 1/1 4/1 8/1\n"
)
MODEL = (
    "mtllib bed.mtl\n"
    + "".join(f"v {x} {y} {z}\n" for z in (0, 7) for x, y in ((0, 0), (3, 0), (3, 2), (0, 2)))
    + f"vt 0.5 0.5\nusemtl cloth\n{FACES}usemtl glass\nv 1 1 9\nv 2 1 9\nv 2 2 9\nf 9/1 10/1 11/1\n"
    + "usemtl front\nf 5/1 6/1 7/1\n"
)
MATERIALS = "newmtl cloth\nmap_Kd a cloth.png\nnewmtl glass\nKd 1 1 1\nd 0.1\nnewmtl front\nKd 1 0 0\nKs 1 1 1\nNs 50\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    image = io.BytesIO()
    Image.new("RGB", (600, 300), (0, 255, 0)).save(image, "PNG")
    with zipfile.ZipFile(tmp_path / "Scopia.sh3f", "w") as archive:
        archive.writestr("PluginFurnitureCatalog.properties", CATALOGUE)
        archive.writestr("a/bed.obj", MODEL)
        archive.writestr("a/bed.mtl", MATERIALS)
        archive.writestr("a/a cloth.png", image.getvalue())
    return tmp_path


def test_pieces_have_the_size_category_and_place_of_the_catalogue(folder: Path) -> None:
    bed, chair = load_furniture(folder).pieces
    assert (bed.name, bed.category, bed.place, bed.size) == ("Iron bed", "bed", WALL, (1.4, 0.5, 2.0))
    assert (chair.category, chair.place, chair.size) == ("chair", FREE, (0.4, 0.6, 0.5))
    assert (bed.mesh.corners.min(), bed.mesh.corners.max()) == pytest.approx((-1, 1), abs=1e-4)


def test_glass_is_omitted_but_measured_and_the_front_of_a_model_faces_minus_z(folder: Path) -> None:
    bed, chair = load_furniture(folder).pieces
    for piece, axis, sign in ((bed, 2, -1), (chair, 0, 1)):
        red = [k for k, material in enumerate(piece.mesh.materials) if material.color[0] > 5 * material.color[1]]
        front = piece.mesh.corners[piece.mesh.material_ids == red[0]]
        assert np.allclose(front[..., axis], sign * (7 - 4.5) / 4.5, atol=1e-4)
        assert piece.mesh.materials[red[0]].gloss == 0.5
        assert len(piece.mesh.material_ids) == 13


def test_images_are_reduced_and_decoded(folder: Path) -> None:
    mesh = load_furniture(folder).pieces[0].mesh
    texture = next(material.texture for material in mesh.materials if material.texture is not None)
    assert texture.size == (256, 128) and (texture.pixels == (0, 255, 0, 255)).all()


def test_a_piece_stands_on_the_floor(folder: Path) -> None:
    bed = load_furniture(folder).pieces[0]
    builder = SceneBuilder(np.random.default_rng(0))
    grey = builder.add_material(Pattern.PLAIN, (0.5, 0.5, 0.5), mottle=0)
    builder.add_mesh(bed.mesh, (0, -0.25, 0), (0.7, 0.25, 1.0), [grey] * len(bed.mesh.materials))
    builder.add_box((0, 0.1, 0), (9, 0.1, 9), grey)
    builder.add_room((-20, -20, 20, 20), [grey] * 5, 0, 0, 20)
    scene = builder.finish((1, 1, 1), grey, grey)
    pose = np.eye(4)
    pose[:3, 3] = 0, -1.5, 0
    _, depth = scene.panorama(pose, 64, 1)
    assert depth[63, 0] == pytest.approx(1.0, rel=1e-3)  # the upper side of the bed
    pose[:3, 3] = 0, -0.01, -2
    _, depth = scene.panorama(pose, 64, 1)
    assert depth[31, 64] == pytest.approx(1 + 2 * 2 / 9, rel=2e-3)  # its front


def test_a_cache_replaces_the_catalogues(folder: Path, tmp_path: Path) -> None:
    cache = tmp_path / "furniture.npz"
    first = load_furniture(folder, cache)
    again = load_furniture(folder / "missing", cache)
    for a, b in zip(first.pieces, again.pieces, strict=True):
        assert (a.name, a.size, a.author) == (b.name, b.size, b.author)
        assert np.array_equal(a.mesh.corners, b.mesh.corners)
    with pytest.raises(InputError, match=r"needed catalogues \*\.sh3f"):
        load_furniture(folder / "missing")


def test_the_attribution_names_authors_and_licences(folder: Path) -> None:
    text = load_furniture(folder).attribution()
    assert "CC BY 3.0" in text and "Ann: Iron bed" in text and "Bob: Chair" in text


def test_homes_contain_furniture_of_a_library_and_are_complete_without_one(folder: Path) -> None:
    library, found = load_furniture(folder), 0
    for index in range(6):
        home = build_home(np.random.default_rng(index), library)
        found += int((home.variants[0].arrays.bodies.kinds == MESH).sum())
    assert found > 0
    plain = build_home(np.random.default_rng(1))
    assert (plain.variants[0].arrays.bodies.kinds != MESH).all()
