"""Ray tracing has closed-form distances, and the BVH finds every hit."""

import math

import numpy as np
import pytest

from pansplat_homes.bvh import first_hit
from pansplat_homes.raytracer import portal_form_factor
from pansplat_homes.scene import GeneratedScene, SceneBuilder
from pansplat_homes.textures import Pattern


def _scene(fill) -> GeneratedScene:
    builder = SceneBuilder(np.random.default_rng(0))
    material = builder.add_material(Pattern.PLAIN, (0.5, 0.5, 0.5), mottle=0)
    fill(builder, material)
    builder.add_room((-20, -20, 20, 20), [material] * 5, 0, 0, 20)
    return builder.finish((1, 1, 1), material, material)


def _distance(scene: GeneratedScene, origin, towards) -> tuple[float, int]:
    direction = np.asarray(towards, float) / np.linalg.norm(towards)
    return first_hit(scene.arrays.bodies, tuple(map(float, origin)), tuple(direction), math.inf, False, True)[:2]


def test_distances_to_single_bodies_are_exact() -> None:
    turned = _scene(lambda b, material: b.add_box((0, 0, 4), (1, 1, 1), material, yaw=math.pi / 4))
    assert _distance(turned, (0, 0, 0), (1e-9, 1e-9, 1)) == (pytest.approx(4 - math.sqrt(2)), 0)
    ball = _scene(lambda b, material: b.add_ellipsoid((3, 0, 0), (2, 1, 0.5), material))
    assert _distance(ball, (0, 0, 0), (1, 0, 0))[0] == pytest.approx(1)
    drum = _scene(lambda b, material: b.add_cylinder((0, 3, 0), 1, 0.5, material))
    assert _distance(drum, (0.9, 0, 0), (1e-9, 1, 1e-9))[0] == pytest.approx(2.5)
    assert _distance(drum, (-3, 3.2, 0), (1, 1e-9, 1e-9))[0] == pytest.approx(2)
    assert _distance(drum, (0, 0, 1.1), (1e-9, 1, 1e-9)) == (math.inf, -1)


def test_the_bvh_gives_the_hits_of_an_exhaustive_search() -> None:
    rng = np.random.default_rng(5)

    def fill(builder: SceneBuilder, material: int) -> None:
        for _ in range(60):
            centre, half = rng.uniform(-5, 5, size=3), rng.uniform(0.1, 0.8, size=3)
            kind = rng.integers(3)
            if kind == 0:
                builder.add_box(centre, half, material, *rng.uniform(0, 3, size=2))
            elif kind == 1:
                builder.add_ellipsoid(centre, half, material, rng.uniform(0, 3))
            else:
                builder.add_cylinder(centre, half[0], half[1], material, rng.uniform(0, 3))

    scene = _scene(fill)
    bodies = scene.arrays.bodies
    everything = np.array([[-99.0, -99, -99, 99, 99, 99]])
    hits = 0
    for _ in range(150):
        origin, direction = rng.uniform(-6, 6, size=3), rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        ray = tuple(origin), tuple(direction)
        found = first_hit(bodies, *ray, math.inf, False, True)[:2]
        best = (math.inf, -1)
        for k in range(60):
            single = np.array([[k, 1]], np.int64)
            alone = bodies._replace(bounds=everything, links=single)
            best = min(best, first_hit(alone, *ray, math.inf, False, True)[:2])
        hits += found[1] >= 0
        assert found[0] == best[0]
        assert found[1] == best[1] or found[1] < 0
        blocked = first_hit(bodies, *ray, 3.0, True, True)[1] >= 0
        assert blocked == (found[0] < 3)
    assert 15 < hits < 135


@pytest.mark.slow
def test_depth_is_radial_at_pixel_centres() -> None:
    scene = _scene(lambda b, material: b.add_box((0, 1.5, 0), (30, 0.1, 30), material))
    _, depth = scene.panorama(_pose(3, 0.2, -1), 32, 2)
    below = np.arange(32) >= 20  # nearer to the horizon the floor ends
    latitude = (np.arange(32) + 0.5) * math.pi / 32 - math.pi / 2
    assert np.allclose(depth[below], (1.2 / np.sin(latitude[below]))[:, None], rtol=1e-12)
    assert (depth[:16] > 30).all()  # the sky
    assert np.isfinite(depth).all()


