"""The paper's tables with our rows, the frame-distance figure, and the files of an evaluation.

Source: PanSplat, section 4 and tables 1 to 4; a user's re-run of the released 512 checkpoint (PanSplat issue 6). The
code of the paper's figure on Insta360 is not public: ours uses the middle frame of pairs spread evenly over the
sequences.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure
from rich.table import Table

from pansplat.atomic import replacing
from pansplat.evaluation.protocol import ProtocolResult, SetResult
from pansplat.files import SOFTWARE

Values = dict[tuple[str, str], float]
"""By test set and metric."""

HEADS = {
    "gaussians": "Gaussians",
    "psnr": "PSNR",
    "ws_psnr": "WS-PSNR",
    "ssim": "SSIM",
    "lpips": "LPIPS",
    "abs_rel": "AbsRel",
    "sq_rel": "SqRel",
    "rmse": "RMSE",
}
_FORMATS = {"gaussians": ",.0f", "psnr": ".2f", "ws_psnr": ".2f", "abs_rel": ".4f", "sq_rel": ".4f", "rmse": ".4f"}
_METRICS = ("ws_psnr", "ssim", "lpips")
_METRICS_WITH_PSNR = ("psnr", "ws_psnr", "ssim", "lpips")
_RERUN = "PanSplat (a user's re-run)"


@dataclass(frozen=True)
class TableRow:
    """The values of one method."""

    method: str
    values: Values


@dataclass(frozen=True)
class TableLayout:
    """A table of the paper.

    Attributes:
        sets, metrics: from left to right; every set has all metrics.
        rows: the paper's.
    """

    title: str
    sets: tuple[str, ...]
    metrics: tuple[str, ...]
    rows: tuple[TableRow, ...]

    @property
    def columns(self) -> list[tuple[str, str]]:
        """Test set and metric of each column."""
        return [(name, metric) for name in self.sets for metric in self.metrics]


def _make_layout(
    title: str, sets: tuple[str, ...], metrics: tuple[str, ...], rows: Mapping[str, Sequence[float | None]]
) -> TableLayout:
    columns = [(name, metric) for name in sets for metric in metrics]
    table_rows = (
        TableRow(method, {c: n for c, n in zip(columns, numbers, strict=True) if n is not None})
        for method, numbers in rows.items()
    )
    return TableLayout(title, sets, metrics, tuple(table_rows))


_NO_VALUES = (None, None, None)

LAYOUTS: dict[str, TableLayout] = {
    "m3d": _make_layout(
        "Matterport3D, wide baselines",
        ("M3D 1.0 m", "M3D 1.5 m", "M3D 2.0 m"),
        _METRICS,
        {
            "S-NeRF": (15.25, 0.579, 0.546, 14.16, 0.563, 0.580, 13.13, 0.523, 0.607),
            "OmniSyn": (22.90, 0.850, 0.244, 20.31, 0.790, 0.317, 18.91, 0.761, 0.354),
            "IBRNet": (25.72, 0.855, 0.258, 21.69, 0.751, 0.382, 20.04, 0.706, 0.431),
            "NeuRay": (24.92, 0.832, 0.260, 21.92, 0.766, 0.347, 19.85, 0.715, 0.407),
            "PanoGRF": (27.12, 0.876, 0.195, 23.38, 0.811, 0.282, 20.96, 0.761, 0.352),
            "MVSplat (spherical)": (28.19, 0.912, 0.105, 21.82, 0.807, 0.230, 13.31, 0.595, 0.554),
            "PanSplat": (28.81, 0.931, 0.091, 24.09, 0.849, 0.181, 20.56, 0.777, 0.265),
            _RERUN: (28.806, 0.9305, 0.0905, 24.089, 0.8493, 0.1802, 20.194, 0.7731, 0.2722),
        },
    ),
    "narrow": _make_layout(
        "Matterport3D, narrow baselines",
        ("M3D 0.2 m", "M3D 0.5 m"),
        _METRICS,
        {
            "PanoGRF": (33.27, None, None, 30.46, None, None),
            "MVSplat (spherical)": (32.04, None, None, 30.58, None, None),
            "PanSplat": (32.88, None, None, 31.42, None, None),
            _RERUN: (32.880, 0.9587, 0.0661, 31.448, 0.9504, 0.0720),
        },
    ),
    "replica": _make_layout(
        "Replica",
        ("Replica 1.0 m",),
        _METRICS,
        {
            "S-NeRF": (16.10, 0.723, 0.443),
            "OmniSyn": (23.17, 0.898, 0.189),
            "IBRNet": (22.65, 0.854, 0.291),
            "NeuRay": (25.90, 0.899, 0.187),
            "PanoGRF": (29.22, 0.937, 0.134),
            "MVSplat (spherical)": (30.54, 0.958, 0.059),
            "PanSplat": (30.78, 0.962, 0.069),
            _RERUN: (30.746, 0.9613, 0.0696),
        },
    ),
    "residential": _make_layout(
        "Residential",
        ("Residential 0.3 m",),
        _METRICS,
        {
            "S-NeRF": (22.47, 0.741, 0.435),
            "OmniSyn": _NO_VALUES,
            "IBRNet": (22.47, 0.735, 0.498),
            "NeuRay": (22.38, 0.753, 0.427),
            "PanoGRF": (31.03, 0.909, 0.207),
            "MVSplat (spherical)": (31.21, 0.906, 0.200),
            "PanSplat": (30.97, 0.917, 0.172),
            _RERUN: (30.996, 0.9167, 0.1726),
        },
    ),
    "360loc": _make_layout(
        "360Loc",
        ("360Loc",),
        _METRICS_WITH_PSNR,
        {
            "MVSplat (spherical)": (24.13, 24.67, 0.823, 0.170),
            "PanSplat": (24.96, 25.58, 0.833, 0.159),
            "PanSplat + deferred blending": (27.35, 28.14, 0.860, 0.127),
        },
    ),
    "insta360": _make_layout(
        "Insta360",
        ("Insta360",),
        _METRICS_WITH_PSNR,
        {
            "MVSplat (spherical)": (20.93, 23.24, 0.786, 0.227),
            "PanSplat": (21.92, 24.43, 0.813, 0.211),
            "PanSplat + deferred blending": (23.36, 25.68, 0.822, 0.183),
        },
    ),
    "ablation": _make_layout(
        "Ablation on Matterport3D",
        ("M3D 1.0 m",),
        ("gaussians", *_METRICS),
        {
            "Base": (1_049_000, 27.07, 0.895, 0.127),
            "+ Fibonacci lattice": (668_000, 27.86, 0.906, 0.116),
            "+ Gaussian pyramid (full)": (887_000, 28.81, 0.931, 0.091),
            "without monocular depth": (None, 28.84, None, None),
            "without residual heads": (None, 28.14, None, None),
            "without hierarchical cost volume": (None, 26.95, None, None),
            "without the first three heads": (None, 28.05, None, None),
        },
    ),
}

DEPTH_LAYOUT = _make_layout(
    "Depth of the inputs, Matterport3D",
    ("M3D 1.0 m",),
    ("abs_rel", "sq_rel", "rmse"),
    {_RERUN: (0.01716, 0.00799, 0.1433)},
)


def rich_table(layout: TableLayout, ours: Sequence[TableRow]) -> Table:
    """The printable table: the paper's rows, a line, and ours in bold."""
    table = Table(title=layout.title)
    table.add_column("method")
    for index, (name, metric) in enumerate(layout.columns):
        above = name if index % len(layout.metrics) == 0 else ""
        table.add_column(f"{above}\n{HEADS[metric]}", justify="right")
    for row in layout.rows:
        table.add_row(row.method, *_format_cells(row, layout))
    table.add_section()
    for row in ours:
        table.add_row(row.method, *_format_cells(row, layout), style="bold")
    return table


