"""The page in headless Chromium with WebGL 2 on the processor: pictures, input, flights, controls."""

import io
import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
import torch
from browser_pages import (
    FRAME_MS,
    HOLD,
    RECORD,
    SIZE,
    WITHOUT_GAUSSIANS,
    OpenPage,
    Sites,
    aim,
    decode,
    draw_reference,
    in_level,
    new_context,
    opened,
    psnr,
    render_reference,
    wait_until,
)
from PIL import Image

from pansplat.bench.scenes import full_lattice_room, make_room_cameras
from pansplat.export import page as page_module
from pansplat.export.page import write_page
from pansplat.gaussians.scene import Scene
from pansplat.geometry.equirect import sample_equirect, uv_from_directions
from pansplat.images.image_files import read_panorama
from pansplat.inputs.panorama_sets import PanoramaSet
from pansplat.notebook import _bundle_scene
from pansplat.tours.facts import TourFacts
from pansplat.tours.houses import find_houses
from pansplat.tours.merge import select_views
from pansplat.tours.scene_graph import make_graph


@pytest.fixture(scope="module")
def page(chromium: Any, folder: Path) -> Iterator[OpenPage]:
    with opened(chromium, folder / "tour.html", is_stepped=True) as page:
        yield page


@pytest.fixture
def home(page: OpenPage) -> OpenPage:
    """The page with its first camera."""
    page.page.keyboard.press("KeyR")
    page.settle()
    return page


POSES = [
    ((-0.6, 0.3, 0.2), 2.5, -0.7, 90.0),
    ((0.5, -0.2, 1.6), -1.0, 0.5, 60.0),  # 1 m and less from the Gaussians of two views
]


@pytest.mark.parametrize(("position", "yaw", "pitch", "fov"), POSES)
def test_the_picture_is_that_of_the_rasteriser(home, scene, position, yaw, pitch, fov) -> None:
    camera = {"position": position, "yaw": yaw, "pitch": pitch, "fov": fov}
    home.run("(camera) => Object.assign(pansplat.camera, camera)", camera)
    image = home.draw()
    level, origin = np.array(home.run("HEADER.level")), scene.cam2world[:, :3, 3].mean(0).numpy()
    reference = draw_reference(scene, level, origin, camera)
    assert reference.std() > 0.05
    assert psnr(image, reference) > 42
    assert psnr(image[:, ::-1], reference) < 25 and psnr(image[::-1], reference) < 25


@pytest.fixture(scope="module")
def room() -> Scene:
    """A room of boxes with two cameras, whose walls are found."""
    return Scene(full_lattice_room(128), make_room_cameras(2), 0.1, 10.0, names=("west", "east"), height=128)


@pytest.fixture(scope="module")
def room_photographs(room: Scene, take_photographs: Callable[..., list[PanoramaSet]]) -> list[PanoramaSet]:
    return take_photographs(room, 256)


