"""Rasterising Gaussians: one function for three backends, and deferred blending of the images of single views."""

from pansplat.geometry.pose import blend_weights
from pansplat.rendering.blend import blend
from pansplat.rendering.rasterize import Rendering, rasterize

__all__ = ["Rendering", "blend", "blend_weights", "rasterize"]