def markdown_table(layout: TableLayout, ours: Sequence[TableRow]) -> str:
    """The table in Markdown, with ours in bold."""
    names = [f"{name} {HEADS[metric]}" for name, metric in layout.columns]
    lines = [f"### {layout.title}", "", f"| method | {' | '.join(names)} |", "|---" * (len(names) + 1) + "|"]
    for row in (*layout.rows, *ours):
        cells = [row.method, *_format_cells(row, layout)]
        if row in ours:
            cells = [f"**{cell}**" for cell in cells]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _format_cells(row: TableRow, layout: TableLayout) -> list[str]:
    """Formatted numbers; a dash for a missing one."""
    cells = []
    for column in layout.columns:
        value = row.values.get(column)
        cells.append("-" if value is None else format(value, _FORMATS.get(column[1], ".3f")))
    return cells


def frame_distance_curves(rows: Sequence[SetResult], metric: str) -> dict[str, list[tuple[int, float]]]:
    """By method, the frame distances and the values of the metric."""
    lines: dict[str, list[tuple[int, float]]] = {}
    for row in rows:
        value = row.mean(metric)
        if value is not None:
            lines.setdefault(row.method, []).append((int(row.set.split()[0]), value))
    return {method: sorted(line) for method, line in lines.items()}


def plot_frame_distance(result: ProtocolResult, path: Path) -> None:
    """Write the figure: a panel for WS-PSNR, and one for LPIPS if it was measured."""
    metrics = ["ws_psnr", *(["lpips"] if result.lpips else [])]
    figure = Figure(figsize=(5.5 * len(metrics), 4), layout="constrained")
    panels = figure.subplots(1, len(metrics), squeeze=False)[0]
    for axes, metric in zip(panels, metrics, strict=True):
        for method, line in frame_distance_curves(result.sets, metric).items():
            axes.plot(*zip(*line, strict=True), marker="o", label=method)
        unit = ", dB" if metric == "ws_psnr" else f" ({result.lpips}), lower is better"
        axes.set(xlabel="frames between the inputs", ylabel=HEADS[metric] + unit)
        axes.grid(alpha=0.25)
    panels[0].legend(fontsize=8)
    with replacing(path) as partial:
        figure.savefig(partial, dpi=110, metadata={"Software": "pansplat"})


