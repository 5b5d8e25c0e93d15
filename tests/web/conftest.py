"""Scenes of coloured Gaussians around three cameras, their pages, and the browser that shows them."""

import dataclasses
import math
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from http.server import ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from browser_pages import HOST, LIMIT, OPTIONS, ORIGINS, QuietHandler, Sites
from PIL import Image

from pansplat.export import page as page_module
from pansplat.export import page_files
from pansplat.export.page import write_page
from pansplat.gaussians.scene import Gaussians, Scene, SceneTour
from pansplat.geometry.fibonacci import fibonacci_directions
from pansplat.inputs.panorama_sets import Note, Panorama, PanoramaSet
from pansplat.tours.facts import TourFacts


@pytest.fixture(autouse=True)
def small_poster(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pansplat.export.page._POSTER_SIZE", (27, 32))


def make_scene(num_views: int = 3, per_view: int = 700, degree: int = 1, seed: int = 0) -> Scene:
    """Flat Gaussians of random colours on a sphere of 2 to 3 m around each camera; cameras are turned and tilted."""
    random = torch.Generator().manual_seed(seed)
    poses = torch.eye(4, dtype=torch.float64).repeat(num_views, 1, 1)
    for view in range(num_views):
        angle = torch.tensor(0.7 * view)
        poses[view, 0, 0] = poses[view, 2, 2] = angle.cos()
        poses[view, 0, 2], poses[view, 2, 0] = angle.sin(), -angle.sin()
        poses[view, :3, 3] = torch.tensor((100 + 0.8 * view, -1.5, 0.5 * (view % 2)))
    directions = fibonacci_directions(per_view).float().repeat(num_views, 1)
    count = len(directions)
    views = torch.arange(num_views).repeat_interleave(per_view)
    distances = 2 + torch.rand(count, 1, generator=random)
    # The thin axis of a Gaussian is roughly its direction.
    quats = torch.cat((1 + directions[:, 2:], -directions[:, 1:2], directions[:, :1], torch.zeros(count, 1)), dim=1)
    harmonics = torch.randn(count, (degree + 1) ** 2, 3, generator=random) * 0.15
    harmonics[:, 0] = 3.5 * (torch.rand(count, 3, generator=random) - 0.5)
    return Scene(
        Gaussians(
            means=directions * distances + poses[views, :3, 3].float(),
            scales=torch.tensor((0.16, 0.11, 0.01)) * (0.5 + torch.rand(count, 1, generator=random)),
            quats=quats,
            opacities=0.3 + 0.69 * torch.rand(count, generator=random),
            harmonics=harmonics,
            levels=torch.zeros(count, dtype=torch.uint8),
            views=views.to(torch.uint8),
        ),
        poses,
        near=0.5,
        far=10.0,
        names=tuple(f"room {view}" for view in range(num_views)),
        height=64,
    )


@pytest.fixture(scope="session")
def scene() -> Scene:
    """Three views, harmonics of degree 1, 100 m from the world's origin."""
    return make_scene()


@pytest.fixture(scope="session")
def plain_scene() -> Scene:
    """Two views without harmonics."""
    return make_scene(num_views=2, degree=0)


@pytest.fixture(scope="session")
def house(scene: Scene) -> Scene:
    """The scene as that of a tour: the three views in a row, two edges."""
    return dataclasses.replace(scene, tour=SceneTour(((0, 1, 0.5), (1, 2, 0.4))))


@pytest.fixture(scope="session")
def flat() -> Scene:
    """A tour of three parts: two placed views, and two single ones 20 m and 40 m away.

    A link leads from the first view to the third one on its right, and another one back, ahead.
    """
    scene = make_scene(num_views=4, per_view=400)
    poses, means = scene.cam2world.clone(), scene.gaussians.means.clone()
    for view in (2, 3):
        poses[view, 0, 3] += 20 * (view - 1)
        means[scene.gaussians.views == view, 0] += 20 * (view - 1)
    return dataclasses.replace(
        scene,
        gaussians=dataclasses.replace(scene.gaussians, means=means),
        cam2world=poses,
        names=("room 0", "room 1", "</script><b>hall", "attic"),
        tour=SceneTour(
            ((0, 1, 0.5), (2, 2, 1.0), (3, 3, 1.0)),
            ((0, 2, 0.5 * math.pi, 0.6, "<i>down"), (2, 0, 0.0, 0.3, "")),
        ),
        starts=((0.3, 0.2), None, None, (1.0, -0.2)),
    )


@pytest.fixture(scope="session")
def take_photographs(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Scene, int], list[PanoramaSet]]:
    """A function that writes smooth random panoramas of a height for the cameras of a scene to a new folder.

    It returns a pair of one view each. They are not what the Gaussians show.
    """

    def take(scene: Scene, height: int) -> list[PanoramaSet]:
        folder, pairs = tmp_path_factory.mktemp("photographs"), []
        for view, pose in enumerate(scene.cam2world):
            noise = np.random.default_rng(view).uniform(60, 220, (16, 32, 1)) + np.array((0, 10, 0))
            noise = np.pad(noise, ((0, 0), (1, 1), (0, 0)), mode="wrap")
            pixels = cv2.resize(noise, None, fx=height / 16, fy=height / 16)[:, height // 16 : -height // 16]
            pixels = pixels + np.linspace(-30, 30, height)[:, None, None]
            path = folder / f"{view}.png"
            Image.fromarray(pixels.clip(1, 255).astype(np.uint8)).save(path)
            pairs.append(PanoramaSet(f"{view}", folder, (Panorama(f"{view}", path, pose),), (), 0.5, 10.0, (path,)))
        return pairs

    return take


@pytest.fixture(scope="session")
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


@pytest.fixture(scope="session")
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


@pytest.fixture(scope="session")
def photographs(scene: Scene, take_photographs: Callable[..., list[PanoramaSet]]) -> list[PanoramaSet]:
    """Of the scene, 1024 rows; the second one has a note ahead on the right, the third one another."""
    taken = take_photographs(scene, 1024)
    links = ("https://example.org/a?b=<c>&d", "http://example.org")
    notes = Note(0.3, 0.1, "<b>Oak</b>\nfloor", links), Note(1.0, 0.0, "x")
    for number, note in enumerate(notes, start=1):
        (panorama,) = taken[number].context
        taken[number] = dataclasses.replace(taken[number], context=(dataclasses.replace(panorama, notes=(note,)),))
    return taken


@pytest.fixture(scope="session")
def folder(scene, house, flat, sites, photographs, take_photographs) -> Path:
    """tour.html, split.html with files, house.html with a graph, flat.html with parts.

    photos.html, photos/index.html and rooms.html (as flat.html) have photographs; poor/index.html has a poor edge.
    """
    folder = sites.folder
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page_module, "_POSTER_SIZE", (27, 32))
        patch.setattr(page_files, "_PART_BYTES", 30_000)
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
