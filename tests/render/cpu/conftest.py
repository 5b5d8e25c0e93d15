"""Scenes as the numba stages take them, and what the float64 reference sees of them."""

import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch
from torch import Tensor

from pansplat.gaussians.gaussians import Gaussians
from pansplat.render import splats
from pansplat.render.cpu.memory import Lease
from pansplat.render.cpu.observe import Camera, Fields, Observed, observe
from pansplat.render.cpu.records import ALONG, DIRECTION, FIRST, FRONT_A, FRONT_B, LEVEL, REST, SECOND, UNIT

SPREAD = 0.1 * (math.pi / 64) ** 2


def _fields(scene: Gaussians, covariances: Tensor | None = None) -> Fields:
    scene, nothing = scene.to(dtype=torch.float32), np.empty
    if covariances is None:
        shape = scene.quats.numpy(), scene.scales.numpy(), nothing((0, 3, 3), np.float32)
    else:
        shape = nothing((0, 4), np.float32), nothing((0, 3), np.float32), covariances.float().numpy()
    return Fields(scene.means.numpy(), *shape, scene.opacities.numpy(), scene.harmonics.numpy())


@pytest.fixture
def fields() -> Callable[..., Fields]:
    """A scene as float32 arrays."""
    return _fields


@pytest.fixture
def lease() -> Iterator[Lease]:
    """Memory for one test."""
    lease = Lease()
    yield lease
    del lease


@pytest.fixture
def seen(lease: Lease, pose: Tensor) -> Callable[..., Observed]:
    """What the numba stage sees of a scene."""

    def see(scene: Gaussians, covariances: Tensor | None = None, *, threads: int = 1, near: float = 0.05) -> Observed:
        return observe(_fields(scene, covariances), Camera(pose.numpy(), SPREAD, True, near), lease, threads)

    return see


@pytest.fixture
def truth(pose: Tensor) -> Callable[..., splats.Observed]:
    """What the float64 reference sees of the same float32 numbers."""

    def see(scene: Gaussians, covariances: Tensor | None = None) -> splats.Observed:
        covariances = None if covariances is None else covariances.float().double()
        scene = scene.to(dtype=torch.float32).to(dtype=torch.float64)
        return splats.observe(scene, covariances, pose, spread=SPREAD, compensate=True, exact=True)

    return see


def _decode(records: Tensor) -> dict[str, Tensor]:
    """The quantities of docs/rendering.md in records, those that do not depend on the choice of a and b."""
    direction = records[:, DIRECTION:REST] + records[:, REST:FIRST]
    first, second = records[:, FIRST:SECOND], records[:, SECOND:FRONT_A]
    front = direction + records[:, FRONT_A, None] * first + records[:, FRONT_B, None] * second
    across = first[:, :, None] * first[:, None, :] + second[:, :, None] * second[:, None, :]
    return {
        "direction": direction,
        "across": across / UNIT,
        "front": front,
        "along": records[:, ALONG] * UNIT,
        "peak": 2 ** records[:, LEVEL],
    }


@pytest.fixture
def decode() -> Callable[[Tensor], dict[str, Tensor]]:
    """What records hold, free of the choice of axes."""
    return _decode
