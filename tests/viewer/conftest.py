"""One OpenGL context and pooled renderers for the session, scenes, and comparison with the torch reference."""

import functools
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest
import torch
from synthetic_scenes import make_balls

from pansplat.errors import InputError
from pansplat.gaussians.ply import save_ply
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.geometry.equirect import pixel_directions
from pansplat.geometry.fibonacci import fibonacci_directions
from pansplat.geometry.pose import rotations_from_quats
from pansplat.images.image_files import write_image
from pansplat.inputs.panorama_sets import Link, Panorama, PanoramaSet
from pansplat.rendering import Rendering, rasterize
from pansplat.tours.facts import TourFacts
from pansplat.tours.floor import FloorOutline
from pansplat.tours.graph import TourGraph
from pansplat.tours.merge import merge_scenes
from pansplat.tours.outlook import BINS
from pansplat.tours.scene_views import choose_scene_views
from pansplat_viewer.core.loader import LoadedScene, SceneEntry
from pansplat_viewer.core.tour_scenes import TourScenes
from pansplat_viewer.draw.cpu_renderer import CpuRenderer
from pansplat_viewer.draw.frame_renderer import FrameRenderer
from pansplat_viewer.draw.offscreen import create_context
from pansplat_viewer.draw.renderer import DrawSettings, SplatRenderer

_Y0 = 0.28209479177387814  # the constant harmonic


@pytest.fixture(scope="session")
def wait_until() -> Callable[..., Any]:
    """Calls a function until its result is true, and returns the result; fails after `seconds`."""

    def wait(condition: Callable[[], Any], expected: str, seconds: float = 300.0) -> Any:
        deadline = time.monotonic() + seconds
        while not (result := condition()):
            assert time.monotonic() < deadline, f"no {expected} in {seconds:.0f} s"
            time.sleep(0.005)
        return result

    return wait


@pytest.fixture(scope="session")
def gl_context() -> Iterator[moderngl.Context]:
    """A standalone OpenGL context. Use `ctx`, which makes it current and checks for errors."""
    try:
        context = create_context()
    except InputError as error:
        if os.environ.get("CI"):
            pytest.fail(str(error))
        pytest.skip(str(error))
    yield context
    context.release()


@pytest.fixture
def ctx(gl_context: moderngl.Context) -> Iterator[moderngl.Context]:
    """The OpenGL context, current; fails on an OpenGL error before or after the test."""
    with gl_context:
        assert gl_context.error == "GL_NO_ERROR"
        yield gl_context
        assert gl_context.error == "GL_NO_ERROR"


@pytest.fixture(scope="session")
def _renderers(gl_context: moderngl.Context) -> Iterator[dict[tuple[str, int, int], FrameRenderer]]:
    renderers: dict[tuple[str, int, int], FrameRenderer] = {}
    yield renderers
    with gl_context:
        for renderer in renderers.values():
            renderer.release()


@pytest.fixture
def make_renderer(ctx, _renderers) -> Callable[..., FrameRenderer]:
    """Returns a renderer with a newly uploaded scene; `name` may be `cpu`, `slot` selects one of several."""

    def get(scene: Scene, name: str = "gl", color_bits: int = 32, slot: int = 0) -> FrameRenderer:
        key = (name, color_bits, slot)
        if key not in _renderers and name == "cpu":
            _renderers[key] = CpuRenderer(ctx, exact=True)
        elif key not in _renderers:
            _renderers[key] = SplatRenderer(ctx, color_bits=color_bits)
        _renderers[key].upload(scene)
        return _renderers[key]

    return get


@pytest.fixture(scope="session")
def random_scene() -> Callable[..., Scene]:
    """Returns a shell of Gaussians of `size` radians, 1 to 4 m from the origin, elongated up to 10:1; do not modify."""
    return _make_random_scene


@functools.cache
def _make_random_scene(count: int = 300, degree: int = 1, size: float = 0.06, seed: int = 0) -> Scene:
    random = torch.Generator().manual_seed(seed)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=random), dim=-1)
    radii = 1 + 3 * torch.rand(count, 1, generator=random)
    elongation = torch.exp(0.8 * torch.randn(count, 3, generator=random))
    cam2world = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    cam2world[:, :3, 3] = torch.tensor(((0.3, 0.1, -0.2), (-0.3, 0.0, 0.25)))
    gaussians = Gaussians(
        means=directions * radii,
        scales=size * radii * elongation,
        quats=torch.randn(count, 4, generator=random),
        opacities=torch.rand(count, generator=random),
        harmonics=0.3 * torch.randn(count, (degree + 1) ** 2, 3, generator=random),
        levels=torch.randint(0, 4, (count,), generator=random),
        views=torch.randint(0, 2, (count,), generator=random),
    )
    return Scene(gaussians, cam2world, 0.45, 10.0, ("a", "b"))


