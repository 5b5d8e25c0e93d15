"""The reference backend: pure torch, float32 or float64, differentiable, in bounded memory.

Source: docs/rendering.md, section 4. Every faster backend is compared with this one.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pansplat.constants import ALPHA_CUT, ALPHA_CUT_ROUNDING, EWA_NEAR_FACTOR, MAX_ALPHA
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering.image_planes import ImagePlane
from pansplat.rendering.projection import (
    Footprints,
    ProjectedGaussians,
    compute_footprints,
    is_in_image,
    project_gaussians,
    select_drawable,
)
from pansplat.rendering.rasterize import Kernel, RasterInfo, RasterOptions, RasterSums
from pansplat.threads import one_thread

TILE = 8  # pixels
_MARGIN = 0.01  # pixels added around each box, far more than rounding
_ENTRIES = 1 << 22  # entries listed at a time


@dataclass(frozen=True, eq=False)
class TileLists:
    """For each tile of some rows of tiles, the Gaussians that touch it, front to back.

    Attributes:
        tiles: index of the first tile, and one past the last, in the picture's row-major order of tiles.
        entries: Gaussian indices, tile after tile.
        starts: where each tile's entries begin, and the end of the last.
    """

    tiles: tuple[int, int]
    entries: Int[Tensor, "e"]
    starts: Int[Tensor, "t"]


def tile_grid(height: int, width: int, tile: int = TILE) -> tuple[int, int]:
    """Number of rows and columns of tiles that cover a picture."""
    return -(-height // tile), -(-width // tile)


def list_tiles(
    boxes: Float[Tensor, "n 4"],
    order: Int[Tensor, "n"],
    size: tuple[int, int],
    *,
    wraps: bool,
    limit: int = _ENTRIES,
) -> Iterator[TileLists]:
    """Lists for all tiles, in bands of tile rows with about `limit` entries at most.

    Args:
        boxes: left, right, top, bottom, pixels; left > right where a Gaussian is not seen.
        order: Gaussians front to back.
        size: height and width, pixels.
        wraps: whether column `width` is column 0 again.
    """
    rows, columns = tile_grid(*size)
    ranges = tile_ranges(boxes[order], size, wraps)
    seen = torch.nonzero((ranges[:, 1] > 0) & (ranges[:, 3] > 0))[:, 0]
    order, (first_column, num_columns, first_row, num_rows) = order[seen], ranges[seen].unbind(1)
    # Entries in each row of tiles, by differences at the boxes' ends.
    change = torch.zeros(rows + 1, dtype=torch.int64, device=boxes.device)
    change.index_add_(0, first_row, num_columns)
    change.index_add_(0, first_row + num_rows, -num_columns)
    for low, high in bands(change.cumsum(0)[:rows].tolist(), limit):
        top = first_row.clamp_min(low)
        count = (torch.minimum(first_row + num_rows, torch.as_tensor(high)) - top).clamp_min(0) * num_columns
        inside = torch.repeat_interleave(torch.arange(len(order), device=boxes.device), count)
        step = torch.arange(len(inside), device=boxes.device) - (count.cumsum(0) - count)[inside]
        across = num_columns[inside]
        column = (first_column[inside] + step % across) % columns
        tile = (top[inside] - low + step // across) * columns + column
        tile, place = torch.sort(tile, stable=True)
        per_tile = torch.bincount(tile, minlength=(high - low) * columns)
        starts = torch.cat((per_tile.new_zeros(1), per_tile.cumsum(0)))
        yield TileLists((low * columns, high * columns), order[inside[place]], starts)


def tile_ranges(
    boxes: Float[Tensor, "n 4"], size: tuple[int, int], wraps: bool, tile: int = TILE
) -> Int[Tensor, "n 4"]:
    """First column, number of columns, first row, number of rows of the tiles that each box touches."""
    height, width = size
    columns = tile_grid(height, width, tile)[1]
    left, right, top, bottom = boxes.unbind(1)
    hidden = (left > right) | (top > bottom)
    # Pixels whose centres lie inside; limited as floats, before the cast can overflow.
    first_x, first_y = (torch.ceil(edge - 0.5 - _MARGIN) for edge in (left, top))
    last_x, last_y = (torch.floor(edge - 0.5 + _MARGIN) for edge in (right, bottom))
    hidden |= (first_y > height - 1) | (last_y < 0) | (last_y < first_y) | (last_x < first_x)
    first_y, last_y = first_y.clamp(0, height - 1).long() // tile, last_y.clamp(0, height - 1).long() // tile
    if wraps:
        everywhere = last_x - first_x >= width - 1
        start = torch.remainder(first_x, width).long().clamp(0, width - 1)
        end = torch.remainder(last_x, width).long().clamp(0, width - 1)
        first_x, last_x = start // tile, end // tile
        wrapped = end < start
        num_x = torch.where(wrapped, columns - first_x + last_x + 1, last_x - first_x + 1)
        everywhere |= num_x >= columns
        first_x = torch.where(everywhere, 0, first_x)
        num_x = torch.where(everywhere, columns, num_x)
    else:
        hidden |= (first_x > width - 1) | (last_x < 0)
        first_x = first_x.clamp(0, width - 1).long() // tile
        num_x = last_x.clamp(0, width - 1).long() // tile - first_x + 1
    ranges = torch.stack((first_x, num_x, first_y, last_y - first_y + 1), dim=1)
    return torch.where(hidden[:, None], torch.zeros_like(ranges), ranges)


def bands(per_row: list[int], limit: int) -> Iterator[tuple[int, int]]:
    """Split rows into runs whose entries sum to at most `limit` (a single row may hold more)."""
    low, total = 0, 0
    for row, count in enumerate(per_row):
        if row > low and total + count > limit:
            yield low, row
            low, total = row, 0
        total += count
    yield low, len(per_row)


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
        centres: float64, in the units of `Footprints.point`.
        offsets: pixel minus centre, and 1, in the picture's type.
    """

    centres: Float[Tensor, "tile 3"]
    offsets: Float[Tensor, "tile 4 pixel"]


