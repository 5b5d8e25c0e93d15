"""A scene as one camera sees it, and the times of a call."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from torch import Tensor

from pansplat.constants import FILTER_VARIANCE
from pansplat.rendering.cpu.projection import Camera, GaussianArrays, ProjectedGaussians
from pansplat.rendering.cpu.rasterize import MIN_TRANSMITTANCE
from pansplat.rendering.image_planes import ImagePlane


class CameraView(NamedTuple):
    """A scene, and its projection for one camera.

    Attributes:
        min_transmittance: a pixel is finished at this transmittance or below.
    """

    gaussians: GaussianArrays
    camera: Camera
    projected: ProjectedGaussians
    threads: int
    min_transmittance: float = MIN_TRANSMITTANCE


def make_camera(pose: Tensor, plane: ImagePlane, near: float) -> Camera:
    """The camera of a pose (cam2world), and the settings that depend on the size of the image plane's pixels."""
    return Camera(np.ascontiguousarray(pose.detach().numpy()), FILTER_VARIANCE * plane.pixel_angle**2, near)


@dataclass
class Statistics:
    """The number of Gaussians that reach an image, and seconds by stage."""

    visible: int = 0
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the time of the `with` block to a stage."""
        start = time.perf_counter()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start
