"""The page in an emulated headset: pictures of both eyes, controllers, sessions."""

import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
from browser_pages import OpenPage, decode, draw_reference, in_level, new_context, opened, psnr
from jaxtyping import Float
from PIL import Image

from pansplat.export.page import PageFiles
from pansplat.export.page_server import PageServer

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
        # A page with photographs is ready before its Gaussians are read; a picture is drawn after that.
        page.run("pansplat.render(40, 20).then(() => 0)")
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
        # The eye keeps its height over the floor, which rises evenly along edges.
        first, second, third = (np.subtract(spot["mark"], spot["position"]) for spot in page.run("HEADER.spots"))
        steepest = max(abs(in_level(page, a - b)[1]) for a, b in ((first, second), (first, third))) / 0.9  # metres
        assert 0 < abs(down) < steepest * math.hypot(right, forward)
        stopped = page.camera
        page.run("device.controllers.right.updateAxes('thumbstick', 1, 0)")
        page.run("walked().then(walked)")
        assert page.camera["yaw"] - stopped["yaw"] == pytest.approx(math.pi / 6), "once"
        page.run("device.controllers.right.updateAxes('thumbstick', 0, 0)")
        page.run("walked()")
        page.run("device.controllers.right.updateAxes('thumbstick', -1, 0)")
        page.run("walked()")
        assert page.camera["yaw"] == pytest.approx(stopped["yaw"])
        right, down, forward = in_level(page, np.subtract(page.camera["position"], stopped["position"]))
        assert (right, forward) == pytest.approx((0, 0), abs=1e-6) and abs(down) < 0.02  # the floor of another edge
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
        fly = "step = 120; walked().then(walked).then(walked).then(walked)"
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
        XRSystem.prototype.requestSession = () => Promise.reject(new DOMException("", "NotAllowedError"));
    """
    with opened(chromium, folder / "tour.html", script=f"{iwer};{HEADSET};{refuse}") as page:
        page.page.click("#vr")
        page.page.wait_for_selector("#notice[open]")
        assert "The browser does not allow VR" in page.page.inner_text("#notice")
        page.page.keyboard.press("Escape")
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
def test_the_resolution_of_a_headset_that_states_no_rate_follows_its_first_frames(chromium, folder, iwer) -> None:
    unstated = "Object.defineProperty(XRSession.prototype, 'frameRate', { value: undefined }); step = 1000 / 60;"
    with in_headset(chromium, folder / "tour.html", iwer, SCALED + unstated) as page:
        page.wait("frames > 240 && scale === 1")
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
