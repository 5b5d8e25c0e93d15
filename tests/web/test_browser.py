"""The page in headless Chromium with WebGL 2 on the processor: pictures, input, loading."""

import base64
import dataclasses
import io
import json
import math
import os
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any, ClassVar

import numpy as np
import pytest
import shapely
import torch
from jaxtyping import Float
from PIL import Image

from pansplat import pipeline
from pansplat.bench.scenes import full_lattice_room, make_room_cameras
from pansplat.export import page as page_module
from pansplat.export.page import PageFiles, write_page
from pansplat.export.page_server import PageServer
from pansplat.gaussians.scene import Scene
from pansplat.geometry.equirect import sample_equirect, uv_from_directions
from pansplat.geometry.path import turn_axes
from pansplat.geometry.world import WorldFrame
from pansplat.images.image_files import read_panorama
from pansplat.inputs.panorama_sets import Note, PanoramaSet
from pansplat.notebook import _bundle_scene
from pansplat.tours.doll_house import find_rooms
from pansplat.tours.facts import TourFacts
from pansplat.tours.merge import make_graph, select_views

SIZE = (320, 240)
LIMIT = 180  # seconds, after which a state that the page does not reach is an error
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
        browser = playwright.chromium.launch(executable_path=program, args=list(OPTIONS), timeout=1000 * LIMIT)
        yield browser
        browser.close()


# Messages of the page stay until the next one: the test may read them late.
STAY = """(({ setTimeout }) => {
    window.setTimeout = (act, ms, ...values) => ms === 5000 ? 0 : setTimeout(act, ms, ...values);
})(window);"""
SLOW = """(({ requestAnimationFrame }) => {  // a frame takes 0.3 s, as on a slow machine
    window.requestAnimationFrame = (onFrame) => setTimeout(() => requestAnimationFrame(onFrame), 300);
})(window);"""

# Time stands still but for `step`, which draws the next frame.
CLOCK = """((waiting, time) => {
    performance.now = () => time;
    requestAnimationFrame = (onFrame) => waiting.push(onFrame);
    step = (milliseconds) => {
        time += milliseconds;
        waiting.splice(0).forEach((onFrame) => onFrame(time));
    };
})([], 1e5);"""
FRAME_MS = 30  # of it; the page keeps its resolution
# Messages to the worker wait while `isHolding`, until `release`.
HOLD = """
    held = [], isHolding = () => false;
    window.Worker = class extends Worker {
        postMessage(message) {
            if (isHolding(message)) held.push(message);
            else super.postMessage(message);
            window.worker = this;
        }
    };
    release = () => { isHolding = () => false; held.splice(0).forEach((message) => worker.postMessage(message)); };
"""
WITHOUT_GAUSSIANS = HOLD + "isHolding = ({ chunk }) => chunk;"


def new_context(chromium: Any, **options: Any) -> Any:
    """A context of the browser, in which nothing depends on the time that the machine takes."""
    context = chromium.new_context(**options)
    context.set_default_timeout(1000 * LIMIT)
    context.add_init_script(STAY)
    return context


class QuietHandler(SimpleHTTPRequestHandler):
    """Serves a folder and prints nothing."""

    def log_message(self, *_: Any) -> None:
        pass


@dataclass(frozen=True)
class Sites:
    """A folder that two servers on this machine show, each with an origin of its own.

    Attributes:
        pages: origin from which pages come that are embedded.
        host: origin of the page around them.
    """

    folder: Path
    pages: str
    host: str


@pytest.fixture(scope="module")
def sites(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Sites]:
    folder = tmp_path_factory.mktemp("pages")
    (folder / "host.html").write_text(HOST)
    with ExitStack() as stack:
        origins = []
        for _ in range(2):
            handler = partial(QuietHandler, directory=str(folder))
            server = stack.enter_context(ThreadingHTTPServer(("127.0.0.1", 0), handler))
            Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
            stack.callback(server.shutdown)
            origins.append(f"http://127.0.0.1:{server.server_port}")
        ORIGINS[folder] = origins[0]
        yield Sites(folder, *origins)


