"""`pansplat bench formats`: size, error and time of the file formats of scenes.

Each row writes a scene, reads it, and compares the Gaussians field by field, and panoramas of all Gaussians at three
places between the input cameras. Blending by views is off, because some formats hold no views.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from pansplat import pipeline
from pansplat.bench.fidelity import clamped_psnr
from pansplat.files import SCENE_SUFFIXES
from pansplat.gaussians.formats import load_scene, save_scene, sort_as_written
from pansplat.gaussians.scene import Scene

if TYPE_CHECKING:
    from rich.table import Table

_PLACES = (0.25, 0.5, 0.75)  # between the input cameras
_RANDOM_HARMONICS = 0.05  # standard deviation of harmonics that are made
_FORMATS = (".ply", ".glb", *(suffix for suffix in SCENE_SUFFIXES if suffix not in (".ply", ".glb")))


@dataclass(frozen=True)
class FormatRow:
    """A format and its measurements; errors are root mean squares.

    Attributes:
        position_mm, rotation_degrees: of the means and the axes.
        scale_percent: of the scales, relative.
        opacity: in [0, 1].
        color: of the harmonics of degree 0.
        harmonics: of those above; NaN if the format or the scene has none.
        psnr_db: of the panoramas, lowest of all places; infinite if equal.
        write_s, read_s: seconds.
    """

    suffix: str
    bytes: int
    bytes_per_gaussian: float
    position_mm: float
    rotation_degrees: float
    scale_percent: float
    opacity: float
    color: float
    harmonics: float
    psnr_db: float
    write_s: float
    read_s: float

    def as_json(self) -> dict[str, object]:
        """All fields; null for numbers that are not finite."""
        fields = asdict(self).items()
        return {name: None if isinstance(x, float) and not math.isfinite(x) else x for name, x in fields}


def set_degree(scene: Scene, degree: int) -> Scene:
    """The scene with harmonics of a degree; missing ones are normal random numbers."""
    harmonics, count = scene.gaussians.harmonics, (degree + 1) ** 2
    missing = max(0, count - harmonics.shape[1])
    random = torch.randn(len(harmonics), missing, 3, generator=torch.Generator().manual_seed(0)) * _RANDOM_HARMONICS
    harmonics = torch.cat((harmonics[:, :count], random), dim=1)
    return replace(scene, gaussians=replace(scene.gaussians, harmonics=harmonics))


def measure_formats(scene: Scene, height: int) -> list[FormatRow]:
    """A row for each format.

    Args:
        scene: with at least one Gaussian.
        height: of the compared panoramas, pixels.
    """
    places = [scene.pose_between(place) for place in _PLACES] if len(scene.cam2world) else [torch.eye(4).double()]

    def render(content: Scene) -> list[Tensor]:
        with torch.no_grad():
            return [pipeline.render(content, pose, blend="joint", size=(height, 2 * height)).color for pose in places]

    original = render(scene)
    with tempfile.TemporaryDirectory() as folder:
        return [_measure(scene, Path(folder, f"scene{suffix}"), suffix, original, render) for suffix in _FORMATS]


def _measure(
    scene: Scene, path: Path, suffix: str, original: list[Tensor], render: Callable[[Scene], list[Tensor]]
) -> FormatRow:
    began = time.perf_counter()
    save_scene(scene, path)
    written = time.perf_counter()
    back = load_scene(path)
    read = time.perf_counter()
    size = path.stat().st_size
    path.unlink()
    expected, found = sort_as_written(scene.gaussians, path), back.gaussians
    normalize = torch.nn.functional.normalize
    cosines = (normalize(expected.quats.double(), dim=1) * normalize(found.quats.double(), dim=1)).sum(1).abs()
    shared = min(expected.harmonics.shape[1], found.harmonics.shape[1])
    return FormatRow(
        suffix,
        size,
        size / len(found),
        position_mm=1000 * _rms(found.means - expected.means),
        rotation_degrees=math.degrees(_rms(2 * torch.acos(cosines.clamp(max=1)))),
        scale_percent=100 * _rms(found.scales / expected.scales - 1),
        opacity=_rms(found.opacities - expected.opacities),
        color=_rms(found.harmonics[:, 0] - expected.harmonics[:, 0]),
        harmonics=_rms(found.harmonics[:, 1:shared] - expected.harmonics[:, 1:shared]) if shared > 1 else math.nan,
        psnr_db=min(clamped_psnr(*images) for images in zip(render(back), original, strict=True)),
        write_s=written - began,
        read_s=read - written,
    )


def _rms(error: Tensor) -> float:
    return float(error.double().square().mean().sqrt())


def make_format_table(rows: list[FormatRow], title: str) -> Table:
    """The rows as a table."""
    from rich.table import Table

    table = Table(title=title)
    for name in ("format", "bytes each", "position mm", "rotation °", "scale %", "opacity", "colour", "harmonics",
                 "image dB", "write s", "read s"):  # fmt: skip
        table.add_column(name, justify="left" if name == "format" else "right")
    for row in rows:
        numbers = (row.position_mm, row.rotation_degrees, row.scale_percent, row.opacity, row.color, row.harmonics)
        cells = ["" if math.isnan(number) else f"{number:.2g}" for number in numbers]
        picture = "equal" if math.isinf(row.psnr_db) else f"{row.psnr_db:.1f}"
        table.add_row(row.suffix, f"{row.bytes_per_gaussian:.1f}", *cells, picture,
                      f"{row.write_s:.2f}", f"{row.read_s:.2f}")  # fmt: skip
    return table
