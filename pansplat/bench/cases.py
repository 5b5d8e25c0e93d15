"""What is measured: ways to draw, gathered in groups that answer one question on one scene."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from pansplat.gaussians.scene import Gaussians
from pansplat.rendering.image_planes import Layout, Stitching
from pansplat.rendering.official import OFFICIAL, official_face_size
from pansplat.rendering.rasterize import Kernel, Lowpass, Order

Precision = Literal["float32", "float64"]


@dataclass(frozen=True)
class Case:
    """A way to draw a picture.

    Attributes:
        backend: as in `Row`.
        height: pixels; a panorama is twice as wide, a pinhole picture square with a view of 90 degrees.
        face_size: of a cubemap, pixels.
        stitching: of a cubemap.
        threads: that may be used.
        backward: whether the backward pass is timed as well.
    """

    backend: str
    height: int
    kernel: Kernel = "ray"
    order: Order = "radial"
    filter: Lowpass = "angular"
    layout: Layout = "equirect"
    face_size: int | None = None
    stitching: Stitching = "seamless"
    precision: Precision = "float32"
    threads: int = 1
    backward: bool = True

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the picture."""
        return self.height, self.height if self.layout == "pinhole" else 2 * self.height

    @property
    def possible(self) -> bool:
        """Whether the backend draws such a picture: peers draw one kind only."""
        if self.backend == "gsplat":
            return (self.layout, self.kernel, self.order) == ("cubemap", "ewa", "z")
        if self.backend == "dense":
            return self.exact == self.truth
        return True

    @property
    def truth(self) -> Case:
        """The same picture by the float64 reference."""
        return replace(self, backend="torch", precision="float64", threads=1, backward=False)

    @property
    def exact(self) -> Case:
        """The exact picture that all of this layout are compared with."""
        layout = "pinhole" if self.layout == "pinhole" else "equirect"
        return replace(
            self.truth,
            kernel="ray",
            order="radial",
            filter="angular",
            layout=layout,
            face_size=None,
            stitching="seamless",
        )


@dataclass(frozen=True, eq=False)
class Subject:
    """A scene and a place to stand in it.

    Attributes:
        load: makes or reads the Gaussians, float32, when they are needed.
    """

    name: str
    load: Callable[[], Gaussians]
    pose: Float[Tensor, "4 4"]


@dataclass(frozen=True, eq=False)
class Group:
    """Cases that are drawn in turn, so that whatever else the machine does meets them all.

    Attributes:
        suite: the question, as in `Row`.
        truths: what they are compared with: the exact picture and a float64 one of their own choices, the exact one
            alone, or nothing.
    """

    suite: str
    subject: Subject
    cases: tuple[Case, ...]
    truths: Literal["own", "exact", "none"]


def default_face_size(height: int) -> int:
    """As fine in a face's centre as the panorama's equator."""
    return max(1, round(2 * height / math.pi))


def choices(backend: str, height: int, face_sizes: tuple[int, ...], threads: int) -> list[Case]:
    """Every kernel, order and filter on every layout that has them; a panorama has one order."""
    filters: tuple[Lowpass, ...] = ("angular", "3dgs")
    orders: tuple[Order, ...] = ("radial", "z")
    kernels: tuple[Kernel, ...] = ("ray", "ewa")
    direct = [Case(backend, height, filter=lowpass, threads=threads) for lowpass in filters]
    faces = [
        Case(backend, height, kernel, order, lowpass, "cubemap", face_size, threads=threads)
        for face_size, kernel, order, lowpass in itertools.product(face_sizes, kernels, orders, filters)
    ]
    views = [Case(backend, height, kernel=kernel, layout="pinhole", threads=threads) for kernel in kernels]
    return direct + faces + views


def official(backend: str, height: int, threads: int) -> Case:
    """The published code's options (`OFFICIAL`) on faces of half the height."""
    o, face_size = OFFICIAL, official_face_size(height)
    stitching = "seamless" if height % 4 else o.stitching
    return Case(backend, height, o.kernel, o.order, o.lowpass, "cubemap", face_size, stitching, threads=threads)