@pytest.fixture(scope="module")
def room_page(room: Scene, room_photographs: list[PanoramaSet], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("room") / "doll.html"
    write_page(room, path, photographs=room_photographs)
    return path


def test_the_dolls_house_opens_when_the_gaussians_have_arrived(chromium: Any, room_page: Path) -> None:
    with opened(
        chromium, room_page, script=WITHOUT_GAUSSIANS, is_stepped=True
    ) as page:  # of which the photograph is shown
        page.page.emulate_media(reduced_motion="reduce")
        start = page.camera
        for is_due, press in ((True, "KeyO"), (False, "KeyO"), (True, "KeyO"), (False, "KeyR"), (True, "KeyO")):
            page.page.keyboard.press(press)
            page.run(f"step({FRAME_MS})")
            assert page.page.get_attribute("#doll", "aria-pressed") == str(is_due).lower()
            assert page.camera == start and page.run("pansplat.isSettled()") is False
        page.run("release()")
        page.wait("pansplat.camera.fov === 45 && pansplat.isSettled()")
        assert page.page.get_attribute("#doll", "aria-pressed") == "true"
        assert page.messages == []


def test_the_dolls_house_shows_photographs_on_its_floor_and_has_ways_back(chromium, room, room_photographs, room_page):
    photographs, houses = room_photographs, find_houses(TourFacts(room))
    origin, cameras = room.cam2world[:, :3, 3].mean(0).numpy(), room.cam2world[:, :3, 3].numpy()
    outside = "pansplat.camera.fov === 45 && pansplat.isSettled()"
    with opened(chromium, room_page, is_stepped=True) as page:
        start, level = page.camera, np.array(page.run("HEADER.level"))
        page.page.keyboard.press("KeyO")
        page.wait(outside)
        camera = page.camera
        assert camera["pitch"] == pytest.approx(-math.pi / 4)
        assert min(abs(camera["yaw"] - start["yaw"] - turn) for turn in (0, 0.5 * math.pi)) < 1e-6
        assert page.page.get_attribute("#doll", "aria-pressed") == "true"
        image = page.draw()
        # Where the rays of the pixels meet the floor, and what the nearest camera shows there.
        y, x = (np.mgrid[: SIZE[1], : SIZE[0]] + 0.5 - np.array((SIZE[1], SIZE[0]))[:, None, None] / 2) / SIZE[1] * 2
        tangent = math.tan(math.radians(45 / 2))
        turned = aim(level, camera)
        rays = np.stack((x * tangent, y * tangent, np.ones_like(x)), axis=-1) @ turned.T
        eye, down = camera["position"] + origin, houses.level[:, 1]
        floor = float(np.mean(cameras @ down + houses.floors))
        places = eye + ((floor - eye @ down) / (rays @ down))[..., None] * rays
        outline, flat = houses.plan.rooms[0].shape, places @ houses.level[:, (0, 2)]
        nearest = np.linalg.norm(places[:, :, None] - cameras, axis=-1)
        is_clear = shapely.contains_xy(outline.buffer(-0.1), flat[..., 0], flat[..., 1])
        is_clear &= (np.abs(nearest[..., 0] - nearest[..., 1]) > 0.5) & (nearest.min(axis=-1) > 1.3 * houses.floors[0])
        assert is_clear.mean() > 0.03
        for view in (0, 1):
            chosen = is_clear & (nearest.argmin(axis=-1) == view)
            offsets = (places[chosen] - cameras[view]) @ room.cam2world[view, :3, :3].numpy()
            photograph, _ = read_panorama(photographs[view].context[0].image, 256)
            expected = sample_equirect(photograph, uv_from_directions(torch.from_numpy(offsets)).float()).T.numpy()
            assert chosen.sum() > 500 and np.median(np.abs(image[chosen] - expected)) < 0.03
            assert expected.std() > 0.05
        assert np.abs(image[[0, -1]] - image[0, 0]).max() < 0.01, "the whole house is in the picture"
        left, top = SIZE[0] // 2, SIZE[1] // 2
        page.page.mouse.move(left, top)
        page.page.mouse.down()
        page.page.mouse.move(left + 40, top)
        page.page.mouse.up()
        turned = page.camera
        assert turned["yaw"] == pytest.approx(camera["yaw"] + math.pi / 4)
        page.page.mouse.wheel(0, -200)
        page.wait(f"Math.abs(pansplat.camera.position[1] - {turned['position'][1]}) > 0.1")
        page.settle()
        page.page.mouse.click(left, top)
        page.wait("HEADER.spots.some((s) => s.position.every((x, i) => x === pansplat.camera.position[i]))")
        assert page.camera["fov"] == start["fov"] and page.page.get_attribute("#doll", "aria-pressed") == "false"
        page.look(yaw=77, pitch=5)
        before = page.run("pansplat.getPose()")
        page.page.keyboard.press("KeyO")
        page.wait(outside)
        page.page.keyboard.press("KeyO")
        page.wait("pansplat.camera.fov !== 45 && pansplat.isSettled()")
        after = page.run("pansplat.getPose()")
        assert (after["yaw"], after["pitch"]) == pytest.approx((before["yaw"], before["pitch"])), "it keeps the heading"
        # A phone is turned; a pose and a tour lead out.
        here = page.camera["position"]
        page.page.keyboard.press("KeyO")
        page.wait(outside)
        page.run("resized = false, addEventListener('resize', () => { resized = true; })")
        page.page.set_viewport_size({"width": SIZE[1], "height": SIZE[0]})
        page.wait(f"resized && {outside}")
        image = page.draw(*SIZE[::-1])
        assert np.abs(image[:, [0, -1]] - image[0, 0]).max() < 0.01, "the whole house is in the picture"
        page.run("pansplat.setPose({ yaw: 20 })")
        assert (page.camera["position"], page.camera["fov"]) == (here, start["fov"])
        page.page.keyboard.press("KeyO")
        page.wait(outside)
        page.page.keyboard.press("Space")
        assert page.page.get_attribute("#play", "aria-pressed") == "true"
        assert page.page.get_attribute("#doll", "aria-pressed") == "false" and page.camera["fov"] == start["fov"]
        page.wait(f"pansplat.camera.position.some((x, i) => Math.abs(x - {here}[i]) > 0.1)")
        page.page.keyboard.press("Space")
        page.run("HEADER.doll = []")
        page.page.keyboard.press("KeyO")
        assert "fewer than half" in page.page.inner_text("#status") and page.camera["fov"] != 45
        assert page.messages == []


@pytest.fixture(scope="module")
def ring_page(chromium: Any, folder: Path) -> Iterator[OpenPage]:
    """A page on which no wall hides a ring."""
    with opened(chromium, folder / "tour.html", size=(640, 240), reduced_motion="reduce", is_stepped=True) as page:
        page.run("""HEADER.spots.forEach((spot) => {
            spot.rings = HEADER.spots.map((_, node) => ({ node, mark: null }));
        })""")
        yield page


def look_near_ring(page: OpenPage, yaw: float, pitch: float) -> None:
    """Look from the first panorama that many degrees away from the ring of the second one."""
    position, mark = page.run("[HEADER.spots[0].position, HEADER.spots[1].mark]")
    right, down, forward = in_level(page, np.subtract(mark, position))
    yaw += math.degrees(math.atan2(right, forward))
    pitch -= math.degrees(math.atan2(down, math.hypot(right, forward)))
    page.look(position=position, yaw=yaw, pitch=pitch, fov=75)


AT_SECOND = "pansplat.camera.position.every((x, i) => x === HEADER.spots[1].position[i])"


def test_a_drag_that_starts_on_a_ring_or_its_label_turns_the_view_and_a_click_chooses(ring_page: OpenPage) -> None:
    page, mouse = ring_page, ring_page.page.mouse
    for part in ("", " span"):
        look_near_ring(page, 0, 0)
        ring = page.page.locator(f"#spots button:not([hidden])[title='Go to room 1']{part}").bounding_box()
        place, before = (ring["x"] + ring["width"] / 2, ring["y"] + ring["height"] / 2), page.camera
        for end in ((place[0] + 60, place[1]), place):  # with, and back to where it began
            mouse.move(*place)
            mouse.down()
            mouse.move(place[0] + 30, place[1] + 20)
            mouse.move(*end)
            mouse.up()
            page.settle()
            assert page.camera["position"] == before["position"], "no click"
            assert (page.camera["yaw"] < before["yaw"] - 0.05) == (end != place)
            look_near_ring(page, 0, 0)
        mouse.wheel(0, -200)
        page.wait(f"pansplat.camera.fov < {before['fov']}")
        page.look(fov=before["fov"])
        mouse.click(*place)
        page.wait(AT_SECOND)


def test_flights_jumps_and_keys_end_alike(chromium: Any, folder: Path) -> None:
    """In the start view of the panorama; without one in the direction of the way."""
    with opened(chromium, folder / "tour.html", is_stepped=True) as page:
        right, _, ahead = in_level(page, np.subtract(*page.run("[HEADER.spots[1].position, HEADER.spots[0].position]")))
        along, start = (math.atan2(right, ahead), 0), (-2, 0.1)
        ways = ("goTo(2, { jump: true })", along), ("goTo(2)", start), ("goTo(2, { jump: true })", start), ("", start)
        for way, expected in ways:
            has_start = str(expected == start).lower()
            page.run(f"Object.assign(HEADER.spots[1], {{ ahead: [-2, 0.1], hasStart: {has_start} }})")
            page.look(position=page.run("HEADER.spots[0].position"), yaw=20, pitch=5)
            page.run(f"pansplat.{way}, 0") if way else page.page.keyboard.press("2")
            page.settle()
            assert page.camera["position"] == page.run("HEADER.spots[1].position")
            assert (page.camera["yaw"], page.camera["pitch"]) == pytest.approx(expected, abs=1e-3), way
        assert page.messages == []


def test_what_is_outside_of_the_picture_is_an_arrow_that_leads_there(ring_page: OpenPage) -> None:
    page, found, button = ring_page, [], ring_page.page.locator("#spots button[title='Go to room 1']")
    for yaw, pitch in ((90, 30), (-90, 30), (0, 80), (0, 0)):
        look_near_ring(page, yaw, pitch)
        box = button.bounding_box()
        assert 0 <= box["x"] <= 640 - box["width"] and 0 <= box["y"] <= 240 - box["height"]
        found.append(button.get_attribute("class"))
    assert found == ["arrow left", "arrow right", "arrow down", ""]
    look_near_ring(page, 90, 30)
    button.click()
    page.wait(AT_SECOND)


def test_no_arrow_covers_a_ring(ring_page: OpenPage) -> None:
    """The second panorama is in the picture, near its right border; the third one beyond it, as high."""
    page = ring_page
    page.look(position=page.run("HEADER.spots[1].position"))
    position, level, *old = page.run(
        "[HEADER.spots[0].position, HEADER.level, HEADER.spots[1].mark, HEADER.spots[2].mark]"
    )
    set_mark = "([node, mark]) => mark.forEach((value, k) => { HEADER.spots[node].mark[k] = value; })"
    for node, yaw in ((1, 62), (2, 90)):
        ahead = 3 * np.array((math.sin(math.radians(yaw)), 0, math.cos(math.radians(yaw))))
        page.page.evaluate(set_mark, [node, (position + np.array(level) @ ahead).tolist()])
    page.look(position=position, yaw=0, pitch=0, fov=75)
    ring, arrow = (page.page.locator(f"#spots button[title='Go to room {n}']") for n in (1, 2))
    classes, boxes = (
        [each.get_attribute("class") for each in (ring, arrow)],
        [ring.bounding_box(), arrow.bounding_box()],
    )
    for node, mark in enumerate(old, 1):
        page.page.evaluate(set_mark, [node, mark])
    assert classes == ["", "arrow right"]
    of_ring, of_arrow = boxes
    assert of_ring["x"] + of_ring["width"] > of_arrow["x"], "both are at the border"
    upper, lower = sorted(boxes, key=lambda box: box["y"])
    assert upper["y"] + upper["height"] < lower["y"]


def test_no_ring_is_under_the_buttons(ring_page: OpenPage) -> None:
    """The second panorama comes nearer to the right edge, along the bottom row of the picture."""
    shown = """() => {
        const boxes = (of) => [...document.querySelectorAll(of)].map((each) => each.getBoundingClientRect());
        const [bar] = boxes("#buttons"), rings = boxes("#spots button:not([hidden])");
        const room = document.querySelector("#spots button[title='Go to room 1']:not([hidden])");
        const isBeside = (ring) => ring.right < bar.left || ring.left > bar.right;
        const isUnder = (ring) => ring.bottom >= bar.top && ring.top <= bar.bottom && !isBeside(ring);
        return [rings.some(isUnder), room.className];
    }"""
    found = []
    for turn in (30, -45):
        look_near_ring(ring_page, turn, 28)  # it is near the lower edge
        is_under, kind = ring_page.run(shown)
        assert not is_under, turn
        found.append(kind)
    assert found == ["", "arrow down"]


def test_the_page_loads_without_network_or_messages(page: OpenPage, folder: Path) -> None:
    page.draw()
    assert page.messages == []
    assert [url for url in page.requests if not url.startswith("blob:")] == [(folder / "tour.html").as_uri()]
    assert page.page.title() == "Three rooms"
    page.wait("document.getElementById('cover').hidden")


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
def test_space_flies_through_all_panoramas(home: OpenPage) -> None:
    home.run("""passed = new Set(); (function record() {
        const { position } = pansplat.camera;
        passed.add(HEADER.spots.findIndex((spot) => spot.position.every((x, i) => x === position[i])));
        requestAnimationFrame(record);
    })()""")
    home.page.keyboard.press("Space")
    home.wait("passed.has(1) && passed.has(2)")
    home.page.keyboard.press("Space")
    assert home.page.get_attribute("#play", "aria-pressed") == "false"


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


def test_a_context_that_is_lost_while_the_page_loads_is_restored(chromium: Any, folder: Path) -> None:
    script = """
        const getContext = HTMLCanvasElement.prototype.getContext;
        HTMLCanvasElement.prototype.getContext = function (...args) {
            const gl = getContext.apply(this, args), lost = gl && !window.lost && gl.getExtension("WEBGL_lose_context");
            if (lost) {
                window.lost = lost;
                // After all listeners.
                this.addEventListener("webglcontextlost", () => setTimeout(() => lost.restoreContext()));
                lost.loseContext();
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


@pytest.mark.parametrize(
    ("script", "needed"),
    [
        ("HTMLCanvasElement.prototype.getContext = () => null", "WebGL 2"),
        ("delete window.DecompressionStream", "DecompressionStream"),
    ],
)
def test_what_the_browser_lacks_is_named_over_the_poster_with_browsers_that_have_it(chromium, folder, script, needed):
    context = new_context(chromium)
    page = context.new_page()
    page.add_init_script(script)
    page.goto((folder / "tour.html").as_uri())
    page.wait_for_selector("#cover.failed img")
    message = page.inner_text("#message")
    context.close()
    assert message.startswith(f"This page needs {needed}")
    versions = message[message.index("Chrome") : message.index(" or later")]
    text = (Path(__file__).resolve().parents[2] / "README.md").read_text("utf-8")
    assert f"with WebGL 2 and `DecompressionStream` ({versions} or later)" in text


IN_PARTS = "let views = new Set(); isHolding = ({ chunk, view }) => chunk && views.add(view).size > 1;"


@pytest.mark.parametrize("name", ["tour.html", "split.html"])
def test_the_page_works_when_the_first_view_has_arrived(chromium: Any, folder: Path, name: str) -> None:
    record = """
        window.atob = window.DecompressionStream = class { constructor() { throw new Error("on the main thread"); } };
    """
    with opened(chromium, folder / name, script=HOLD + IN_PARTS + record) as page:
        page.run("drawn = new Set(); draw = Renderer.prototype.drawLayer; 0")
        page.run(
            "Renderer.prototype.drawLayer = function (...range) { drawn.add(range[0]); draw.call(this, ...range); }; 0"
        )
        page.run("dispatchEvent(new Event('resize'))")
        page.wait("drawn.size")
        assert page.run("[...drawn]") == page.run("[HEADER.views[HEADER.loading[0]].start]") == [0]
        start = page.camera["position"]
        page.page.keyboard.down("KeyW")
        page.wait(f"Math.hypot(...pansplat.camera.position.map((x, i) => x - {start}[i])) > 0.02")
        page.page.keyboard.up("KeyW")
        assert page.run("document.getElementById('view').ariaBusy") == "true"
        assert page.run("pansplat.isSettled()") is False
        page.run("release()")
        page.wait("drawn.size === 3 && document.getElementById('view').ariaBusy === 'false'")
        page.settle()
        assert page.run("pansplat.setPose({ yaw: 40 }), pansplat.isSettled()") is False
        assert page.run("document.body.textContent.length < 200000 && !document.querySelector('[type=\"text/plain\"]')")
        assert page.messages == []


@pytest.mark.slow
def test_a_tour_blends_the_views_of_the_edge_and_flies_along_edges(chromium: Any, folder: Path, scene: Scene) -> None:
    with opened(chromium, folder / "house.html", script=RECORD, is_stepped=True) as page:
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
        page.run("(camera) => Object.assign(pansplat.camera, camera)", camera)
        page.draw()
        page.run("(start) => { Object.assign(pansplat.camera, start); record(); }", start)
        page.page.keyboard.press("3")
        page.wait("pansplat.camera.position.every((x, i) => x === HEADER.spots[2].position[i])")
        passed = np.array([frame["position"] for frame in page.run("passed")])
        between = np.linalg.norm(passed[:, None] - spots, axis=2)
        offset = [
            np.linalg.norm(np.cross(passed - a, b - a), axis=1) / np.linalg.norm(b - a)
            for a, b in ((spots[0], spots[1]), (spots[1], spots[2]))
        ]
        assert np.minimum(*offset).max() < 1e-6 and between[:, 1].min() < 0.3
        assert page.messages == []


@pytest.mark.slow
def test_a_page_of_parts_fades_along_a_link_and_lists_all_panoramas(chromium: Any, folder: Path) -> None:
    with opened(chromium, folder / "flat.html", script=RECORD, is_stepped=True) as page:
        keyboard, start = page.page.keyboard, page.camera
        assert (start["yaw"], start["pitch"]) == (0.3, -0.2)
        page.wait("document.getElementById('name').innerText === 'room 0'")  # of the first frame
        # Titles are text. The keyboard opens the list and chooses from it.
        shown = "Array.from(document.querySelectorAll('#spots button:not([hidden])'), (button) => button.title)"
        page.run("pansplat.camera.yaw = 1.5; pansplat.camera.pitch = -0.6; dispatchEvent(new Event('resize'))")
        page.wait(f"{shown}.includes('Go to </script><b>hall <i>down')")
        keyboard.press("l")
        listed = page.page.inner_text("#panoramas").split("\n")
        assert [line for line in listed if line] == ["1. room 0", "2. room 1", "3. </script><b>hall", "4. attic"]
        assert page.run("document.activeElement.textContent") == "1. room 0"
        page.run("record()")
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
        assert old["position"] == start["position"] and (old["yaw"], old["pitch"]) == pytest.approx((to["yaw"], -0.2))
        assert left[0] == 1 and left == sorted(left, reverse=True) and any(0.3 < part < 0.7 for part in left)
        # The image that fades out is that of the last camera.
        frozen = decode(frames[first]["image"])
        page.run("({ position, yaw, pitch }) => Object.assign(pansplat.camera, { position, yaw, pitch })", old)
        assert psnr(page.draw(), frozen) > 30
        keyboard.press("4")  # without a link
        page.wait("document.getElementById('name').textContent === 'attic'")
        page.wait("document.getElementById('still').hidden")
        page.settle()
        assert page.camera["position"] == page.run("HEADER.spots[3].position")
        assert (page.camera["yaw"], page.camera["pitch"]) == pytest.approx((3.1, 0.2), abs=1e-5)
        assert page.run(shown) == ["Go to </script><b>hall"], "nothing leads on: an arrow to the nearest one"
        page.page.click("#home")
        assert page.camera == start
        assert page.messages == []


def test_along_a_poor_edge_the_image_grows_and_fades_fast_into_that_of_the_panorama(chromium, folder) -> None:
    with opened(chromium, folder / "house.html", script=RECORD, is_stepped=True) as page:
        page.settle()
        spots = page.run("HEADER.spots.map(({ position }) => position)")
        page.run("HEADER.poor.push([0, 1])")
        way = np.array(page.run("HEADER.level")).T @ (np.array(spots[1]) - spots[0])
        yaw = math.atan2(way[0], way[2])
        page.run("(yaw) => { pansplat.setPose({ yaw, pitch: 0 }); record(); }", math.degrees(yaw))

        def go(panorama: int) -> tuple[list[dict[str, Any]], int]:
            """The frames of the way to a panorama, and how many places they show."""
            page.run("(panorama) => { passed = []; pansplat.goTo(panorama); }", panorama)
            page.wait("pansplat.isSettled()", 100)
            frames = page.run("passed")
            return frames, len({tuple(np.round(frame["position"], 6) + 0.0) for frame in frames})

        frames, num_places = go(2)
        left = [frame["left"] for frame in frames if 0 < frame["left"] < 1]
        assert num_places == 1 and frames[0]["position"] == pytest.approx(spots[1]), "no picture from between"
        assert 5 <= len(left) <= 8 and left == sorted(left, reverse=True), "0.7 s, at 100 ms a frame"
        assert 1.5 < max(frame["scale"] for frame in frames) <= 1.65
        assert frames[-1]["yaw"] == pytest.approx(yaw)
        assert go(3)[1] > 5, "a good edge is flown"
        assert go(1)[1] > 5, "also before a zoom"
        assert page.messages == []


def test_a_fade_begins_with_the_picture_at_rest(chromium: Any, folder: Path) -> None:
    """The resolution has fallen in motion."""
    width = "document.getElementById('view').width"
    with opened(chromium, folder / "house.html", is_stepped=True) as page:
        page.settle()
        way = in_level(page, np.subtract(*page.run("[1, 0].map((node) => HEADER.spots[node].position)")))
        page.run("(yaw) => pansplat.setPose({ yaw, pitch: 0 })", math.degrees(math.atan2(way[0], way[2])))
        seen = page.draw()
        page.settle()
        page.run("HEADER.poor.push([0, 1]), pansplat.setPose({ yaw: 0 }), pansplat.goTo(2), 0")
        while page.page.is_hidden("#still"):
            least = page.run(f"step(90), {width}")
        assert least < SIZE[0]
        assert psnr(decode(page.run("document.getElementById('still').toDataURL()")), seen) > 45


@pytest.mark.slow
def test_the_image_of_another_room_stays_until_the_start_is_sorted(chromium: Any, folder: Path) -> None:
    with opened(chromium, folder / "house.html", script=HOLD, is_stepped=True) as page:
        hidden = "document.getElementById('still').hidden"
        page.run("HEADER.speed = 0.3")
        page.jump(3)
        assert page.camera["position"] == page.run("HEADER.spots[2].position")
        seen = page.draw()
        page.run("isHolding = ({ position }) => position; 0")
        page.page.keyboard.press("KeyR")
        page.wait("held.length")
        page.run("for (let frame = 0; frame < 30; frame++) step(50)")  # it would fade in 20 frames
        assert page.run("document.getElementById('still').style.opacity") == "1" and not page.run(hidden)
        assert psnr(decode(page.run("document.getElementById('still').toDataURL()")), seen) > 30
        page.run("release()")
        page.wait(hidden)
        page.page.keyboard.press("KeyR")
        assert page.run(hidden), "at the start there is nothing to hide"


def test_the_keys_that_open_a_dialog_close_it(home: OpenPage) -> None:
    for key, dialog in (("h", "#keys"), ("l", "#list")):
        for shown in (True, False, True):
            home.page.keyboard.press(key)
            assert home.page.is_visible(dialog) == shown
        if key == "h":
            assert home.page.is_visible("#no-doll") and home.page.is_hidden("#doll"), "why there is no doll's house"
        home.page.keyboard.press("Escape")
        assert not home.page.is_visible(dialog)


@pytest.mark.slow
def test_the_poster_is_in_place_of_the_picture(chromium, scene, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(page_module, "_POSTER_SIZE", (486, 576))
    write_page(scene, tmp_path / "page.html")
    with opened(chromium, tmp_path / "page.html", is_stepped=True) as page:
        page.page.add_style_tag(content="#buttons, #message, #bar, #spots, #status { display: none !important }")
        page.wait("document.getElementById('cover').hidden")
        page.run("cover = document.getElementById('cover'); cover.style.transition = 'none'; cover.className = ''")
        page.run("cover.hidden = false")
        for width, height in ((195, 422), (420, 240), (300, 270)):
            page.page.set_viewport_size({"width": width, "height": height})
            picture = page.draw(width, height)
            poster = np.asarray(Image.open(io.BytesIO(page.page.screenshot())).convert("RGB"), np.float64) / 255
            assert poster.shape == picture.shape
            quality = psnr(poster, picture)
            assert quality > 27 and all(psnr(np.roll(poster, 3, axis), picture) < quality - 3 for axis in (0, 1))


@pytest.mark.slow
def test_the_wheel_is_the_host_pages_until_a_click(chromium: Any, sites: Sites, folder: Path) -> None:
    host = OpenPage(new_context(chromium, viewport={"width": 500, "height": 400}).new_page())
    host.page.goto(f"{sites.host}/host.html#{sites.pages}/tour.html")
    frame = host.page.frames[1]
    frame.evaluate("pansplat.ready")
    mouse, fov = host.page.mouse, frame.evaluate("pansplat.camera.fov")
    place = (150, 180)

    def scrolls(pixels: int) -> bool:
        """Whether the wheel scrolls the host, and not the field of view."""
        before = host.run("scrollY"), frame.evaluate("pansplat.camera.fov")
        frame.evaluate("turned = 0; onwheel = () => { turned += 1; }")  # after the page's listener
        mouse.wheel(0, pixels)
        wait_until(frame, "turned")
        if frame.evaluate("pansplat.camera.fov") != before[1]:
            assert host.run("scrollY") == before[0]
            return False
        host.wait(f"scrollY === {before[0] + pixels}")
        return frame.evaluate("pansplat.camera.fov") == before[1]

    mouse.move(*place)
    assert scrolls(30) and scrolls(-30)
    assert frame.evaluate("pansplat.camera.fov") == fov and "Click" in frame.inner_text("#status")
    touch_action = "document.getElementById('view').style.touchAction"
    assert frame.evaluate(touch_action) == "pan-y", "a finger scrolls the host"
    mouse.click(*place)
    assert not scrolls(30) and frame.evaluate(touch_action) == "none"
    host.page.keyboard.press("Escape")
    assert scrolls(30) and scrolls(-30)
    mouse.click(*place)
    assert not scrolls(30)
    mouse.move(20, 20)
    mouse.move(*place)
    assert scrolls(30)
    host.page.context.close()


@pytest.mark.slow
def test_a_script_moves_the_camera_and_hears_of_arrivals(chromium: Any, folder: Path) -> None:
    with opened(chromium, folder / "house.html") as page:
        assert page.run("pansplat.panoramas") == ["room 0", "room 1", "room 2"]
        page.run("pansplat.addEventListener('arrive', ({ detail }) => { heard = detail; })")
        assert page.run("pansplat.goTo('room 2')") is True
        assert page.run("heard") == {"panorama": 3, "name": "room 2"}
        assert page.run("pansplat.getPose()")["position"] == page.run("HEADER.spots[2].position")
        assert page.run("Promise.all([pansplat.goTo(1), pansplat.goTo(2, { jump: true })])") == [False, True]
        pose = {"position": [0.1, 0.2, 0.3], "yaw": 30, "pitch": -10, "fov": 60}
        page.run("(pose) => pansplat.setPose(pose)", pose)
        got = page.run("pansplat.getPose()")
        assert got.pop("position") == pytest.approx(pose.pop("position")) and got == pytest.approx(pose)
        assert "panorama 9" in page.run("pansplat.goTo(9).catch(String)")
        with pytest.raises(Exception, match="finite"):
            page.run("pansplat.setPose({ yaw: 'x' })")


def test_a_link_opens_its_pose(chromium: Any, folder: Path) -> None:
    script = "Object.defineProperty(navigator, 'clipboard', {value: {writeText: async (text) => { copied = text; }}});"
    pose = {"position": [0.25, -0.1, 0.4], "yaw": -123.4, "pitch": 12.5, "fov": 60}
    with opened(chromium, folder / "tour.html", script=script) as page:
        start = page.camera
        page.run("(pose) => pansplat.setPose(pose)", pose)
        page.page.click("#more")
        page.page.click("#link")
        assert "copied" in page.page.inner_text("#status")
        link = page.run("copied")
        page.run("navigator.clipboard.writeText = () => Promise.reject(new Error('denied')); 0")
        page.page.click("#more")
        page.page.click("#link")
        page.page.wait_for_selector("#notice[open]")
        assert page.page.inner_text("#notice-text") == link, "where the clipboard is not allowed"
    address, fragment = link.split("#")
    assert address == (folder / "tour.html").as_uri()
    with opened(chromium, folder / "tour.html", fragment="#" + fragment) as page:
        got = page.run("pansplat.getPose()")
        assert got.pop("position") == pytest.approx(pose.pop("position"), abs=1e-3) and got == pytest.approx(pose)
        page.run("hashes = 0; addEventListener('hashchange', () => { hashes += 1; })")
        for wrong in ("#at=1,2,3", "#at=1,2,3,4,5,e", "#other", "#at=,,,,,"):
            page.run("(hash) => { location.hash = hash; }", wrong)
        page.wait("hashes === 4")
        assert page.run("pansplat.getPose().yaw") == pytest.approx(-123.4)
        page.run("location.hash = '#at=0,0,0,10,0,400'")
        page.wait("Math.abs(pansplat.camera.yaw - 10 * Math.PI / 180) < 1e-9")
        assert page.camera["fov"] == 130 and page.messages == []
        assert page.run("HEADER.startFov") == start["fov"]


def test_a_picture_is_saved(home: OpenPage) -> None:
    for click in (
        lambda: home.page.keyboard.press("p"),
        lambda: (home.page.click("#more"), home.page.click("#picture")),
    ):
        with home.page.expect_download() as download:
            click()
        assert download.value.suggested_filename == "Three rooms.png"
        assert home.page.inner_text("#status") == "Picture saved"
        image = np.asarray(Image.open(download.value.path()).convert("RGB"), np.float64) / 255
        assert psnr(image, home.draw()) > 60
    assert home.page.is_hidden("#menu")


def test_rings_on_a_touch_screen_have_names_and_room_for_a_finger(chromium: Any, folder: Path) -> None:
    options = {"has_touch": True, "is_mobile": True}
    with opened(chromium, folder / "tour.html", size=(390, 844), is_stepped=True, **options) as page:
        page.settle()
        page.look(yaw=45, pitch=-40)
        found = page.run("""Array.from(document.querySelectorAll("#spots button:not([hidden], .arrow)"), (button) => {
            const { left, top, width, height } = button.getBoundingClientRect(), label = button.querySelector("span");
            const [x, y] = [left + width / 2, top + height / 2], { visibility } = getComputedStyle(label);
            const places = [[20, 0], [-20, 0], [0, 20], [0, -20]];
            const hit = places.map(([dx, dy]) => document.elementFromPoint(x + dx, y + dy) === button);
            return { name: visibility === "visible" && label.innerText, size: Math.min(width, height), hit };
        })""")
        assert all(ring["name"] in ("room 1", "room 2") for ring in found)
        assert min(ring["size"] for ring in found) < 40 and any(all(ring["hit"]) for ring in found)
        page.look(yaw=45, pitch=30)
        arrows = page.run("""Array.from(document.querySelectorAll("#spots .arrow:not([hidden])"), (button) => {
            const { left, top } = button.getBoundingClientRect();
            return document.elementFromPoint(left + 22, top + 22) === button;
        })""")
        assert arrows and all(arrows), "over the row of buttons"
        right = page.run(
            "Array.from(document.querySelectorAll('#buttons > :not([hidden])'), (e) => e.getBoundingClientRect().left)"
        )
        assert min(right) >= 0
        page.page.click("#more")
        page.page.click("#measure")
        assert page.page.inner_text("#status") == "Tap two points"
        page.run("HEADER.doll = []")
        page.page.keyboard.press("KeyO")
        assert "fewer than half" in page.page.inner_text("#status")
        box = page.page.query_selector("#status").bounding_box()
        assert box["width"] > 0.8 * 390 and box["x"] >= 0 and box["x"] + box["width"] <= 390, "a message is wide"
        page.page.click("#help")
        assert "two fingers" in page.page.inner_text("#keys table") and "W A S D" not in page.page.inner_text(
            "#keys table"
        )


@pytest.mark.slow
def test_distances_are_those_of_the_rasterisers_depth(home: OpenPage, scene: Scene) -> None:
    places, camera = [(70, 60), (230, 170)], {**home.camera, "pitch": -0.1}
    home.look(pitch=math.degrees(-0.1))
    level, origin = np.array(home.run("HEADER.level")), scene.cam2world[:, :3, 3].mean(0).numpy()
    depth = render_reference(scene, level, origin, camera).depth.squeeze().numpy()
    points = []
    for x, y in places:
        step = 2 * math.tan(math.radians(camera["fov"] / 2)) / SIZE[1]
        ray = np.array(((x - SIZE[0] / 2) * step, (y - SIZE[1] / 2) * step, 1))
        points.append(ray / np.linalg.norm(ray) * depth[y - 1 : y + 1, x - 1 : x + 1].mean())
    home.page.click("#more")
    home.page.click("#measure")

    def read(place: tuple[int, int]) -> float:
        home.page.mouse.click(*place)
        return float(home.page.inner_text("#status").split(" m ")[0])

    assert read(places[0]) == pytest.approx(np.linalg.norm(points[0]), rel=0.02)
    between = np.linalg.norm(points[1] - points[0])
    assert read(places[1]) == pytest.approx(between, rel=0.02)
    home.wait("document.querySelectorAll('#marks circle').length === 2")
    shown = home.run(
        "Array.from(document.querySelectorAll('#marks circle'), (e) => [e.cx, e.cy].map((v) => v.baseVal.value))"
    )
    assert np.array(shown) == pytest.approx(np.array(places), abs=0.5)
    assert float(home.page.text_content("#marks text").split()[0]) == pytest.approx(between, rel=0.02)
    # A drag measures nothing, and the line stays in the scene.
    home.page.mouse.move(100, 100)
    home.page.mouse.down()
    home.page.mouse.move(140, 100)
    home.page.mouse.up()
    home.wait(f"document.querySelector('#marks circle').cx.baseVal.value > {places[0][0] + 20}")
    home.run("({ worlds } = HEADER.plan, HEADER.plan.worlds = [0, 1, 1])")  # the panorama here is alone
    home.page.mouse.click(100, 100)
    value, error = re.fullmatch(r"([.\d]+) m ± ([.\d]+) m from the camera", home.page.inner_text("#status")).groups()
    assert float(error) == pytest.approx(0.35 * float(value), abs=0.01)
    home.run("HEADER.plan.worlds = worlds, 0")
    home.page.keyboard.press("Escape")
    assert home.run("document.getElementById('marks').childElementCount") == 0
    home.page.mouse.click(100, 100)
    assert home.run("document.getElementById('marks').childElementCount") == 0


@pytest.mark.slow
def test_the_floor_plan_is_a_drawing_with_the_camera_and_leads_to_panoramas(chromium: Any, folder: Path) -> None:
    with opened(chromium, folder / "flat.html", size=(800, 480)) as page:
        page.page.keyboard.press("m")
        page.settle()
        page.wait("document.querySelector('#drawing img').naturalWidth > 0")
        drawing, plan = page.page.query_selector("#drawing").bounding_box(), page.run("HEADER.plan")
        assert drawing["x"] + drawing["width"] <= 200, "a quarter of the width"
        boxes = [each.bounding_box() for each in page.page.query_selector_all("#drawing button")]
        assert len(boxes) == 4 and min(box[side] for box in boxes for side in ("width", "height")) >= 43.99
        centers = np.array([(box["x"] + 22, box["y"] + 22) for box in boxes])
        corner, scale = np.array((drawing["x"], drawing["y"])), drawing["width"] / plan["size"][0]
        assert centers == pytest.approx(corner + scale * np.array([place[:2] for place in plan["places"]]), abs=0.6)
        assert page.run("document.querySelector('#drawing [aria-current]').ariaLabel") == "Go to room 0"
        turn, here = math.degrees(plan["places"][0][2]), "document.getElementById('here').style"
        page.run("(yaw) => pansplat.setPose({ yaw })", 90 - turn)
        page.wait(f"Math.abs(parseFloat({here}.rotate) - 90) < 1e-3")
        place = np.array([float(page.run(f"parseFloat({here}.{side})")) for side in ("left", "top")]) / 100
        assert corner + place * (drawing["width"], drawing["height"]) == pytest.approx(centers[0], abs=0.6)
        mark = page.page.query_selector("#here").bounding_box()  # turned by 90 degrees, around its place
        assert (mark["width"], mark["height"]) == pytest.approx((44, 18))
        assert (mark["x"] + 22, mark["y"] + 9) == pytest.approx(centers[0], abs=0.6)
        assert page.page.inner_text("#legend") == "Dashed: place not sure"
        position = np.array(page.run("HEADER.spots[0].position")) + 0.5 * np.array(page.run("HEADER.level"))[:, 0]
        page.look(position=position.tolist())
        moved = np.array([float(page.run(f"parseFloat({here}.{side})")) for side in ("left", "top")]) / 100
        expected = 0.5 * np.array((math.cos(math.radians(turn)), math.sin(math.radians(turn))))
        assert (moved - place) * plan["size"] == pytest.approx(expected, abs=1e-3)
        for node, name in ((1, "room 1"), (0, "room 0"), (3, "attic")):
            page.page.mouse.click(*centers[node])
            page.wait(f"document.querySelector('#drawing [aria-current]').ariaLabel === 'Go to {name}'")
        page.page.keyboard.press("m")
        assert page.page.is_hidden("#plan") and page.messages == []


@pytest.mark.slow
def test_with_reduced_motion_the_camera_jumps(chromium: Any, folder: Path) -> None:
    options = {"script": RECORD, "reduced_motion": "reduce", "is_stepped": True}
    with opened(chromium, folder / "house.html", **options) as page:
        spots = page.run("HEADER.spots.map((spot) => spot.position)")
        page.run("record()")
        page.page.keyboard.press("3")
        page.wait(f"pansplat.camera.position.every((x, i) => x === {spots[2]}[i])", 50)
        page.wait("passed.length > 30 && document.getElementById('still').hidden", 50)
        page.page.keyboard.press("Space")
        for node in (0, 1):
            page.wait(f"pansplat.camera.position.every((x, i) => x === {spots[node]}[i])", 50)
        page.page.keyboard.press("Space")
        frames = page.run("passed")
        places = {tuple(np.round(frame["position"], 4)) for frame in frames}
        assert places <= {tuple(np.round(place, 4)) for place in spots}
        assert any(0.2 < frame["left"] < 0.8 for frame in frames), "the image fades"


@pytest.mark.slow
def test_every_control_has_a_name_and_takes_the_focus(chromium: Any, folder: Path) -> None:
    with opened(chromium, folder / "house.html", size=(640, 480)) as page:
        page.settle()  # the name of the panorama is there
        page.page.keyboard.press("m")
        page.page.click("#more")
        nameless = "#view, dialog, nav, button, progress, [role]"
        elements = page.run(f"""Array.from(document.querySelectorAll("{nameless}"), (element) => [
            element.id, element.ariaLabel || element.innerText || element.textContent || element.role])""")
        assert len(elements) > 20 and all(name and name.strip() for _, name in elements)
        visible = page.run("""Array.from(document.querySelectorAll("button"), (button) => button.checkVisibility()
            && (button.id || button.ariaLabel)).filter(Boolean)""")
        assert {"place", "play", "home", "map", "full", "help", "more", "measure", "picture", "link"} < set(visible)
        reached = {}
        page.run("document.getElementById('view').focus()")
        for _ in range(len(visible) + 2):
            page.page.keyboard.press("Tab")
            name, outline = page.run("""(() => {
                const { activeElement: found } = document, { outlineStyle, outlineWidth } = getComputedStyle(found);
                return [found.id || found.ariaLabel, outlineStyle !== "none" && parseFloat(outlineWidth) > 0];
            })()""")
            reached[name] = outline
        assert set(visible) <= set(reached)
        assert all(reached[name] for name in visible if name in ("home", "more", "link"))
        page.page.focus("#map")
        page.page.keyboard.press("Enter")
        assert page.page.is_hidden("#plan") and page.page.get_attribute("#map", "aria-pressed") == "false"
        page.page.keyboard.press("Escape")
        assert page.page.is_hidden("#menu") and page.page.get_attribute("#more", "aria-expanded") == "false"


@pytest.mark.slow
def test_a_notebook_shows_the_page_in_a_frame_that_cannot_reach_it_and_saves_pictures(chromium, plain_scene, tmp_path):
    file = tmp_path / "cell.html"
    file.write_text(f"<!doctype html><meta charset=utf-8>{_bundle_scene(plain_scene)['text/html']}")
    page = OpenPage(new_context(chromium, viewport={"width": 640, "height": 560}).new_page())
    page.page.goto(file.as_uri())
    (frame,) = page.page.main_frame.child_frames
    frame.wait_for_selector("#cover", state="hidden")
    frame.wait_for_selector("#buttons", state="visible")
    wait_until(frame, "pansplat.isSettled()")
    assert frame.evaluate("origin") == "null"
    assert frame.evaluate("document.getElementById('name').innerText") in plain_scene.names
    assert page.messages == []
    with page.page.expect_download() as download:
        frame.click("#more")
        frame.click("#picture")
    assert download.value.suggested_filename == "scene.png"
    assert "if the page around this frame allows" in frame.inner_text("#status")
    with Image.open(download.value.path()) as image:
        assert np.asarray(image.convert("RGB")).std() > 10
    page.page.context.close()
