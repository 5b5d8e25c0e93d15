"""What a person reads: tables of the rows, and how many times faster one renderer was than another."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table

from pansplat.bench.rows import Row
from pansplat.bench.tabulate import Column, number, page_table, terminal_table

_COLUMNS: tuple[Column, ...] = (
    *(("renderer", "left"), ("kernel", "left"), ("order", "left"), ("filter", "left"), ("layout", "left")),
    *(("height", "right"), ("Gaussians", "right"), ("threads", "right"), ("forward ms", "right"), ("CPU", "right")),
    *(("backward ms", "right"), ("CPU", "right"), ("peak MB", "right"), ("PSNR dB", "right"), ("max error", "right")),
    *(("seam", "right"), ("energy", "right"), ("own error", "right")),
)


def tables(rows: Sequence[Row]) -> list[Table]:
    """One table a suite and scene, in the order they were measured; sweeps take one table for all their scenes."""
    return [terminal_table(_COLUMNS, map(cells, own), title) for title, own in _sections(rows).items()]


def markdown(rows: Sequence[Row]) -> str:
    """The same tables, and the findings, as a page's text."""
    parts = ["\n".join(f"* {sentence}" for sentence in findings(rows))]
    for title, own in _sections(rows).items():
        parts.append(f"### {title[0].upper()}{title[1:]}\n\n{page_table(_COLUMNS, map(cells, own))}")
    return "\n\n".join(part for part in parts if part) + "\n"


def _sections(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """The rows of each table, by its title."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        title = row.suite if row.suite in ("count", "resolution") else f"{row.suite}: {row.scene}"
        found.setdefault(title, []).append(row)
    return found


def cells(row: Row) -> tuple[str, ...]:
    """A row's cells; what was not measured is blank."""
    faces = f" {row.face_size}" if row.face_size else ""
    return (
        row.backend if row.precision == "float32" else f"{row.backend} {row.precision}",
        row.kernel,
        row.order,
        row.filter,
        f"{row.layout}{faces}{' official' if row.stitching == 'official' else ''}",
        str(row.height),
        f"{row.num_gaussians:,}",
        str(row.threads),
        _time(row.forward_ms, row.forward_spread_ms),
        _time(row.forward_cpu_ms, None),
        _time(row.backward_ms, row.backward_spread_ms),
        _time(row.backward_cpu_ms, None),
        number(row.peak_mb, "{:,.0f}"),
        _decibels(row),
        number(row.max_error, "{:.1e}"),
        number(row.seam_jump, "{:.1e}"),
        number(row.energy_error, "{:+.2%}"),
        number(row.own_max_error, "{:.1e}"),
    )


def _decibels(row: Row) -> str:
    if row.max_error == 0:
        return "exact"
    return number(row.psnr_db, "{:.1f}")


def _time(middle: float | None, spread: float | None) -> str:
    if middle is None:
        return ""
    digits = 0 if middle >= 100 else 1 if middle >= 10 else 2
    return f"{middle:,.{digits}f}" + (f" ±{spread / 2:.{digits}f}" if spread else "")


def findings(rows: Sequence[Row]) -> list[str]:
    """The headlines as sentences: speed against the peers in the same run, and the distance to the machine's peaks."""
    return [*_against_torch(rows), *_against_dense(rows), *_to_the_peaks(rows)]


def _direct(rows: Sequence[Row], suite: str, backend: str) -> list[Row]:
    """Timed float32 rows of the exact direct panorama, with fewest threads first."""
    chosen = [
        row
        for row in rows
        if (row.suite, row.backend, row.layout, row.filter) == (suite, backend, "equirect", "angular")
        and row.precision == "float32"
        and row.forward_ms is not None
    ]
    return sorted(chosen, key=lambda row: row.threads)


def _against_torch(rows: Sequence[Row]) -> list[str]:
    told = []
    for torch_row in _direct(rows, "headline", "torch")[:1]:
        for row in (*_direct(rows, "headline", "numba"), *_direct(rows, "headline", "triton")):
            told.append(
                f"{row.backend} on {_threads(row.threads)} is {_ratio(torch_row, row)} as fast as the binned torch "
                f"reference on one, {row.height}x{2 * row.height}, {row.num_gaussians:,} Gaussians."
            )
    return told


def _against_dense(rows: Sequence[Row]) -> list[str]:
    """At the size that the dense renderer can bear, and scaled by pixels times Gaussians to the headline's."""
    told = []
    for dense in _direct(rows, "dense", "dense")[:1]:
        for row in (*_direct(rows, "dense", "torch")[:1], *_direct(rows, "dense", "numba")[:1]):
            told.append(
                f"{row.backend} on one thread is {_ratio(dense, row)} as fast as the dense renderer, "
                f"{row.height}x{2 * row.height}, {row.num_gaussians:,} Gaussians."
            )
        for row in _direct(rows, "headline", "numba")[:1]:
            scale = (row.height / dense.height) ** 2 * row.num_gaussians / dense.num_gaussians
            assert dense.forward_ms is not None and row.forward_ms is not None
            told.append(
                f"Scaled by pixels times Gaussians (not measured), the dense renderer would take "
                f"{dense.forward_ms * scale / 1e3:,.0f} s forward at {row.height}x{2 * row.height}, "
                f"{dense.forward_ms * scale / row.forward_ms:,.0f} times numba's time."
            )
    return told


def _to_the_peaks(rows: Sequence[Row]) -> list[str]:
    """Distances to the peaks; by processor time, so that a busy machine does not make a renderer look lazy."""
    told = []
    for row in _direct(rows, "headline", "numba"):
        if row.fma_fraction is None or row.bandwidth_fraction is None or row.forward_cpu_ms is None:
            continue
        text = f"numba on {_threads(row.threads)} reaches {row.fma_fraction:.0%} of the multiply-add peak forward"
        if row.stages_ms.get("raster"):
            share = row.forward_cpu_ms / row.threads / row.stages_ms["raster"]
            text += f" ({row.fma_fraction * share:.0%} while it rasters)"
        if row.backward_fma_fraction is not None:
            text += f", {row.backward_fma_fraction:.0%} backward"
        told.append(f"{text}, and {row.bandwidth_fraction:.0%} of the memory bandwidth forward.")
    return told


def _ratio(slow: Row, fast: Row) -> str:
    """How many times faster, on the clock and by processor time."""
    text = [f"{_quotient(slow.forward_ms, fast.forward_ms)} times"]
    if slow.backward_ms and fast.backward_ms:
        text.append(f"(backward {_quotient(slow.backward_ms, fast.backward_ms)} times)")
    if slow.forward_cpu_ms and fast.forward_cpu_ms and slow.threads == fast.threads:
        cpu = _quotient(slow.forward_cpu_ms, fast.forward_cpu_ms)
        if slow.backward_cpu_ms and fast.backward_cpu_ms:
            cpu += f" and {_quotient(slow.backward_cpu_ms, fast.backward_cpu_ms)}"
        text.append(f"[by processor time {cpu}]")
    return " ".join(text)


def _quotient(slow: float | None, fast: float | None) -> str:
    assert slow is not None and fast
    return f"{slow / fast:,.0f}"


def _threads(count: int) -> str:
    return "one thread" if count == 1 else f"{count} threads"
