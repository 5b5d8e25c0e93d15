"""Sums along the rays of all pictures, differentiable in the Gaussians' records.

Source: docs/rendering.md, section 4.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.rendering.cuda.layout import Layout, pack, unpack
from pansplat.rendering.cuda.lists import Instances, list_tiles
from pansplat.rendering.cuda.pixels import TilePixels, tile_pixels
from pansplat.rendering.cuda.raster import raster
from pansplat.rendering.cuda.raster_backward import by_record, raster_backward
from pansplat.rendering.image_planes import ImagePlane
from pansplat.rendering.projection import Footprints

_SORTING = 40  # bytes an entry, while a band's are sorted


def composite(
    splats: Footprints, instances: Instances, pictures: list[ImagePlane], *, exact: bool
) -> tuple[Float[Tensor, "picture sums height width"], int, int]:
    """Sums of weight x (values, 1) over pictures, the number of entries, and bytes of working memory.

    Differentiable once in all of `splats`.

    Args:
        splats: one a record.
        instances: where they are drawn.
        pictures: all of one size.
        exact: which kernel.
    """
    layout = Layout(exact, splats.values.shape[1] - 1)
    pixels = tile_pixels(pictures, exact=exact, dtype=splats.rows.dtype)
    grads = torch.is_grad_enabled()
    return _Composite.apply(*splats, instances, pixels, layout, pictures[0].size, grads)  # type: ignore[no-any-return]


class _Composite(torch.autograd.Function):
    """The sums; what is kept for backward are the records, the lists and the sums themselves."""

    @staticmethod
    def forward(
        ctx: Any,
        point: Tensor,
        forms: Tensor,
        along: Tensor,
        peak: Tensor,
        values: Tensor,
        instances: Instances,
        pixels: TilePixels,
        layout: Layout,
        size: tuple[int, int],
        recorded: bool,
    ) -> tuple[Tensor, int, int]:
        records = pack(Footprints(point, forms, along, peak, values), layout)
        sums = records.new_empty(len(instances.pictures), layout.channels + 2, *size)
        entries, largest, kept = 0, 0, []
        for lists in list_tiles(instances):
            stops = raster(records, lists, pixels, sums, layout)
            entries += len(lists.entries)
            largest = max(largest, _SORTING * len(lists.entries) + 8 * len(lists.ends))
            if recorded and any(ctx.needs_input_grad):  # which knows nothing of no_grad
                kept.append((lists, stops))
        ctx.save_for_backward(records, forms, sums)
        ctx.plan = instances, pixels, layout, kept
        held = (records, sums, pixels.centres, pixels.offsets, instances.records, instances.ranges)
        return sums, entries, largest + sum(t.numel() * t.element_size() for t in held)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():  # create_graph=True
            raise RuntimeError("second derivatives of a rendering are not available; drop create_graph=True")
        records, forms, sums = ctx.saved_tensors
        instances, pixels, layout, kept = ctx.plan
        totals = records.new_zeros(len(instances.records), layout.gradient)
        for lists, stops in kept:
            raster_backward(records, lists, stops, pixels, sums, grad_outputs[0].contiguous(), layout, totals)
        return *unpack(by_record(totals, instances, len(records)), forms, layout), None, None, None, None, None
