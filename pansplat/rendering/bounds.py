"""Where a Gaussian can be seen: exact boxes on pinhole pictures, tight conservative ones on panoramas.

Source: docs/rendering.md, section 5. All of it is float64 and without gradient.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.constants import ALPHA_CUT, KAPPA_MARGIN

_EVERYTHING = 1e9  # pixels, far outside any picture


def kappa(peak: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    """Largest q at which alpha still reaches the cut; negative where it never does. Rounded up a little."""
    return 2 * torch.log(peak.double().clamp_min(1e-30) / ALPHA_CUT) + KAPPA_MARGIN


def pinhole_boxes(
    direction: Float[Tensor, "n 3"],
    covariance: Float[Tensor, "n 3 3"],
    level: Float[Tensor, "n"],
    size: tuple[int, int],
    focal: float,
) -> Float[Tensor, "n 4"]:
    """Boxes (left, right, top, bottom; pixels) of the exact kernel on a pinhole picture.

    Left > right where a Gaussian is not seen.

    Args:
        direction, covariance: in the picture's camera axes.
        level: kappa.
        size: height and width, pixels.
        focal: pixels.
    """
    height, width = size
    n_z = direction[:, 2]
    d_zz = n_z.square() - level * covariance[:, 2, 2]
    crosses = d_zz <= 0  # the plane through the eye: no bound
    safe = torch.where(crosses, torch.ones_like(d_zz), d_zz)
    edges = []
    for axis, extent in ((0, width), (1, height)):
        n_x = direction[:, axis]
        c_xx, c_xz, c_zz = covariance[:, axis, axis], covariance[:, axis, 2], covariance[:, 2, 2]
        across = n_z.square() * c_xx + n_x.square() * c_zz - 2 * n_x * n_z * c_xz
        root = torch.sqrt((level * across + level.square() * (c_xz.square() - c_xx * c_zz)).clamp_min(0))
        middle = n_x * n_z - level * c_xz
        for sign in (-1, 1):
            edge = focal * (middle + sign * root) / safe + 0.5 * extent
            edges.append(torch.where(crosses, torch.full_like(edge, sign * _EVERYTHING), edge))
    unseen = (level < 0) | (~crosses & (n_z < 0))
    # Those that cross the plane through the eye have no box, but most of them lie beside the view.
    for normal in _inward(size, focal, direction):
        distance = direction @ normal
        clear = distance.square() > level * (covariance @ normal @ normal)
        unseen |= clear & (distance < 0)
    return _hide(torch.stack(edges, dim=1), unseen)


def _inward(size: tuple[int, int], focal: float, like: Tensor) -> Float[Tensor, "4 3"]:
    """Normals, into the view, of the planes through the eye and the picture's four sides."""
    across, down = size[1] / (2 * focal), size[0] / (2 * focal)
    normals = ((1, 0, across), (-1, 0, across), (0, 1, down), (0, -1, down))
    return torch.tensor(normals, dtype=like.dtype, device=like.device)


def ewa_boxes(
    point: Float[Tensor, "n 3"], variances: Float[Tensor, "n 2"], level: Float[Tensor, "n"]
) -> Float[Tensor, "n 4"]:
    """Boxes of the classic kernel (left, right, top, bottom; pixels)."""
    reach = torch.sqrt(level.clamp_min(0)[:, None] * variances)
    low, high = point[:, :2] - reach, point[:, :2] + reach
    return _hide(torch.stack((low[:, 0], high[:, 0], low[:, 1], high[:, 1]), dim=1), level < 0)


