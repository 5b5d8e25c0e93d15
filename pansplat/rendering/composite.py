"""Front-to-back compositing of tiles, dense within small blocks of pixels and Gaussians.

Source: docs/rendering.md, section 4. A picture's tiles are taken in groups with similar numbers of Gaussians,
and a group's Gaussians in blocks, so that memory is bounded whatever the scene; only the transmittance passes
from block to block. Backward walks the same blocks in reverse and computes each again under autograd.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pansplat.constants import ALPHA_CUT, ALPHA_CUT_ROUNDING, MAX_ALPHA
from pansplat.rendering.splats import Splats
from pansplat.rendering.tiles import TileLists
from pansplat.threads import one_thread

_BLOCK = 32  # Gaussians a step
# Pixel-Gaussian pairs a step, few enough for the cache.
_PAIRS = 32768
# Less light than this is none: float32 loses digits below 1e-38, and processors slow down.
_DARK = 1e-20
_VALUES = 11  # where a row's values begin, behind forms, along and peak


@dataclass(frozen=True, eq=False)
class TilePixels:
    """Pixels of a picture by tile, relative to the tile's centre so that float32 keeps sub-pixel differences.

    Attributes:
        centres: float64, in the units of `Splats.point`.
        offsets: pixel minus centre, and 1, in the picture's type.
    """

    centres: Float[Tensor, "tile 3"]
    offsets: Float[Tensor, "tile 4 pixel"]


def composite(splats: Splats, lists: TileLists, pixels: TilePixels, *, exact: bool) -> Float[Tensor, "tile pixel sums"]:
    """Sums along each pixel's ray of weight x (values, 1), for the tiles of `lists`.

    Differentiable once in all of `splats`.
    """
    rows = torch.cat((splats.forms.flatten(1), splats.along[:, None], splats.peak[:, None], splats.values), dim=1)
    return _Composite.apply(rows, splats.point, lists, pixels, exact, torch.is_grad_enabled())  # type: ignore[no-any-return]


class _Composite(torch.autograd.Function):
    """The sums, with a backward that recomputes block by block."""

    @staticmethod
    @one_thread()
    def forward(
        ctx: Any, rows: Tensor, points: Tensor, lists: TileLists, pixels: TilePixels, exact: bool, recorded: bool
    ) -> Float[Tensor, "tile pixel sums"]:
        needs_grad = recorded and any(ctx.needs_input_grad)  # which knows nothing of no_grad
        padded = _pad(rows), _pad(points)
        first = lists.tiles[0]
        count = lists.tiles[1] - first
        size = pixels.offsets.shape[-1]
        sums = rows.new_zeros(count, size, rows.shape[1] - _VALUES + 1)
        kept = []
        for tiles, blocks in _groups(lists, len(rows), size):
            transmittance = rows.new_ones(len(tiles), size)
            before = []
            for block in blocks:
                live = tiles[: len(block)]
                through = transmittance[: len(block)]
                if needs_grad:
                    before.append(through)
                transmittance, added = _block(*_gather(padded, block, pixels, live + first), through, exact=exact)
                sums.index_add_(0, live, added)
                if float(transmittance.max()) <= (0.0 if needs_grad else torch.finfo(rows.dtype).eps):
                    break
            kept.append(before)
        ctx.save_for_backward(rows, points)
        ctx.plan = lists, pixels, exact, kept
        return sums

    @staticmethod
    @one_thread()
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, Tensor, None, None, None, None]:
        if torch.is_grad_enabled():  # create_graph=True
            raise RuntimeError("second derivatives of a rendering are not available; drop create_graph=True")
        (grad_sums,) = grad_outputs
        rows, points = ctx.saved_tensors
        lists, pixels, exact, kept = ctx.plan
        padded = _pad(rows), _pad(points)
        grad_rows, grad_points = torch.zeros_like(padded[0]), torch.zeros_like(padded[1])
        groups = _groups(lists, len(rows), pixels.offsets.shape[-1])
        for (tiles, blocks), before in zip(groups, kept, strict=True):
            grad_through = rows.new_zeros(0, pixels.offsets.shape[-1])
            drawn = list(itertools.islice(blocks, len(before)))  # blocks in the dark were left out
            for block, through in zip(reversed(drawn), reversed(before), strict=True):
                live = tiles[: len(block)]
                row, point, centres, offsets = _gather(padded, block, pixels, live + lists.tiles[0])
                inputs = tuple(t.detach().requires_grad_() for t in (row, point, through))
                # Tiles that end with this block have no later block to hear from.
                silent = rows.new_zeros(len(live) - len(grad_through), grad_through.shape[1])
                with torch.enable_grad():
                    outputs = _block(inputs[0], inputs[1], centres, offsets, inputs[2], exact=exact)
                grads = torch.autograd.grad(
                    outputs,
                    inputs,
                    (torch.cat((grad_through, silent)), grad_sums[live]),
                    materialize_grads=True,
                )
                grad_rows.index_add_(0, block.reshape(-1), grads[0].flatten(0, 1))
                grad_points.index_add_(0, block.reshape(-1), grads[1].flatten(0, 1))
                grad_through = grads[2]
        return grad_rows[:-1], grad_points[:-1], None, None, None, None


def _pad(table: Tensor) -> Tensor:
    """The table with a row of zeros, an invisible Gaussian that fills up blocks."""
    return torch.cat((table, table.new_zeros(1, table.shape[1])))


def _groups(
    lists: TileLists, filler: int, size: int
) -> Iterator[tuple[Int[Tensor, "g"], Iterator[Int[Tensor, "live block"]]]]:
    """Groups of tiles (counted from the lists' first), and each's blocks of Gaussians, front to back.

    A group's tiles are sorted by falling number of Gaussians, so those still live in a block come first.
    """
    counts, tiles = torch.sort(lists.starts.diff(), descending=True, stable=True)
    tiles = tiles[counts > 0]
    num = max(1, _PAIRS // (_BLOCK * size))
    for low in range(0, len(tiles), num):
        group = tiles[low : low + num]
        yield group, _blocks(lists, group, counts[low : low + len(group)], filler)


def _blocks(
    lists: TileLists, tiles: Int[Tensor, "g"], counts: Int[Tensor, "g"], filler: int
) -> Iterator[Int[Tensor, "live block"]]:
    step = torch.arange(_BLOCK, device=tiles.device)
    starts, ends = lists.starts[tiles, None], lists.starts[tiles + 1, None]
    for low in range(0, int(counts[0]), _BLOCK):
        live = int((counts > low).sum())
        place = starts[:live] + low + step
        entry = lists.entries[place.clamp_max(len(lists.entries) - 1)]
        yield torch.where(place < ends[:live], entry, filler)


def _gather(
    padded: tuple[Tensor, Tensor], block: Int[Tensor, "g block"], pixels: TilePixels, tiles: Int[Tensor, "g"]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rows and points of a block's Gaussians, the centres and pixels of its tiles."""
    flat = block.reshape(-1)
    row = padded[0].index_select(0, flat).view(*block.shape, -1)
    point = padded[1].index_select(0, flat).view(*block.shape, 3)
    return row, point, pixels.centres[tiles], pixels.offsets[tiles]


def _block(
    row: Float[Tensor, "g block row"],
    point: Float[Tensor, "g block 3"],
    centres: Float[Tensor, "g 3"],
    offsets: Float[Tensor, "g 4 pixel"],
    through: Float[Tensor, "g pixel"],
    *,
    exact: bool,
) -> tuple[Float[Tensor, "g pixel"], Float[Tensor, "g pixel sums"]]:
    """Transmittance behind a block of Gaussians, and what the block adds to the sums."""
    alpha = _alphas(row, (point - centres[:, None]).to(row.dtype), offsets, exact=exact)
    behind = _above(torch.cumprod(1 - alpha, dim=1), _DARK)
    ahead = torch.cat((torch.ones_like(behind[:, :1]), behind[:, :-1]), dim=1)
    weights = alpha * ahead * through[:, None]
    values = torch.cat((row[..., _VALUES:], torch.ones_like(row[..., :1])), dim=2)
    return _above(through * behind[:, -1], _DARK), weights.transpose(1, 2) @ values


def _alphas(
    row: Float[Tensor, "g block row"],
    point: Float[Tensor, "g block 3"],
    offsets: Float[Tensor, "g 4 pixel"],
    *,
    exact: bool,
) -> Float[Tensor, "g block pixel"]:
    """Opacity of each Gaussian at each pixel of its tile.

    Args:
        row: forms a, b, l; along; peak; values.
        point: relative to the tile's centre.
        offsets: pixels relative to the tile's centre, and 1.
    """
    g, block = row.shape[:2]
    num = 3 if exact else 2
    forms = row[..., : 3 * num].view(g, block, num, 3)
    constant = -(forms * point[:, :, None, :]).sum(dim=3, keepdim=True)
    linear = torch.cat((forms, constant), dim=3).transpose(1, 2).reshape(g, num * block, 4)
    a, b, *front = (linear @ offsets).view(g, num, block, -1).unbind(1)
    q = a * a + b * b
    peak = row[..., 10, None]
    if not exact:
        return _cut(peak * torch.exp(-0.5 * q))
    # The bound only matters within a hair of the plane through the eye; it keeps slopes finite there.
    ahead = 1 + front[0]
    bounded = ahead.clamp_min(torch.finfo(row.dtype).eps ** 0.5)
    alpha = _cut(peak * torch.exp(-0.5 * q / (bounded * bounded + row[..., 9, None] * q)))
    if bool(ahead.detach().amin() > 0):  # nearly always
        return alpha
    return alpha * (ahead > 0)


def _cut(alpha: Tensor) -> Tensor:
    """At most 0.99, and 0 below 1/255."""
    return _above(alpha.clamp_max(MAX_ALPHA), ALPHA_CUT * (1 - ALPHA_CUT_ROUNDING))


def _above(values: Tensor, floor: float) -> Tensor:
    """The values, but 0 and without gradient where they are no more than `floor`."""
    return torch.nn.functional.threshold(values, floor, 0.0)
