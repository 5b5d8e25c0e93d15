"""One measured way to draw one picture, and the file that keeps all of them."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass, field
from pathlib import Path

from pansplat.atomic import replacing


@dataclass
class Row:
    """What one renderer took for one picture, and how far it is from the truth.

    The errors are those of the colours against the exact picture: kernel "ray", order "radial", filter "angular",
    one ray a panorama's pixel, float64. Those that begin with `own` are against the float64 picture of the row's own
    kernel, order, filter, layout and faces: what is left is the backend's. None is what was not measured.

    Attributes:
        suite: the question the row is part of: "choices", "headline", "dense", "count", "resolution", "threads".
        scene: name of the scene.
        backend: "torch", "numba", "triton", "dense", "gsplat", or "gl33" and "gl43" for the viewer.
        kernel, order, filter, layout: as `pansplat.rasterize` has them (`lowpass` for the filter).
        height: of the picture, pixels.
        face_size: of the cube faces, pixels; None where there are none.
        stitching: of the cube faces.
        precision: "float32" or "float64".
        num_gaussians: in the scene.
        threads: that the backend may use.
        forward_ms, forward_min_ms: median and least, without gradients.
        forward_spread_ms: range between the quartiles.
        backward_ms, backward_min_ms, backward_spread_ms: of the backward pass alone, to all fields of the Gaussians.
        forward_cpu_ms, backward_cpu_ms: least processor time, of all threads together.
        repeats: how many times were taken.
        peak_mb: 10^6 bytes at most over what the process held before, forward without gradients.
        backward_peak_mb: likewise, of forward and backward together.
        psnr_db, max_error, seam_jump, energy_error: see `fidelity.Fidelity`.
        stages_ms: by the backend's own clock, of the fastest forward pass.
        pairs: pixel centres in the Gaussians' boxes (see `work`).
        fma_fraction, backward_fma_fraction: that arithmetic over the processor time, of one thread's peak.
        bandwidth_fraction: the least traffic over the least time, of the peak on as many threads.
        note: what else the reader should know.
    """

    suite: str
    scene: str
    backend: str
    kernel: str
    order: str
    filter: str
    layout: str
    height: int
    face_size: int | None
    stitching: str
    precision: str
    num_gaussians: int
    threads: int
    forward_ms: float | None = None
    forward_min_ms: float | None = None
    forward_spread_ms: float | None = None
    forward_cpu_ms: float | None = None
    backward_ms: float | None = None
    backward_min_ms: float | None = None
    backward_spread_ms: float | None = None
    backward_cpu_ms: float | None = None
    repeats: int = 0
    peak_mb: float | None = None
    backward_peak_mb: float | None = None
    psnr_db: float | None = None
    max_error: float | None = None
    seam_jump: float | None = None
    energy_error: float | None = None
    own_psnr_db: float | None = None
    own_max_error: float | None = None
    stages_ms: dict[str, float] = field(default_factory=dict)
    pairs: int | None = None
    fma_fraction: float | None = None
    backward_fma_fraction: float | None = None
    bandwidth_fraction: float | None = None
    note: str = ""

    def as_json(self) -> dict[str, object]:
        """The fields; numbers to six digits, those that are not finite as null."""
        values = dataclasses.asdict(self)
        values["stages_ms"] = {name: _number(value) for name, value in self.stages_ms.items()}
        return {name: _number(value) if isinstance(value, float) else value for name, value in values.items()}


def _number(value: float) -> float | None:
    return float(f"{value:.6g}") if math.isfinite(value) else None


def write_rows(path: Path, machine: dict[str, object], rows: list[Row]) -> None:
    """Write {machine, rows} as JSON; the file is whole at any moment.

    Raises:
        InputError: the file cannot be written.
    """
    text = json.dumps({"machine": machine, "rows": [row.as_json() for row in rows]}, indent=1, allow_nan=False)
    with replacing(path) as partial:
        partial.write_text(text + "\n")
