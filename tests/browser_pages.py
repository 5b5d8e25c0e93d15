"""Pages in headless Chromium: servers, a clock that stands still, and the rasteriser's pictures for their cameras."""

import base64
import io
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http.server import SimpleHTTPRequestHandler
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from pansplat import pipeline
from pansplat.gaussians.scene import Scene
from pansplat.geometry.level import turn_axes

SIZE = (320, 240)
LIMIT = 180  # seconds, after which a state that the page does not reach is an error
OPTIONS = ("--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
# Messages of the page stay until the next one: the test may read them late.
STAY = """(({ setTimeout }) => {
    window.setTimeout = (act, ms, ...values) => ms === 5000 ? 0 : setTimeout(act, ms, ...values);
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
FRAME_MS = 30  # milliseconds between two frames of the stepped clock; the page lowers its resolution for longer ones
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
# `record` lists the cameras and stills of the next frames in `passed`.
RECORD = """
    passed = [];
    record = () => {
        const still = document.getElementById("still"), { position, yaw, pitch } = pansplat.camera;
        const left = still.hidden ? 0 : Number(still.style.opacity), { transform } = still.style;
        const image = left && !passed.some((frame) => frame.image) ? still.toDataURL("image/png") : null;
        const scale = transform ? Number(transform.slice(6, -1)) : 1;
        passed.push({ position: [...position], yaw, pitch, left, scale, image });
        requestAnimationFrame(record);
    };
"""


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
        self.wait("pansplat.isSettled()", 100)

    def look(self, **pose: Any) -> None:
        """Place the camera, and wait until the picture is final."""
        self.run("(pose) => pansplat.setPose(pose)", pose)
        self.settle()

    def jump(self, panorama: int) -> None:
        """Go to a panorama, from 1, without a flight."""
        self.run("(panorama) => { pansplat.goTo(panorama, { jump: true }); }", panorama)
        self.settle()

    def draw(self, width: int = SIZE[0], height: int = SIZE[1]) -> Float[np.ndarray, "height width 3"]:
        self.run("(size) => { drawn = 0; pansplat.render(...size).then((url) => { drawn = url; }); }", [width, height])
        self.wait("drawn", 0)
        return decode(self.run("drawn"))


def decode(url: str) -> Float[np.ndarray, "height width 3"]:
    """The image of a data URL."""
    image = Image.open(io.BytesIO(base64.b64decode(url.split(",")[1]))).convert("RGB")
    return np.asarray(image, np.float64) / 255


ORIGINS: dict[Path, str] = {}  # folder -> http address at which a test serves it


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


HOST = """<!doctype html><style>
body { height: 4000px; margin: 100px 50px }
iframe { border: 0; width: 320px; height: 240px }
</style>
<iframe></iframe>
<script>
const frame = document.querySelector("iframe");
frame.src = location.hash.slice(1);
</script>"""


def in_level(page: OpenPage, vector: Any) -> np.ndarray:
    """A vector of the page's world to the right, down and forward of a level camera."""
    return np.array(page.run("HEADER.level")).T @ np.array(vector)
