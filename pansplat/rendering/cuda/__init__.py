"""The backend for CUDA devices, in Triton. docs/triton.md tells how it works and what was checked."""

from pansplat.rendering.cuda.draw import rasterize_planes as rasterize_planes
