"""What the Triton kernels read and write for each Gaussian: the order of the fields in their tables.

Source: docs/rendering.md, section 3. A picture's points have `axes` coordinates: three for the exact kernel
(directions), two for the classic one (pixels). Both kernels have as many linear forms.

A record is one row, everything that a tile needs:

    point       axes            the Gaussian's point, rounded to the rows' type
    remainder   axes            what rounding left, so that differences to a tile's centre keep their digits
    forms       axes x axes     a, b and, if exact, l
    along       1 if exact      S'
    peak        1
    values      channels + 1    colours, then the distance

A row of gradients holds, for one Gaussian in one tile, sums over the tile's pixels:

    moments     axes x axes     of the slope by each form's value times (pixel - point)
    slopes      axes            of the slope by each form's value
    along       1 if exact
    peak        1
    values      channels + 1
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.rendering.projection import Footprints

TILE = 16
"""Side of a tile, pixels."""


@dataclass(frozen=True)
class Layout:
    """Sizes of the tables' rows.

    Attributes:
        exact: whether the exact kernel draws, or the classic one.
        channels: colours, without the distance.
    """

    exact: bool
    channels: int

    @property
    def axes(self) -> int:
        """Coordinates of a point, and linear forms of a Gaussian."""
        return 3 if self.exact else 2

    @property
    def peak(self) -> int:
        """Where a record's peak stands: behind S', if there is one, and before the values."""
        return (2 + self.axes) * self.axes + int(self.exact)

    @property
    def record(self) -> int:
        """Numbers a record."""
        return self.peak + 1 + self.channels + 1

    @property
    def gradient(self) -> int:
        """Numbers a row of gradients."""
        return self.axes * (self.axes + 1) + int(self.exact) + 1 + self.channels + 1


def pack(splats: Footprints, layout: Layout) -> Float[Tensor, "n record"]:
    """Records of Gaussians, in the type of their forms."""
    dtype = splats.rows.dtype
    point = splats.point[:, : layout.axes].double()
    rounded = point.to(dtype)
    forms = splats.rows[:, : layout.axes, : layout.axes].flatten(1)
    along = [splats.along[:, None]] if layout.exact else []
    parts = (rounded, (point - rounded.double()).to(dtype), forms, *along, splats.peak[:, None], splats.values)
    return torch.cat(parts, dim=1).contiguous()


def unpack(gradient: Float[Tensor, "n gradient"], forms: Float[Tensor, "n 3 3"], layout: Layout) -> Footprints:
    """Gradients of Gaussians from their rows summed over tiles.

    Args:
        gradient: rows of gradients.
        forms: of the same Gaussians.
    """
    axes, channels = layout.axes, layout.channels
    moments, slopes, rest = gradient.split((axes * axes, axes, gradient.shape[1] - axes * (axes + 1)), dim=1)
    by_form = torch.zeros_like(forms)
    by_form[:, :axes, :axes] = moments.view(-1, axes, axes)
    by_point = -(slopes.double()[:, :, None] * forms[:, :axes].double()).sum(dim=1)
    along = rest[:, 0] if layout.exact else torch.zeros_like(rest[:, 0])
    return Footprints(by_point, by_form, along, rest[:, -channels - 2], rest[:, -channels - 1 :])
