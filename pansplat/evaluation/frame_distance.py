"""The figure of quality over the distance of the input frames: where deferred blending begins to pay.

Source: PanSplat, section 4, the figure on Insta360 (its code is not public: ours is the frame in the middle of pairs
that are spread evenly over the sequences).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from pansplat.atomic import replacing
from pansplat.evaluation.protocol import ProtocolResult, SetResult
from pansplat.evaluation.tables import HEADS, Layout


def frame_distance_layout(result: ProtocolResult) -> Layout:
    """A table of the figure's numbers; the paper gives none."""
    sets = tuple(dict.fromkeys(row.set for row in result.sets))
    return Layout("The frame in the middle, by frames between the inputs", sets, ("ws_psnr",), ())


def curves(rows: Sequence[SetResult], metric: str) -> dict[str, list[tuple[int, float]]]:
    """By method, the frame distances and what was reached there."""
    lines: dict[str, list[tuple[int, float]]] = {}
    for row in rows:
        value = row.mean(metric)
        if value is not None:
            lines.setdefault(row.method, []).append((int(row.set.split()[0]), value))
    return {method: sorted(line) for method, line in lines.items()}


def plot_frame_distance(result: ProtocolResult, path: Path) -> None:
    """Write the figure: one panel for WS-PSNR, one for LPIPS where it was measured.

    Raises:
        InputError: the file cannot be written.
    """
    metrics = ["ws_psnr", *(["lpips"] if result.lpips else [])]
    figure = Figure(figsize=(5.5 * len(metrics), 4), layout="constrained")
    panels = figure.subplots(1, len(metrics), squeeze=False)[0]
    for axes, metric in zip(panels, metrics, strict=True):
        for method, line in curves(result.sets, metric).items():
            axes.plot(*zip(*line, strict=True), marker="o", label=method)
        unit = ", dB" if metric == "ws_psnr" else f" ({result.lpips}), lower is better"
        axes.set(xlabel="frames between the inputs", ylabel=HEADS[metric] + unit)
        axes.grid(alpha=0.25)
    panels[0].legend(fontsize=8)
    with replacing(path) as partial:
        figure.savefig(partial, dpi=110)