@pytest.fixture
def pose() -> np.ndarray:
    """A camera near the origin with a general rotation."""
    cam2world = np.eye(4)
    quat = torch.tensor((0.7, 0.3, -0.5, 0.2), dtype=torch.float64)
    cam2world[:3, :3] = rotations_from_quats(quat).numpy()
    cam2world[:3, 3] = 0.05, -0.1, 0.08
    return cam2world


@pytest.fixture(scope="session")
def turn() -> Callable[[np.ndarray, float], np.ndarray]:
    """Returns a pose that is turned to the right by degrees."""

    def turn(pose: np.ndarray, degrees: float) -> np.ndarray:
        angle, turned = np.radians(degrees), pose.copy()
        about_y = np.array(((np.cos(angle), 0, np.sin(angle)), (0, 1, 0), (-np.sin(angle), 0, np.cos(angle))))
        turned[:3, :3] = pose[:3, :3] @ about_y
        return turned

    return turn


def _rasterize_reference(
    scene: Scene, cam2world: np.ndarray, size: tuple[int, int], settings: DrawSettings
) -> Rendering:
    options = {"vertical_fov_degrees": settings.vertical_fov_degrees, "near": settings.near}
    options |= {"size": size[::-1], "layout": "pinhole", "background": settings.background}
    return rasterize(scene.gaussians.to(dtype=torch.float64), torch.from_numpy(cam2world), **options)


@pytest.fixture
def reference() -> Callable[..., Rendering]:
    """Renders a scene with the float64 torch reference under the same settings."""
    return _rasterize_reference


@pytest.fixture
def assert_matches() -> Callable[..., None]:
    """Renders an image of the expected size and compares it with the Rendering, at all pixels or at those of a mask.

    Bounds: mean 1e-4, max 5e-3. Where alpha is within rounding of 1/255, one renderer may draw a splat and the other
    may skip it. That changes a pixel by at most 1/255 of the splat's colour. The maximum covers colours up to 1.25.
    """

    def check(
        renderer: FrameRenderer,
        cam2world: np.ndarray,
        settings: DrawSettings,
        expected: Rendering,
        where: np.ndarray | None = None,
    ) -> None:
        renderer.render(cam2world, expected.alpha.shape[::-1], settings)
        where = np.ones(expected.alpha.shape, bool) if where is None else where
        color = np.concatenate((expected.color.numpy(), expected.alpha.numpy()[None])).transpose(1, 2, 0)
        error = np.abs(renderer.read_color() - color)[where]
        assert error.mean() <= 1e-4
        assert error.max() <= 5e-3
        depth = expected.depth.numpy()
        relative = (np.abs(renderer.read_depth() - depth) / np.maximum(depth, 1e-3))[where]
        # Where alpha is small, one such splat changes the mean depth more, so the maximum is looser.
        assert relative.mean() <= 1e-4
        assert (relative > 5e-3).mean() <= 1e-3

    return check


@pytest.fixture
def assert_reference(make_renderer, reference, assert_matches) -> Callable[..., None]:
    """Checks that OpenGL and the processor render a scene as the reference does, perhaps another one, `drawn`."""

    def check(
        scene: Scene, cam2world: np.ndarray, size: tuple[int, int], settings: DrawSettings, drawn: Scene | None = None
    ) -> None:
        expected = reference(drawn or scene, cam2world, size, settings)
        for name in ("gl", "cpu"):
            assert_matches(make_renderer(scene, name), cam2world, settings, expected)

    return check


@pytest.fixture(scope="session")
def small_scene() -> Scene:
    """1200 Gaussians, large and tiny, around two cameras 0.5 m apart along +z; the views differ in colour."""
    random = torch.Generator().manual_seed(3)
    count, parts = 600, []
    for view in range(2):
        directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=random), dim=-1)
        radii = 2 + 2 * torch.rand(count, 1, generator=random)
        color = 0.5 + 0.4 * directions
        color[:, view] *= 0.3
        parts.append(
            Gaussians(
                means=directions * radii + torch.tensor((0, 0, 0.5 * view)),
                scales=torch.tensor((0.5, 0.3, 0.1)) * torch.where(torch.arange(count) % 2 > 0, 1, 0.02)[:, None],
                quats=torch.randn(count, 4, generator=random),
                opacities=torch.rand(count, generator=random),
                harmonics=((color - 0.5) / _Y0)[:, None, :],
                levels=torch.randint(0, 4, (count,), generator=random),
                views=torch.full((count,), view),
            )
        )
    cam2world = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    cam2world[1, 2, 3] = 0.5
    return Scene(Gaussians.cat(parts), cam2world, 0.45, 10.0, ("a.png", "b.png"), "synthetic", 64)


