"""What every backend of the rasteriser is given, and what it gives back.

Source: docs/rendering.md; docs/adr/0005 gives the reasons.
"""

from dataclasses import dataclass, field
from typing import Literal, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from pansplat.constants import FILTER_VARIANCE
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering.panorama import Picture

Kernel = Literal["ray", "ewa"]
Order = Literal["radial", "z"]
Lowpass = Literal["angular", "3dgs"]


@dataclass(frozen=True)
class Options:
    """What to draw: all that changes the mathematics of a picture.

    Attributes:
        kernel: "ray" is exact; "ewa" is the classic approximation, on pinhole pictures only.
        order: by distance, or by each picture's depth.
        lowpass: "angular" conserves energy; "3dgs" widens by 0.3 pixel^2.
        near: Gaussians whose mean is nearer are left out, metres.
        strict: refuse Gaussians that are not finite rather than leave them out.
    """

    kernel: Kernel
    order: Order
    lowpass: Lowpass
    near: float
    strict: bool

    def spread(self, pixel_angle: float) -> float:
        """e^2 of docs/rendering.md: the variance added across the ray, radians^2."""
        return FILTER_VARIANCE[self.lowpass] * pixel_angle**2 if self._widens else 0.0

    @property
    def dilation(self) -> float:
        """Variance added to the projected covariance, pixels^2."""
        return 0.0 if self._widens else FILTER_VARIANCE[self.lowpass]

    @property
    def _widens(self) -> bool:
        return self.lowpass == "angular" or self.kernel == "ray"


@dataclass(frozen=True)
class Info:
    """How many Gaussians took part in a picture, and what it cost.

    Attributes:
        total: given.
        dropped: left out because a number was not finite or absurdly large, or a covariance not positive.
        near: left out because they are nearer than `near`.
        visible: could reach the alpha cut somewhere in the picture (the sum over faces for a cubemap).
        entries: pairs of a Gaussian and a tile.
        backend: who drew it.
        bytes: working memory at its largest, where the backend counts it.
        seconds: time spent in each stage, where the backend measures it.
    """

    total: int
    dropped: int
    near: int
    visible: int
    entries: int
    backend: str = "torch"
    bytes: int = 0
    seconds: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Drawn:
    """Pictures before background and normalisation.

    Attributes:
        sums: sums along each pixel's ray of weight x (channels, radial distance, 1).
        info: counts over all the pictures.
    """

    sums: Float[Tensor, "picture sums height width"]
    info: Info


@runtime_checkable
class Draw(Protocol):
    """A backend: Gaussians and a pose in, sums of every picture out.

    Differentiable in all floating fields, in `covariances` and in the pose.
    """

    def __call__(
        self,
        gaussians: Gaussians,
        covariances: Float[Tensor, "n 3 3"] | None,
        pose: Float[Tensor, "4 4"],
        pictures: list[Picture],
        options: Options,
    ) -> Drawn:
        """Draw.

        Args:
            gaussians: float32 or float64.
            covariances: world covariances in place of scales and rotations, square metres.
            pose: cam2world, float64, checked to be rigid.
            pictures: all of one size and focal length.
            options: see there.

        Raises:
            InputError: `options.strict`, and a Gaussian is not finite.
        """
        ...