def test_bodies_cast_shadows() -> None:
    def fill(builder: SceneBuilder, material: int) -> None:
        builder.add_box((0, 1.1, 0), (5, 0.1, 5), material)
        builder.add_box((0, -0.5, 0), (0.3, 0.02, 0.3), material)
        builder.add_light((0, -2, 0), (20, 20, 20), 0.0)

    image, _ = _scene(fill).panorama(_pose(1.2, 0, 0), 64, 1)
    row = 32 + round(math.degrees(math.atan(1 / 1.2)) / 180 * 64)
    under_the_plate, on_the_other_side = image[row, 32, 0], image[row, 96, 0]
    assert under_the_plate == pytest.approx(0.5, abs=0.03)  # of the surrounding light, floors get all
    assert on_the_other_side > under_the_plate + 0.3


def test_a_portal_lights_its_group_as_the_integral_over_its_area() -> None:
    builder = SceneBuilder(np.random.default_rng(0))
    builder.add_portal((0, -1.2, 3), (0.7, 0.5), 2, (1, 1, 1), 0)
    light = builder.lights[0]
    x, y = np.meshgrid(np.linspace(-0.7, 0.7, 401), -1.2 + np.linspace(-0.5, 0.5, 401))
    for point, normal in (((0.3, -1.0, 0), (0, 0, 1)), ((-1, 0, 1), (0, -1, 0)), ((-2, -1, 2), (1, 0, 0))):
        ray = np.stack((x, y, np.full_like(x, 3)), axis=-1) - point
        away = np.linalg.norm(ray, axis=-1)
        exact = (ray @ normal * ray[..., 2] / (np.pi * away**4)).mean() * 1.4
        assert portal_form_factor(light, tuple(map(float, point)), tuple(map(float, normal))) == pytest.approx(
            exact, rel=0.1
        )
    threshold = portal_form_factor(light, (0.0, -1.2, 2.9999), (0.0, -1.0, 0.0))
    assert threshold == pytest.approx(0.5, abs=0.01)