@pytest.fixture
def room(tmp_path: Path, small_scene: Scene) -> Path:
    """The small scene as a file."""
    save_ply(small_scene, tmp_path / "room.ply")
    return tmp_path / "room.ply"


@pytest.fixture(scope="session")
def axis_photos() -> np.ndarray:
    """Two panoramas coloured by direction: red to the right, green up, blue ahead; the second is dim."""
    directions = pixel_directions(128, 256).numpy()
    image = 0.5 + 0.5 * directions * np.array((1, -1, 1), dtype=np.float32)
    return np.stack((image, 0.3 * image)).astype(np.float32)


@pytest.fixture(scope="session")
def house(tmp_path_factory, axis_photos) -> TourGraph:
    """A tour of four panoramas, 0.8 m apart along an L; its three edges have a scene each."""
    folder = tmp_path_factory.mktemp("house")
    panoramas = []
    for index, (x, z) in enumerate(((0, 0), (0, 0.8), (0, 1.6), (0.8, 1.6))):
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3], pose[2, 3] = x, z
        write_image(folder / f"room{index}.png", axis_photos[index % 2])
        image, at = folder / f"room{index}.png", (folder / "links.json", (f"room{index}.png",), ())
        panoramas.append(Panorama(f"room{index}", image, pose, links_at=at))
    overlaps = {(0, 1): 0.4, (1, 2): 0.4, (2, 3): 0.4}
    return TourGraph("house tour", folder, tuple(panoramas), 0.45, 10.0, (), overlaps)


@pytest.fixture(scope="session")
def parted_house(house) -> TourGraph:
    """The house, with its last panorama 20 m away in another part; a link leads to it, and one back."""
    *placed, alone = house.panoramas
    pose = alone.cam2world.clone()
    pose[0, 3] = 20.0
    placed[2] = replace(placed[2], links=(Link("room3", 0.1, 0.6, "to the hall"),))
    alone = replace(alone, cam2world=pose, title="hall", links=(Link("room2", 1.2, 0.5),))
    return replace(house, panoramas=(*placed, alone), overlaps={(0, 1): 0.4, (1, 2): 0.4, (3, 3): 1.0})


@pytest.fixture(scope="session")
def house_file(house, tmp_path_factory) -> Path:
    """The tour as one file."""
    file = tmp_path_factory.mktemp("file") / "home.ply"
    scenes = TourScenes(house)
    save_ply(merge_scenes(house, lambda views: _load_house(scenes.make_entry(views)).scene), file)
    return file


@pytest.fixture(scope="session")
def load_house() -> Callable[[SceneEntry], LoadedScene]:
    """Makes a scene of a tour: a sphere of Gaussians around each view; the scenes have different colours."""
    return _load_house


def _load_house(entry: SceneEntry) -> LoadedScene:
    tour = entry.tour
    assert tour is not None
    if not entry.views:
        views = next(iter(choose_scene_views(tour).values()))
        entry = SceneEntry(entry.name, pair=tour.make_set(views), tour=tour, views=views)
    directions, cam2world = fibonacci_directions(500), tour.cam2world[list(entry.views)]
    color = torch.tensor((0.3, 0.5, 0.7)).roll(sum(entry.views)) + 0.2 * directions
    places = [pose[:3, 3] + 4 * directions for pose in cam2world]
    parts = [make_balls(means, 0.5, 0.95, color=color, views=view) for view, means in enumerate(places)]
    scene = Scene(Gaussians.cat(parts), cam2world, 0.45, 10.0, (), "synthetic", 64)
    angles = torch.linspace(0, 2 * torch.pi, 13)[:-1]
    corners = torch.stack((angles.sin(), angles.cos()), dim=1).double().numpy()
    centers = {view: tour.positions[view][[0, 2]] for view in entry.views}
    outlines = {view: FloorOutline(center + corners, 1.0) for view, center in centers.items()}
    facts = TourFacts(scene, tour, entry.views)
    outlooks, hidden = np.zeros((len(entry.views), BINS)), [[] for _ in entry.views]
    vars(facts).update(outlines=outlines, outlooks=outlooks, hidden=hidden, walls=[], poor=())
    vars(facts).update(clearances=outlooks[:, None].repeat(12, 1))
    return LoadedScene(entry, scene, facts=facts)


@pytest.fixture(scope="session")
def pair(axis_photos, small_scene, tmp_path_factory) -> PanoramaSet:
    """The two photographs at the cameras of the small scene."""
    folder = tmp_path_factory.mktemp("pair")
    panoramas = []
    for name, image, pose in zip(small_scene.names, axis_photos, small_scene.cam2world, strict=True):
        write_image(folder / name, image)
        panoramas.append(Panorama(name, folder / name, pose))
    return PanoramaSet("pair", folder, tuple(panoramas), (), 0.45, 10.0)
