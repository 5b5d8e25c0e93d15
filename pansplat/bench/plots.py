"""Pictures of the rows: time against error with the front of the best, and how the cost grows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pansplat.atomic import replacing
from pansplat.bench.rows import Row

_MARKERS = {"numba": "o", "torch": "s", "triton": "D", "gl33": "^", "gl43": "v", "gsplat": "P", "dense": "X"}
_COLORS = {"ray": "#1764ab", "ewa": "#c8501e"}
_FLOOR = 1e-8  # errors below are float32's rounding, if that


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of the points that no other point beats in both numbers, by rising first number.

    A point that equals another in both is on the front if the other is.
    """
    front = []
    for index in sorted(range(len(points)), key=lambda i: points[i]):
        if not front or points[index][1] < points[front[-1]][1] or points[index] == points[front[-1]]:
            front.append(index)
    return front


def plot_choices(rows: Sequence[Row], path: Path) -> bool:
    """Time on x, root mean square error on y, both logarithmic; False when there is nothing to show.

    Raises:
        InputError: the file cannot be written.
    """
    shown = [row for row in rows if row.suite == "choices" and row.forward_ms and row.psnr_db is not None]
    shown = [row for row in shown if row.layout != "pinhole"]
    if not shown:
        return False
    points = [(float(row.forward_ms or 0), max(_FLOOR, 10 ** (-float(row.psnr_db or 0) / 20))) for row in shown]
    figure = Figure(figsize=(10, 6.5), layout="constrained")
    axes = figure.subplots()
    for row, (x, y) in zip(shown, points, strict=True):
        filled = _COLORS[row.kernel] if row.filter == "angular" else "none"
        edge = _COLORS[row.kernel] if row.precision == "float32" else "#444444"
        axes.scatter(x, y, s=55, marker=_MARKERS.get(row.backend, "*"), facecolors=filled, edgecolors=edge, zorder=3)
    front = pareto_front(points)
    axes.plot(*zip(*(points[i] for i in front), strict=True), color="#2a8c4a", linewidth=1.5, zorder=2)
    axes.set(xscale="log", yscale="log", xlabel="forward, milliseconds")
    axes.set_ylim(bottom=min(axes.get_ylim()[0], 0.03 * min(y for _, y in points)))
    _label(axes, [(points[i], _name(shown[i])) for i in front])
    axes.set_ylabel("root mean square error of the colours (the exact picture is drawn at 1e-8)")
    first = shown[0]
    axes.set_title(f"{first.scene}: {first.num_gaussians:,} Gaussians at {first.height}x{2 * first.height}", loc="left")
    decibels = axes.secondary_yaxis("right", functions=(lambda y: y, lambda y: y))
    decibels.set_yticks([10.0**-k for k in range(9)], [f"{20 * k} dB" for k in range(9)])
    _legend(axes, shown)
    axes.grid(alpha=0.25)
    _save(figure, path)
    return True


def _name(row: Row) -> str:
    layout = "direct" if row.layout == "equirect" else f"faces of {row.face_size}"
    order = "" if row.layout == "equirect" else f" {row.order}"
    return f"{row.backend} {row.kernel}{order} {row.filter}, {layout}" + (" float64" * (row.precision == "float64"))


def _label(axes: Axes, labels: list[tuple[tuple[float, float], str]]) -> None:
    """Names beside the front's points, above it on the left and below on the right; apart where points crowd."""
    low, high = (math.log(edge) for edge in axes.get_xlim())
    for index, (point, name) in enumerate(labels):
        right = math.log(point[0]) < 0.5 * (low + high)
        axes.annotate(
            name,
            point,
            xytext=(14, 12 + 13 * (index % 3)) if right else (-14, -12 - 13 * (index % 3)),
            textcoords="offset points",
            ha="left" if right else "right",
            fontsize=8,
            arrowprops={"arrowstyle": "-", "color": "#999999", "linewidth": 0.6},
        )


def _legend(axes: Axes, rows: Sequence[Row]) -> None:
    for backend in dict.fromkeys(row.backend for row in rows):
        axes.scatter([], [], marker=_MARKERS.get(backend, "*"), color="#888888", label=backend)
    for kernel in dict.fromkeys(row.kernel for row in rows):
        axes.plot([], [], linewidth=4, color=_COLORS[kernel], label=f"kernel {kernel}")
    axes.scatter([], [], marker="o", facecolors="none", edgecolors="#888888", label="hollow: filter 3dgs")
    axes.scatter([], [], marker="s", facecolors="#cccccc", edgecolors="#444444", label="dark rim: float64")
    axes.plot([], [], color="#2a8c4a", label="nothing is faster and better")
    axes.legend(fontsize=8, loc="best")


def plot_sweeps(rows: Sequence[Row], path: Path) -> bool:
    """The least time of each row against the number of Gaussians and of pixels; False when there is nothing to show.

    Raises:
        InputError: the file cannot be written.
    """
    sweeps = {name: [row for row in rows if row.suite == name and row.forward_ms] for name in ("count", "resolution")}
    if not any(sweeps.values()):
        return False
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    _curves(left, sweeps["count"], "num_gaussians")
    heights = {row.height for row in sweeps["count"]}
    where = f" at {max(heights)}x{2 * max(heights)}" if heights else ""
    left.set(
        xlabel="Gaussians" + where, ylabel="milliseconds, least of the repeats", title="more Gaussians, same picture"
    )
    _curves(right, sweeps["resolution"], "height")
    right.set(
        xlabel="height of the panorama, pixels",
        ylabel="milliseconds, least of the repeats",
        title="larger picture, its own scene",
    )
    _save(figure, path)
    return True


def _curves(axes: Axes, rows: Sequence[Row], x: str) -> None:
    for backend in dict.fromkeys(row.backend for row in rows):
        own = sorted((row for row in rows if row.backend == backend), key=lambda row: getattr(row, x))
        for name, style in (("forward", "-"), ("backward", "--")):
            line = [(getattr(row, x), getattr(row, f"{name}_min_ms")) for row in own if getattr(row, f"{name}_min_ms")]
            if line:
                threads = f", {own[0].threads} threads" if own[0].threads > 1 else ""
                label = f"{backend} {name}{threads}"
                axes.plot(*zip(*line, strict=True), style, marker=_MARKERS.get(backend, "*"), label=label)
    axes.set(xscale="log", yscale="log")
    axes.grid(alpha=0.25, which="both")
    low, high = axes.get_ylim()
    if high < 10 * low:  # less than a decade would make hills of the machine's whims
        middle = math.sqrt(low * high)
        axes.set_ylim(middle / math.sqrt(10), middle * math.sqrt(10))
    if rows:
        axes.legend(fontsize=8)


def _save(figure: Figure, path: Path) -> None:
    with replacing(path) as partial:
        figure.savefig(partial, dpi=110)
