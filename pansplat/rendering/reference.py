"""The reference backend: pure torch, float32 or float64, differentiable, in bounded memory.

Source: docs/rendering.md, section 4. Every faster backend is compared with this one.

Compositing is dense within small blocks of pixels and Gaussians. The tiles of an image are processed in groups with
similar numbers of Gaussians, and a group's Gaussians in blocks, which bounds the memory; a block passes only the
transmittance to the next. Backward visits the same blocks in reverse order and recomputes each under autograd.
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
from pansplat.rendering.rasterize import Kernel, RasterOptions
from pansplat.system.threads import one_thread

TILE_SIZE = 8  # pixels
_BOX_MARGIN = 0.01  # pixels added around each box, far more than rounding errors
_MAX_INTERSECTIONS = 1 << 22  # intersections in a band of tile rows
_BLOCK_SIZE = 32  # Gaussians in a block
_MAX_PAIRS = 32768  # pairs of a pixel and a Gaussian in a block, which fit the cache
_MIN_TRANSMITTANCE = 1e-20  # less is set to zero: float32 is slow and inexact below 1e-38
_FIRST_VALUE = 11  # first column of the values in a record, after rows, radial variance and peak


@dataclass(frozen=True, eq=False)
class TileIntersections:
    """For each tile of a band of tile rows, the Gaussians whose boxes intersect it, front to back.

    Attributes:
        tiles: index of the first tile, and one past the last, in the image's row-major order of tiles.
        indices: indices of the Gaussians, tile after tile.
        starts: start of each tile in `indices`, and the end of the last tile.
    """

    tiles: tuple[int, int]
    indices: Int[Tensor, "e"]
    starts: Int[Tensor, "t"]


@dataclass(frozen=True, eq=False)
class TilePixels:
    """Pixels of an image by tile, relative to the tile's centre so that float32 keeps sub-pixel differences.

    Attributes:
        centres: float64, in the units of `Footprints.point`.
        offsets: pixel minus centre, and 1, in the image's type.
    """

    centres: Float[Tensor, "tile 3"]
    offsets: Float[Tensor, "tile 4 pixel"]


@one_thread()
def rasterize_planes(
    gaussians: Gaussians,
    pose: Float[Tensor, "4 4"],
    planes: list[ImagePlane],
    options: RasterOptions,
) -> Float[Tensor, "plane sums height width"]:
    """Rasterise with torch operations; see `pansplat.rendering.rasterize.RasterBackend`."""
    if planes[0].eye_offset:
        return _rasterize_columns(gaussians, pose, planes[0], options)
    projected = _project(gaussians, pose, planes[0], options)
    return torch.stack([_rasterize_plane(projected, plane, options) for plane in planes])


def _project(
    gaussians: Gaussians,
    pose: Float[Tensor, "4 4"],
    plane: ImagePlane,
    options: RasterOptions,
) -> ProjectedGaussians:
    """The drawable Gaussians, projected from a camera."""
    return project_gaussians(
        select_drawable(gaussians, pose, options.near),
        pose,
        filter_variance=options.filter_variance(plane.pixel_angle),
        exact=options.kernel == "ray",
    )


def _rasterize_columns(
    gaussians: Gaussians,
    pose: Float[Tensor, "4 4"],
    plane: ImagePlane,
    options: RasterOptions,
) -> Float[Tensor, "1 sums height width"]:
    """Rasterise each column of a panorama from its own eye: section 9, literally; kernel "ray" only."""
    (height, width), directions = plane.size, plane.directions()
    columns = []
    for column, eye in enumerate(plane.column_eyes()):
        moved = torch.cat((pose[:, :3], (pose[:, 3] + pose[:, :3] @ eye)[:, None]), dim=1)
        projected = _project(gaussians, moved, plane, options)
        footprints, boxes = compute_footprints(projected, plane, options)
        # A box may wrap around: count the columns from its left edge on.
        after_left = torch.remainder(column + 0.5 - boxes[:, 0], width)
        reached = (after_left <= boxes[:, 1] - boxes[:, 0] + 2 * _BOX_MARGIN) | (after_left > width - _BOX_MARGIN)
        reached = torch.nonzero(reached & is_in_image(boxes, plane))[:, 0]
        footprints = Footprints(*(field[reached] for field in footprints))
        boxes = boxes[reached]
        boxes[:, 0], boxes[:, 1] = 0, 1  # the box of an image of this column alone
        order = torch.argsort(projected.radius.detach()[reached], stable=True)
        pixels = _arrange_points(directions[:, column : column + 1], projected.peak.dtype)
        bands = [
            composite(footprints, band, pixels, exact=True)
            for band in intersect_tiles(boxes, order, (height, 1), wraps=False)
        ]
        sums = torch.cat(bands).reshape(-1, TILE_SIZE, TILE_SIZE, bands[0].shape[-1])[:, :, 0].flatten(0, 1)
        columns.append(sums[:height].T)
    return torch.stack(columns, dim=2)[None]


def _rasterize_plane(
    projected: ProjectedGaussians, plane: ImagePlane, options: RasterOptions
) -> Float[Tensor, "sums height width"]:
    """Compute sums of weight x (channels, distance, 1)."""
    z = (projected.direction.detach() @ plane.rotation[:, 2]) * projected.radius.detach()
    if options.kernel == "ewa":
        ahead = z > EWA_NEAR_FACTOR * options.near
        projected, z = ProjectedGaussians(*(field[ahead] for field in projected)), z[ahead]
    key = projected.radius.detach() if options.kernel == "ray" else z
    footprints, boxes = compute_footprints(projected, plane, options)
    visible = torch.nonzero(is_in_image(boxes, plane))[:, 0]
    if len(visible) < len(boxes):
        footprints, boxes = Footprints(*(field[visible] for field in footprints)), boxes[visible]
        key = key[visible]
    pixels = _arrange_pixels(plane, options.kernel, projected.peak.dtype)
    rows, columns = tile_grid(*plane.size)
    order = torch.argsort(key, stable=True)
    bands = [
        composite(footprints, band, pixels, exact=options.kernel == "ray")
        for band in intersect_tiles(boxes, order, plane.size, wraps=plane.is_panorama)
    ]
    sums = torch.cat(bands).reshape(rows, columns, TILE_SIZE, TILE_SIZE, -1)
    sums = sums.permute(4, 0, 2, 1, 3).reshape(-1, rows * TILE_SIZE, columns * TILE_SIZE)
    return sums[:, : plane.size[0], : plane.size[1]]


def _arrange_pixels(plane: ImagePlane, kernel: Kernel, dtype: torch.dtype) -> TilePixels:
    """Arrange the pixels by tile; tiles that extend beyond the image repeat its last row and column."""
    return _arrange_points(plane.directions() if kernel == "ray" else plane.coordinates(), dtype)


def _arrange_points(points: Float[Tensor, "height width axis"], dtype: torch.dtype) -> TilePixels:
    height, width = points.shape[:2]
    rows, columns = tile_grid(height, width)
    y = torch.arange(rows * TILE_SIZE, device=points.device).clamp_max(height - 1)
    x = torch.arange(columns * TILE_SIZE, device=points.device).clamp_max(width - 1)
    points = torch.nn.functional.pad(points[y][:, x], (0, 3 - points.shape[-1]))
    points = points.reshape(rows, TILE_SIZE, columns, TILE_SIZE, 3).transpose(1, 2).reshape(-1, TILE_SIZE**2, 3)
    centres = points.mean(dim=1)
    offsets = (points - centres[:, None]).to(dtype)
    homogeneous = torch.cat((offsets, torch.ones_like(offsets[..., :1])), dim=2)
    return TilePixels(centres, homogeneous.transpose(1, 2).contiguous())


# --- tile intersections ---


def tile_grid(height: int, width: int, tile_size: int = TILE_SIZE) -> tuple[int, int]:
    """Count the rows and columns of tiles that cover an image."""
    return -(-height // tile_size), -(-width // tile_size)


def intersect_tiles(
    boxes: Float[Tensor, "n 4"],
    order: Int[Tensor, "n"],
    size: tuple[int, int],
    *,
    wraps: bool,
    limit: int = _MAX_INTERSECTIONS,
) -> Iterator[TileIntersections]:
    """List the intersections of all tiles, in bands of tile rows with at most `limit` intersections (or one row).

    Args:
        boxes: left, right, top, bottom, pixels; left > right where a Gaussian is not seen.
        order: Gaussians front to back.
        size: height and width, pixels.
        wraps: column `width` is column 0.
    """
    rows, columns = tile_grid(*size)
    ranges = tile_ranges(boxes[order], size, wraps)
    seen = torch.nonzero((ranges[:, 1] > 0) & (ranges[:, 3] > 0))[:, 0]
    order, (first_column, num_columns, first_row, num_rows) = order[seen], ranges[seen].unbind(1)
    # Count the intersections in each row of tiles, from differences at the boxes' ends.
    change = torch.zeros(rows + 1, dtype=torch.int64, device=boxes.device)
    change.index_add_(0, first_row, num_columns)
    change.index_add_(0, first_row + num_rows, -num_columns)
    for low, high in split_rows(change.cumsum(0)[:rows].tolist(), limit):
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
        yield TileIntersections((low * columns, high * columns), order[inside[place]], starts)


def tile_ranges(
    boxes: Float[Tensor, "n 4"], size: tuple[int, int], wraps: bool, tile_size: int = TILE_SIZE
) -> Int[Tensor, "n 4"]:
    """Find the tiles of each box: first column, number of columns, first row, number of rows."""
    height, width = size
    columns = tile_grid(height, width, tile_size)[1]
    left, right, top, bottom = boxes.unbind(1)
    hidden = (left > right) | (top > bottom)
    # Pixels whose centres lie inside; clamped as floats, because the cast could overflow.
    first_x, first_y = (torch.ceil(edge - 0.5 - _BOX_MARGIN) for edge in (left, top))
    last_x, last_y = (torch.floor(edge - 0.5 + _BOX_MARGIN) for edge in (right, bottom))
    hidden |= (first_y > height - 1) | (last_y < 0) | (last_y < first_y) | (last_x < first_x)
    first_y = first_y.clamp(0, height - 1).long() // tile_size
    last_y = last_y.clamp(0, height - 1).long() // tile_size
    if wraps:
        everywhere = last_x - first_x >= width - 1
        start = torch.remainder(first_x, width).long().clamp(0, width - 1)
        end = torch.remainder(last_x, width).long().clamp(0, width - 1)
        first_x, last_x = start // tile_size, end // tile_size
        wrapped = end < start
        num_x = torch.where(wrapped, columns - first_x + last_x + 1, last_x - first_x + 1)
        everywhere |= num_x >= columns
        first_x = torch.where(everywhere, 0, first_x)
        num_x = torch.where(everywhere, columns, num_x)
    else:
        hidden |= (first_x > width - 1) | (last_x < 0)
        first_x = first_x.clamp(0, width - 1).long() // tile_size
        num_x = last_x.clamp(0, width - 1).long() // tile_size - first_x + 1
    ranges = torch.stack((first_x, num_x, first_y, last_y - first_y + 1), dim=1)
    return torch.where(hidden[:, None], torch.zeros_like(ranges), ranges)


def split_rows(per_row: list[int], limit: int) -> Iterator[tuple[int, int]]:
    """Split rows into bands whose counts sum to at most `limit`; a single row may exceed it."""
    low, total = 0, 0
    for row, count in enumerate(per_row):
        if row > low and total + count > limit:
            yield low, row
            low, total = row, 0
        total += count
    yield low, len(per_row)


# --- compositing ---


def composite(
    footprints: Footprints, intersections: TileIntersections, pixels: TilePixels, *, exact: bool
) -> Float[Tensor, "tile pixel sums"]:
    """Sum weight x (values, 1) along the ray of each pixel, for the tiles of `intersections`.

    Differentiable once in all of `footprints`.
    """
    f = footprints
    records = torch.cat((f.rows.flatten(1), f.radial_variance[:, None], f.peak[:, None], f.values), dim=1)
    return _Composite.apply(records, f.point, intersections, pixels, exact, torch.is_grad_enabled())  # type: ignore[no-any-return]


class _Composite(torch.autograd.Function):
    """Compositing whose backward recomputes the blocks."""

    @staticmethod
    @one_thread()
    def forward(
        ctx: Any,
        records: Tensor,
        points: Tensor,
        intersections: TileIntersections,
        pixels: TilePixels,
        exact: bool,
        grad_enabled: bool,
    ) -> Float[Tensor, "tile pixel sums"]:
        needs_grad = grad_enabled and any(ctx.needs_input_grad)  # needs_input_grad ignores no_grad
        padded = _append_zero_row(records), _append_zero_row(points)
        first = intersections.tiles[0]
        count = intersections.tiles[1] - first
        size = pixels.offsets.shape[-1]
        sums = records.new_zeros(count, size, records.shape[1] - _FIRST_VALUE + 1)
        kept = []
        for tiles, blocks in _group_tiles(intersections, len(records), size):
            transmittance = records.new_ones(len(tiles), size)
            before = []
            for block in blocks:
                active = tiles[: len(block)]
                through = transmittance[: len(block)]
                if needs_grad:
                    before.append(through)
                transmittance, added = _composite_block(
                    *_gather_block(padded, block, pixels, active + first), through, exact=exact
                )
                sums.index_add_(0, active, added)
                if float(transmittance.max()) <= (0.0 if needs_grad else torch.finfo(records.dtype).eps):
                    break
            kept.append(before)
        ctx.save_for_backward(records, points)
        ctx.saved = intersections, pixels, exact, kept
        return sums

    @staticmethod
    @one_thread()
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, Tensor, None, None, None, None]:
        if torch.is_grad_enabled():  # the caller chose create_graph=True
            raise RuntimeError("second derivatives of a rendering are not available; drop create_graph=True")
        (grad_sums,) = grad_outputs
        records, points = ctx.saved_tensors
        intersections, pixels, exact, kept = ctx.saved
        padded = _append_zero_row(records), _append_zero_row(points)
        grad_records, grad_points = torch.zeros_like(padded[0]), torch.zeros_like(padded[1])
        groups = _group_tiles(intersections, len(records), pixels.offsets.shape[-1])
        for (tiles, blocks), before in zip(groups, kept, strict=True):
            grad_through = records.new_zeros(0, pixels.offsets.shape[-1])
            composited = list(itertools.islice(blocks, len(before)))  # forward may have stopped before the last block
            for block, through in zip(reversed(composited), reversed(before), strict=True):
                active = tiles[: len(block)]
                record, point, centres, offsets = _gather_block(padded, block, pixels, active + intersections.tiles[0])
                inputs = tuple(t.detach().requires_grad_() for t in (record, point, through))
                # Tiles that end with this block have no gradient from a later one.
                ended = records.new_zeros(len(active) - len(grad_through), grad_through.shape[1])
                with torch.enable_grad():
                    outputs = _composite_block(inputs[0], inputs[1], centres, offsets, inputs[2], exact=exact)
                grads = torch.autograd.grad(
                    outputs, inputs, (torch.cat((grad_through, ended)), grad_sums[active]), materialize_grads=True
                )
                grad_records.index_add_(0, block.reshape(-1), grads[0].flatten(0, 1))
                grad_points.index_add_(0, block.reshape(-1), grads[1].flatten(0, 1))
                grad_through = grads[2]
        return grad_records[:-1], grad_points[:-1], None, None, None, None


def _append_zero_row(table: Tensor) -> Tensor:
    """Append a row of zeros: an invisible Gaussian that pads blocks."""
    return torch.cat((table, table.new_zeros(1, table.shape[1])))


def _group_tiles(
    intersections: TileIntersections, padding: int, size: int
) -> Iterator[tuple[Int[Tensor, "g"], Iterator[Int[Tensor, "active block"]]]]:
    """Group tiles (counted from the band's first), and list the blocks of Gaussians of each group, front to back.

    A group's tiles are in descending order of their number of Gaussians: those with Gaussians in a block come first.
    """
    counts, tiles = torch.sort(intersections.starts.diff(), descending=True, stable=True)
    tiles = tiles[counts > 0]
    num = max(1, _MAX_PAIRS // (_BLOCK_SIZE * size))
    for low in range(0, len(tiles), num):
        group = tiles[low : low + num]
        yield group, _list_blocks(intersections, group, counts[low : low + len(group)], padding)


def _list_blocks(
    intersections: TileIntersections, tiles: Int[Tensor, "g"], counts: Int[Tensor, "g"], padding: int
) -> Iterator[Int[Tensor, "active block"]]:
    step = torch.arange(_BLOCK_SIZE, device=tiles.device)
    starts, ends = intersections.starts[tiles, None], intersections.starts[tiles + 1, None]
    for low in range(0, int(counts[0]), _BLOCK_SIZE):
        active = int((counts > low).sum())
        place = starts[:active] + low + step
        index = intersections.indices[place.clamp_max(len(intersections.indices) - 1)]
        yield torch.where(place < ends[:active], index, padding)


def _gather_block(
    padded: tuple[Tensor, Tensor], block: Int[Tensor, "g block"], pixels: TilePixels, tiles: Int[Tensor, "g"]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Gather records and points of a block's Gaussians, and centres and pixels of its tiles."""
    flat = block.reshape(-1)
    record = padded[0].index_select(0, flat).view(*block.shape, -1)
    point = padded[1].index_select(0, flat).view(*block.shape, 3)
    return record, point, pixels.centres[tiles], pixels.offsets[tiles]


def _composite_block(
    record: Float[Tensor, "g block record"],
    point: Float[Tensor, "g block 3"],
    centres: Float[Tensor, "g 3"],
    offsets: Float[Tensor, "g 4 pixel"],
    through: Float[Tensor, "g pixel"],
    *,
    exact: bool,
) -> tuple[Float[Tensor, "g pixel"], Float[Tensor, "g pixel sums"]]:
    """Compute the transmittance behind a block of Gaussians, and the block's contribution to the sums."""
    alpha = _evaluate_alphas(record, (point - centres[:, None]).to(record.dtype), offsets, exact=exact)
    behind = _zero_up_to(torch.cumprod(1 - alpha, dim=1), _MIN_TRANSMITTANCE)
    in_front = torch.cat((torch.ones_like(behind[:, :1]), behind[:, :-1]), dim=1)
    weights = alpha * in_front * through[:, None]
    values = torch.cat((record[..., _FIRST_VALUE:], torch.ones_like(record[..., :1])), dim=2)
    return _zero_up_to(through * behind[:, -1], _MIN_TRANSMITTANCE), weights.transpose(1, 2) @ values


def _evaluate_alphas(
    record: Float[Tensor, "g block record"],
    point: Float[Tensor, "g block 3"],
    offsets: Float[Tensor, "g 4 pixel"],
    *,
    exact: bool,
) -> Float[Tensor, "g block pixel"]:
    """Evaluate alpha of each Gaussian at each pixel of its tile.

    Args:
        record: rows a, b, l; radial variance; peak; values.
        point: relative to the tile's centre.
        offsets: pixels relative to the tile's centre, and 1.
    """
    g, block = record.shape[:2]
    num = 3 if exact else 2
    rows = record[..., : 3 * num].view(g, block, num, 3)
    constant = -(rows * point[:, :, None, :]).sum(dim=3, keepdim=True)
    linear = torch.cat((rows, constant), dim=3).transpose(1, 2).reshape(g, num * block, 4)
    a, b, *front = (linear @ offsets).view(g, num, block, -1).unbind(1)
    q = a * a + b * b
    # The logarithm, because the gradient of exp times a large peak can overflow; the rows that pad a block are 0.
    log_peak = record[..., 10, None].clamp_min(torch.finfo(record.dtype).tiny).log()
    if not exact:
        return _clamp_alpha(torch.exp(log_peak - 0.5 * q))
    # The bound has an effect only near the plane L = 0; it keeps gradients finite there.
    plane_distance = 1 + front[0]
    bounded = plane_distance.clamp_min(torch.finfo(record.dtype).eps ** 0.5)
    alpha = _clamp_alpha(torch.exp(log_peak - 0.5 * q / (bounded * bounded + record[..., 9, None] * q)))
    if bool(plane_distance.detach().amin() > 0):  # true for nearly every block
        return alpha
    return alpha * (plane_distance > 0)


def _clamp_alpha(alpha: Tensor) -> Tensor:
    """Limit alpha to 0.99, and set it to 0 below 1/255."""
    return _zero_up_to(alpha.clamp_max(MAX_ALPHA), ALPHA_CUT * (1 - ALPHA_CUT_ROUNDING))


def _zero_up_to(values: Tensor, floor: float) -> Tensor:
    """Set values of at most `floor` to 0, without gradient."""
    return torch.nn.functional.threshold(values, floor, 0.0)