_PAPER_LPIPS = "lpips-vgg"


def list_table_layouts(result: ProtocolResult) -> list[TableLayout]:
    """The paper's tables for the evaluation; a table without the paper's rows for the frame-distance figure."""
    if result.protocol == "frame-distance":
        sets = tuple(dict.fromkeys(row.set for row in result.sets))
        return [TableLayout("The frame in the middle, by frames between the inputs", sets, ("ws_psnr",), ())]
    with_depth = result.protocol == "m3d" and any(row.depth for row in result.sets)
    return [LAYOUTS[result.protocol], *([DEPTH_LAYOUT] if with_depth else [])]


def our_rows(result: ProtocolResult, layout: TableLayout) -> list[TableRow]:
    """A row for each method with its values on the table's sets."""
    rows: dict[str, TableRow] = {}
    for set_result in result.sets:
        row = rows.setdefault(set_result.method, TableRow(set_result.method, {}))
        for metric in layout.metrics:
            value = set_result.mean(metric)
            if value is not None:
                row.values[set_result.set, metric] = value
    return list(rows.values())


def rich_tables(result: ProtocolResult) -> list[Table]:
    """The printable tables."""
    return [rich_table(layout, our_rows(result, layout)) for layout in list_table_layouts(result)]


def report_notes(result: ProtocolResult) -> list[str]:
    """Notes on the tables: numbers of images, missing data, and figures that are not comparable."""
    counts = {row.set: len(row.scores) for row in result.sets}
    lines = ["Ours: " + ", ".join(f"{name}: {n} image{'s' * (n != 1)}" for name, n in counts.items()) + "."]
    if result.height != 512:
        lines.append(f"Ours is at {result.height}x{2 * result.height}, the paper's figures at 512x1024.")
    if result.lpips is None:
        lines.append("No LPIPS: its weights were not found (see docs/evaluation.md).")
    elif result.lpips != _PAPER_LPIPS:
        lines.append(f"LPIPS of ours is {result.lpips}, the paper's is {_PAPER_LPIPS}: they are not comparable.")
    lines += [f"Missing: {line}." for line in result.missing]
    lines += [f"Left out: {line}" for line in result.skipped]
    return lines


def write_report(result: ProtocolResult, out: Path) -> list[Path]:
    """Write table.md, and frame_distance.png for that protocol; return the paths."""
    tables = [markdown_table(layout, our_rows(result, layout)) for layout in list_table_layouts(result)]
    with replacing(out / "table.md") as partial:
        partial.write_text(
            "\n".join([f"<!-- {SOFTWARE} -->", *tables, *(f"* {note}" for note in report_notes(result))]) + "\n",
            encoding="utf-8",
        )
    written = [out / "table.md"]
    if result.protocol == "frame-distance":
        plot_frame_distance(result, out / "frame_distance.png")
        written.append(out / "frame_distance.png")
    return written
