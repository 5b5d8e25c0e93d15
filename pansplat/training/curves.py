"""A picture of a run: the loss step by step, and how good its pictures have become."""

from __future__ import annotations

import math
from pathlib import Path

from matplotlib.figure import Figure

from pansplat.atomic import replacing
from pansplat.training.logs import read_table

_SMOOTH = 20  # the thick line is the mean of a 20th of the steps


def plot_run(folder: Path) -> Path | None:
    """Draw `curves.png` of the tables in a run's folder; None where nothing is logged yet.

    Raises:
        InputError: the file cannot be written.
    """
    log, scores = (read_table(folder / name) for name in ("log.csv", "validation.csv"))
    if not log:
        return None
    figure = Figure(figsize=(9, 5.5), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    steps = [int(row["step"]) + 1 for row in log]
    losses = [float(row["loss"]) for row in log]
    above.plot(steps, losses, color="#b9cfe4", linewidth=1)
    above.plot(steps, _smoothed(losses), color="#1764ab", linewidth=2)
    above.set_ylabel("loss")
    for measure, color, label in (("psnr", "#c8501e", "PSNR, dB"), ("ws_psnr", "#e0a030", "WS-PSNR, dB")):
        below.plot([int(row["step"]) for row in scores], _numbers(scores, measure), "o-", color=color, label=label)
    below.set(xlabel="step", ylabel="unseen places, dB")
    below.legend(loc="lower right")
    for axes in (above, below):
        axes.grid(alpha=0.25)
    path = folder / "curves.png"
    with replacing(path) as unfinished:
        figure.savefig(unfinished, dpi=110, format="png")
    return path


def _smoothed(values: list[float]) -> list[float]:
    """Each value's mean with those before it, over a 20th of all."""
    width = max(1, math.ceil(len(values) / _SMOOTH))
    means = []
    for end in range(1, len(values) + 1):
        window = values[max(0, end - width) : end]
        means.append(sum(window) / len(window))
    return means


def _numbers(rows: list[dict[str, str]], name: str) -> list[float]:
    return [float(row[name]) for row in rows]
