"""A small scene with two views whose every setting shows, and a context to draw it on."""

from collections.abc import Iterator

import moderngl
import numpy as np
import pytest
import torch

from pansplat.gaussians.scene import Gaussians, Scene

_Y0 = 0.28209479177387814  # the constant harmonic


@pytest.fixture(scope="session")
def small_scene() -> Scene:
    """1200 Gaussians, large and tiny, around two cameras 0.5 m apart along +z; the views differ in colour."""
    random = torch.Generator().manual_seed(3)
    count, parts = 600, []
    for view in range(2):
        directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=random), dim=-1)
        radii = 2 + 2 * torch.rand(count, 1, generator=random)
        color = 0.5 + 0.4 * directions
        color[:, view] *= 0.3
        parts.append(
            Gaussians(
                means=directions * radii + torch.tensor((0, 0, 0.5 * view)),
                scales=torch.tensor((0.5, 0.3, 0.1)) * torch.where(torch.arange(count) % 2 > 0, 1, 0.02)[:, None],
                quats=torch.randn(count, 4, generator=random),
                opacities=torch.rand(count, generator=random),
                harmonics=((color - 0.5) / _Y0)[:, None, :],
                levels=torch.randint(0, 4, (count,), generator=random),
                views=torch.full((count,), view),
            )
        )
    cam2world = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    cam2world[1, 2, 3] = 0.5
    return Scene(Gaussians.cat(parts), cam2world, 0.45, 10.0, ("a.png", "b.png"), "synthetic", 64)


@pytest.fixture(scope="session")
def axis_photos() -> np.ndarray:
    """Two panoramas coloured by direction: red to the right, green up, blue ahead; the second is dim."""
    from pansplat.geometry.equirect import pixel_directions

    directions = pixel_directions(128, 256).numpy()
    image = 0.5 + 0.5 * directions * np.array((1, -1, 1), dtype=np.float32)
    return np.stack((image, 0.3 * image)).astype(np.float32)


@pytest.fixture(scope="module")
def ctx() -> Iterator[moderngl.Context]:
    """A standalone OpenGL context that must have seen no error when it goes."""
    from pansplat_viewer.offscreen import create_context

    context = create_context()
    yield context
    assert context.error == "GL_NO_ERROR"
    context.release()
