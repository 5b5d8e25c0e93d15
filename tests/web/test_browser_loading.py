"""The page in Chromium: its photographs, and files that arrive late, damaged or never."""

import io
import json
import math
import re
import shutil
import time
from collections.abc import Iterator
from functools import partial
from http.server import ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from browser_pages import (
    FRAME_MS,
    HOLD,
    LIMIT,
    SIZE,
    STAY,
    WITHOUT_GAUSSIANS,
    QuietHandler,
    aim,
    draw_reference,
    find_address,
    in_level,
    new_context,
    opened,
    psnr,
)
from PIL import Image

from pansplat.geometry.equirect import sample_equirect, uv_from_directions
from pansplat.images.image_files import read_panorama
from pansplat.inputs.panorama_sets import PanoramaSet


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
        page.jump(3)  # so that its photograph is there
        yaw = "90 - 180 * Math.sign(pansplat.camera.yaw)"
        page.run(f"pansplat.setPose({{ position: HEADER.spots[1].position, yaw: {yaw} }})")
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
        page.run("pansplat.camera.position[0] += 0.3")  # metres beside the panorama, as after a headset session
        page.settle()
        assert page.draw().min() > 0.1
        page.run("pansplat.goTo(1), 0")
        page.settle()
        assert page.camera["position"] == page.run("HEADER.spots[0].position") and page.messages == []


def test_a_note_of_the_tour_is_a_marker_at_its_panorama_that_opens_plain_text(chromium, folder, scene) -> None:
    with opened(chromium, folder / "photos.html", is_stepped=True) as page:
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


VIEWS = ((0, 0, 0, 75), (0, 130, -60, 75), (1, 45, 40, 110), (2, -100, 10, 25))  # panorama, yaw, pitch, field of view


@pytest.mark.parametrize(("name", "views"), [("photos.html", VIEWS[:2]), ("photos/index.html", VIEWS[2:])])
def test_photographs_are_shown_at_panoramas_and_gaussians_elsewhere(chromium, folder, scene, photographs, name, views):
    origin = scene.cam2world[:, :3, 3].mean(0).numpy()
    with opened(chromium, folder / name, is_stepped=True) as page:
        level = np.array(page.run("HEADER.level"))
        for node, yaw, pitch, fov in views:
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


@pytest.mark.parametrize(("status", "num_failures"), [(200, 2), (404, 3)])
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


@pytest.mark.parametrize("case", ["missing", "late"])
def test_a_zoom_along_a_poor_edge_ends_where_the_photograph_does_not_arrive(chromium, folder, case: str) -> None:
    """A tile of the preview is missing, or late and the camera leaves."""
    with opened(chromium, folder / "poor" / "index.html", is_stepped=True) as page:
        page.settle()
        if case == "missing":
            page.page.route(f"**/{page.run('HEADER.photographs[1].name')}_0.jpg", lambda route: route.abort())
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
            page.page.keyboard.down("KeyW")
            page.run("step(90)")
            page.page.keyboard.up("KeyW")
        page.wait(f"{opacity} < 1", 1)
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
        pose = page.run("pansplat.getPose()")
        page.jump(3)
        assert list_loaded() == sorted({first, 2})
        page.jump(first + 1)
        page.run(LOSE_AND_RESTORE)
        page.settle()
        page.look(**pose)
        assert psnr(page.draw(), image) > 30


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
    with opened(chromium, folder / "hosted.html", is_stepped=True) as page:
        page.settle()
        files = page.run("HEADER.views.map(({ files }) => files[0])")

        def list_loaded() -> list[int]:
            return [view for view, file in enumerate(files) if any(url.endswith(f"/{file}") for url in page.requests)]

        assert list_loaded() == [0, 1] and page.run("document.getElementById('view').ariaBusy") == "false"
        image = page.draw()
        page.run("pansplat.goTo(2), 0")
        page.settle()
        assert list_loaded() == [0, 1, 2] and page.messages == []
        page.jump(1)
        page.look(yaw=0, pitch=0)
        page.page.keyboard.press("KeyR")
        page.settle()
        assert psnr(page.draw(), image) > 40


def read_failure(chromium: Any, path: Path | str) -> str:
    """The message over the poster of a page that fails."""
    context = new_context(chromium)
    context.add_init_script(FAST)
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


def turn_faults(first: int, count: int) -> list[str]:
    """That many faults of a file in turn, from one of them."""
    return [FAULTS[(first + number) % len(FAULTS)] for number in range(count)]


def test_files_that_do_not_arrive_are_read_again(chromium: Any, folder: Path, faulty: str) -> None:
    files, tiles = list_files(folder / "poor" / "index.html")
    read = (files[0], files[2], tiles[0], tiles[2])
    FaultyHandler.faults |= {name: turn_faults(first, 2) for first, name in enumerate(read)}
    with opened(chromium, f"{faulty}/poor/index.html", script=FAST) as page:
        page.settle()
        page.run("pansplat.goTo(3, { jump: true }), 0")
        page.wait("document.getElementById('name').innerText === 'room 2' && pansplat.isSettled()")
        assert not any(FaultyHandler.faults.values()) and page.page.inner_text("#status") == ""
        page.look(position=[x + 0.1 for x in page.run("HEADER.spots[2].position")])
        assert page.draw().std() > 0.05 and page.page.is_hidden("#cover")


def test_a_part_that_does_not_arrive_ends_no_page_and_is_shown_when_it_does(chromium, folder, faulty) -> None:
    files, _ = list_files(folder / "hosted.html")
    FaultyHandler.faults[files[2]] = turn_faults(0, 4)
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


def test_tiles_that_do_not_arrive_do_not_delay_the_gaussians(chromium: Any, folder: Path, faulty: str) -> None:
    _, tiles = list_files(folder / "photos" / "index.html")
    FaultyHandler.faults |= {tile: [fault] * 9 for tile, fault in zip(tiles, FAULTS[1:], strict=True)}
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


def test_a_fade_to_a_photograph_does_not_wait_for_the_order_of_the_gaussians(chromium: Any, folder: Path) -> None:
    with opened(chromium, folder / "poor" / "index.html", script=HOLD, is_stepped=True) as page:
        page.settle()
        page.run("isHolding = ({ position }) => position, pansplat.goTo(2), 0")
        page.wait("Number(document.getElementById('still').style.opacity) < 0.5", 10)
        page.run("release()")
        page.settle()
        assert page.page.is_hidden("#still")
