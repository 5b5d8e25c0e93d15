"""Meshes: rays hit the triangles that a search over all of them finds; images, OBJ files and simplification."""

import math
from itertools import product

import numpy as np
import pytest

from pansplat_homes.bvh import first_hit
from pansplat_homes.meshes import Mesh, MeshMaterial, Texture, make_mesh, read_obj, simplify
from pansplat_homes.scene import GeneratedScene, SceneBuilder
from pansplat_homes.textures import Pattern, image_color, mip_levels

GREY = (MeshMaterial((0.5, 0.5, 0.5)),)
SQUARE = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3 4/4\n"


def _random_mesh(count: int, seed: int = 0) -> Mesh:
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-1, 1, (count, 1, 3)) + rng.uniform(-0.3, 0.3, (count, 3, 3))
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in corners.reshape(-1, 3))
    text += "".join(f"f {3 * k + 1} {3 * k + 2} {3 * k + 3}\n" for k in range(count))
    return make_mesh(read_obj(text)[0], GREY)


def _scene(*bodies) -> GeneratedScene:
    builder = SceneBuilder(np.random.default_rng(0))
    grey = builder.add_material(Pattern.PLAIN, (0.5, 0.5, 0.5), mottle=0)
    for mesh, centre, half, yaw in bodies:
        shown = [builder.add_image_material(m.texture) if m.texture else grey for m in mesh.materials]
        builder.add_mesh(mesh, centre, half, shown, yaw)
    builder.add_room((-20, -20, 20, 20), [grey] * 5, 0, 0, 20)
    return builder.finish((1, 1, 1), grey, grey)


def _world_triangles(mesh: Mesh, centre, half, yaw: float) -> np.ndarray:
    turn = np.array(((math.cos(yaw), 0, math.sin(yaw)), (0, 1, 0), (-math.sin(yaw), 0, math.cos(yaw))))
    return (mesh.corners.astype(np.float64) * half) @ turn.T + centre