class FaultyHandler(QuietHandler):
    """Drops, delays and replaces files by their names, as often as `faults` has it."""

    faults: ClassVar[dict[str, list[str]]] = {}

    def do_GET(self) -> None:
        waiting = self.faults.get(self.path.rsplit("/")[-1], [])
        fault = waiting.pop(0) if waiting else None
        if fault == "html":
            self.path = "/host.html"
        elif fault == "half":
            content = Path(self.translate_path(self.path)).read_bytes()
            self.send_response(200)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content[: len(content) // 2])
            self.wfile.flush()
        if fault in ("half", "silence"):
            time.sleep(2 * LIMIT)
        elif fault != "drop":
            super().do_GET()


@pytest.fixture
def faulty(folder: Path) -> Iterator[str]:
    """Origin of a FaultyHandler that shows the folder."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(FaultyHandler, directory=str(folder))) as server:
        Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        FaultyHandler.faults.clear()
        server.shutdown()


@pytest.fixture(scope="module")
def photographs(scene: Scene, take_photographs: Callable[..., list[PanoramaSet]]) -> list[PanoramaSet]:
    """Of the scene, 1024 rows; the second one has a note ahead on the right, the third one another."""
    taken = take_photographs(scene, 1024)
    notes = (
        Note(0.3, 0.1, "<b>Oak</b>\nfloor", ("https://example.org/a?b=<c>&d", "http://example.org")),
        Note(1.0, 0.0, "x"),
    )
    for number, note in enumerate(notes, start=1):
        (panorama,) = taken[number].context
        taken[number] = dataclasses.replace(taken[number], context=(dataclasses.replace(panorama, notes=(note,)),))
    return taken


@pytest.fixture(scope="module")
def folder(scene, house, flat, sites, photographs, take_photographs) -> Path:
    """tour.html, split.html with files, house.html with a graph, flat.html with parts.

    photos.html, photos/index.html and rooms.html (as flat.html) have photographs; poor/index.html has a poor edge.
    """
    folder = sites.folder
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page_module, "_POSTER_SIZE", (27, 32))
        patch.setattr(page_module, "_PART_BYTES", 30_000)
        patch.setattr(TourFacts, "poor", ())  # surfaces of the scenes do not agree
        write_page(scene, folder / "tour.html", title="Three rooms")
        write_page(scene, folder / "split.html", split=True)
        write_page(house, folder / "house.html")
        write_page(flat, folder / "flat.html")
        write_page(flat, folder / "rooms.html", photographs=take_photographs(flat, 256))
        write_page(scene, folder / "photos.html", photographs=photographs)
        (folder / "photos").mkdir()
        write_page(scene, folder / "photos" / "index.html", photographs=photographs, split=True)
        write_page(house, folder / "hosted.html", split=True)
        (folder / "poor").mkdir()
        poor = {"photographs": photographs, "photo_height": 512, "split": True}
        patch.setattr(TourFacts, "poor", ((0, 1),))
        write_page(house, folder / "poor" / "index.html", **poor)
    return folder


def wait_until(frame: Any, condition: str) -> None:
    """Wait until an expression of a page or frame is true; the page's policy forbids playwright's own function."""
    end = time.monotonic() + LIMIT
    while not frame.evaluate(condition):
        assert time.monotonic() < end, condition
        frame.wait_for_timeout(10)


class OpenPage:
    """A page in the browser, with its requests and messages."""

    def __init__(self, page: Any, is_stepped: bool = False) -> None:
        self.page, self.is_stepped, self.requests, self.messages = page, is_stepped, [], []
        page.on("request", lambda request: self.requests.append(request.url))
        page.on("console", lambda message: self.messages.append(message.text))
        page.on("pageerror", lambda error: self.messages.append(str(error.stack)))

    def load(self, address: str) -> None:
        self.page.goto(address)
        late = f"new Promise((resolve) => setTimeout(resolve, {1000 * LIMIT}, 'late'))"
        assert self.page.evaluate(f"Promise.race([pansplat.ready.then(() => 'ready', String), {late}])") == "ready"

    def run(self, program: str, *arguments: Any) -> Any:
        return self.page.evaluate(program, *arguments)

    @property
    def camera(self) -> dict[str, Any]:
        return self.run("({...pansplat.camera, position: [...pansplat.camera.position]})")

    def wait(self, condition: str, milliseconds: float = FRAME_MS) -> None:
        """Wait until an expression is true, after frames of that time where CLOCK stands still."""
        wait_until(self.page, f"(step({milliseconds}), {condition})" if self.is_stepped else condition)

    def settle(self) -> None:
        """Wait until the picture is final."""
        self.wait("pansplat.isSettled()")

    def look(self, **pose: Any) -> None:
        """Place the camera, and wait until the picture is final."""
        self.run("(pose) => pansplat.setPose(pose)", pose)
        self.settle()

    def jump(self, panorama: int) -> None:
        """Go to a panorama, from 1, without a flight."""
        self.run("(panorama) => { pansplat.goTo(panorama, { jump: true }); }", panorama)
        self.settle()

    def draw(self) -> Float[np.ndarray, "height width 3"]:
        return decode(self.run("([width, height]) => pansplat.render(width, height)", list(SIZE)))


def decode(url: str) -> Float[np.ndarray, "height width 3"]:
    """The image of a data URL."""
    image = Image.open(io.BytesIO(base64.b64decode(url.split(",")[1]))).convert("RGB")
    return np.asarray(image, np.float64) / 255


ORIGINS: dict[Path, str] = {}  # of served folders


def find_address(path: Path) -> str:
    """Of a page from disk, or from its server if it has files beside it."""
    folders = [folder for folder in ORIGINS if folder in path.parents and '"folder": null' not in path.read_text()]
    return f"{ORIGINS[folders[0]]}/{path.relative_to(folders[0]).as_posix()}" if folders else path.as_uri()


@contextmanager
def opened(
    chromium: Any,
    path: Path | str,
    *,
    size: tuple[int, int] = SIZE,
    script: str = "",
    fragment: str = "",
    is_stepped: bool = False,
    **options: Any,
) -> Iterator[OpenPage]:
    """The loaded page of a file or address in a context of its own.

    `script` runs before those of the page, `fragment` ends its address, `is_stepped` is with CLOCK.
    """
    context = new_context(chromium, viewport={"width": size[0], "height": size[1]}, **options)
    page = OpenPage(context.new_page(), is_stepped)
    page.page.add_init_script((CLOCK if is_stepped else "") + script)
    page.load((path if isinstance(path, str) else find_address(path)) + fragment)
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
    page.settle()
    return page


def aim(level: np.ndarray, camera: dict[str, Any]) -> np.ndarray:
    """The axes of a camera of the page, whose numbers may be integers."""
    return turn_axes(level.astype(float), float(camera["yaw"]), float(camera["pitch"]))


def draw_reference(
    scene: Scene, level: np.ndarray, origin: np.ndarray, camera: dict[str, Any], size: tuple[int, int] = SIZE
) -> np.ndarray:
    """The rasteriser's image for a camera of the page; `level` is its axes at yaw and pitch 0."""
    color = render_reference(scene, level, origin, camera, size).color
    return color.clamp(0, 1).permute(1, 2, 0).double().numpy()


@torch.no_grad()
def render_reference(
    scene: Scene, level: np.ndarray, origin: np.ndarray, camera: dict[str, Any], size: tuple[int, int] = SIZE
) -> Any:
    """The rasteriser's picture and depth for a camera of the page."""
    pose = np.eye(4)
    pose[:3, :3] = aim(level, camera)
    pose[:3, 3] = camera["position"] + origin
    options = {"size": size[::-1], "layout": "pinhole", "vertical_fov_degrees": camera["fov"]}
    return pipeline.render(scene, pose, **options)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return -10 * math.log10(max(float(((a - b) ** 2).mean()), 1e-12))


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


def test_the_dolls_house_shows_the_photographs_on_its_floor_and_a_click_goes_back_inside(
    chromium: Any, room: Scene, room_photographs: list[PanoramaSet], room_page: Path
) -> None:
    photographs, rooms = room_photographs, find_rooms(TourFacts(room))
    origin, cameras = room.cam2world[:, :3, 3].mean(0).numpy(), room.cam2world[:, :3, 3].numpy()
    with opened(chromium, room_page) as page:
        page.page.emulate_media(reduced_motion="reduce")
        start, level = page.camera, np.array(page.run("HEADER.level"))
        page.page.keyboard.press("KeyO")
        page.wait("pansplat.camera.fov === 45 && pansplat.isSettled()")
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
        eye, down = camera["position"] + origin, rooms.level[:, 1]
        floor = float(np.mean(cameras @ down + rooms.floors))
        places = eye + ((floor - eye @ down) / (rays @ down))[..., None] * rays
        outline, flat = rooms.plan.rooms[0].shape, places @ rooms.level[:, (0, 2)]
        nearest = np.linalg.norm(places[:, :, None] - cameras, axis=-1)
        is_clear = shapely.contains_xy(outline.buffer(-0.1), flat[..., 0], flat[..., 1])
        is_clear &= (np.abs(nearest[..., 0] - nearest[..., 1]) > 0.5) & (nearest.min(axis=-1) > 1.3 * rooms.floors[0])
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
        page.draw()
        page.page.mouse.click(left, top)
        page.wait("HEADER.spots.some((s) => s.position.every((x, i) => x === pansplat.camera.position[i]))")
        assert page.camera["fov"] == start["fov"] and page.page.get_attribute("#doll", "aria-pressed") == "false"
        page.settle()
        page.run("pansplat.setPose({ yaw: 77, pitch: 5 })")
        before = page.run("pansplat.getPose()")
        page.page.keyboard.press("KeyO")
        page.wait("pansplat.camera.fov === 45")
        page.page.keyboard.press("KeyO")
        page.wait("pansplat.camera.fov !== 45 && pansplat.isSettled()")
        after = page.run("pansplat.getPose()")
        assert (after["yaw"], after["pitch"]) == pytest.approx((before["yaw"], before["pitch"])), "it keeps the heading"
        page.run("HEADER.doll = []")
        page.page.keyboard.press("KeyO")
        assert "fewer than half" in page.page.inner_text("#status") and page.camera["fov"] != 45
        assert page.messages == []


def test_a_pose_and_a_tour_lead_out_of_the_dolls_house(chromium: Any, room_page: Path) -> None:
    with opened(chromium, room_page, is_stepped=True) as page:
        start = page.camera
        outside = "pansplat.camera.fov === 45 && pansplat.isSettled()"
        page.page.keyboard.press("KeyO")
        page.wait(outside)
        page.run("resized = false, addEventListener('resize', () => { resized = true; })")
        page.page.set_viewport_size({"width": SIZE[1], "height": SIZE[0]})
        page.wait(f"resized && {outside}")
        image = decode(page.run("([width, height]) => pansplat.render(width, height)", list(SIZE[::-1])))
        assert np.abs(image[:, [0, -1]] - image[0, 0]).max() < 0.01, (
            "the whole house is in the picture of a turned phone"
        )
        page.run("pansplat.setPose({ yaw: 20 })")
        turned = page.camera
        assert (turned["position"], turned["fov"], turned["pitch"]) == (start["position"], start["fov"], start["pitch"])
        page.page.keyboard.press("KeyO")
        page.wait(outside)
        page.page.keyboard.press("Space")
        assert page.page.get_attribute("#play", "aria-pressed") == "true"
        assert page.page.get_attribute("#doll", "aria-pressed") == "false" and page.camera["fov"] == start["fov"]
        page.wait(f"pansplat.camera.position.some((x, i) => Math.abs(x - {start['position']}[i]) > 0.1)")
        assert page.messages == []


def test_a_drag_that_starts_on_a_ring_or_its_label_turns_the_view_and_a_click_chooses(chromium, folder) -> None:
    with opened(chromium, folder / "tour.html", size=(640, 480), reduced_motion="reduce") as page:
        page.run("HEADER.spots.forEach((spot) => { spot.hidden = []; })")
        position, mark = page.run("[HEADER.spots[0].position, HEADER.spots[1].mark]")
        right, down, forward = in_level(page, np.subtract(mark, position))
        pose = {"position": position, "yaw": math.degrees(math.atan2(right, forward))}
        pose["pitch"] = -math.degrees(math.atan2(down, math.hypot(right, forward)))
        for part in ("", " span"):
            page.look(**pose)
            ring = page.page.locator(f"#spots button:not([hidden])[title='Go to room 1']{part}").bounding_box()
            place = ring["x"] + ring["width"] / 2, ring["y"] + ring["height"] / 2
            before, mouse = page.camera, page.page.mouse
            for end in ((place[0] + 60, place[1]), place):  # with, and back to where it began
                mouse.move(*place)
                mouse.down()
                mouse.move(place[0] + 30, place[1] + 20)
                mouse.move(*end)
                mouse.up()
                page.settle()
                assert page.camera["position"] == position, "no click"
                assert (page.camera["yaw"] < before["yaw"] - 0.05) == (end != place)
                page.look(**pose)
            mouse.wheel(0, -200)
            page.wait(f"pansplat.camera.fov < {before['fov']}")
            page.look(fov=before["fov"])
            mouse.click(*place)
            page.wait("pansplat.camera.position.every((x, i) => x === HEADER.spots[1].position[i])")


def test_a_page_of_small_and_large_units_is_that_of_metres(chromium, folder, scene, photographs, tmp_path) -> None:
    seen, plans = [], []
    for unit in (1.0, 1e3, 1e-3):
        path = tmp_path / f"{unit:g}.html"
        framed = dataclasses.replace(scene, frame=WorldFrame(unit))
        write_page(framed, path, photographs=photographs, photo_height=256)
        with opened(chromium, path, size=(640, 480)) as page:
            position = page.run("HEADER.spots[0].position")
            for offset in (0.02, 0.1):
                page.look(position=[position[0] + offset, *position[1:]], yaw=0, pitch=0)
                seen.append(page.draw())
            page.page.keyboard.press("KeyM")
            page.settle()
            plans.append(page.run("document.getElementById('drawing').innerHTML"))
    assert psnr(seen[0], seen[1]) < 25, "a photograph, and Gaussians"
    assert "svg" in plans[0] and plans[0] == plans[1] == plans[2]
    assert min(psnr(seen[k], seen[k % 2]) for k in range(2, 6)) > 45


def test_flights_jumps_and_keys_end_alike(chromium: Any, folder: Path) -> None:
    """In the start view of the panorama; without one in the direction of the way."""
    with opened(chromium, folder / "tour.html", is_stepped=True) as page:
        right, _, ahead = in_level(page, np.subtract(*page.run("[HEADER.spots[1].position, HEADER.spots[0].position]")))
        for has_start, expected in ((False, (math.atan2(right, ahead), 0)), (True, (-2, 0.1))):
            page.run(f"Object.assign(HEADER.spots[1], {{ ahead: [-2, 0.1], hasStart: {str(has_start).lower()} }})")
            for way in ("goTo(2, { jump: true })", "goTo(2)", ""):
                page.run("pansplat.setPose({ position: HEADER.spots[0].position, yaw: 20, pitch: 5 })")
                page.settle()
                page.run(f"pansplat.{way}, 0") if way else page.page.keyboard.press("2")
                page.settle()
                assert page.camera["position"] == page.run("HEADER.spots[1].position")
                assert (page.camera["yaw"], page.camera["pitch"]) == pytest.approx(expected, abs=1e-3), way
        assert page.messages == []


def test_a_flight_looks_ahead_between_the_photographs_of_its_ends(chromium: Any, folder: Path) -> None:
    count = """drawn = 0; (({ drawElementsInstanced }) => {
        WebGL2RenderingContext.prototype.drawElementsInstanced = function (...values) {
            drawn += 1;
            drawElementsInstanced.apply(this, values);
        };
    })(WebGL2RenderingContext.prototype);"""
    with opened(chromium, folder / "poor" / "index.html", script=count, is_stepped=True) as page:
        start, end = (np.array(page.run(f"HEADER.spots[{node}].position")) for node in (1, 2))
        right, _, ahead = in_level(page, end - start)
        page.run("pansplat.goTo(3, { jump: true }), 0")  # so that its photograph is there
        page.settle()
        page.run(
            "pansplat.setPose({ position: HEADER.spots[1].position, yaw: 90 - 180 * Math.sign(pansplat.camera.yaw) })"
        )
        page.settle()
        frames = []
        page.run("pansplat.goTo(3), 0")
        while not frames or frames[-1][0] < 1:
            page.run("drawn = 0, step(20), 0")
            camera = page.camera
            part = np.linalg.norm(camera["position"] - start) / np.linalg.norm(end - start)
            frames.append((part, page.run("drawn") > 0, camera["yaw"]))
        parts = np.array([part for part, *_ in frames])
        shown = {bool(is_drawn) for part, is_drawn, _ in frames if part < 0.1 or part > 0.9}
        assert shown == {False} and all(is_drawn for part, is_drawn, _ in frames if 0.2 < part < 0.8)
        assert 15 <= (parts == 0).sum() <= 23 and 45 <= (parts > 0).sum() <= 53, "a turn of 0.4 s, and a flight of one"
        flown = [yaw for part, _, yaw in frames if part > 0]
        assert np.cos(flown) == pytest.approx(math.cos(math.atan2(right, ahead))) and np.ptp(flown) < 1e-9


def test_a_room_without_a_flight_shows_its_photograph_only(chromium: Any, folder: Path) -> None:
    with opened(chromium, folder / "rooms.html", is_stepped=True) as page:
        page.settle()
        page.run("pansplat.goTo(3), 0")
        page.wait("pansplat.isSettled() && pansplat.camera.position.every((x, i) => x === HEADER.spots[2].position[i])")
        assert page.draw().min() > 0.1, "a photograph, and nothing black"
        page.run("pansplat.camera.position[0] += 0.3")  # as a headset leaves it
        page.settle()
        assert page.draw().min() > 0.1
        page.run("pansplat.goTo(1), 0")
        page.settle()
        assert page.camera["position"] == page.run("HEADER.spots[0].position") and page.messages == []


def test_what_is_outside_of_the_picture_is_an_arrow_that_leads_there(chromium: Any, folder: Path) -> None:
    with opened(chromium, folder / "tour.html", size=(640, 480), is_stepped=True) as page:
        page.run("HEADER.spots.forEach((spot) => { spot.hidden = []; })")
        place, mark = page.run("[HEADER.spots[0].position, HEADER.spots[1].mark]")
        right, _, ahead = in_level(page, np.subtract(mark, place))
        yaw, found = math.degrees(math.atan2(right, ahead)), []
        for turn, pitch in ((90, 0), (-90, 0), (0, 60), (0, -40)):
            page.look(yaw=yaw + turn, pitch=pitch, fov=75)
            button = page.page.locator("#spots button[title='Go to room 1']")
            box = button.bounding_box()
            assert 0 <= box["x"] <= 640 - box["width"] and 0 <= box["y"] <= 480 - box["height"]
            found.append(button.get_attribute("class"))
        assert found == ["arrow left", "arrow right", "arrow down", ""]
        page.look(yaw=yaw + 90, pitch=0)
        button.click()
        page.settle()
        assert page.camera["position"] == page.run("HEADER.spots[1].position")


def test_no_ring_is_under_the_buttons(chromium: Any, folder: Path) -> None:
    """The second panorama comes nearer to the right edge, along the bottom row of the picture."""
    shown = """() => {
        const boxes = (of) => [...document.querySelectorAll(of)].map((each) => each.getBoundingClientRect());
        const [bar] = boxes("#buttons"), rings = boxes("#spots button:not([hidden])");
        const room = document.querySelector("#spots button[title='Go to room 1']:not([hidden])");
        const isBeside = (ring) => ring.right < bar.left || ring.left > bar.right;
        const isUnder = (ring) => ring.bottom >= bar.top && ring.top <= bar.bottom && !isBeside(ring);
        return [rings.some(isUnder), room.className];
    }"""
    with opened(chromium, folder / "tour.html", size=(640, 240)) as page:
        page.run("HEADER.spots.forEach((spot) => { spot.hidden = []; })")
        position, mark = page.run("[HEADER.spots[0].position, HEADER.spots[1].mark]")
        right, down, forward = in_level(page, np.subtract(mark, position))
        yaw = math.degrees(math.atan2(right, forward))
        pitch = -math.degrees(math.atan2(down, math.hypot(right, forward))) + 28  # it is near the lower edge
        found = []
        for turn in (30, -45):
            page.look(yaw=yaw + turn, pitch=pitch, fov=75)
            is_under, kind = page.run(shown)
            assert not is_under, turn
            found.append(kind)
        assert found == ["", "arrow down"]


def test_a_note_of_the_tour_is_a_marker_at_its_panorama_that_opens_plain_text(chromium, folder, scene) -> None:
    with opened(chromium, folder / "photos.html") as page:
        marker = page.page.locator("#spots button.note:not([hidden])")
        assert marker.count() == 0
        direction = np.array((math.sin(0.3) * math.cos(0.1), math.sin(0.1), math.cos(0.3) * math.cos(0.1)))
        local = np.array(page.run("HEADER.level")).T @ scene.cam2world[1, :3, :3].numpy() @ direction
        yaw, pitch = math.degrees(math.atan2(local[0], local[2])), -math.degrees(math.asin(local[1]))
        at = """([yaw, pitch, away]) => {
            const [x, y, z] = HEADER.spots[1].position;
            pansplat.setPose({ position: [x + away, y, z], yaw, pitch, fov: 60 });
        }"""
        page.run(at, [yaw, pitch, 0])
        page.settle()
        (box,) = (each.bounding_box() for each in marker.element_handles())
        assert (box["x"] + 22, box["y"] + 22) == pytest.approx((SIZE[0] / 2, SIZE[1] / 2), abs=1)
        assert min(box["width"], box["height"]) >= 44
        marker.click()
        assert page.page.inner_text("#notice-text") == "<b>Oak</b>\nfloor"
        links = page.run(
            "Array.from(document.querySelectorAll('#notice-links a'), (a) => [a.textContent, a.href, a.rel, a.target])"
        )
        assert [link[0] for link in links] == ["https://example.org/a?b=<c>&d", "http://example.org"]
        assert [link[2:] for link in links] == [["noopener noreferrer", "_blank"]] * 2
        page.page.click("#notice button")
        page.run(at, [yaw + 150, 0, 0])
        page.settle()
        assert marker.count() == 0, "behind the camera"
        page.run(at, [yaw, pitch, 0.6])
        page.settle()
        assert marker.count() == 0, "away from the panorama"
        assert page.messages == []


def look_at_photograph(photograph: PanoramaSet, level: np.ndarray, camera: dict[str, Any]) -> np.ndarray:
    """The picture of a photograph for a camera of the page at its panorama; the mean of 3x3 samples of a pixel."""
    (panorama,) = photograph.context
    image, _ = read_panorama(panorama.image, 1024)
    width, height = (3 * side for side in SIZE)
    tangent = math.tan(math.radians(camera["fov"]) / 2)
    y, x = ((2 * (np.arange(side) + 0.5) - side) / height * tangent for side in (height, width))
    rays = np.stack((*np.meshgrid(x, y), np.ones((height, width))), axis=-1)
    turned = aim(level, camera)
    rays = torch.from_numpy(rays @ (panorama.cam2world[:3, :3].numpy().T @ turned).T)
    seen = sample_equirect(image, uv_from_directions(rays).float()).permute(1, 2, 0).double().numpy()
    return seen.reshape(SIZE[1], 3, SIZE[0], 3, 3).mean(axis=(1, 3))


@pytest.mark.parametrize("name", ["photos.html", "photos/index.html"])
def test_at_a_panorama_the_page_shows_its_photograph_and_gaussians_elsewhere(
    chromium: Any, folder: Path, scene: Scene, photographs: list[PanoramaSet], name: str
) -> None:
    origin = scene.cam2world[:, :3, 3].mean(0).numpy()
    with opened(chromium, folder / name) as page:
        level = np.array(page.run("HEADER.level"))
        for node, yaw, pitch, fov in ((0, 0, 0, 75), (0, 130, -60, 75), (1, 45, 40, 110), (2, -100, 10, 25)):
            spot = page.run("(node) => HEADER.spots[node].position", node)
            for offset, is_photograph in ((0.0, True), (0.02, True), (0.1, False)):
                pose = {"position": [spot[0] + offset, *spot[1:]], "yaw": yaw, "pitch": pitch, "fov": fov}
                page.run("(pose) => pansplat.setPose(pose)", pose)
                image, camera = page.draw(), page.camera
                seen = look_at_photograph(photographs[node], level, camera)
                if is_photograph:
                    assert psnr(image, seen) > (34 if offset else 38), "surfaces are 2.5 m away"
                    assert psnr(image[:, ::-1], seen) < 30 and psnr(image[::-1], seen) < 30
                else:
                    assert psnr(image, draw_reference(scene, level, origin, camera)) > 40
            page.settle()
        assert page.messages == []


def test_a_photograph_fades_without_a_jump(chromium: Any, folder: Path) -> None:
    look = """(milliseconds) => {
        const copy = Object.assign(document.createElement("canvas"), { width: 16, height: 12 }).getContext("2d");
        step(milliseconds);
        copy.drawImage(document.getElementById("view"), 0, 0, 16, 12);
        return [...copy.getImageData(0, 0, 16, 12).data];
    }"""
    with opened(chromium, folder / "photos.html", is_stepped=True) as page:
        for offset in (0.05, -0.05):
            page.settle()
            page.run("(offset) => { pansplat.camera.position[0] += offset; pansplat.setPose({}); }", offset)
            seen = np.array([page.run(look, FRAME_MS) for _ in range(16)], float).reshape(16, 192, 4)
            seen = seen[..., :3].reshape(16, 576)
            seen = seen[seen.max(axis=1) > 0]  # a canvas that is not drawn in a frame is black
            along = seen[-1] - seen[0]
            assert np.abs(along).mean() > 10
            parts = (seen - seen[0]) @ along / (along @ along)
            assert (np.diff(parts) > -0.05).all() and ((parts > 0.1) & (parts < 0.9)).sum() >= 3, "0.2 s"


@pytest.mark.parametrize("status", [200, 404])
@pytest.mark.parametrize("num_failures", [2, 3])
def test_a_tile_that_does_not_arrive_is_read_three_times_and_then_named(chromium, folder, sites, status, num_failures):
    """A web server may answer with a page of its own in place of a file that is missing."""
    with opened(chromium, f"{sites.pages}/photos/index.html", is_stepped=True) as page:
        page.settle()
        tile, answered = f"{page.run('HEADER.photographs[2].name')}_0.jpg", []

        def answer(route: Any) -> None:
            answered.append(route)
            if len(answered) <= num_failures:
                route.fulfill(status=status, content_type="text/html", body="<!doctype html><p>Not found</p>")
            else:
                route.continue_()

        page.page.route(f"**/{tile}", answer)
        page.run("pansplat.goTo(3, { jump: true }), 0")
        warned = [f"{tile} is missing, or is no tile" in message for message in page.messages]
        for count in range(1, num_failures + 1):
            while sum(warned) < count:
                page.run("step(0)")
                warned = [f"{tile} is missing, or is no tile" in message for message in page.messages]
            page.run("step(1990)")
            assert len(answered) == count, "a pause of two seconds"
            page.run("step(20)")
        page.settle()
        assert len(answered) == 3
        named = "A part of the photograph of room 2 cannot be loaded" if num_failures == 3 else ""
        assert page.page.inner_text("#status") == named


@pytest.mark.parametrize("case", ["missing", "late", "left"])
def test_a_fade_along_a_poor_edge_ends_where_the_photograph_does_not_arrive(chromium, folder, case: str) -> None:
    """A tile of the preview is missing or late, or the camera leaves before it is there."""
    shutil.copytree(folder / "poor", folder / case)
    with opened(chromium, folder / case / "index.html", is_stepped=True) as page:
        page.settle()
        if case == "missing":
            (folder / case / "index_files" / f"{page.run('HEADER.photographs[1].name')}_0.jpg").unlink()
        else:
            page.run("createImageBitmap = () => new Promise(() => {}), 0")
        start, opacity = page.camera["position"], "Number(document.getElementById('still').style.opacity)"
        page.run("pansplat.goTo(2), 0")
        page.wait(f"!pansplat.camera.position.every((x, i) => x === {start}[i])", 5)
        if case == "late":
            page.run("step(1990)")
            for _ in range(20):  # the Gaussians may arrive late, too
                page.wait("true", 0)
            assert page.run(opacity) == 1
            page.run("step(20)")
        if case == "left":
            page.page.keyboard.down("KeyW")
            page.run("step(90)")
            page.page.keyboard.up("KeyW")
        page.wait(f"{opacity} < 1", 0.001)
        page.run("step(700)")
        assert page.page.is_hidden("#still")
        before = page.camera["position"]
        page.page.keyboard.down("KeyS")
        page.run("step(90)")
        page.page.keyboard.up("KeyS")
        assert page.camera["position"] != before, "keys work"


LOSE_AND_RESTORE = """async () => {
    const view = document.getElementById("view");
    const lost = view.getContext("webgl2").getExtension("WEBGL_lose_context");
    const event = (name) => new Promise((resolve) => view.addEventListener(name, resolve, { once: true }));
    const isLost = event("webglcontextlost"), isRestored = event("webglcontextrestored");
    lost.loseContext();
    await isLost;
    await new Promise((resolve) => setTimeout(resolve));  // after all listeners: then it can be restored
    lost.restoreContext();
    await isRestored;
}"""


def test_a_folder_loads_the_tiles_that_are_needed_and_shows_them_again_after_lost_graphics(chromium, folder) -> None:
    with opened(chromium, folder / "photos" / "index.html") as page:
        page.settle()
        names = page.run("HEADER.photographs.map(({ name }) => name)")

        def list_loaded() -> list[int]:
            return [node for node, name in enumerate(names) if any(f"/{name}_" in url for url in page.requests)]

        (first,) = list_loaded()
        image = page.draw()
        page.run("pose = pansplat.getPose(), 0")
        page.jump(3)
        assert list_loaded() == sorted({first, 2})
        page.run("(node) => pansplat.goTo(node, { jump: true })", first + 1)
        page.settle()
        page.run(LOSE_AND_RESTORE)
        page.settle()
        page.run("pansplat.setPose(pose)")
        page.settle()
        assert psnr(page.draw(), image) > 30


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


COUNT_TEXTURES = """
    const gl = WebGL2RenderingContext.prototype, { texStorage2D } = gl;
    window.textures = [];
    gl.texStorage2D = function (...values) {
        window.textures.push(values.slice(2));
        texStorage2D.apply(this, values);
    };
"""


def test_a_gaussian_takes_28_bytes_of_textures_that_every_device_has(chromium: Any, folder: Path) -> None:
    with opened(chromium, folder / "tour.html", script=COUNT_TEXTURES) as page:
        formats = ("RGBA32UI", "R32UI", "RGBA8", "R32UI")
        codes = [page.run(f"WebGL2RenderingContext.{name}") for name in formats]
        rows = math.ceil(page.run("HEADER.count") / 2048)
        assert page.run("textures.slice(0, 4)") == [[code, 2048, rows] for code in codes]
        assert rows * 2048 * (16 + 4 + 4 + 4) == 2048 * 2 * 28
        # A pixel takes 20: colours of the layer and of the sum, and two numbers.
        targets = [page.run(f"WebGL2RenderingContext.{name}") for name in ("RGBA16F", "RGBA16F", "RG16F")]
        page.wait("textures.length >= 7")
        assert [code for code, *_ in page.run("textures.slice(4, 7)")] == targets


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


@pytest.mark.parametrize("name", ["photos.html", "photos/index.html"])
def test_the_photograph_is_shown_before_any_gaussians_arrive(chromium, folder, photographs, name: str) -> None:
    with opened(chromium, folder / name, script=WITHOUT_GAUSSIANS, is_stepped=True) as page:  # and is ready
        node, start, level = page.run("HEADER.loading[0]"), page.camera["position"], np.array(page.run("HEADER.level"))
        page.run("pansplat.setPose({ yaw: 30, pitch: 10 })")
        page.wait("document.getElementById('cover').hidden")
        seen, end = look_at_photograph(photographs[node], level, page.camera), time.monotonic() + LIMIT
        middle, shown = np.s_[60:110, 60:260], np.zeros_like(seen)  # without buttons and arrows
        while psnr(shown[middle], seen[middle]) <= 25:  # until the larger tiles have arrived
            assert time.monotonic() < end
            page.wait("true")
            shown = np.asarray(Image.open(io.BytesIO(page.page.screenshot())).convert("RGB"), np.float64) / 255
        assert psnr(shown[middle][:, ::-1], seen[middle]) < 22
        page.page.keyboard.press("KeyO")
        page.page.keyboard.down("KeyW")
        page.page.keyboard.press("2")
        for _ in range(10):
            page.run(f"step({FRAME_MS})")
        page.page.keyboard.up("KeyW")
        assert page.camera["position"] == start, "nothing leaves the photograph yet"
        page.run("pansplat.goTo(1, { jump: true }), release()")
        page.settle()
        assert psnr(page.draw(), look_at_photograph(photographs[0], level, page.camera)) > 38
        assert page.messages == []


def test_a_folder_loads_the_gaussians_of_the_edges_at_the_camera(chromium: Any, folder: Path) -> None:
    with opened(chromium, folder / "hosted.html") as page:
        page.settle()
        files = page.run("HEADER.views.map(({ files }) => files[0])")

        def list_loaded() -> list[int]:
            return [view for view, file in enumerate(files) if any(url.endswith(f"/{file}") for url in page.requests)]

        assert list_loaded() == [0, 1] and page.run("document.getElementById('view').ariaBusy") == "false"
        image = page.draw()
        page.run("pansplat.goTo(2)")
        page.settle()
        assert list_loaded() == [0, 1, 2] and page.messages == []
        page.run("pansplat.goTo(1).then(() => pansplat.setPose({ yaw: 0, pitch: 0 }))")
        page.settle()
        page.page.keyboard.press("KeyR")
        page.settle()
        assert psnr(page.draw(), image) > 40


def read_failure(chromium: Any, path: Path | str) -> str:
    """The message over the poster of a page that fails."""
    context = new_context(chromium)
    page = context.new_page()
    page.goto(path if isinstance(path, str) else find_address(path))
    page.wait_for_selector("#cover.failed")
    message = page.inner_text("#message")
    context.close()
    return message


FAST = """(({ setTimeout }) => {  // silence and pauses between tries are short
    const shorten = (ms) => ms > 1000 && ms <= 10000 && ms !== 5000 ? ms / 10 : ms;
    window.setTimeout = (act, ms, ...values) => setTimeout(act, shorten(ms), ...values);
})(window);"""
FAULTS = ("drop", "silence", "half", "html")


def list_files(path: Path) -> tuple[list[str], list[str]]:
    """The .bin of each view and the first tile of each photograph of a page."""
    (header,) = re.findall(r"^const HEADER = (.*);$", path.read_text(), flags=re.MULTILINE)
    header = json.loads(header)
    files = [view["files"][0] for view in header["views"]]
    return files, [f"{photograph['name']}_0.jpg" for photograph in header["photographs"]]


@pytest.mark.parametrize("fault", FAULTS)
def test_a_file_that_does_not_arrive_is_read_again(chromium: Any, folder: Path, faulty: str, fault: str) -> None:
    files, tiles = list_files(folder / "poor" / "index.html")
    FaultyHandler.faults |= {name: [fault, fault] for name in (files[0], files[2], tiles[0], tiles[2])}
    with opened(chromium, f"{faulty}/poor/index.html", script=FAST) as page:
        page.settle()
        page.run("pansplat.goTo(3, { jump: true }), 0")
        page.wait("document.getElementById('name').innerText === 'room 2' && pansplat.isSettled()")
        assert not any(FaultyHandler.faults.values()) and page.page.inner_text("#status") == ""
        page.look(position=[x + 0.1 for x in page.run("HEADER.spots[2].position")])
        assert page.draw().std() > 0.05 and page.page.is_hidden("#cover")


@pytest.mark.parametrize("fault", FAULTS)
def test_a_part_that_does_not_arrive_ends_no_page_and_is_shown_when_it_does(chromium, folder, faulty, fault) -> None:
    files, _ = list_files(folder / "hosted.html")
    FaultyHandler.faults[files[2]] = [fault] * 4
    with opened(chromium, f"{faulty}/hosted.html", script=FAST) as page:
        page.run("groups = HEADER.groups[1], HEADER.groups[1] = [2], 0")  # nothing else is seen there
        page.run("pansplat.goTo(3, { jump: true }), 0")
        page.wait(
            "document.getElementById('status').innerText === 'A part of the scene at room 2 cannot be loaded yet'"
        )
        page.wait("document.getElementById('still').hidden")
        assert page.page.is_hidden("#cover") and page.draw().std() < 0.01
        page.wait(f"performance.getEntriesByName(new URL('hosted_files/{files[2]}', location)).length > 4")
        page.settle()
        assert page.draw().std() > 0.05


@pytest.mark.parametrize("fault", FAULTS)
def test_a_tile_that_does_not_arrive_does_not_delay_the_gaussians(chromium, folder, faulty, fault: str) -> None:
    _, tiles = list_files(folder / "photos" / "index.html")
    FaultyHandler.faults |= {tile: [fault] * 9 for tile in tiles}
    endless = STAY.replace("5000", "10000")  # silence
    with opened(chromium, f"{faulty}/photos/index.html", script=endless) as page:
        page.wait("document.getElementById('view').ariaBusy === 'false'")
        page.look(position=[x + 0.1 for x in page.run("HEADER.spots[2].position")])
        assert page.draw().std() > 0.05


def test_a_fade_ends_though_the_camera_walks_away_before_the_gaussians_arrive(chromium: Any, folder: Path) -> None:
    late = HOLD + "isHolding = ({ chunk, view }) => chunk && view === 2;"
    with opened(chromium, folder / "house.html", script=late, is_stepped=True) as page:
        page.run("pansplat.goTo(3, { jump: true }), HEADER.groups[1] = [2], 0")
        page.page.keyboard.down("KeyS")
        away = "Math.hypot(...pansplat.camera.position.map((x, i) => x - HEADER.spots[2].position[i]))"
        page.wait(f"{away} > 1.1 * HEADER.speed")
        page.page.keyboard.up("KeyS")
        assert page.page.is_visible("#still")
        page.run("release()")
        page.settle()
        assert page.page.is_hidden("#still")


def test_missing_parts_are_named(chromium: Any, folder: Path) -> None:
    (folder / "alone").mkdir()
    shutil.copy(folder / "split.html", folder / "alone")
    assert "copy the whole folder" in read_failure(chromium, folder / "alone" / "split.html")


def test_a_folder_that_is_opened_from_disk_says_what_to_do(chromium: Any, folder: Path) -> None:
    message = read_failure(chromium, (folder / "split.html").as_uri())
    assert "only from a web server" in message and "--serve" in message and ".html" in message


def test_data_that_cannot_be_read_is_reported(chromium: Any, folder: Path, tmp_path: Path) -> None:
    text = (folder / "tour.html").read_text()
    (tmp_path / "bad.html").write_text(text.replace(">H4s", ">AAA", 1))
    assert "cannot be read" in read_failure(chromium, tmp_path / "bad.html")


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
        # Titles are text. The keyboard opens the list and chooses from it.
        shown = "Array.from(document.querySelectorAll('#spots button:not([hidden])'), (button) => button.title)"
        page.run("pansplat.camera.yaw = 1.5; pansplat.camera.pitch = -0.6; dispatchEvent(new Event('resize'))")
        page.wait(f"{shown}.includes('Go to </script><b>hall <i>down')")
        keyboard.press("l")
        listed = page.page.inner_text("#panoramas").split("\n")
        assert [line for line in listed if line] == ["1. room 0", "2. room 1", "3. </script><b>hall", "4. attic"]
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
        assert old["position"] == start["position"] and (old["yaw"], old["pitch"]) == pytest.approx((to["yaw"], -0.2))
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
        page.settle()
        assert page.camera["position"] == page.run("HEADER.spots[3].position")
        assert (page.camera["yaw"], page.camera["pitch"]) == pytest.approx((3.1, 0.2), abs=1e-5)
        assert page.run(shown) == ["Go to </script><b>hall"], "nothing leads on: an arrow to the nearest one"
        page.page.click("#home")
        assert page.camera == start
        assert page.messages == []


def test_along_a_poor_edge_the_image_grows_and_fades_fast_into_that_of_the_panorama(chromium, folder) -> None:
    with opened(chromium, folder / "house.html", script=FRAMES) as page:
        page.settle()
        spots = page.run("HEADER.spots.map(({ position }) => position)")
        page.run("HEADER.poor.push([0, 1]); passed = []")
        way = np.array(page.run("HEADER.level")).T @ (np.array(spots[1]) - spots[0])
        page.run("(yaw) => pansplat.setPose({ yaw, pitch: 0 })", math.degrees(math.atan2(way[0], way[2])))
        page.run("""scales = []; record(); (function follow() {
            const { transform } = document.getElementById("still").style;
            scales.push(transform ? Number(transform.slice(6, -1)) : 1);
            requestAnimationFrame(follow);
        })()""")
        assert page.run("pansplat.goTo(2)")
        page.settle()
        frames, scales = page.run("passed"), page.run("scales")
        places = {tuple(np.round(frame["position"], 6) + 0.0) for frame in frames}
        assert places == {tuple(np.round(spot, 6) + 0.0) for spot in spots[:2]}, "no picture from between"
        left = [frame["left"] for frame in frames if 0 < frame["left"] < 1]
        assert 5 <= len(left) <= 8 and left == sorted(left, reverse=True), "0.7 s, at 100 ms a frame"
        assert 1.5 < max(scales) <= 1.65 and frames[-1]["yaw"] == pytest.approx(frames[0]["yaw"])
        assert page.run("pansplat.goTo(3)")
        between = page.run("(first) => passed.slice(first).map(({ position }) => position)", len(frames))
        assert len({tuple(place) for place in between}) > 5, "a good edge is flown"
        page.run("passed = []")
        assert page.run("pansplat.goTo(1)")
        assert len({tuple(place) for place in page.run("passed.map(({ position }) => position)")}) > 5, (
            "also before a zoom"
        )
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


def test_a_fade_to_a_photograph_does_not_wait_for_the_order_of_the_gaussians(chromium: Any, folder: Path) -> None:
    with opened(chromium, folder / "poor" / "index.html", script=HOLD, is_stepped=True) as page:
        page.settle()
        page.run("isHolding = ({ position }) => position, pansplat.goTo(2), 0")
        page.wait("Number(document.getElementById('still').style.opacity) < 0.5", 10)
        page.run("release()")
        page.settle()
        assert page.page.is_hidden("#still")


@pytest.mark.slow
def test_the_image_of_another_room_stays_until_the_start_is_sorted(chromium: Any, folder: Path) -> None:
    with opened(chromium, folder / "house.html", script=HOLD + FRAMES) as page:
        page.run("HEADER.speed = 0.3; pansplat.goTo(3, { jump: true })")
        hidden = "document.getElementById('still').hidden"
        page.settle()
        assert page.camera["position"] == page.run("HEADER.spots[2].position")
        seen = page.draw()
        page.run("isHolding = ({ position }) => position; 0")
        page.page.keyboard.press("KeyR")
        page.wait("held.length")
        page.run("passed = []; record()")
        page.wait("passed.length > 30")  # it would fade in 20 frames
        assert page.run("document.getElementById('still').style.opacity") == "1" and not page.run(hidden)
        assert psnr(decode(page.run("document.getElementById('still').toDataURL()")), seen) > 30
        page.run("release()")
        page.wait(hidden)
        page.page.keyboard.press("KeyR")
        assert page.run(hidden), "at the start there is nothing to hide"


# ---- as people use pages ----


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
@pytest.mark.parametrize("size", [(195, 422), (420, 240), (300, 270)])
def test_the_poster_is_in_place_of_the_picture(chromium, scene, tmp_path, monkeypatch, size: tuple[int, int]) -> None:
    monkeypatch.setattr(page_module, "_POSTER_SIZE", (486, 576))
    write_page(scene, tmp_path / "page.html")
    with opened(chromium, tmp_path / "page.html", size=size) as page:
        page.page.add_style_tag(content="#buttons, #message, #bar, #spots, #status { display: none !important }")
        page.wait("document.getElementById('cover').hidden")
        picture = decode(page.run("([width, height]) => pansplat.render(width, height)", list(size)))
        page.run("cover = document.getElementById('cover'); cover.style.transition = 'none'; cover.className = ''")
        page.run("cover.hidden = false")
        with io.BytesIO(page.page.screenshot()) as file:
            poster = np.asarray(Image.open(file).convert("RGB"), np.float64) / 255
        assert poster.shape == picture.shape
        quality = psnr(poster, picture)
        assert quality > 27 and all(psnr(np.roll(poster, 3, axis), picture) < quality - 3 for axis in (0, 1))


HOST = """<!doctype html><style>
body { height: 4000px; margin: 100px 50px }
iframe { border: 0; width: 320px; height: 240px }
</style>
<iframe></iframe>
<script>
const frame = document.querySelector("iframe");
frame.src = location.hash.slice(1);
</script>"""


@pytest.mark.slow
def test_no_other_page_shows_a_served_page_in_a_frame(chromium: Any, sites: Sites, folder: Path) -> None:
    with PageServer(PageFiles((folder / "house.html",), 0, 0)) as server:
        Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        page = new_context(chromium, ignore_https_errors=True).new_page()
        with page.expect_event("requestfailed", lambda request: request.url == server.url) as failed:
            page.goto(f"{sites.host}/host.html#{server.url}")
        assert failed.value.failure == "net::ERR_BLOCKED_BY_RESPONSE"
        page.context.close()
        server.shutdown()


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
    with opened(chromium, folder / "tour.html", size=(390, 844), script=SLOW, **options) as page:
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
    with opened(chromium, folder / "house.html", script=FRAMES, reduced_motion="reduce") as page:
        spots = page.run("HEADER.spots.map((spot) => spot.position)")
        page.run("passed = []; record()")
        page.page.keyboard.press("3")
        page.wait(f"pansplat.camera.position.every((x, i) => x === {spots[2]}[i])")
        page.wait("passed.length > 30 && document.getElementById('still').hidden")
        page.page.keyboard.press("Space")
        for node in (0, 1):
            page.wait(f"pansplat.camera.position.every((x, i) => x === {spots[node]}[i])")
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


# An emulated headset: images of 200x200 pixels with a focal length of 100 pixels, off the optical axis. A frame takes
# `step` milliseconds on every machine.
HEADSET = """
    device = new IWER.XRDevice(IWER.metaQuest3, { stereoEnabled: true, ipd: 0.064 });
    device.installRuntime({ forceInstall: true });
    Object.defineProperty(XRView.prototype, "projectionMatrix", { get() {
        const [left, right] = this.eye === "left" ? [-1.2, 0.8] : [-0.8, 1.2], [top, bottom] = [0.9, -1.1];
        const x = (right + left) / (right - left), y = (top + bottom) / (top - bottom);
        const [width, height] = [right - left, top - bottom];
        return new Float32Array([2 / width, 0, 0, 0, 0, 2 / height, 0, 0, x, y, -1, -1, 0, 0, -0.2, 0]);
    } });
    setHead = (position, yaw, pitch) => {
        const [cy, sy, cp, sp] = [yaw, pitch].flatMap((angle) => [Math.cos(angle / 2), Math.sin(angle / 2)]);
        device.position.set(...position);
        device.quaternion.set(cy * sp, sy * cp, -sy * sp, cy * cp);
    };
    const request = requestAnimationFrame;
    let time = performance.now();
    step = 10;
    performance.now = () => time;
    requestAnimationFrame = (onFrame) => request(() => onFrame(time));
    frames = 0;
    const requestXR = XRSession.prototype.requestAnimationFrame;
    XRSession.prototype.requestAnimationFrame = function (onFrame) {
        return requestXR.call(this, (now, frame) => {
            time += step;
            frames += 1;
            onFrame(time, frame);
            if (window.take) take(document.getElementById("view").toDataURL("image/png"));
        });
    };
    takePicture = () => new Promise((resolve) => { take = (url) => { take = null; resolve(url); }; });
    // Frames without a picture are not drawn, which a software rasteriser does ten times in a second.
    for (const name of ["drawArrays", "drawElementsInstanced"]) {
        const draw = WebGL2RenderingContext.prototype[name];
        WebGL2RenderingContext.prototype[name] = function (...values) {
            if (window.take || !device.activeSession) draw.apply(this, values);
        };
    }
    walked = () => new Promise((resolve) => {  // five frames later
        const end = frames + 5, check = () => frames >= end ? resolve() : request(check);
        check();
    });
"""


@pytest.fixture(scope="module")
def iwer() -> str:
    """The emulator of headsets; without it the tests are skipped: the registry of npm may be out of reach."""
    path = Path(sys.prefix) / "iwer" / "iwer.min.js"
    if not path.is_file():
        pytest.skip(f"needs {path} (npm package iwer; `bash setup.sh --dev` fetches it)")
    return path.read_text()


@contextmanager
def in_headset(
    chromium: Any, path: Path, iwer: str, script: str = "", head: tuple[float, float, float] = (0.1, 1.6, -0.2)
) -> Iterator[OpenPage]:
    """The page after "Enter VR", with the head turned 0.2 to the left; controllers are off."""
    with opened(chromium, path, size=(400, 200), script=f"{iwer};{HEADSET};{script}") as page:
        page.run("(head) => setHead(head, 0.2, 0)", head)
        page.run("Object.values(device.controllers).forEach((each) => { each.connected = false; })")
        page.run("pansplat.render(40, 20).then(() => 0)")  # with a photograph, the page is ready before the Gaussians
        page.page.click("#vr")
        page.wait("frames > 2")
        yield page
        of_iwer = ("Nominal frame rate", "onDeviceFrame")  # the second one when the graphics are lost
        assert [text for text in page.messages if not any(part in text for part in of_iwer)] == []


def see(page: OpenPage, position: tuple[float, ...], yaw: float, pitch: float) -> Float[np.ndarray, "200 400 3"]:
    """Both eyes' picture for a pose of the head in the room, after the Gaussians are sorted for it."""
    page.run("(pose) => setHead(...pose)", [position, yaw, pitch])
    page.run("walked()")
    image, last = None, None
    while image is None or last is None or not np.array_equal(image, last):
        page.settle()
        last, image = image, decode(page.run("walked().then(walked).then(walked).then(takePicture)"))
    return image


def in_level(page: OpenPage, vector: Any) -> np.ndarray:
    """A vector of the page's world to the right, down and forward of a level camera."""
    return np.array(page.run("HEADER.level")).T @ np.array(vector)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tour.html", "photos.html"])
def test_both_eyes_see_the_pictures_of_the_rasteriser(chromium, folder, scene, iwer, name: str) -> None:
    origin = scene.cam2world[:, :3, 3].mean(0).numpy()
    with in_headset(chromium, folder / name, iwer) as page:
        level = np.array(page.run("HEADER.level"))
        spot = page.run("HEADER.spots[HEADER.walk[0]]")
        start, mark = {"position": spot["position"], "yaw": spot["ahead"][0]}, page.run("HEADER.spots[0].mark")
        assert page.camera["yaw"] == pytest.approx(start["yaw"]), "the head looks where the page has looked"
        image = see(page, (0.1 + 0.15, 1.7, -0.2 - 0.1), -0.3, 0.6)
        page.page.set_viewport_size({"width": 400, "height": 100})
        page.run("document.getElementById('view').height = 100")
        low = see(page, (0.1 + 0.15, 1.7, -0.2 - 0.1), -0.3, 0.6)
    yaw, heading = start["yaw"] + 0.2 + 0.3, start["yaw"] + 0.2  # a positive yaw of the page turns right
    c, s = math.cos(heading), math.sin(heading)
    moved = level @ np.array(((c, 0, s), (0, 1, 0), (-s, 0, c))) @ np.array((0.15, 0, 0.1))
    center = start["position"] + moved
    center += level[:, 1] * (level[:, 1] @ (mark - center) - 1.7)  # over the floor
    right = level @ (math.cos(yaw), 0, -math.sin(yaw))
    fov = 2 * math.degrees(math.atan(1.1))
    for eye, crop in enumerate((slice(0, 200), slice(40, 240))):
        camera = {"position": center + right * (0.064 * eye - 0.032), "yaw": yaw, "pitch": 0.6, "fov": fov}
        reference = draw_reference(scene, level, origin, camera, (240, 220))[20:, crop]
        left, other = 200 * eye, 200 - 200 * eye
        assert psnr(image[:, left : left + 200], reference) > 42 > 25 > psnr(image[:, other : other + 200], reference)
        # Pixels twice as high as wide.
        halved = 0.5 * (reference[::2] + reference[1::2])
        assert psnr(low[:, left : left + 200], halved) > 35


@pytest.mark.slow
def test_sticks_walk_and_turn_in_steps(chromium: Any, folder: Path, iwer: str) -> None:
    with in_headset(chromium, folder / "tour.html", iwer) as page:
        page.run("device.controllers.left.connected = device.controllers.right.connected = true")
        page.run("walked()")
        start = page.camera
        page.run("device.controllers.left.updateAxes('thumbstick', 0, -1)")
        page.wait(f"Math.hypot(...pansplat.camera.position.map((x, i) => x - {start['position']}[i])) > 0.05")
        page.run("device.controllers.left.updateAxes('thumbstick', 0, 0)")
        page.run("walked()")
        right, down, forward = in_level(page, np.subtract(page.camera["position"], start["position"]))
        assert math.atan2(right, forward) == pytest.approx(start["yaw"]) and math.hypot(right, forward) > 0.05
        assert abs(down) < 1e-6
        stopped = page.camera
        page.run("device.controllers.right.updateAxes('thumbstick', 1, 0)")
        page.run("walked().then(walked)")
        assert page.camera["yaw"] - stopped["yaw"] == pytest.approx(math.pi / 6), "once"
        page.run("device.controllers.right.updateAxes('thumbstick', 0, 0)")
        page.run("walked()")
        page.run("device.controllers.right.updateAxes('thumbstick', -1, 0)")
        page.run("walked()")
        assert page.camera["yaw"] == pytest.approx(stopped["yaw"])
        assert page.camera["position"] == pytest.approx(stopped["position"])
        # The vignette is black at the border while the camera walks, and nowhere at rest.
        page.run("device.controllers.right.updateAxes('thumbstick', 0, 0)")
        page.run("device.controllers.left.updateAxes('thumbstick', 0, 0.5)")
        page.run("walked().then(walked).then(walked).then(walked)")
        moving = decode(page.run("takePicture()"))
        page.run("device.controllers.left.updateAxes('thumbstick', 0, 0)")
        resting = see(page, (0.1, 1.6, -0.2), 0.2, 0)
        assert moving[:10, :10].max() == 0 and moving[80:100, 110:130].mean() > 0.1 and resting[:10, :10].mean() > 0.1
        # A goes back to the start, B leaves.
        page.run("device.controllers.right.updateButtonValue('a-button', 1)")
        page.run("walked()")
        assert in_level(page, np.subtract(page.camera["position"], start["position"])) == pytest.approx(0, abs=1e-6)
        page.run("device.controllers.right.updateButtonValue('b-button', 1)")
        page.wait("!device.activeSession")


POINT = """
    // Points a controller or hand at a panorama from below a head that is turned 0.2 to the left.
    pointAt = (input, node) => {
        const heading = pansplat.camera.yaw + 0.2, { mark } = HEADER.spots[node];
        const [x, y, z] = [0, 1, 2].map((k) => mark.reduce((sum, value, i) => {
            return sum + (value - pansplat.camera.position[i]) * HEADER.level[i][k];
        }, 0));
        const c = Math.cos(heading), s = Math.sin(heading);
        const to = [c * x - s * z, -y + 0.3, -(s * x + c * z)], length = Math.hypot(...to);
        const yaw = Math.atan2(-to[0], -to[2]), pitch = Math.asin(to[1] / length);
        const [cy, sy, cp, sp] = [yaw, pitch].flatMap((angle) => [Math.cos(angle / 2), Math.sin(angle / 2)]);
        input.connected = true;
        input.position.set(device.position.x, device.position.y - 0.3, device.position.z);
        input.quaternion.set(cy * sp, sy * cp, -sy * sp, cy * cp);
    };
"""


def above(page: OpenPage, node: int) -> np.ndarray:
    """How far the camera is to the right and in front of a panorama."""
    return in_level(page, np.subtract(page.camera["position"], page.run(f"HEADER.spots[{node}].position")))[[0, 2]]


@pytest.mark.slow
def test_controllers_and_hands_select_rings(chromium: Any, folder: Path, iwer: str) -> None:
    with in_headset(chromium, folder / "tour.html", iwer, POINT) as page:
        fly = "step = 120; walked().then(walked).then(walked)"
        right = "device.controllers.right"
        page.run(f"{right}.connected = true")  # it points straight ahead, at no ring
        before = page.camera
        page.run(f"{right}.updateButtonValue('trigger', 1), walked()")
        page.run(f"{right}.updateButtonValue('trigger', 0), walked()")
        assert page.camera == before
        page.run(f"pointAt({right}, 1)")
        rings = see(page, (0.1, 1.6, -0.2), 0.2, -0.7)
        assert (rings[:, :200].min(axis=2) > 0.98).sum() > 40, "the ring that is pointed at is white"
        page.run(f"step = 1; {right}.updateButtonValue('trigger', 1)")  # a flight takes 1000 frames
        page.run("walked()")
        page.run(f"{right}.updateButtonValue('trigger', 0)")
        between = above(page, 1)
        assert 0.01 < np.linalg.norm(between) < 1.2, "a flight"
        page.run(fly)
        assert above(page, 1) == pytest.approx(0, abs=1e-5)
        # The head that moves during a flight is not taken along.
        page.run(f"step = 1; pointAt({right}, 0); {right}.updateButtonValue('trigger', 1)")
        page.run("walked()")
        page.run("setHead([0.3, 1.6, -0.2], 0.2, 0)")
        page.run(fly)
        heading = before["yaw"] + 0.2
        assert above(page, 0) == pytest.approx((0.2 * math.cos(heading), -0.2 * math.sin(heading)), abs=1e-5)
        page.run("setHead([0.1, 1.6, -0.2], 0.2, 0)")
        page.run("walked()")
        assert above(page, 0) == pytest.approx(0, abs=1e-5)
        # The squeeze jumps, behind a fade from black.
        page.run(f"step = 1; pointAt({right}, 2); {right}.updateButtonValue('squeeze', 1)")
        page.run("walked()")
        assert above(page, 2) == pytest.approx(0, abs=1e-5)
        assert decode(page.run("takePicture()")).mean() < 0.1
        page.run("step = 50")
        page.settle()
        # A hand pinches.
        page.run("device.primaryInputMode = 'hand'; device.hands.left.connected = false")
        page.run("walked()")
        page.run("pointAt(device.hands.right, 1); device.hands.right.updatePinchValue(1)")
        page.run(fly)
        assert above(page, 1) == pytest.approx(0, abs=1e-5)


@pytest.mark.slow
def test_a_link_to_another_part_fades_from_black(chromium: Any, folder: Path, iwer: str) -> None:
    with in_headset(chromium, folder / "flat.html", iwer, POINT) as page:
        page.run("step = 30; dispatchEvent(new KeyboardEvent('keydown', {code: 'Digit3'}))")  # along the link
        arrive = """async () => {
            const away = () => pansplat.camera.position.map((x, i) => x - HEADER.spots[2].position[i]);
            while (Math.hypot(...away()) >= 3) await new Promise(requestAnimationFrame);
            return takePicture();
        }"""
        assert decode(page.run(arrive)).mean() < 0.1
        page.settle()
        assert decode(page.run("takePicture()")).mean() > 0.1
        assert above(page, 2) == pytest.approx(0, abs=1e-5)
        back = page.run("HEADER.links[1]")
        assert math.cos(page.camera["yaw"] - back["yaw"]) == pytest.approx(-1), "away from the link back"
        assert page.run("document.getElementById('still').hidden")


@pytest.mark.slow
def test_both_eyes_see_the_photograph_where_there_are_no_gaussians(chromium: Any, folder: Path, iwer: str) -> None:
    with in_headset(chromium, folder / "rooms.html", iwer) as page:
        page.run("step = 30; pansplat.goTo(3, { jump: true }).then(() => 0)")
        image = see(page, (0.3, 1.6, -0.2), 0.2, 0)
        left, right = image[:, :200], image[:, 200:]
        assert image[40:160, 40:160].min() > 0.1 and psnr(left[40:160, 60:160], right[40:160, 20:120]) > 35


@pytest.mark.parametrize(("script", "height"), [("", 0.5), ("device.supportedFeatures.splice(2, 1);", 1.6)])
def test_without_a_floor_of_the_same_height_the_head_begins_at_the_camera(chromium, folder, iwer, script, height):
    with in_headset(chromium, folder / "tour.html", iwer, script, (0.1, height, -0.2)) as page:
        start = page.run("HEADER.spots[HEADER.walk[0]]")
        assert page.camera["position"] == pytest.approx(start["position"], abs=1e-6)
        page.run("(height) => setHead([0.1, height + 0.2, -0.2], 0.2, 0)", height)
        page.run("walked()")
        moved = in_level(page, np.subtract(page.camera["position"], start["position"]))
        assert moved == pytest.approx((0, -0.2, 0), abs=1e-6)


@pytest.mark.slow
def test_leaving_and_a_lost_session_return_to_the_page(chromium: Any, folder: Path, iwer: str) -> None:
    with in_headset(chromium, folder / "tour.html", iwer) as page:
        assert page.page.get_attribute("#vr", "aria-pressed") == "true"
        seen = page.camera
        for leave in ("document.getElementById('vr').click()", "device.activeSession.end()"):
            page.run(leave)
            page.wait("!device.activeSession && document.getElementById('vr').ariaPressed === 'false'")
            image = page.draw()
            assert image.std() > 0.05 and page.camera["position"] == pytest.approx(seen["position"])
            page.page.keyboard.press("KeyR")
            assert page.camera["roll"] == 0 and page.camera["yaw"] == page.run("HEADER.spots[HEADER.walk[0]].ahead[0]")
            page.run("frames = 0; document.getElementById('vr').click()")
            page.wait("frames > 2")
        # The headset moves its reference space.
        page.run("device.recenter()")
        page.run("walked()")
        assert page.camera["yaw"] == pytest.approx(seen["yaw"], abs=1e-6)
        # The graphics are lost in the headset.
        page.run(
            "document.getElementById('view').getContext('webgl2').getExtension('WEBGL_lose_context').loseContext()"
        )
        page.wait("!device.activeSession && document.getElementById('notice').open")
        assert "Please enter VR again" in page.page.inner_text("#notice")


def test_a_refused_session_is_explained(chromium: Any, folder: Path, iwer: str) -> None:
    refuse = """
        error = new DOMException("", "NotAllowedError");
        XRSystem.prototype.requestSession = () => Promise.reject(error);
    """
    with opened(chromium, folder / "tour.html", script=f"{iwer};{HEADSET};{refuse}") as page:
        page.page.click("#vr")
        page.page.wait_for_selector("#notice[open]")
        assert "The browser does not allow VR" in page.page.inner_text("#notice")
        page.page.keyboard.press("Escape")
        page.run("error = new Error('no display')")
        page.page.click("#vr")
        page.page.wait_for_selector("#notice[open]")
        assert "VR could not start: no display" in page.page.inner_text("#notice")
        assert page.run("document.getElementById('no-vr').hidden") and page.draw().std() > 0.05


def test_a_page_from_disk_or_http_says_how_to_enter_vr(chromium: Any, folder: Path) -> None:
    without = "Object.defineProperty(navigator, 'xr', { value: undefined });"
    with opened(chromium, folder / "tour.html", script=without) as page:
        assert page.page.is_hidden("#vr")
        page.page.click("#help")
        assert "https" in page.page.inner_text("#no-vr")
    insecure = f"{without} Object.defineProperty(window, 'isSecureContext', {{ value: false }});"
    with opened(chromium, folder / "tour.html", script=insecure) as page:
        page.page.click("#vr")
        page.page.wait_for_selector("#notice[open]")
        assert "https" in page.page.inner_text("#notice")


def test_a_served_page_may_use_webxr(chromium: Any, folder: Path) -> None:
    with PageServer(PageFiles((folder / "tour.html",), 0, 0)) as server:
        Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        page = OpenPage(new_context(chromium, ignore_https_errors=True).new_page())  # the user accepts the certificate
        page.page.goto(server.url)
        assert page.run("pansplat.ready.then(() => isSecureContext && 'xr' in navigator)")
        assert page.draw().std() > 0.05 and page.messages == []
        assert {url for url in page.requests if not url.startswith("blob:")} == {server.url}
        page.page.context.close()
        server.shutdown()


SCALED = """
    XRView.prototype.requestViewportScale = function (value) { scale = value; };
    const getViewport = XRWebGLLayer.prototype.getViewport;
    XRWebGLLayer.prototype.getViewport = function (view) {
        const { x, width, height } = getViewport.call(this, view);
        return { x, y: 0, width: Math.round(scale * width), height: Math.round(scale * height) };
    };
"""


@pytest.mark.slow
@pytest.mark.parametrize(("milliseconds", "scale"), [(1000 / 60, 1), (33, 0.4)])
def test_the_resolution_of_a_headset_that_states_no_rate_follows_its_first_frames(
    chromium: Any, folder: Path, iwer: str, milliseconds: float, scale: float
) -> None:
    unstated = (
        f"Object.defineProperty(XRSession.prototype, 'frameRate', {{ value: undefined }}); step = {milliseconds};"
    )
    with in_headset(chromium, folder / "tour.html", iwer, SCALED + unstated) as page:
        page.wait(f"frames > 240 && scale === {scale}")
        if scale == 1:
            page.run("step = 25")
            page.wait("scale < 1")
            page.run("step = 1000 / 60")
            page.wait("scale === 1")


@pytest.mark.slow
def test_the_resolution_follows_the_time_between_frames(chromium: Any, folder: Path, iwer: str) -> None:
    with in_headset(chromium, folder / "tour.html", iwer, SCALED) as page:
        sharp = see(page, (0.1, 1.6, -0.2), 0.2, 0.6)
        page.run("step = 40")
        page.wait("scale === 0.4")
        image = decode(page.run("step = 10, takePicture()"))
        assert image[:120].max() == image[:, 80:200].max() == 0
        left = Image.fromarray((255 * sharp[:, :200]).astype(np.uint8)).resize((80, 80), Image.Resampling.BOX)
        assert psnr(image[120:, :80], np.asarray(left) / 255) > 30
        page.wait("scale > 0.4")


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
