"""Compile every kernel for GPUs, which need not be present, and print one JSON line for each.

Run: python .ci/tools/compile_for_gpu.py [COMPUTE_CAPABILITY ...]   (by default 80 90)
TRITON_INTERPRET must not be set. NVIDIA's assembler, which Triton includes, reports registers and spills.
"""

import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import triton
from triton import knobs
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from pansplat.rendering.cuda.projection import project_kernel
from pansplat.rendering.cuda.projection_backward import backpropagate_projection_kernel
from pansplat.rendering.cuda.rasterize import (
    RecordLayout,
    num_warps,
    rasterize_backward_kernel,
    rasterize_kernel,
    sum_gradients_kernel,
)
from pansplat.rendering.cuda.tiling import intersect_kernel

_FLOATS = ("means", "opacities", "harmonics", "quats", "scales", "peaks", "values", "rows")
_FLOATS += ("radial_variances", "records", "centres", "offsets", "sums", "grad_sums", "gradients", "totals")
_INTEGERS = ("record_ids", "slots", "starts", "stops", "tile_order", "instances", "ranges")
_FLOATS += ("grad_world_directions", "grad_peaks", "grad_rows", "grad_radial_variances")
_FLOATS += ("grad_means", "grad_opacities", "grad_quats", "grad_scales")
_DOUBLES = ("camera", "directions", "radii", "covariances", "grad_directions", "grad_radii")
_DOUBLES += ("grad_covariances", "grad_camera")
_TYPES = {"ends": "*i64", "tiles": "i32", **dict.fromkeys(_DOUBLES, "*fp64")}
_SIZES = ("TINY", "AXES", "CHANNELS", "RECORD", "PEAK", "GRADIENT", "FIELDS", "GROUP", "AT_ONCE")
_SIZES += ("DEGREE", "EXACT", "BLOCK")


def _type(kernel, name: str) -> str:
    if kernel is intersect_kernel and name in ("records", "tiles"):
        return {"records": "*i32", "tiles": "*i16"}[name]
    if name in _SIZES:
        return "constexpr"
    return _TYPES.get(name) or ("*fp32" if name in _FLOATS else "*i32" if name in _INTEGERS else "i32")


def _report(label: str, kernel, warps: int, capability: int, **sizes) -> None:
    signature = {name: _type(kernel, name) for name in kernel.arg_names}
    sizes = {name: value for name, value in sizes.items() if name in signature}
    compiled = triton.compile(
        ASTSource(kernel, signature, sizes), target=GPUTarget("cuda", capability, 32), options={"num_warps": warps}
    )
    with tempfile.TemporaryDirectory() as folder:
        binary = Path(folder) / "kernel.cubin"
        binary.write_bytes(compiled.asm["cubin"])
        usage = subprocess.run(
            [knobs.nvidia.cuobjdump.path, "-res-usage", str(binary)], capture_output=True, text=True, check=True
        ).stdout
    numbers = {name: int(re.search(name + r":(\d+)", usage)[1]) for name in ("REG", "STACK", "LOCAL", "SHARED")}
    atomics = len(re.findall(r"\b(?:atom|red)\.", compiled.asm["ptx"]))
    print(json.dumps(dict(kernel=label, capability=capability, warps=warps, atomics=atomics, **numbers)))


def main() -> None:
    for capability in [int(text) for text in sys.argv[1:]] or [80, 90]:
        for exact in (True, False):
            for channels in (3, 8) if exact else (3,):
                layout = RecordLayout(exact, channels)
                sizes = dict(
                    TINY=3.5e-4, AXES=layout.axes, CHANNELS=channels, RECORD=layout.record_size,
                    PEAK=layout.peak_column,
                    GRADIENT=layout.gradient_size, FIELDS=triton.next_power_of_2(layout.gradient_size),
                )  # fmt: skip
                name = f"{'ray' if exact else 'ewa'}, {channels} channels"
                _report(f"forward {name}", rasterize_kernel, num_warps(layout, 2), capability, **sizes)
                _report(f"backward {name}", rasterize_backward_kernel, num_warps(layout, 1), capability, **sizes)
        for group, at_once in ((16, 1), (1, 16)):
            sizes = dict(GRADIENT=18, FIELDS=32, GROUP=group, AT_ONCE=at_once)
            _report(f"sum {group} x {at_once}", sum_gradients_kernel, 2, capability, **sizes)
        sizes = dict(DEGREE=4, CHANNELS=3, EXACT=True, BLOCK=128)
        _report("project, degree 4", project_kernel, 4, capability, **sizes)
        sizes |= dict(BLOCK=64)
        _report("project backward", backpropagate_projection_kernel, 2, capability, **sizes)
        _report("intersect", intersect_kernel, 4, capability)


if __name__ == "__main__":
    main()
