"""The stages joined into a backend: torch tensors in, sums and gradients out.

Source: docs/rendering.md; docs/rasterizer.md tells what each stage costs.
"""

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.errors import InputError
from pansplat.gaussians.gaussians import Gaussians
from pansplat.rendering.backend import EWA_NEAR, Drawn, Info, Options
from pansplat.rendering.cpu import bins
from pansplat.rendering.cpu.bins import TileLists, list_tiles
from pansplat.rendering.cpu.boxes import LARGEST_SIDE, find_boxes
from pansplat.rendering.cpu.compiling import announced
from pansplat.rendering.cpu.ewa import TOTALS, project, project_backward
from pansplat.rendering.cpu.memory import Lease, array_to_give
from pansplat.rendering.cpu.observe import PIECE, Camera, Fields, Observed, observe
from pansplat.rendering.cpu.observe_backward import Gradients, add_slots, chain
from pansplat.rendering.cpu.raster import Kept, raster_forward, room_to_keep
from pansplat.rendering.cpu.raster_backward import raster_backward
from pansplat.rendering.cpu.records import FIELDS
from pansplat.rendering.cpu.sort import depths_along, sort_front_to_back
from pansplat.rendering.cpu.tables import plane_of
from pansplat.rendering.cpu.threads import share, thread_count
from pansplat.rendering.panorama import Picture
from pansplat.rendering.selection import not_finite

_LEAST_SPREAD = 1e-9  # pixel^2: without a filter a disc seen edge-on would have no width to divide by


class Projection(NamedTuple):
    """What one picture shows: records, boxes, and the distances that it is drawn in order of.

    And, if its tile lists came in one band, these and what its forward kept.
    """

    records: np.ndarray
    boxes: np.ndarray
    distances: np.ndarray
    lists: TileLists | None = None
    kept: Kept | None = None


