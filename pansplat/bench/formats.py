"""`pansplat bench formats`: size, error and time of the file formats of scenes.

Each row writes a scene, reads it, and compares the Gaussians field by field, and panoramas of all Gaussians at three
places between the input cameras. Blending by views is off, because some formats hold no views.

Values of a row: root mean squares of the errors of the means (`position_mm`), the axes (`rotation_degrees`), the scales
(`scale_percent`), the opacities, and the harmonics of degree 0 (`color`) and above (`harmonics`, if there are any);
`psnr_db` is the lowest of the panoramas, infinite if they are equal.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from pansplat import pipeline
from pansplat.bench.harness import time_call
from pansplat.bench.report import Benchmark, Column, Header, Report, Row, make_axes
from pansplat.evaluation.metrics import psnr
from pansplat.files import SCENE_SUFFIXES
from pansplat.gaussians.formats import load_scene, save_scene, sort_as_written
from pansplat.gaussians.scene import Scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PLACES = (0.25, 0.5, 0.75)  # between the input cameras
_RANDOM_HARMONICS = 0.05  # standard deviation of harmonics that are made
_MAX_PSNR = 120.0  # dB, in the plot
_FORMATS = (".ply", ".glb", *(suffix for suffix in SCENE_SUFFIXES if suffix not in (".ply", ".glb")))
_CPU = torch.device("cpu")


@dataclass(frozen=True)
class FormatCase:
    """A format, by its suffix."""

    suffix: str


def set_degree(scene: Scene, degree: int) -> Scene:
    """The scene with harmonics of a degree; missing ones are normal random numbers."""
    harmonics, count = scene.gaussians.harmonics, (degree + 1) ** 2
    missing = max(0, count - harmonics.shape[1])
    random = torch.randn(len(harmonics), missing, 3, generator=torch.Generator().manual_seed(0)) * _RANDOM_HARMONICS
    harmonics = torch.cat((harmonics[:, :count], random), dim=1)
    return replace(scene, gaussians=replace(scene.gaussians, harmonics=harmonics))


def measure_formats(scene: Scene, height: int, report: Report, *, name: str = "scene") -> None:
    """Add a row for each format.

    Args:
        scene: with at least one Gaussian.
        height: of the compared panoramas, pixels.
        name: of the scene.
    """
    places = [scene.pose_between(place) for place in _PLACES] if len(scene.cam2world) else [torch.eye(4).double()]

    def render(content: Scene) -> list[Tensor]:
        with torch.no_grad():
            return [pipeline.render(content, pose, blend="joint", size=(height, 2 * height)).color for pose in places]

    original = render(scene)
    with tempfile.TemporaryDirectory() as folder:
        for suffix in _FORMATS:
            report.step(suffix)
            result = _measure(scene, Path(folder, f"scene{suffix}"), original, render)
            report.add(Row("formats", name, FormatCase(suffix), result))


def _measure(
    scene: Scene, path: Path, original: list[Tensor], render: Callable[[Scene], list[Tensor]]
) -> dict[str, float]:
    written, _ = time_call(lambda: save_scene(scene, path), _CPU)
    read, back = time_call(lambda: load_scene(path), _CPU)
    expected, found = sort_as_written(scene.gaussians, path), back.gaussians
    normalize = torch.nn.functional.normalize
    cosines = (normalize(expected.quats.double(), dim=1) * normalize(found.quats.double(), dim=1)).sum(1).abs()
    result = {
        "bytes": path.stat().st_size,
        "bytes_per_gaussian": path.stat().st_size / len(found),
        "position_mm": 1000 * _rms(found.means - expected.means),
        "rotation_degrees": math.degrees(_rms(2 * torch.acos(cosines.clamp(max=1)))),
        "scale_percent": 100 * _rms(found.scales / expected.scales - 1),
        "opacity": _rms(found.opacities - expected.opacities),
        "color": _rms(found.harmonics[:, 0] - expected.harmonics[:, 0]),
        "psnr_db": min(psnr(*images) for images in zip(render(back), original, strict=True)),
        "write_s": written.wall,
        "read_s": read.wall,
    }
    shared = min(expected.harmonics.shape[1], found.harmonics.shape[1])
    if shared > 1:
        result["harmonics"] = _rms(found.harmonics[:, 1:shared] - expected.harmonics[:, 1:shared])
    path.unlink()
    return result


def _rms(error: Tensor) -> float:
    return float(error.double().square().mean().sqrt())


def plot_formats(rows: Sequence[Row], header: Header) -> Figure:
    """Plot the PSNR over the bytes of a Gaussian; images without an error stand at 120 dB."""
    figure, (axes,) = make_axes(1, (7, 4))
    for row in rows:
        point = row.get("bytes_per_gaussian"), min(_MAX_PSNR, row.get("psnr_db"))
        axes.plot(*point, "o", color="#1764ab")
        axes.annotate(row.case.suffix, point, xytext=(5, 5), textcoords="offset points", fontsize=8)
    axes.set(xlabel="bytes of a Gaussian", ylabel="PSNR of panoramas, dB (at most 120)", title=rows[0].scene)
    figure.suptitle(header["machine"]["cpu"], x=0.01, ha="left", fontsize=9)
    return figure


FORMATS = Benchmark(
    "formats",
    (
        Column("format", "suffix"),
        Column("bytes each", "bytes_per_gaussian", "{:.1f}"),
        Column("position mm", "position_mm", "{:.2g}"),
        Column("rotation °", "rotation_degrees", "{:.2g}"),
        Column("scale %", "scale_percent", "{:.2g}"),
        Column("opacity", "opacity", "{:.2g}"),
        Column("colour", "color", "{:.2g}"),
        Column("harmonics", "harmonics", "{:.2g}"),
        Column("image dB", "psnr_db", "{:.1f}"),
        Column("write s", "write_s", "{:.2f}"),
        Column("read s", "read_s", "{:.2f}"),
    ),
    lambda row: row.scene,
    plot_formats,
    width=140,
)
