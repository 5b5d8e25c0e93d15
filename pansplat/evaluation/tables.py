"""The paper's tables: its rows, and ours beside them.

Source: PanSplat, tables 1 to 4 (PAPER.md); a user's clean re-run of the released 512 checkpoint (PanSplat issue 6).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rich.table import Table

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
_USUAL = ("ws_psnr", "ssim", "lpips")
_ALL = ("psnr", "ws_psnr", "ssim", "lpips")
_RERUN = "PanSplat (a user's re-run)"


@dataclass(frozen=True)
class TableRow:
    """A method and what it reached."""

    method: str
    values: Values


@dataclass(frozen=True)
class Layout:
    """A table of the paper.

    Attributes:
        title: what it shows.
        sets: test sets, left to right.
        metrics: for each of them, left to right.
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


def _layout(
    title: str, sets: tuple[str, ...], metrics: tuple[str, ...], rows: Mapping[str, Sequence[float | None]]
) -> Layout:
    columns = [(name, metric) for name in sets for metric in metrics]
    made = []
    for method, numbers in rows.items():
        values = {c: n for c, n in zip(columns, numbers, strict=True) if n is not None}
        made.append(TableRow(method, values))
    return Layout(title, sets, metrics, tuple(made))


_NONE3 = (None, None, None)

LAYOUTS: dict[str, Layout] = {
    "m3d": _layout(
        "Matterport3D, wide baselines",
        ("M3D 1.0 m", "M3D 1.5 m", "M3D 2.0 m"),
        _USUAL,
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
    "narrow": _layout(
        "Matterport3D, narrow baselines",
        ("M3D 0.2 m", "M3D 0.5 m"),
        _USUAL,
        {
            "PanoGRF": (33.27, None, None, 30.46, None, None),
            "MVSplat (spherical)": (32.04, None, None, 30.58, None, None),
            "PanSplat": (32.88, None, None, 31.42, None, None),
            _RERUN: (32.880, 0.9587, 0.0661, 31.448, 0.9504, 0.0720),
        },
    ),
    "replica": _layout(
        "Replica",
        ("Replica 1.0 m",),
        _USUAL,
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
    "residential": _layout(
        "Residential",
        ("Residential 0.3 m",),
        _USUAL,
        {
            "S-NeRF": (22.47, 0.741, 0.435),
            "OmniSyn": _NONE3,
            "IBRNet": (22.47, 0.735, 0.498),
            "NeuRay": (22.38, 0.753, 0.427),
            "PanoGRF": (31.03, 0.909, 0.207),
            "MVSplat (spherical)": (31.21, 0.906, 0.200),
            "PanSplat": (30.97, 0.917, 0.172),
            _RERUN: (30.996, 0.9167, 0.1726),
        },
    ),
    "360loc": _layout(
        "360Loc",
        ("360Loc",),
        _ALL,
        {
            "MVSplat (spherical)": (24.13, 24.67, 0.823, 0.170),
            "PanSplat": (24.96, 25.58, 0.833, 0.159),
            "PanSplat + deferred blending": (27.35, 28.14, 0.860, 0.127),
        },
    ),
    "insta360": _layout(
        "Insta360",
        ("Insta360",),
        _ALL,
        {
            "MVSplat (spherical)": (20.93, 23.24, 0.786, 0.227),
            "PanSplat": (21.92, 24.43, 0.813, 0.211),
            "PanSplat + deferred blending": (23.36, 25.68, 0.822, 0.183),
        },
    ),
    "ablation": _layout(
        "Ablation on Matterport3D",
        ("M3D 1.0 m",),
        ("gaussians", *_USUAL),
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

DEPTH_LAYOUT = _layout(
    "Depth of the inputs, Matterport3D",
    ("M3D 1.0 m",),
    ("abs_rel", "sq_rel", "rmse"),
    {_RERUN: (0.01716, 0.00799, 0.1433)},
)


def rich_table(layout: Layout, ours: Sequence[TableRow], heads: Mapping[str, str] = HEADS) -> Table:
    """The table to print: the paper's rows, a line, ours in bold.

    Args:
        heads: what to call the metrics.
    """
    table = Table(title=layout.title)
    table.add_column("method")
    for index, (name, metric) in enumerate(layout.columns):
        above = name if index % len(layout.metrics) == 0 else ""
        table.add_column(f"{above}\n{heads[metric]}", justify="right")
    for row in layout.rows:
        table.add_row(row.method, *_cells(row, layout))
    table.add_section()
    for row in ours:
        table.add_row(row.method, *_cells(row, layout), style="bold")
    return table


def markdown_table(layout: Layout, ours: Sequence[TableRow], heads: Mapping[str, str] = HEADS) -> str:
    """The same as a Markdown table, ours in bold."""
    names = [f"{name} {heads[metric]}" for name, metric in layout.columns]
    lines = [f"### {layout.title}", "", f"| method | {' | '.join(names)} |", "|---" * (len(names) + 1) + "|"]
    for row in (*layout.rows, *ours):
        cells = [row.method, *_cells(row, layout)]
        if row in ours:
            cells = [f"**{cell}**" for cell in cells]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _cells(row: TableRow, layout: Layout) -> list[str]:
    """Formatted numbers; a dash where there is none."""
    cells = []
    for column in layout.columns:
        value = row.values.get(column)
        cells.append("-" if value is None else format(value, _FORMATS.get(column[1], ".3f")))
    return cells
