"""`pansplat bench viewer`: times of the viewer's frames by stage, and their errors, over counts of Gaussians.

A case is a renderer (OpenGL, the processor), a view and a mode. The scenes are synthetic rooms. The viewer
runs as a command because no module may import it.

Values of a row: `frame_ms` is the median time of a frame, `spread_ms` half the range between the quartiles, `best_ms`
the fastest frame, to which other load adds least; `stages` are median milliseconds; `psnr_db` and `max_error` are
against the float64 image of the same mode; `device` is OpenGL's name of the device, or numba.
"""

from __future__ import annotations

import importlib.util
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from torch import Tensor

from pansplat import pipeline
from pansplat.bench.harness import Header, Suite, announce, compare_images, make_axes, quartile_range
from pansplat.bench.raster import make_room_scene
from pansplat.bench.scenes import make_room_cameras
from pansplat.errors import InputError
from pansplat.evaluation.results import Column, Row
from pansplat.gaussians.ply import save_ply
from pansplat.gaussians.scene import Scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure

View = Literal["perspective", "coarse", "look-around", "panorama"]
Mode = Literal["joint", "deferred"]

FOV_DEGREES = 75.0  # vertical, as in the window
RENDERERS = ("cpu", "gl")
_PANORAMA_SIZE = (1024, 512)  # width and height of panoramas, pixels
_MAX_REFERENCE = 1_000_000  # Gaussians; float64 takes a minute beyond
_VIEWER_PACKAGE = "pansplat_viewer"
_RATES = (15, 60)  # lines of the plot, frames per second


@dataclass(frozen=True)
class ViewerCase:
    """A frame of the viewer.

    Attributes:
        renderer: `cpu` or `gl`.
        view: `perspective` moves; `coarse` moves at half the resolution; `look-around` turns and reads cube faces;
            `panorama` has all directions; OpenGL stitches it from six cube faces.
        mode: `joint` or `deferred`.
        width, height: the size of the image, pixels.
    """

    renderer: str
    view: View
    mode: Mode
    width: int
    height: int

    @property
    def image_key(self) -> tuple[object, ...]:
        """The values that the exact image depends on."""
        return self.view == "panorama", self.mode, self.width, self.height

    def settings(self) -> dict[str, object]:
        """The values of the viewer's `DrawSettings`, and the size."""
        values: dict[str, object] = {"mode": self.mode, "size": [self.width, self.height]}
        if self.view == "panorama":
            return {**values, "layout": "equirect"}
        return {**values, "vertical_fov_degrees": FOV_DEGREES, "cached": self.view == "look-around"}


