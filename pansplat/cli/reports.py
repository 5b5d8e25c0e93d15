"""`pansplat evaluate`, `pansplat check` and `pansplat info`: what a user wants to know."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import torch
from rich.table import Table

from pansplat import pipeline
from pansplat.cli.commands import Check, Evaluate, Info
from pansplat.cli.printing import table_console
from pansplat.cli.scenes import blend_mode, choose_pair, progress_bar, require_height
from pansplat.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

    from pansplat.gaussians.scene import Scene

_BARS = " ▁▂▃▄▅▆▇█"


def run_evaluate(command: Evaluate) -> int:
    """Evaluate all pairs with targets in the folders and print the table."""
    from pansplat.cli.protocols import choose_lpips
    from pansplat.evaluation.report import evaluate, results_table

    require_height(command.height)
    if not command.paths:
        raise InputError("`pansplat evaluate` needs at least one folder of pairs, or --protocol")
    blend = blend_mode(command.blend or "deferred")
    lpips = choose_lpips(command.lpips, command.height)
    pairs = []
    for path in command.paths:
        found = pipeline.load_pairs(path, convention=command.convention, near=command.near, far=command.far)
        with_targets = [pair for pair in found if pair.targets]
        if not with_targets:
            print(
                f"note: {path}: none of its {len(found)} pairs has a target view; passed over",
                file=sys.stderr,
            )
        pairs += with_targets
    predictor = pipeline.load_model(command.model, compat=command.compat, precision=command.precision)
    with progress_bar() as progress:
        cases = evaluate(
            pairs,
            predictor,
            command.out,
            height=command.height,
            blend=blend,
            drawing=command.drawing,
            lpips=lpips,
            progress=progress,
        )
    table_console().print(results_table(cases))
    if lpips is not None:
        print(f"LPIPS is {lpips.name}")
    print(f"{command.out / 'results.json'} and the pictures beside it")
    return 0


def run_info(command: Info) -> int:
    """Print what a scene holds."""
    scene = pipeline.load(command.path)
    gaussians = scene.gaussians
    console = table_console()
    print(f"{command.path}: {len(gaussians):,} Gaussians, SH degree {gaussians.degree}")
    if scene.model:
        made = f"made by {scene.model} at {scene.height}x{2 * scene.height}"
        print(f"{made}, near {scene.near:g} m, far {scene.far:g} m")
    if not len(gaussians):
        return 0
    console.print(_counts(scene))
    for name, values, unit in (
        ("opacity", gaussians.opacities, ""),
        ("largest scale", gaussians.scales.amax(dim=1), " m"),
        ("smallest scale", gaussians.scales.amin(dim=1), " m"),
    ):
        print(_spread(name, values, unit, log=unit != ""))
    low, high = gaussians.means.amin(dim=0).tolist(), gaussians.means.amax(dim=0).tolist()
    print("bounds          " + ", ".join(f"{a} {x:.2f} to {y:.2f} m" for a, x, y in zip("xyz", low, high, strict=True)))
    for index, pose in enumerate(scene.cam2world):
        name = scene.names[index] if index < len(scene.names) else ""
        place = ", ".join(f"{x:.3f}" for x in pose[:3, 3].tolist())
        print(f"camera {index}        at ({place}) m  {name}")
    return 0


def run_check(command: Check) -> int:
    """Print how well the poses fit the pictures; 1 when a mistake is likely."""
    from pansplat.evaluation.pose_check import AS_GIVEN, check_pair

    check = check_pair(choose_pair(command.path, command.choice))
    table = Table(title=f"{check.name}: baseline {check.baseline:.3f} m")
    table.add_column("poses read")
    table.add_column("error of the warped view", justify="right")
    for reading, error in check.errors.items():
        style = "bold" if reading == AS_GIVEN else "green" if error < check.error and check.likely_mistake else ""
        table.add_row(reading, f"{error:.3f}", style=style)
    console = table_console()
    console.print(table)
    if check.indistinguishable:
        print(f"these views cannot tell from {AS_GIVEN}: {', '.join(check.indistinguishable)}")
    for warning in check.warnings:
        console.print(f"warning: {warning}", style="yellow", markup=False, soft_wrap=True)
    if check.likely_mistake:
        console.print(f"likely mistake: {check.likely_mistake}", style="bold red", markup=False, soft_wrap=True)
        return 1
    print("no other reading of the poses fits far better")
    return 0


def _counts(scene: Scene) -> Table:
    """Gaussians by level (rows) and view (columns)."""
    gaussians = scene.gaussians
    views = max(len(scene.cam2world), int(gaussians.views.max()) + 1)
    table = Table()
    table.add_column("level")
    for view in range(views):
        table.add_column(f"view {view}", justify="right")
    for level in sorted(set(gaussians.levels.tolist())):
        here = gaussians.views[gaussians.levels == level]
        table.add_row(str(level), *(f"{int((here == view).sum()):,}" for view in range(views)))
    return table


def _spread(name: str, values: Tensor, unit: str, *, log: bool) -> str:
    """One line: extremes, median, and a histogram of 24 bars between the extremes."""
    low, middle, high = float(values.min()), float(values.median()), float(values.max())
    shown = values.clamp_min(1e-12).log10() if log else values
    span = (float(shown.min()), max(float(shown.max()), float(shown.min()) + 1e-6))
    counts = torch.histc(shown.float(), 24, *span)
    bars = "".join(_BARS[round(8 * float(count / counts.max()))] for count in counts)
    return f"{name:<15} {low:.3g} to {high:.3g}{unit}, median {middle:.3g}{unit}  |{bars}|" + (" (log)" if log else "")
