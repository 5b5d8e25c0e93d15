"""`pansplat info`: the contents of a scene file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from pansplat.errors import InputError
from pansplat.system.console import can_print, make_table_console
from pansplat.system.devices import describe_devices

if TYPE_CHECKING:
    from rich.table import Table
    from torch import Tensor

    from pansplat.gaussians.scene import Scene

_BARS, _ASCII_BARS = " ▁▂▃▄▅▆▇█", " .:-=+*#@"


_MAX_COLUMNS = 64  # views that the table shows


@dataclass(frozen=True)
class Info:
    """Print the contents of a scene file: Gaussians by level and view, opacities, scales, bounds, cameras."""

    path: Positional[Path | None] = None
    """The scene file, of any format (docs/formats.md)."""
    devices: Annotated[bool, arg(name="device")] = False
    """Print what runs on the processor and what on a graphics card."""

    def run(self) -> int:
        """Print the contents of the scene."""
        from pansplat import pipeline

        if self.devices:
            print("\n".join(describe_devices()))
        if self.path is None:
            if self.devices:
                return 0
            raise InputError("`pansplat info` needs a scene file or --device, got neither; give one")
        scene = pipeline.load(self.path)
        scene = scene.scaled(scene.frame.unit)
        gaussians = scene.gaussians
        print(f"{self.path}: {len(gaussians):,} Gaussians, SH degree {gaussians.degree}")
        if scene.model:
            source = f"predicted by {scene.model} at {scene.height}x{2 * scene.height}"
            print(f"{source}, near {scene.near:g} m, far {scene.far:g} m")
        if not len(gaussians):
            return 0
        make_table_console().print(_make_count_table(scene))
        for name, values, unit in (
            ("opacity", gaussians.opacities, ""),
            ("largest scale", gaussians.scales.amax(dim=1), " m"),
            ("smallest scale", gaussians.scales.amin(dim=1), " m"),
        ):
            print(_format_distribution(name, values, unit, log=unit != ""))
        low, high = gaussians.means.amin(dim=0).tolist(), gaussians.means.amax(dim=0).tolist()
        axes = (f"{axis} {a:.4g} to {b:.4g} m" for axis, a, b in zip("xyz", low, high, strict=True))
        print("bounds          " + ", ".join(axes))
        if any(scene.frame.origin):
            print(f"origin          at ({', '.join(f'{x:.15g}' for x in scene.frame.origin)}) m")
        for index, pose in enumerate(scene.cam2world):
            name = scene.names[index] if index < len(scene.names) else ""
            position = ", ".join(f"{x:.6g}" for x in pose[:3, 3].tolist())
            gains = ", ".join(f"{gain:.3f}" for gain in scene.gains[index]) if scene.gains else ""
            print(f"camera {index}        at ({position}) m  {name}" + (f"  gains {gains}" if gains else ""))
        return 0


def _make_count_table(scene: Scene) -> Table:
    """Number of Gaussians by level (rows) and view (columns)."""
    from rich.table import Table

    gaussians = scene.gaussians
    views = min(max(len(scene.cam2world), int(gaussians.views.max()) + 1), _MAX_COLUMNS)
    table = Table()
    table.add_column("level")
    for view in range(views):
        table.add_column(f"view {view}", justify="right")
    for level in sorted(set(gaussians.levels.tolist())):
        views_of_level = gaussians.views[gaussians.levels == level]
        table.add_row(str(level), *(f"{int((views_of_level == view).sum()):,}" for view in range(views)))
    return table


def _format_distribution(name: str, values: Tensor, unit: str, *, log: bool) -> str:
    """One line: minimum, maximum, median, and a histogram of 24 bars."""
    import torch

    low, middle, high = float(values.min()), float(values.median()), float(values.max())
    shown = values.clamp_min(1e-12).log10() if log else values
    bounds = (float(shown.min()), max(float(shown.max()), float(shown.min()) + 1e-6))
    counts = torch.histc(shown.float(), 24, *bounds)
    levels = _BARS if can_print(_BARS) else _ASCII_BARS
    bars = "".join(levels[round(8 * float(count / counts.max()))] for count in counts)
    return f"{name:<15} {low:.3g} to {high:.3g}{unit}, median {middle:.3g}{unit}  |{bars}|" + (" (log)" if log else "")