def _pose(x: float, y: float, z: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def test_a_mirror_shows_the_mirrored_scene_and_has_no_depth() -> None:
    def fill(sign: int, builder: SceneBuilder, material: int) -> None:
        red = builder.add_material(Pattern.PLAIN, (0.8, 0.1, 0.1), mottle=0)
        builder.add_box((0.4, 0.1, 2 - sign), (0.3, 0.5, 0.1), red)
        builder.add_ellipsoid((-0.5, -0.4, 2 - 0.6 * sign), (0.3, 0.2, 0.4), material)
        builder.add_light((0.2, -2, 2 - 0.3 * sign), (5, 5, 5), 0.0)

    def fill_mirror(builder: SceneBuilder, material: int) -> None:
        fill(1, builder, material)
        glass = builder.add_material(Pattern.PLAIN, (0, 0, 0), mirror=0.9)
        builder.add_box((0, 0, 2.001), (3, 3, 0.001), glass)

    seen, depth = _scene(fill_mirror).panorama(_pose(0, 0, 1.6), 64, 1)
    direct, _ = _scene(lambda b, m: fill(-1, b, m)).panorama(_pose(0, 0, 1.6), 64, 1)
    ahead = np.s_[26:38, 55:74]
    assert (depth[ahead] == 0).all()
    assert np.isclose(seen[ahead], 0.9 * direct[ahead], rtol=1e-3).mean() > 0.98
    assert direct[ahead].std() > 0.1
    assert (depth[:, :30] > 0).all()


def test_glass_shows_what_is_behind_it_and_reflects_at_grazing_angles() -> None:
    def fill(builder: SceneBuilder, material: int) -> None:
        white = builder.add_material(Pattern.PLAIN, (0.9, 0.9, 0.9), glow=1, mottle=0)
        builder.add_box((0, 0, 4), (9, 9, 0.1), material)
        builder.add_box((9, 0, -4), (0.1, 9, 4.5), white)

    def fill_glass(builder: SceneBuilder, material: int) -> None:
        fill(builder, material)
        builder.add_glass((0, 0, 1), (9, 9, 0.01))

    through, depth = _scene(fill_glass).panorama(np.eye(4), 64, 1)
    without, distance = _scene(fill).panorama(np.eye(4), 64, 1)
    assert np.array_equal(depth, distance)
    assert np.allclose(through[32, 64], (1 - 0.08 / 1.04) * without[32, 64] + 0.08 / 1.04 * 0.5, atol=0.06)
    assert through[32, 90, 0] - without[32, 90, 0] > 2 * abs(through[32, 64, 0] - without[32, 64, 0])


def test_lamps_and_ambient_light_belong_to_rooms() -> None:
    builder = SceneBuilder(np.random.default_rng(0))
    material = builder.add_material(Pattern.PLAIN, (0.5, 0.5, 0.5), mottle=0)
    builder.add_box((0, 0.1, 0), (9, 0.1, 9), material)
    builder.add_room((-9, -9, 0, 9), [material] * 5, 0, 0, 20, (2, 1, 1), 0)
    builder.add_room((0, -9, 9, 9), [material] * 5, 0, 0, 20, (1, 1, 1), 1)
    builder.add_light((0, -2, 0), (0, 0, 4), 0.0, group=1)
    image, _ = builder.finish((1, 1, 1), material, material).panorama(_pose(0, -2, 0), 64, 1)
    angle = 54.5 / 64 * math.pi - math.pi / 2
    lit = 0.5 + 0.5 * 4 * math.sin(angle) / (0.6 + 4 / math.sin(angle) ** 2)
    assert image[54, 96] == pytest.approx([0.5, 0.5, lit], rel=0.03)
    assert image[54, 32] == pytest.approx([1, 0.5, 0.5], rel=0.03)


def test_polished_floors_reflect_more_at_grazing_angles() -> None:
    def fill(gloss: float, builder: SceneBuilder, material: int) -> None:
        floor = builder.add_material(Pattern.PLAIN, (0.1, 0.1, 0.1), gloss=gloss, mottle=0)
        white = builder.add_material(Pattern.PLAIN, (0.9, 0.9, 0.9), glow=1, mottle=0)
        builder.add_box((0, 0.1, 0), (9, 0.1, 9), floor)
        builder.add_box((0, -4, 9), (9, 4, 0.1), white)

    matt, polished = (_scene(lambda b, m, g=g: fill(g, b, m)).panorama(_pose(0, -1.5, 0), 64, 1) for g in (0.0, 1.0))
    assert np.array_equal(matt[1], polished[1])
    gain = polished[0][..., 0] - matt[0][..., 0]
    assert gain[38, 64] > 2 * gain[46, 64] > 0


def test_the_floor_is_darker_below_and_beside_what_stands_on_it() -> None:
    def fill(up: float, builder: SceneBuilder, material: int) -> None:
        builder.add_box((0, 0.1, 0), (9, 0.1, 9), material)
        builder.add_box((2, -up - 0.2, 0), (0.3, 0.2, 0.3), material)

    images = [_scene(lambda b, m, up=up: fill(up, b, m)).panorama(_pose(0, -1.5, 0), 128, 1)[0] for up in (0.0, 5.0)]
    column = 192  # towards +x
    rows = np.arange(90, 120)
    distances = 1.5 / np.tan((rows + 0.5) * math.pi / 128 - math.pi / 2)
    shade = images[0][rows, column, 0] / images[1][rows, column, 0]
    beside = (distances > 1.6) & (distances < 1.69)
    assert (shade[distances < 1.3] == 1).all()
    assert (shade[beside] < 0.85).all() and beside.any()