@dataclass
class _Notes:
    """What is told about a picture: counts, seconds by stage, and bytes of the arrays alive at once."""

    dropped: int = 0
    near: int = 0
    visible: int = 0
    entries: int = 0
    bytes: int = 0
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the seconds that something takes to a stage."""
        start = time.perf_counter()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start


def draw(
    gaussians: Gaussians,
    covariances: Float[Tensor, "n 3 3"] | None,
    pose: Float[Tensor, "4 4"],
    pictures: list[Picture],
    options: Options,
) -> Drawn:
    """Draw by numba kernels, in float32; see `pansplat.rendering.backend.Draw`.

    Raises:
        InputError: the Gaussians are not in main memory, a picture's side is above 32767 pixels, or
            `options.strict` and a Gaussian is not finite.
    """
    if gaussians.means.device.type != "cpu":
        raise InputError(
            f"backend 'numba' draws Gaussians in main memory, got them on {gaussians.means.device}; use "
            "backend='auto', or move them with gaussians.to(device='cpu')"
        )
    if max(pictures[0].size) > LARGEST_SIDE:
        raise InputError(
            f"`size` must be at most {LARGEST_SIDE} pixels a side for backend 'numba', got {pictures[0].size}; "
            "draw a smaller picture, or use backend='torch'"
        )
    dtype = gaussians.means.dtype
    shape = (gaussians.quats, gaussians.scales, None) if covariances is None else (None, None, covariances)
    fields = (gaussians.means, *shape, gaussians.opacities, gaussians.harmonics)
    fields = tuple(None if f is None else f.to(torch.float32).contiguous() for f in fields)
    notes = _Notes()
    sums = _Draw.apply(*fields, pose, pictures, options, notes, torch.is_grad_enabled())
    if options.strict and notes.dropped:
        raise InputError(not_finite(gaussians, covariances, pose, options))
    info = Info(
        len(gaussians), notes.dropped, notes.near, notes.visible, notes.entries, "numba", notes.bytes, notes.seconds
    )
    return Drawn(sums.to(dtype), info)


class _Draw(torch.autograd.Function):
    """The sums of all pictures, differentiable once in the fields and the pose."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor | None,
        scales: Tensor | None,
        covariances: Tensor | None,
        opacities: Tensor,
        harmonics: Tensor,
        pose: Tensor,
        pictures: list[Picture],
        options: Options,
        notes: _Notes,
        recorded: bool,
    ) -> Tensor:
        tensors = means, quats, scales, covariances, opacities, harmonics
        fields, camera = _fields(*tensors), _camera(pose, pictures[0], options)
        threads, lease = thread_count(), Lease()
        needs_grad = recorded and any(ctx.needs_input_grad)  # which knows nothing of no_grad
        height, width = pictures[0].size
        with announced(gradients=needs_grad and options.kernel == "ray"):
            with notes.timed("observe"):
                observed = observe(fields, camera, lease, threads)
            sums = array_to_give((len(pictures), harmonics.shape[2] + 2, height, width), np.float32)
            kept = [
                _draw_picture(
                    (fields, camera, observed), picture, options, sums[number], notes, needs_grad, lease, threads
                )
                for number, picture in enumerate(pictures)
            ]
        notes.dropped, notes.near = observed.dropped, observed.near
        notes.bytes += sums.nbytes + sum(part.nbytes for part in observed[:4])
        result = torch.from_numpy(sums)
        if needs_grad:
            ctx.save_for_backward(*tensors, pose, result)
            ctx.plan = pictures, options, observed, kept, lease, threads
        return result

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():  # create_graph=True
            raise RuntimeError("second derivatives of a rendering are not available; drop create_graph=True")
        *tensors, pose, sums = ctx.saved_tensors
        pictures, options, observed, kept, _lease, threads = ctx.plan
        fields, camera = _fields(*tensors), _camera(pose, pictures[0], options)
        grad_sums = grad_outputs[0].contiguous().numpy()
        wanted = [
            torch.from_numpy(array_to_give(tuple(tensor.shape), np.float32)) if needed else None
            for tensor, needed in zip(tensors, ctx.needs_input_grad, strict=False)
        ]
        with announced():
            own = Lease()
            slots = _slot_gradients(
                (fields, camera, observed), pictures, options, kept, sums.numpy(), grad_sums, own, threads
            )
            arrays = (
                np.empty((0, *field.shape[1:]), np.float32) if grad is None else grad.numpy()
                for field, grad in zip(fields, wanted, strict=True)
            )
            own_pose = np.empty((3 if ctx.needs_input_grad[6] else 0, 4))
            filled = chain(fields, camera, observed, *slots, Gradients(*arrays, pose=own_pose), threads)
        grad_pose = None
        if ctx.needs_input_grad[6]:
            grad_pose = torch.zeros_like(pose)
            grad_pose[:3] = torch.from_numpy(filled.pose)
        return (*wanted, grad_pose, None, None, None, None)


def _fields(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    covariances: Tensor | None,
    opacities: Tensor,
    harmonics: Tensor,
) -> Fields:
    """The tensors as arrays, no rows for those not given."""
    given = (means, quats, scales, covariances, opacities, harmonics)
    shapes = ((3,), (4,), (3,), (3, 3), (), harmonics.shape[1:])
    return Fields(
        *(
            np.empty((0, *shape), np.float32) if tensor is None else tensor.detach().numpy()
            for tensor, shape in zip(given, shapes, strict=True)
        )
    )


def _camera(pose: Tensor, picture: Picture, options: Options) -> Camera:
    least = _LEAST_SPREAD * picture.pixel_angle**2
    return Camera(
        np.ascontiguousarray(pose.detach().numpy()),
        max(options.spread(picture.pixel_angle), least),
        options.lowpass == "angular",
        options.near,
    )


