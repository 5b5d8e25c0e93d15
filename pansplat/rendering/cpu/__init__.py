"""The rasteriser on a CPU: differentiable numba kernels with explicit SIMD vectors.

Source: docs/rendering.md; docs/rasterizer.md describes the stages.
"""

from pansplat.rendering.cpu.backend import rasterize_planes

__all__ = ["rasterize_planes"]
