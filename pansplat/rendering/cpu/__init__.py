"""The rasteriser on the processor: numba kernels with explicit vectors, no compiler needed, differentiable.

Source: docs/rendering.md; docs/rasterizer.md tells how it works.
"""

from pansplat.rendering.cpu.backend import rasterize_planes

__all__ = ["rasterize_planes"]