def equirect_boxes(
    direction: Float[Tensor, "n 3"],
    covariance: Float[Tensor, "n 3 3"],
    level: Float[Tensor, "n"],
    size: tuple[int, int],
) -> Float[Tensor, "n 4"]:
    """Boxes of the exact kernel on a panorama, pixels.

    Left may be negative and right beyond the width: they wrap.
    """
    height, width = size
    x, y, z = direction.unbind(1)
    level = level[:, None]
    flat = torch.hypot(x, z)
    on_axis = flat < 1e-12
    ahead_x = torch.where(on_axis, torch.zeros_like(x), x / flat.clamp_min(1e-12))
    ahead_z = torch.where(on_axis, torch.ones_like(z), z / flat.clamp_min(1e-12))
    zero = torch.zeros_like(x)
    ahead = torch.stack((ahead_x, zero, ahead_z), dim=1)
    east = torch.stack((ahead_z, zero, -ahead_x), dim=1)
    south = torch.stack((-y * ahead_x, flat, -y * ahead_z), dim=1)

    def form(p: Tensor, q: Tensor) -> Tensor:
        return ((p[:, None, :] @ covariance)[:, 0, :] * q).sum(dim=1, keepdim=True) * level

    # Longitude, from the mean's: tangents of the shadow on the horizontal plane.
    d_ff = flat[:, None].square() - form(ahead, ahead)
    slopes = _tangents(form(east, ahead), form(east, east), d_ff)
    longitude = torch.atan2(x, z)[:, None]
    columns = ((longitude + torch.atan(slopes)) / (2 * math.pi) + 0.5) * width
    around = torch.tensor((-_EVERYTHING, _EVERYTHING), dtype=columns.dtype, device=columns.device)
    columns = torch.where(d_ff <= 0, around, columns)

    # Latitude: a box around the ellipse in the plane that touches the sphere at the mean's direction.
    d_nn = 1 - form(direction, direction)
    sides = _tangents(form(east, direction), form(east, east), d_nn).abs().amax(dim=1)
    ends = _tangents(form(south, direction), form(south, south), d_nn)
    bottom = torch.asin(_highest_sine(y, flat, ends, sides))
    top = -torch.asin(_highest_sine(-y, flat, -ends.flip(1), sides))
    rows = (torch.stack((top, bottom), dim=1) / math.pi + 0.5) * height
    rows = torch.where(d_nn <= 0, around, rows)
    columns = torch.where(d_nn <= 0, around, columns)
    return _hide(torch.cat((columns, rows), dim=1), level[:, 0] < 0)


def _tangents(mixed: Tensor, side: Tensor, ahead: Tensor) -> Float[Tensor, "n 2"]:
    """Lower and upper slope of a cone with dual entries -mixed, -side, ahead > 0 (else 1 stands in)."""
    ahead = torch.where(ahead > 0, ahead, torch.ones_like(ahead))
    root = torch.sqrt((mixed.square() + side * ahead).clamp_min(0))
    return torch.cat((-mixed - root, -mixed + root), dim=1) / ahead


def _highest_sine(
    sine: Float[Tensor, "n"],
    cosine: Float[Tensor, "n"],
    ends: Float[Tensor, "n 2"],
    sides: Float[Tensor, "n"],
) -> Float[Tensor, "n"]:
    """Bound on the sine of latitude over a box in the tangent plane at latitude asin(sine).

    Args:
        ends: lowest and highest step towards growing latitude.
        sides: largest step aside.
    """
    height = sine[:, None] + ends * cosine[:, None]
    aside = torch.where(height > 0, torch.zeros_like(height), sides[:, None].square())
    highest = (height / torch.sqrt(1 + aside + ends.square())).amax(dim=1)
    over_pole = (sine > 0) & (ends[:, 0] * sine <= cosine) & (cosine <= ends[:, 1] * sine)
    return torch.where(over_pole, torch.ones_like(highest), highest).clamp(-1, 1)


def _hide(boxes: Float[Tensor, "n 4"], unseen: Tensor) -> Float[Tensor, "n 4"]:
    nowhere = torch.tensor((1.0, -1.0, 1.0, -1.0), dtype=boxes.dtype, device=boxes.device)
    return torch.where(unseen[:, None], nowhere, boxes)