def _draw_picture(
    scene: tuple[Fields, Camera, Observed],
    picture: Picture,
    options: Options,
    sums: np.ndarray,
    notes: _Notes,
    needs_grad: bool,
    lease: Lease,
    threads: int,
) -> Projection | None:
    """Write one picture's sums, and return what its backward needs."""
    lease, observed = lease if needs_grad else Lease(), scene[2]
    with notes.timed("boxes"):
        records, boxes = _place(scene, picture, options, lease, threads)
    distances = observed.radii
    if options.order == "z" and not picture.is_panorama:
        with notes.timed("sort"):
            towards = picture.rotation[:, 2].numpy().copy()
            distances = depths_along(observed.records, observed.radii, towards, lease, threads)
    plane, shown = plane_of(picture, exact=options.kernel == "ray"), Projection(records, boxes, distances)
    bands = list_tiles(boxes, picture.size, slots=needs_grad, threads=threads, limit=bins.LIMIT)
    while True:
        with notes.timed("bin"):
            lists = next(bands, None)
        if lists is None:
            break
        with notes.timed("sort"):
            sort_front_to_back(lists, distances, threads)
        whole = needs_grad and len(lists.starts) == 1 + math.prod(plane.tiles)
        with notes.timed("raster"):
            room = room_to_keep(lists.starts, lists.lease) if whole else None
            raster_forward(
                records, observed.values, lists.entries, lists.starts, plane, sums,
                first_row=lists.first_row, kept=room, threads=threads,
            )  # fmt: skip
        notes.entries += len(lists.entries)
        given = observed.records, observed.radii
        own = sum(part.nbytes for part in (records, distances) if not any(part is other for other in given))
        listed = sum(part.nbytes for part in (lists.entries, lists.starts, lists.slots, lists.offsets, *(room or ())))
        notes.bytes = max(notes.bytes, own + boxes.nbytes + listed)
        if whole:
            shown = shown._replace(lists=lists, kept=room)
        del lists
    notes.visible += int(np.count_nonzero(boxes.view(np.int64) != bins.NOWHERE))
    return shown if needs_grad else None


def _place(
    scene: tuple[Fields, Camera, Observed], picture: Picture, options: Options, lease: Lease, threads: int
) -> tuple[np.ndarray, np.ndarray]:
    """Records and boxes on a picture."""
    if options.kernel == "ewa":
        return project(*scene, picture, options.dilation, EWA_NEAR * options.near, lease, threads)
    return scene[2].records, find_boxes(scene[2].records, picture, lease, threads)


def _slot_gradients(
    scene: tuple[Fields, Camera, Observed],
    pictures: list[Picture],
    options: Options,
    projections: list[Projection],
    sums: np.ndarray,
    grad_sums: np.ndarray,
    lease: Lease,
    threads: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Gradients of the camera's records and values in slots, the classic kernel's totals, and where slots begin."""
    fields, camera, observed = scene
    num, num_values = observed.values.shape
    exact = options.kernel == "ray"
    alone = exact and len(pictures) == 1 and projections[0].lists is not None
    total_records = np.zeros((num if exact and not alone else 0, FIELDS), np.float32)
    totals = np.zeros((0 if exact else num, TOTALS))
    total_values = np.zeros((0 if alone else num, num_values), np.float32)
    pieces = -(-num // PIECE)
    for number, (picture, projection) in enumerate(zip(pictures, projections, strict=True)):
        plane = plane_of(picture, exact=exact)
        bands = [projection.lists] if projection.lists else list_tiles(
            projection.boxes, picture.size, slots=True, threads=threads, limit=bins.LIMIT
        )  # fmt: skip
        for lists in bands:
            room = projection.kept
            if room is None:  # drawn once more: what many bands would have to keep is too much
                sort_front_to_back(lists, projection.distances, threads)
                room = room_to_keep(lists.starts, lists.lease)
                raster_forward(
                    projection.records, observed.values, lists.entries, lists.starts, plane, sums[number],
                    first_row=lists.first_row, kept=room, threads=threads,
                )  # fmt: skip
            band = lease if alone else Lease()
            grad_records = band.array((len(lists.entries), FIELDS), np.float32)
            grad_values = band.array((len(lists.entries), num_values), np.float32)
            raster_backward(
                projection.records, observed.values, lists.entries, lists.starts, lists.slots, plane, sums[number],
                room, grad_sums[number], grad_records, grad_values, first_row=lists.first_row, threads=threads,
            )  # fmt: skip
            if alone:
                return grad_records, grad_values, totals, lists.offsets
            offsets = lists.offsets
            if exact:
                share(_adding(offsets, grad_records, total_records), pieces, threads)
            else:
                project_backward(fields, camera, picture, options.dilation, grad_records, offsets, totals, threads)
            share(_adding(offsets, grad_values, total_values), pieces, threads)
    return total_records, total_values, totals, np.arange(num + 1)


def _adding(offsets: np.ndarray, slots: np.ndarray, totals: np.ndarray) -> Any:
    return lambda piece: add_slots(piece, offsets, slots, totals)
