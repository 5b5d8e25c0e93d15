"""The page in headless Chromium with WebGL 2 on the processor: pictures, input, loading."""

import base64
import io
import math
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from jaxtyping import Float
from PIL import Image

from pansplat import pipeline
from pansplat.data.pairs import Link, Panorama
from pansplat.gaussians.scene import Scene
from pansplat.geometry.path import path_poses
from pansplat.tours import EDGE_HYSTERESIS, TourGraph, make_graph, select_views
from pansplat.tours.layout import REACH
from pansplat.web import page as page_module
from pansplat.web import write_page

SIZE = (320, 240)
LOADS = int(os.environ.get("PANSPLAT_PAGE_LOADS", "2"))  # docs/web.md has the result of 50
OPTIONS = ("--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """A browser; without one the tests fail in CI and are skipped elsewhere."""
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        program = None
    if program is None:
        missing = "Chromium (Debian package chromium) and playwright (pip install -e '.[dev]')"
        if os.environ.get("CI"):
            pytest.fail(f"CI needs {missing}")
        pytest.skip(f"needs {missing}")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=list(OPTIONS))
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def folder(scene: Scene, house: Scene, flat: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """tour.html, split.html with its parts, house.html with a graph, and flat.html with parts."""
    folder = tmp_path_factory.mktemp("pages")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page_module, "_POSTER_SIZE", (18, 32))
        patch.setattr(page_module, "_PART_BYTES", 30_000)
        write_page(scene, folder / "tour.html", title="Three rooms")
        write_page(scene, folder / "split.html", split=True)
        write_page(house, folder / "house.html")
        write_page(flat, folder / "flat.html")
    return folder


class OpenPage:
    """A page in the browser, with its requests and messages."""

    def __init__(self, page: Any) -> None:
        self.page, self.requests, self.messages = page, [], []
        page.on("request", lambda request: self.requests.append(request.url))
        page.on("console", lambda message: self.messages.append(message.text))
        page.on("pageerror", lambda error: self.messages.append(str(error)))

    def load(self, path: Path) -> None:
        self.page.goto(path.as_uri())
        assert self.page.evaluate("pansplat.ready.then(() => 'ready', String)") == "ready"

    def run(self, program: str, *arguments: Any) -> Any:
        return self.page.evaluate(program, *arguments)

    @property
    def camera(self) -> dict[str, Any]:
        return self.run("({...pansplat.camera, position: [...pansplat.camera.position]})")

    def wait(self, condition: str) -> None:
        """Wait until an expression is true; the page's policy forbids playwright's own function."""
        end = time.monotonic() + 60
        while not self.run(condition):
            assert time.monotonic() < end, condition
            self.page.wait_for_timeout(10)

    def draw(self) -> Float[np.ndarray, "height width 3"]:
        return decode(self.run("([width, height]) => pansplat.render(width, height)", list(SIZE)))


def decode(url: str) -> Float[np.ndarray, "height width 3"]:
    """The image of a data URL."""
    image = Image.open(io.BytesIO(base64.b64decode(url.split(",")[1]))).convert("RGB")
    return np.asarray(image, np.float64) / 255


@contextmanager
def opened(
    chromium: Any, path: Path, *, size: tuple[int, int] = SIZE, script: str = "", **options: Any
) -> Iterator[OpenPage]:
    """The loaded page in a context of its own; `script` runs before those of the page."""
    context = chromium.new_context(viewport={"width": size[0], "height": size[1]}, **options)
    page = OpenPage(context.new_page())
    page.page.add_init_script(script)
    page.load(path)
    yield page
    context.close()


@pytest.fixture(scope="module")
def page(chromium: Any, folder: Path) -> Iterator[OpenPage]:
    with opened(chromium, folder / "tour.html") as page:
        yield page


@pytest.fixture
def home(page: OpenPage) -> OpenPage:
    """The page with its first camera."""
    page.page.keyboard.press("KeyR")
    return page


def draw_reference(scene: Scene, level: np.ndarray, origin: np.ndarray, camera: dict[str, Any]) -> np.ndarray:
    """The rasteriser's image for a camera of the page; `level` is its axes at yaw and pitch 0."""
    cy, sy, cp, sp = (f(camera[angle]) for angle in ("yaw", "pitch") for f in (math.cos, math.sin))
    pose = np.eye(4)
    turn = np.array(((cy, 0, sy), (0, 1, 0), (-sy, 0, cy))) @ np.array(((1, 0, 0), (0, cp, -sp), (0, sp, cp)))
    pose[:3, :3], pose[:3, 3] = level @ turn, camera["position"] + origin
    options = {"size": SIZE[::-1], "layout": "pinhole", "vertical_fov_degrees": camera["fov"]}
    with torch.no_grad():
        color = pipeline.render(scene, pose, **options).color
    return color.clamp(0, 1).permute(1, 2, 0).double().numpy()


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return -10 * math.log10(max(float(((a - b) ** 2).mean()), 1e-12))


POSES = [
    ((-0.6, 0.3, 0.2), 2.5, -0.7, 90.0),
    ((0.5, -0.2, 1.6), -1.0, 0.5, 60.0),  # 1 m and less from the Gaussians of two views
]


@pytest.mark.parametrize(("position", "yaw", "pitch", "fov"), POSES)
def test_the_picture_is_that_of_the_rasteriser(
    home: OpenPage, scene: Scene, position: tuple[float, ...], yaw: float, pitch: float, fov: float
) -> None:
    camera = {"position": position, "yaw": yaw, "pitch": pitch, "fov": fov}
    home.run("(camera) => Object.assign(pansplat.camera, camera)", camera)
    image = home.draw()
    level, origin = path_poses(scene.cam2world)[0, :3, :3].numpy(), scene.cam2world[:, :3, 3].mean(0).numpy()
    reference = draw_reference(scene, level, origin, camera)
    assert reference.std() > 0.05
    assert psnr(image, reference) > 42
    assert psnr(image[:, ::-1], reference) < 25 and psnr(image[::-1], reference) < 25


def test_the_page_loads_without_network_or_messages(page: OpenPage, folder: Path) -> None:
    page.draw()
    assert page.messages == []
    assert [url for url in page.requests if not url.startswith("blob:")] == [(folder / "tour.html").as_uri()]
    assert page.page.title() == "Three rooms"
    page.wait("document.getElementById('cover').hidden")


@pytest.mark.slow
def test_keys_walk_and_jump(home: OpenPage) -> None:
    keyboard, start = home.page.keyboard, home.camera
    keyboard.down("KeyW")
    home.wait(f"Math.hypot(...pansplat.camera.position.map((x, i) => x - {start['position']}[i])) > 0.02")
    keyboard.up("KeyW")
    level = np.array(home.run("HEADER.level"))
    moved = level.T @ (np.array(home.camera["position"]) - start["position"])
    assert moved[2] > 0.02 and abs(moved[0]) < 1e-6 and abs(moved[1]) < 1e-6
    keyboard.press("3")
    home.wait("pansplat.camera.position.every((x, i) => x === HEADER.spots[2].position[i])")
    keyboard.press("KeyR")
    assert home.camera == start


def test_walking_stays_near_the_panoramas(home: OpenPage) -> None:
    home.run("pansplat.camera.position = [50, 0, 0]")
    home.page.keyboard.down("KeyD")
    home.wait("Math.hypot(...pansplat.camera.position) < 10")
    home.page.keyboard.up("KeyD")
    distances = home.run(
        "HEADER.spots.map((s) => Math.hypot(...s.position.map((x, i) => x - pansplat.camera.position[i])))"
    )
    assert min(distances) <= home.run("HEADER.limits[0]") * 1.000001


def test_the_scene_follows_the_mouse(home: OpenPage) -> None:
    mouse, start = home.page.mouse, home.camera
    mouse.move(200, 100)
    mouse.down()
    mouse.move(240, 130)
    mouse.up()
    turned = home.camera
    radians = 2 * math.tan(math.radians(start["fov"]) / 2) / SIZE[1]
    assert turned["yaw"] == pytest.approx(start["yaw"] - 40 * radians)
    assert turned["pitch"] == pytest.approx(30 * radians)
    mouse.move(10, 10)
    assert home.camera == turned
    mouse.wheel(0, -100)
    home.wait(f"pansplat.camera.fov < {start['fov']}")


@pytest.mark.slow
def test_space_flies_through_all_panoramas_and_a_ring_to_one(home: OpenPage) -> None:
    home.run("HEADER.speed *= 100")  # a flight takes at least 0.6 s
    home.page.keyboard.press("Space")
    for view in (1, 2):
        target = home.run(f"HEADER.spots[{view}].position")
        home.wait(f"Math.hypot(...pansplat.camera.position.map((x, i) => x - {target}[i])) < 0.1")
    home.page.keyboard.press("Space")
    stopped = home.camera["position"]
    assert home.page.get_attribute("#play", "aria-pressed") == "false"
    home.page.keyboard.press("KeyR")
    home.run("pansplat.camera.pitch = -0.9")
    home.run("pansplat.camera.yaw = 0")
    home.draw()
    home.page.click("#spots button:not([hidden]) >> nth=0", force=True)
    home.wait(f"!pansplat.camera.position.every((x, i) => x === {stopped}[i])")
    home.wait("HEADER.spots.slice(1).some((s) => s.position.every((x, i) => x === pansplat.camera.position[i]))")


@pytest.mark.slow
def test_two_fingers_walk_and_one_turns(chromium: Any, folder: Path) -> None:
    with opened(chromium, folder / "tour.html", size=(240, 320), has_touch=True, is_mobile=True) as page:
        session = page.page.context.new_cdp_session(page.page)

        def touch(kind: str, *points: tuple[float, float]) -> None:
            touches = [{"x": x, "y": y, "id": index} for index, (x, y) in enumerate(points)]
            session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": touches})

        start = page.camera
        touch("touchStart", (100, 100))
        touch("touchMove", (140, 100))
        touch("touchEnd")
        page.wait(f"pansplat.camera.yaw < {start['yaw'] - 0.01}")
        assert page.camera["position"] == start["position"]
        touch("touchStart", (100, 120), (200, 120))
        touch("touchMove", (80, 120), (220, 120))
        touch("touchEnd")
        page.wait(f"!pansplat.camera.position.every((x, i) => x === {start['position']}[i])")
        forward = np.array(page.run("HEADER.level"))[:, 2]
        assert (np.array(page.camera["position"]) - start["position"]) @ forward > 0
        # The device turns 30 degrees to the left, and 20 up.
        assert page.page.is_visible("#motion")
        event = "new DeviceOrientationEvent('deviceorientation', {alpha, beta, gamma: 0})"
        page.run(f"byMotion = (alpha, beta) => dispatchEvent({event})")
        page.page.click("#motion")
        page.wait("document.getElementById('motion').getAttribute('aria-pressed') === 'true'")
        page.run("byMotion(10, 90)")
        before = page.camera
        page.run("byMotion(40, 110)")
        after = page.camera
        assert after["yaw"] - before["yaw"] == pytest.approx(-math.radians(30))
        assert (before["pitch"], after["pitch"]) == pytest.approx((0, math.radians(20)), abs=1e-9)
        assert after["roll"] == pytest.approx(0, abs=1e-9)
        assert page.messages == []


def test_a_lost_context_is_restored(home: OpenPage) -> None:
    before = home.draw()
    home.run("""async () => {
        const view = document.getElementById("view");
        const lost = view.getContext("webgl2").getExtension("WEBGL_lose_context");
        const event = (name) => new Promise((resolve) => view.addEventListener(name, resolve, { once: true }));
        const isLost = event("webglcontextlost"), isRestored = event("webglcontextrestored");
        lost.loseContext();
        await isLost;
        await new Promise((resolve) => setTimeout(resolve));  // after all listeners: then it can be restored
        lost.restoreContext();
        await isRestored;
    }""")
    assert psnr(home.draw(), before) > 60


def test_a_context_that_is_lost_while_the_page_loads_is_restored(chromium: Any, folder: Path) -> None:
    script = """
        const getContext = HTMLCanvasElement.prototype.getContext;
        HTMLCanvasElement.prototype.getContext = function (...args) {
            const gl = getContext.apply(this, args), lost = gl && !window.lost && gl.getExtension("WEBGL_lose_context");
            if (lost) {
                window.lost = lost;
                lost.loseContext();
                setTimeout(() => lost.restoreContext(), 300);
            }
            return gl;
        };
    """
    with opened(chromium, folder / "tour.html", script=script) as page:
        assert page.draw().std() > 0.05


def test_a_sorter_that_ends_is_reported_and_rejects_pictures(chromium: Any, folder: Path) -> None:
    script = "window.Worker = class extends Worker { constructor(url) { super(url); window.sorter = this; } }"
    with opened(chromium, folder / "tour.html", script=script) as page:
        page.run("sorter.terminate(); sorter.dispatchEvent(new ErrorEvent('error', {message: 'no memory'}))")
        page.page.wait_for_selector("#cover.failed img")
        assert "no memory" in page.page.inner_text("#message")
        assert "no memory" in page.run("pansplat.camera.position[0] += 0.1; pansplat.render(64, 48).catch(String)")


def test_without_webgl_the_page_says_so_over_its_poster(chromium: Any, folder: Path) -> None:
    context = chromium.new_context()
    page = context.new_page()
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.goto((folder / "tour.html").as_uri())
    page.wait_for_selector("#cover.failed img")
    assert "WebGL 2" in page.inner_text("#message")
    context.close()


@pytest.mark.slow
def test_every_load_shows_the_scene(chromium: Any, folder: Path) -> None:
    for load in range(LOADS):
        name = ("tour.html", "split.html")[load % 2]
        with opened(chromium, folder / name) as page:
            assert page.draw().std() > 0.05
            assert page.messages == [], load
            assert all(url.startswith(("file:", "blob:")) for url in page.requests)


def test_the_picture_is_the_same_on_a_device_with_the_smallest_textures(
    home: OpenPage, chromium: Any, folder: Path
) -> None:
    script = """
      const gl = WebGL2RenderingContext.prototype, { getParameter, texStorage2D } = gl;
      window.widths = [];
      gl.getParameter = function (name) { return name === gl.MAX_TEXTURE_SIZE ? 2048 : getParameter.call(this, name); };
      gl.texStorage2D = function (...values) { window.widths.push(values[3]); texStorage2D.apply(this, values); };"""
    with opened(chromium, folder / "tour.html", script=script) as page:
        widths = page.run("widths")
        assert 3 * 682 in widths and max(widths) <= 2048, "geometry has three texels a Gaussian"
        assert np.array_equal(page.draw(), home.draw())


def test_missing_parts_are_named(chromium: Any, folder: Path, tmp_path: Path) -> None:
    shutil.copy(folder / "split.html", tmp_path)
    context = chromium.new_context()
    page = context.new_page()
    page.goto((tmp_path / "split.html").as_uri())
    page.wait_for_selector("#cover.failed")
    assert "Copy the whole folder" in page.inner_text("#message")
    context.close()


def test_the_graph_of_the_page_is_that_of_the_tour(page: OpenPage) -> None:
    row = [(0, 0, 0), (0, 0.1, 1), (0, 0, 2), (0.2, 0, 3), (1, 0, 1), (1, 0, 2.2), (2, 0, 2), (0.5, 0, 2.9)]
    others = [(9, 0, 0), (9, 0, 9), (10, 0, 9.5)]  # parts of one and of two panoramas
    places = np.array([*row, *others])
    poses = torch.eye(4, dtype=torch.float64).repeat(len(places), 1, 1)
    poses[:, :3, 3] = torch.from_numpy(places)
    edges = [(0, 1), (1, 2), (2, 3), (1, 4), (2, 5), (4, 5), (5, 6), (3, 7), (8, 8), (9, 10)]
    links = {6: (Link("8", 0.0),), 8: (Link("10", 0.0),)}
    panoramas = tuple(Panorama(str(node), Path(), pose, links=links.get(node, ())) for node, pose in enumerate(poses))
    overlaps = {edge: 0.1 + 0.02 * edge[1] for edge in edges}
    tour = TourGraph("", Path(), panoramas, 0.5, 10.0, (), overlaps)
    graph = {
        "positions": places.tolist(),
        "parts": tour.parts,
        "edges": edges,
        "next": tour.find_next_nodes(),
        "hysteresis": EDGE_HYSTERESIS,
        "reach": REACH,
    }
    random = np.random.default_rng(0)
    positions = random.uniform((-1, -0.5, -1), (3, 0.5, 4), (60, 3))
    positions[40:] = random.uniform((3, -0.5, -1), (11, 0.5, 11), (20, 3))
    nodes, current = range(len(places)), random.integers(len(edges), size=60)
    found = page.run(
        """([graph, positions, current]) => positions.map((position, i) => ({
            nearest: graph.edges[nearestEdge(graph, position)],
            ofPart: graph.edges[nearestEdge(graph, position, partOfEdge(graph, current[i]))],
            followed: graph.edges[followEdge(graph, position, current[i])],
            reachable: graph.positions.map((_, node) => isReachable(graph, current[i], node)),
            ways: graph.positions.map((_, node) => findWay(graph, position, node)),
            waysOfPart: graph.positions.map((_, node) => findWay(graph, position, node, 0)),
            fades: graph.positions.map((_, node) => isFade(graph, node, graph.edges[current[i]][0])),
        }))""",
        [graph, positions.tolist(), current.tolist()],
    )
    for position, number, case in zip(positions, current, found, strict=True):
        edge = edges[number]
        assert tuple(case["nearest"]) == tour.find_nearest_edge(position)[0]
        assert tuple(case["ofPart"]) == tour.find_nearest_edge(position, tour.parts[edge[0]])[0]
        assert tuple(case["followed"]) == tour.follow_edge(position, edge)
        assert set(np.flatnonzero(case["reachable"])) == tour.list_reachable(edge)
        assert case["ways"] == [tour.find_way(position, node) for node in nodes]
        assert case["waysOfPart"] == [tour.find_way(position, node, 0) for node in nodes]
        assert case["fades"] == [tour.is_fade(node, edge[0]) for node in nodes]
    followed = [tuple(case["followed"]) for case in found]
    assert len({edge == tuple(case["nearest"]) for edge, case in zip(followed, found, strict=True)}) == 2, "hysteresis"
    parts = [
        (tour.parts[edge[0]], tour.parts[edges[number][0]]) for edge, number in zip(followed, current, strict=True)
    ]
    assert len({a == b for a, b in parts}) == 2, "a position near another part is in it"


@pytest.mark.slow
def test_a_tour_blends_the_views_of_the_edge_and_flies_along_edges(chromium: Any, folder: Path, scene: Scene) -> None:
    with opened(chromium, folder / "house.html") as page:
        spots = np.array(page.run("HEADER.spots.map((spot) => spot.position)"))
        start = page.camera
        position = 0.6 * spots[1] + 0.4 * spots[2]
        camera = {"position": position.tolist(), "yaw": 0.3, "pitch": -0.1, "fov": 75.0}
        page.run("(camera) => Object.assign(pansplat.camera, camera)", camera)
        image = page.draw()
        level, origin = make_graph(scene).level_axes, scene.cam2world[:, :3, 3].mean(0).numpy()
        edge = select_views(scene, (1, 2))
        of_edge, of_all = (draw_reference(which, level, origin, camera) for which in (edge, scene))
        assert psnr(image, of_edge) > 42 > 35 > psnr(of_edge, of_all)
        page.page.keyboard.press("KeyR")
        assert page.camera == start
        # A flight to the last panorama passes the second one, also from a camera that has just left the shown edge.
        page.run("HEADER.speed *= 100")
        page.run("(camera) => Object.assign(pansplat.camera, camera)", camera)
        page.draw()
        fly = """(start) => {
            const request = requestAnimationFrame;
            let time = performance.now();  // a frame takes 30 ms on every machine
            performance.now = () => time;
            requestAnimationFrame = (onFrame) => request(() => onFrame(time += 30));
            Object.assign(pansplat.camera, start);
            dispatchEvent(new KeyboardEvent("keydown", {code: "Digit3"}));
            passed = [];
            const record = () => { passed.push([...pansplat.camera.position]); request(record); };
            record();
        }"""
        page.run(fly, start)
        page.wait("pansplat.camera.position.every((x, i) => x === HEADER.spots[2].position[i])")
        passed = np.array(page.run("passed"))
        between = np.linalg.norm(passed[:, None] - spots, axis=2)
        offset = [
            np.linalg.norm(np.cross(passed - a, b - a), axis=1) / np.linalg.norm(b - a)
            for a, b in ((spots[0], spots[1]), (spots[1], spots[2]))
        ]
        assert np.minimum(*offset).max() < 1e-6 and between[:, 1].min() < 0.3
        # The route begins near the camera and turns it.
        page.page.keyboard.press("Space")
        page.wait(f"Math.hypot(...pansplat.camera.position.map((x, i) => x - {spots[2].tolist()}[i])) > 0.1")
        assert abs(page.camera["yaw"] - start["yaw"]) > 0.1
        page.page.keyboard.press("Space")
        assert page.page.get_attribute("#play", "aria-pressed") == "false"
        assert page.messages == []


FRAMES = """
    const request = requestAnimationFrame;
    let time = performance.now();  // a frame takes 50 ms on every machine
    performance.now = () => time;
    requestAnimationFrame = (onFrame) => request(() => onFrame(time += 50));
    record = () => {
        const still = document.getElementById("still"), { position, yaw, pitch } = pansplat.camera;
        const left = still.hidden ? 0 : Number(still.style.opacity);
        const image = left && !passed.some((frame) => frame.image) ? still.toDataURL("image/png") : null;
        passed.push({ position: [...position], yaw, pitch, left, image });
        request(record);
    };
"""


@pytest.mark.slow
def test_a_page_of_parts_fades_along_a_link_and_lists_all_panoramas(chromium: Any, folder: Path) -> None:
    with opened(chromium, folder / "flat.html", script=FRAMES) as page:
        keyboard, start = page.page.keyboard, page.camera
        assert (start["yaw"], start["pitch"]) == (0.3, -0.2)
        page.wait("document.getElementById('name').innerText === 'room 0'")  # of the first frame
        assert page.page.inner_text("#kind") == ""
        # Titles are text. The keyboard opens the list and chooses from it.
        shown = "Array.from(document.querySelectorAll('#spots button:not([hidden])'), (button) => button.title)"
        page.run("pansplat.camera.yaw = 1.5; pansplat.camera.pitch = -0.6; dispatchEvent(new Event('resize'))")
        page.wait(f"{shown}.includes('Go to </script><b>hall <i>down')")
        keyboard.press("l")
        listed = page.page.inner_text("#panoramas").split("\n")
        assert [line for line in listed if line] == [
            *("Placed panoramas", "1. room 0", "2. room 1"),
            *("Single photographs, not placed", "3. </script><b>hall", "4. attic"),
        ]
        assert page.run("document.activeElement.textContent") == "1. room 0"
        page.run("passed = []; record()")
        keyboard.press("Tab")
        keyboard.press("Tab")
        keyboard.press("Enter")
        page.wait("document.getElementById('name').textContent === '</script><b>hall'")
        page.wait("document.getElementById('still').hidden")
        frames, (to, back) = page.run("passed"), page.run("HEADER.links")
        assert page.camera["position"] == page.run("HEADER.spots[2].position")
        assert math.cos(page.camera["yaw"] - back["yaw"]) == pytest.approx(-1), "away from the link back"
        first = next(k for k, frame in enumerate(frames) if frame["left"])
        old, left = frames[first - 1], [frame["left"] for frame in frames[first:]]
        assert old["position"] == pytest.approx(to["leave"], abs=1e-6) and old["yaw"] == pytest.approx(to["yaw"])
        assert left[0] == 1 and left == sorted(left, reverse=True) and any(0.3 < part < 0.7 for part in left)
        # The image that fades out is that of the last camera.
        frozen = decode(frames[first]["image"])
        page.run(
            "(camera) => Object.assign(pansplat.camera, camera)",
            {key: old[key] for key in ("position", "yaw", "pitch")},
        )
        assert psnr(page.draw(), frozen) > 30
        keyboard.press("4")  # without a link
        page.wait("document.getElementById('name').textContent === 'attic'")
        page.wait("document.getElementById('still').hidden")
        assert page.camera["position"] == page.run("HEADER.spots[3].position")
        assert (page.camera["yaw"], page.camera["pitch"]) == pytest.approx((3.1, 0.2), abs=1e-5)
        assert page.page.inner_text("#kind") == "single photograph" and page.run(shown) == []
        # The camera slows down near the limit.
        page.run("passed = []; HEADER.speed *= 3")
        keyboard.down("KeyW")
        page.wait("passed.length > 40")
        keyboard.up("KeyW")
        steps = np.linalg.norm(np.diff([frame["position"] for frame in page.run("passed")], axis=0), axis=1)
        away = math.dist(page.camera["position"], page.run("HEADER.spots[3].position"))
        assert 0.8 < away < page.run("HEADER.limits[2]") and steps[-1] < 0.1 * steps.max()
        page.page.click("#home")
        assert page.camera == start
        assert page.messages == []


@pytest.mark.slow
def test_a_notebook_shows_the_page_in_a_frame_that_cannot_reach_it(
    chromium: Any, plain_scene: Scene, tmp_path: Path
) -> None:
    from pansplat.notebook import _bundle_scene

    file = tmp_path / "cell.html"
    file.write_text(f"<!doctype html><meta charset=utf-8>{_bundle_scene(plain_scene)['text/html']}")
    page = chromium.new_page(viewport={"width": 640, "height": 560})
    messages: list[str] = []
    page.on("console", lambda message: messages.append(message.text))
    page.on("pageerror", lambda error: messages.append(str(error)))
    page.goto(file.as_uri())
    (frame,) = page.main_frame.child_frames
    frame.wait_for_selector("#cover", state="hidden", timeout=120_000)
    frame.wait_for_selector("#buttons", state="visible")
    assert frame.evaluate("origin") == "null"
    assert frame.evaluate("document.getElementById('name').innerText") in plain_scene.names
    assert messages == []
    page.close()
