"""The backend for CUDA devices, in Triton. docs/triton.md tells how it works and what was checked."""

from pansplat.render.cuda.draw import draw as draw