def _nearest(triangles: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> float:
    """Distance along a ray by solving for barycentric coordinates of each triangle."""
    first, edges = triangles[:, 0], triangles[:, 1:] - triangles[:, :1]
    matrix = np.stack((edges[:, 0], edges[:, 1], np.broadcast_to(-direction, first.shape)), axis=-1)
    a, b, t = np.linalg.solve(matrix, (origin - first)[..., None])[..., 0].T
    inside = (a >= 0) & (b >= 0) & (a + b <= 1) & (t > 1e-6)
    return t[inside].min(initial=math.inf)


def test_rays_hit_the_nearest_triangle_of_all_placed_meshes() -> None:
    rng = np.random.default_rng(1)
    meshes = [_random_mesh(300), _random_mesh(40, 1)]
    bodies = [(meshes[k % 2], rng.uniform(-3, 3, 3), rng.uniform(0.3, 1.5, 3), rng.uniform(0, 6)) for k in range(5)]
    scene, triangles = _scene(*bodies), np.concatenate([_world_triangles(*body) for body in bodies])
    hits = 0
    for _ in range(300):
        origin = rng.uniform(-4, 4, 3)
        direction = bodies[rng.integers(5)][1] + rng.normal(0, 0.5, 3) - origin
        direction /= np.linalg.norm(direction)
        ray = tuple(origin), tuple(direction)
        t, body, triangle = first_hit(scene.arrays.bodies, *ray, math.inf, False, True)
        exact = _nearest(triangles, origin, direction)
        assert t == pytest.approx(exact, rel=1e-5, abs=1e-5)
        assert (body >= 0) == (triangle >= 0) == math.isfinite(exact)
        assert (first_hit(scene.arrays.bodies, *ray, 2.0, True, True)[1] >= 0) == (exact < 2)
        hits += body >= 0
    assert 60 < hits < 290


def test_meshes_of_spheres_are_shaded_as_spheres() -> None:
    """Interpolated normals, in a stretched and turned placement, agree with those of an ellipsoid."""
    azimuth, latitude = np.meshgrid(np.linspace(0, 2 * np.pi, 65), np.linspace(0, np.pi, 33), indexing="ij")
    rise, across = np.cos(latitude), np.sin(latitude)
    sphere = np.stack((across * np.cos(azimuth), rise, across * np.sin(azimuth)), axis=-1).astype(np.float32)
    a, b, c, d = sphere[:-1, :-1], sphere[1:, :-1], sphere[1:, 1:], sphere[:-1, 1:]
    corners = np.stack((np.stack((a, b, c), axis=-2), np.stack((a, c, d), axis=-2))).reshape(-1, 3, 3)
    material_ids, texcoords = np.zeros(len(corners), np.int32), np.zeros((len(corners), 3, 2), np.float32)
    ball = Mesh(corners, corners, texcoords, material_ids, GREY)
    images = []
    for is_mesh in (True, False):
        builder = SceneBuilder(np.random.default_rng(0))
        grey = builder.add_material(Pattern.PLAIN, (0.5, 0.5, 0.5), mottle=0)
        if is_mesh:
            builder.add_mesh(ball, (0, 0, 3), (1.0, 0.5, 0.8), [grey], 0.7)
        else:
            builder.add_ellipsoid((0, 0, 3), (1.0, 0.5, 0.8), grey, 0.7)
        builder.add_light((2, -3, 0), (9, 9, 9), 0.0)
        builder.add_room((-20, -20, 20, 20), [grey] * 5, 0, 0, 20, (0, 0, 0))
        images.append(builder.finish((0, 0, 0), grey, grey).panorama(np.eye(4), 128, 1))
    (seen, near), (exact, far) = images
    both = (near < 4) & (far < 4)
    assert both.sum() > 200
    assert (np.abs(near - far)[both] < 0.01).mean() > 0.95
    assert np.abs(seen - exact)[both].mean() < 0.01
    assert exact[both].std() > 0.05


def test_both_sides_of_a_face_are_visible_and_lit() -> None:
    square = make_mesh(read_obj(SQUARE)[0], GREY)
    builder = SceneBuilder(np.random.default_rng(0))
    grey = builder.add_material(Pattern.PLAIN, (0.5, 0.5, 0.5), mottle=0)
    for z in (-2, 2):
        builder.add_mesh(square, (0, 0, z), (1, 1, 0.01), [grey])
    builder.add_light((0, 0, 0), (4, 4, 4), 0.0)
    builder.add_room((-20, -20, 20, 20), [grey] * 5, 0, 0, 20, (0, 0, 0))
    image, depth = builder.finish((0, 0, 0), grey, grey).panorama(np.eye(4), 64, 1)
    assert depth[32, 64] == pytest.approx(2, rel=1e-3) and depth[32, 0] == pytest.approx(2, rel=1e-3)
    assert image[32, 64] == pytest.approx(0.5 * 4 / 4.6, rel=0.02)
    assert image[32, 0] == pytest.approx(image[32, 64], rel=0.02)


def test_images_are_seen_upright_and_unmirrored_from_the_front() -> None:
    """The front of an OBJ model, +z with y up, becomes -z with y down."""
    pixels = np.full((2, 2, 4), 255, np.uint8)
    pixels[0, 0, :3], pixels[0, 1, :3], pixels[1, 0, :3] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
    material = (MeshMaterial((1, 1, 1), Texture(pixels)),)
    square = make_mesh(read_obj(SQUARE)[0], material, np.diag((1, -1, -1)))
    scene = _scene((square, (0, 0, 2), (1.0, 1.0, 0.01), 0.0))
    image, _ = scene.panorama(np.eye(4), 128, 1)
    found = {(dy, dx): image[64 + 8 * dy, 128 + 8 * dx].argmax() for dy, dx in product((-1, 1), (-1, 1))}
    assert [found[-1, -1], found[-1, 1], found[1, -1]] == [0, 1, 2]


def test_transparent_texels_are_holes() -> None:
    pixels = np.full((8, 8, 4), 255, np.uint8)
    pixels[:, 4:, 3] = 0
    square = make_mesh(read_obj(SQUARE)[0], (MeshMaterial((1, 1, 1), Texture(pixels)),), np.diag((1, -1, -1)))
    _, depth = _scene((square, (0, 0, 2), (1.0, 1.0, 0.01), 0.0)).panorama(np.eye(4), 64, 1)
    assert depth[32, 60] < 2.2 < 30 < depth[32, 68]


def test_coarser_levels_keep_the_mean_of_linear_light() -> None:
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (16, 32, 4)).astype(np.uint8)
    texels = mip_levels(pixels)
    assert len(texels) == 32 * 16 + 16 * 8 + 8 * 4 + 4 * 2 + 2 * 1 + 1
    encoded = pixels[..., :3] / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    image = np.array([0, 32, 16])
    assert image_color(texels, image, 0.3, 0.8, 9.0) == pytest.approx(linear.mean(axis=(0, 1)), abs=0.006)
    for row, column in ((0, 0), (3, 30), (15, 7)):
        u, v = (column + 0.5) / 32, 1 - (row + 0.5) / 16
        assert image_color(texels, image, u - 2, v + 1, 0.0) == pytest.approx(linear[row, column], abs=1e-9)
    halfway = image_color(texels, image, 1.0, 1 - 0.5 / 16, 0.0)
    assert halfway == pytest.approx((linear[0, 0] + linear[0, -1]) / 2, abs=1e-9)


def test_obj_files_may_count_backwards_and_have_polygons_and_several_materials() -> None:
    text = "usemtl a\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvn 0 0 1\nf -4//-1 -3//-1 -2//-1 -1//-1\nusemtl b\nf 1 2 3\n"
    triangles, names = read_obj(text)
    assert names[1:] == ["a", "b"] and list(triangles.material_ids) == [1, 1, 2]
    assert np.allclose(triangles.corners[1], ((0, 0, 0), (1, 1, 0), (0, 1, 0)))
    assert np.allclose(triangles.normals, (0, 0, 1))


def test_simplified_meshes_stay_near_the_surface() -> None:
    rng = np.random.default_rng(0)
    steps = np.arange(81)
    heights = 0.1 * rng.random((81, 81))
    text = "".join(f"v {x} {heights[x, z]} {z}\n" for x in steps for z in steps)
    text += "".join(
        f"f {a} {a + 1} {a + 82} {a + 81}\n" for x in steps[:-1] for z in steps[:-1] for a in [81 * x + z + 1]
    )
    triangles, _ = read_obj(text)
    small = simplify(triangles, 1000)
    assert len(triangles.material_ids) == 12800 and 500 < len(small.material_ids) <= 1000
    assert small.corners[..., 1].min() >= 0 and small.corners[..., 1].max() <= 0.1
    extent = np.ptp(small.corners.reshape(-1, 3), axis=0)
    assert extent[0] > 75 and extent[2] > 75
    area = np.linalg.norm(np.cross(*(small.corners[:, k] - small.corners[:, 0] for k in (1, 2))), axis=-1).sum() / 2
    assert area == pytest.approx(80 * 80, rel=0.1)