def composite(
    splats: Footprints, lists: TileLists, pixels: TilePixels, *, exact: bool
) -> Float[Tensor, "tile pixel sums"]:
    """Sums along each pixel's ray of weight x (values, 1), for the tiles of `lists`.

    Differentiable once in all of `splats`.
    """
    rows = torch.cat((splats.rows.flatten(1), splats.along[:, None], splats.peak[:, None], splats.values), dim=1)
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


@one_thread()
def rasterize_planes(
    gaussians: Gaussians,
    covariances: Float[Tensor, "n 3 3"] | None,
    pose: Float[Tensor, "4 4"],
    pictures: list[ImagePlane],
    options: RasterOptions,
) -> RasterSums:
    """Rasterise by torch operations; see `pansplat.rendering.rasterize.RasterBackend`."""
    chosen = select_drawable(gaussians, covariances, pose.detach(), options)
    observed = project_gaussians(
        chosen.gaussians,
        chosen.covariances,
        pose,
        filter_variance=options.filter_variance(pictures[0].pixel_angle),
        compensate=options.lowpass == "angular",
        exact=options.kernel == "ray",
    )
    drawn = [_picture(observed, picture, options) for picture in pictures]
    sums = torch.stack([picture for picture, _, _ in drawn])
    visible, entries = sum(d[1] for d in drawn), sum(d[2] for d in drawn)
    return RasterSums(sums, RasterInfo(chosen.total, chosen.dropped, chosen.near, visible, entries))


def _picture(
    observed: ProjectedGaussians, picture: ImagePlane, options: RasterOptions
) -> tuple[Float[Tensor, "sums height width"], int, int]:
    """Sums of weight x (channels, distance, 1) over one picture, the number of Gaussians and of entries drawn."""
    z = (observed.direction.detach() @ picture.rotation[:, 2]) * observed.radius.detach()
    if options.kernel == "ewa":
        ahead = z > EWA_NEAR_FACTOR * options.near
        observed, z = ProjectedGaussians(*(field[ahead] for field in observed)), z[ahead]
    key = observed.radius.detach() if options.order == "radial" or picture.is_panorama else z
    splats, boxes = compute_footprints(observed, picture, options)
    seen = torch.nonzero(is_in_image(boxes, picture))[:, 0]
    if len(seen) < len(boxes):
        splats, boxes, key = Footprints(*(field[seen] for field in splats)), boxes[seen], key[seen]
    pixels = _tile_pixels(picture, options.kernel, observed.peak.dtype)
    rows, columns = tile_grid(*picture.size)
    order_in_depth = torch.argsort(key, stable=True)
    bands, entries = [], 0
    for lists in list_tiles(boxes, order_in_depth, picture.size, wraps=picture.is_panorama):
        bands.append(composite(splats, lists, pixels, exact=options.kernel == "ray"))
        entries += len(lists.entries)
    sums = torch.cat(bands).reshape(rows, columns, TILE, TILE, -1)
    sums = sums.permute(4, 0, 2, 1, 3).reshape(-1, rows * TILE, columns * TILE)
    return sums[:, : picture.size[0], : picture.size[1]], len(seen), entries


def _tile_pixels(picture: ImagePlane, kernel: Kernel, dtype: torch.dtype) -> TilePixels:
    """The picture's pixels by tile; tiles that stick out repeat the last row and column."""
    points = picture.directions() if kernel == "ray" else picture.coordinates()
    rows, columns = tile_grid(*picture.size)
    y = torch.arange(rows * TILE, device=points.device).clamp_max(picture.size[0] - 1)
    x = torch.arange(columns * TILE, device=points.device).clamp_max(picture.size[1] - 1)
    points = torch.nn.functional.pad(points[y][:, x], (0, 3 - points.shape[-1]))
    points = points.reshape(rows, TILE, columns, TILE, 3).transpose(1, 2).reshape(-1, TILE * TILE, 3)
    centres = points.mean(dim=1)
    offsets = (points - centres[:, None]).to(dtype)
    homogeneous = torch.cat((offsets, torch.ones_like(offsets[..., :1])), dim=2)
    return TilePixels(centres, homogeneous.transpose(1, 2).contiguous())