def list_viewer_cases(size: tuple[int, int], renderers: Sequence[str] = RENDERERS) -> list[ViewerCase]:
    """The cases of one scene.

    Args:
        size: width and height of the window, pixels.
        renderers: some of `cpu` and `gl`.
    """
    sizes: dict[View, tuple[int, int]] = {
        "perspective": size,
        "coarse": (size[0] // 2, size[1] // 2),
        "look-around": size,
        "panorama": _PANORAMA_SIZE,
    }
    return [
        ViewerCase(renderer, view, mode, *sizes[view])
        for renderer in renderers
        for view in sizes
        for mode in ("joint", "deferred")
        if renderer == "cpu" or view != "coarse"
        if view != "panorama" or mode == "joint"
    ]


def measure_viewer(height: int, cases: Sequence[ViewerCase], *, repeats: int, threads: int) -> Iterator[Row]:
    """Yield the row of each case on the room of a height.

    Args:
        repeats: frames of each case; OpenGL draws a third.
        threads: number of threads of numba and of software OpenGL.
    """
    if importlib.util.find_spec(_VIEWER_PACKAGE) is None:
        raise InputError("the viewer is not installed; install all of pansplat to measure it")
    room = make_room_scene(height)
    scene = Scene(room.load(), make_room_cameras(), near=0.1, far=100.0)
    count = len(scene.gaussians)
    announce(f"{room.name}: {count:,} Gaussians, float64 images")
    images = _render_exact(scene, room.pose, cases) if count <= _MAX_REFERENCE else {}
    with tempfile.TemporaryDirectory() as folder:
        save_ply(scene, Path(folder, "scene.ply"))
        for renderer in dict.fromkeys(case.renderer for case in cases):
            announce(f"{room.name}: {renderer}")
            chosen = [case for case in cases if case.renderer == renderer]
            job = Path(folder, "job.json")
            content = {
                "scene": str(Path(folder, "scene.ply")),
                "pose": room.pose.tolist(),
                "size": [chosen[0].width, chosen[0].height],
                "repeats": repeats if renderer == "cpu" else max(repeats // 3, 1),
                "folder": folder,
                "renderers": [renderer],
                "settings": [case.settings() for case in chosen],
            }
            job.write_text(json.dumps(content), "utf-8")
            for line in map(json.loads, run_viewer(job, threads)):
                case, times = chosen[line["settings"]], line["frame_ms"]
                values = {
                    "num_gaussians": count,
                    "frame_ms": statistics.median(times),
                    "spread_ms": quartile_range(times) / 2,
                    "best_ms": min(times),
                    "stages": line["stages"],
                    "device": line["device"],
                }
                if case.image_key in images:
                    image = torch.from_numpy(np.load(line["image"])[..., :3]).permute(2, 0, 1)
                    values |= compare_images(image, images[case.image_key])
                yield Row({"suite": "viewer", "scene": room.name, **asdict(case)}, values)


def run_viewer(job: Path, threads: int) -> list[str]:
    """The lines that the viewer's command prints for a job."""
    environment = os.environ | {"LP_NUM_THREADS": str(threads)}  # threads of Mesa's software OpenGL
    command = [sys.executable, "-m", f"{_VIEWER_PACKAGE}.draw.timing", str(job)]
    ended = subprocess.run(command, env=environment, capture_output=True, encoding="utf-8", errors="replace")
    if ended.returncode:
        messages = ended.stderr.strip().splitlines()
        raise InputError(f"the viewer rendered nothing: {messages[-1] if messages else 'no message'}")
    return ended.stdout.splitlines()


@torch.no_grad()
def _render_exact(scene: Scene, pose: Tensor, cases: Sequence[ViewerCase]) -> dict[tuple[object, ...], Tensor]:
    """The float64 images of the cases, by their `image_key`."""
    double = replace(scene, gaussians=scene.gaussians.to(dtype=torch.float64))
    return {
        key: pipeline.render(
            double,
            pose,
            blend=case.mode,
            size=(case.height, case.width),
            layout="equirect" if case.view == "panorama" else "pinhole",
            vertical_fov_degrees=FOV_DEGREES,
            backend="torch",
        ).color
        for key, case in {case.image_key: case for case in cases}.items()
    }


def plot_viewer(rows: Sequence[Row], header: Header) -> Figure:
    """Plot the time of a frame over the number of Gaussians, for each view, renderer and mode."""
    from matplotlib.ticker import NullFormatter

    views = list(dict.fromkeys(row.get("view") for row in rows))
    figure, axes = make_axes(len(views), (3.6 * len(views), 4.2), sharey=True)
    for ax, view in zip(axes, views, strict=True):
        of_view = [row for row in rows if row.get("view") == view]
        for renderer, mode in dict.fromkeys((row.get("renderer"), row.get("mode")) for row in of_view):
            line = [row for row in of_view if (row.get("renderer"), row.get("mode")) == (renderer, mode)]
            points = sorted((row.get("num_gaussians"), row.get("frame_ms")) for row in line)
            style, color = "o-" if mode == "joint" else "s--", f"C{RENDERERS.index(renderer)}"
            ax.loglog(*zip(*points, strict=True), style, color=color, label=f"{renderer}, {mode}")
        for rate in _RATES:
            ax.axhline(1000 / rate, color="grey", linewidth=0.8)
            ax.annotate(f"{rate} fps", (1, 1000 / rate), xycoords=("axes fraction", "data"), ha="right", va="bottom")
        ax.set(title=f"{view}, {of_view[0].get('width')}x{of_view[0].get('height')}", xlabel="Gaussians")
        ax.xaxis.set_minor_formatter(NullFormatter())  # they would overlap
        ax.legend(fontsize=7)
    axes[0].set_ylabel("frame, ms")
    figure.suptitle(header["machine"]["cpu"], x=0.01, ha="left", fontsize=9)
    return figure


def _format_stages(row: Row) -> str:
    return ", ".join(f"{name} {value:.1f}" for name, value in row.get("stages").items() if value >= 0.05)


VIEWER = Suite(
    "viewer",
    (
        Column("renderer", "renderer"),
        Column("view", "view"),
        Column("mode", "mode"),
        Column("pixels", lambda row: f"{row.get('width')}x{row.get('height')}", ">"),
        Column("frame ms", lambda row: f"{row.get('frame_ms'):,.1f} ±{row.get('spread_ms'):.1f}", ">"),
        Column("fastest", "best_ms", ",.1f"),
        Column("fps", lambda row: 1000 / row.get("frame_ms"), ",.1f"),
        Column("PSNR dB", "psnr_db", ".1f"),
        Column("max error", "max_error", ".1e"),
        Column("stages, ms", _format_stages),
    ),
    lambda row: f"{row.get('num_gaussians'):,} Gaussians ({row.get('scene')})",
    plot_viewer,
)
