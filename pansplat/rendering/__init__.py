"""Drawing Gaussians: the differentiable reference rasteriser, and blending of its pictures."""

from pansplat.geometry.pose import blend_weights
from pansplat.rendering.blend import blend
from pansplat.rendering.rasterize import Rendering, rasterize

__all__ = ["Rendering", "blend", "blend_weights", "rasterize"]
