"""Compile the numba kernels of rasteriser, viewer and sweep into numba's cache: `python -m pansplat.cli.warm_up`.

setup.sh runs this once, so that later commands do not compile them. Kernels of PanSplat are compiled by the
first call that uses them.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import torch

from pansplat.inputs.views import Views
from pansplat.pipeline import predict
from pansplat.rendering.cpu.display import DisplayScene, PixelFaces, Selection, blend_to_pixels
from pansplat.rendering.cpu.tiling import radix_argsort
from pansplat.rendering.rasterize import rasterize


def main() -> None:
    """Predict, refine and draw a small scene of noise, and print the time."""
    start = time.perf_counter()
    images, masks = torch.rand(2, 3, 64, 128), torch.ones(2, 64, 128, dtype=torch.bool)
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[1, 0, 3] = 0.2
    views = Views(images, poses, masks, near=0.1, far=10.0, names=("left", "right"))
    gaussians = predict(views, "default", refine_steps=1, device="cpu").gaussians  # it has all kernels of "sweep"
    shiny = replace(gaussians, harmonics=torch.ones(len(gaussians), 4, 3, requires_grad=True))
    rasterize(shiny, poses[0], size=(16, 32), layout="cubemap", backend="numba").color.sum().backward()
    rasterize(gaussians, poses[0], size=(16, 32), eye_offset=0.03, backend="numba")
    fields = gaussians.means, gaussians.opacities, gaussians.quats, gaussians.scales, gaussians.harmonics
    scene = DisplayScene(*(field.numpy() for field in fields), np.ones(len(gaussians), np.float32))
    faces, pixels = PixelFaces.allocate(7.0), np.zeros((16, 16), np.uint32)
    labels, selection = gaussians.views.numpy().astype(np.int16), Selection(np.eye(3), 0.01)
    layers = scene.rasterize(np.zeros(3), faces.plane(0), labels, 2, 0.05, selection=selection)
    blend_to_pixels(layers.sums, np.full(2, 0.5), (0.0, 0.0, 0.0), pixels, bottom_up=True)
    faces.sample(np.eye(3), 20.0, pixels)
    radix_argsort(np.ones(9, np.float32))  # the viewer's order of Gaussians
    print(f"CPU kernels are compiled ({time.perf_counter() - start:.0f} s)")


if __name__ == "__main__":
    main()
