"""The backend for CUDA devices, in Triton; docs/triton.md describes it and how it was tested."""

from pansplat.rendering.cuda.backend import rasterize_planes as rasterize_planes
