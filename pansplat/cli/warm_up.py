"""Compile the numba kernels of rasteriser, viewer and sweep into numba's cache: `python -m pansplat.cli.warm_up`.

setup.sh runs this once, so that later commands do not compile them. Kernels of PanSplat are compiled by the
first call that uses them.
"""

from __future__ import annotations

import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from typing import TYPE_CHECKING

# The processes that compile import torch and the kernels, this one does not: it would take three seconds.
if TYPE_CHECKING:
    from pansplat.gaussians.scene import Gaussians
    from pansplat.rendering.image_planes import Layout


def main() -> None:
    """Compile the kernels in two processes, and print the time."""
    start = time.perf_counter()
    with ProcessPoolExecutor(len(STEPS), get_context("spawn")) as pool:
        list(pool.map(compile_kernels, range(len(STEPS))))
    print(f"CPU kernels are compiled ({time.perf_counter() - start:.0f} s)")


def compile_kernels(group: int) -> None:
    """Compile the kernels of a group of `STEPS` in this process, without a message about it."""
    from pansplat.system.kernels import hide_message

    hide_message()
    for step in STEPS[group]:
        step()


def _rasterize(degree: int, layout: Layout) -> None:
    """Rasterise Gaussians with harmonics of a degree, forward and backward."""
    import torch

    from pansplat.rendering.rasterize import rasterize

    scene, pose = _make_gaussians(degree), torch.eye(4, dtype=torch.float64)
    rasterize(scene, pose, size=(16, 32), layout=layout, backend="numba").color.sum().backward()


def _rasterize_stereo() -> None:
    """Rasterise the panorama of one eye."""
    import torch

    from pansplat.rendering.rasterize import rasterize

    with torch.no_grad():
        rasterize(_make_gaussians(0), torch.eye(4), size=(16, 32), eye_offset=0.03, backend="numba")


def _make_gaussians(degree: int) -> Gaussians:
    import torch

    from pansplat.gaussians.scene import Gaussians

    return Gaussians(
        means=torch.rand(9, 3).requires_grad_(),
        scales=torch.full((9, 3), 0.1),
        quats=torch.ones(9, 4),
        opacities=torch.full((9,), 0.5),
        harmonics=torch.ones(9, (degree + 1) ** 2, 3),
        levels=torch.zeros(9, dtype=torch.int64),
        views=torch.zeros(9, dtype=torch.int64),
    )


def _draw_display_image() -> None:
    """Draw two layers and a view from cube faces as the viewer does without a GPU."""
    import numpy as np

    from pansplat.rendering.cpu.display import DisplayScene, PixelFaces, Selection, blend_to_pixels
    from pansplat.rendering.cpu.tiling import radix_argsort

    scene = DisplayScene(*(np.ones(shape, np.float32) for shape in ((9, 3), 9, (9, 4), (9, 3), (9, 1, 3), 9)))
    faces, pixels = PixelFaces.allocate(7.0), np.zeros((16, 16), np.uint32)
    labels = np.arange(9, dtype=np.int16) % 2
    selection = Selection(np.eye(3), 0.01)
    layers = scene.rasterize(np.zeros(3), faces.plane(0), labels, 2, 0.05, selection=selection)
    blend_to_pixels(layers.sums, np.full(2, 0.5), (0.0, 0.0, 0.0), faces.pixels[0])
    blend_to_pixels(layers.sums, np.full(2, 0.5), (0.0, 0.0, 0.0), pixels, bottom_up=True)
    faces.sample(np.eye(3), 20.0, pixels)
    radix_argsort(np.ones(9, np.float32))


def _predict() -> None:
    """Predict from two small panoramas of noise by "default", which uses all kernels of "sweep"."""
    import torch

    from pansplat.inputs.views import Views
    from pansplat.pipeline import predict

    images, masks = torch.rand(2, 3, 64, 128), torch.ones(2, 64, 128, dtype=torch.bool)
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[1, 0, 3] = 0.2
    predict(Views(images, poses, masks, near=0.1, far=10.0, names=("left", "right")), "default")


# Few kernels are in both; the first process that compiles one writes it to numba's cache for the other.
STEPS = (
    (_predict,),
    (
        partial(_rasterize, 0, "equirect"),
        partial(_rasterize, 1, "pinhole"),
        _rasterize_stereo,
        _draw_display_image,
    ),
)
"""Groups of calls that compile kernels, of the sweep and of rasteriser and viewer; each group has a process."""


if __name__ == "__main__":
    main()
