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

from pansplat.constants import EWA_NEAR_FACTOR
from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering.cpu import tiling
from pansplat.rendering.cpu.ewa import EWA_GRAD_SIZE, backpropagate_ewa, project_ewa
from pansplat.rendering.cpu.projection import (
    GAUSSIANS_PER_ITEM,
    Camera,
    GaussianArrays,
    ProjectedGaussians,
    project_gaussians,
)
from pansplat.rendering.cpu.projection_backward import GaussianGradients, accumulate_slots, backpropagate_projection
from pansplat.rendering.cpu.rasterize import SavedForBackward, allocate_saved, rasterize_forward
from pansplat.rendering.cpu.rasterize_backward import rasterize_backward
from pansplat.rendering.cpu.records import RECORD_SIZE, tabulate_pixels
from pansplat.rendering.cpu.runtime import Workspace, announce_compilation, parallel_for, pooled_empty, thread_count
from pansplat.rendering.cpu.tiling import (
    LARGEST_SIDE,
    TileIntersections,
    compute_depths,
    find_bounding_boxes,
    intersect_tiles,
    sort_front_to_back,
)
from pansplat.rendering.image_planes import ImagePlane
from pansplat.rendering.projection import not_finite_message
from pansplat.rendering.rasterize import RasterInfo, RasterOptions, RasterSums

_LEAST_SPREAD = 1e-9  # pixel^2: without a filter a disc seen edge-on would have no width to divide by


class Projection(NamedTuple):
    """What one picture shows: records, boxes, and the distances that it is drawn in order of.

    And, if its tile lists came in one band, these and what its forward kept.
    """

    records: np.ndarray
    boxes: np.ndarray
    distances: np.ndarray
    lists: TileIntersections | None = None
    kept: SavedForBackward | None = None


@dataclass
class _Notes:
    """What is told about a picture: counts, seconds by stage, and bytes of the arrays alive at once."""

    dropped: int = 0
    near: int = 0
    visible: int = 0
    intersections: int = 0
    bytes: int = 0
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the seconds that something takes to a stage."""
        start = time.perf_counter()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start


def rasterize_planes(
    gaussians: Gaussians,
    covariances: Float[Tensor, "n 3 3"] | None,
    pose: Float[Tensor, "4 4"],
    pictures: list[ImagePlane],
    options: RasterOptions,
) -> RasterSums:
    """Draw by numba kernels, in float32; see `pansplat.rendering.rasterize.RasterBackend`.

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
        raise InputError(not_finite_message(gaussians, covariances, pose, options))
    info = RasterInfo(
        len(gaussians),
        notes.dropped,
        notes.near,
        notes.visible,
        notes.intersections,
        "numba",
        notes.bytes,
        notes.seconds,
    )
    return RasterSums(sums.to(dtype), info)


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
        pictures: list[ImagePlane],
        options: RasterOptions,
        notes: _Notes,
        recorded: bool,
    ) -> Tensor:
        tensors = means, quats, scales, covariances, opacities, harmonics
        fields, camera = _fields(*tensors), _camera(pose, pictures[0], options)
        threads, workspace = thread_count(), Workspace()
        needs_grad = recorded and any(ctx.needs_input_grad)  # which knows nothing of no_grad
        height, width = pictures[0].size
        with announce_compilation():
            with notes.timed("observe"):
                observed = project_gaussians(fields, camera, workspace, threads)
            sums = pooled_empty((len(pictures), harmonics.shape[2] + 2, height, width), np.float32)
            kept = [
                _draw_picture(
                    (fields, camera, observed), picture, options, sums[number], notes, needs_grad, workspace, threads
                )
                for number, picture in enumerate(pictures)
            ]
        notes.dropped, notes.near = observed.dropped, observed.near
        notes.bytes += sums.nbytes + sum(part.nbytes for part in observed[:4])
        result = torch.from_numpy(sums)
        if needs_grad:
            ctx.save_for_backward(*tensors, pose, result)
            ctx.plan = pictures, options, observed, kept, workspace, threads
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
            torch.from_numpy(pooled_empty(tuple(tensor.shape), np.float32)) if needed else None
            for tensor, needed in zip(tensors, ctx.needs_input_grad, strict=False)
        ]
        with announce_compilation():
            own = Workspace()
            slots = _slot_gradients(
                (fields, camera, observed), pictures, options, kept, sums.numpy(), grad_sums, own, threads
            )
            arrays = (
                np.empty((0, *field.shape[1:]), np.float32) if grad is None else grad.numpy()
                for field, grad in zip(fields, wanted, strict=True)
            )
            own_pose = np.empty((3 if ctx.needs_input_grad[6] else 0, 4))
            filled = backpropagate_projection(
                fields, camera, observed, *slots, GaussianGradients(*arrays, pose=own_pose), threads
            )
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
) -> GaussianArrays:
    """The tensors as arrays, no rows for those not given."""
    given = (means, quats, scales, covariances, opacities, harmonics)
    shapes = ((3,), (4,), (3,), (3, 3), (), harmonics.shape[1:])
    return GaussianArrays(
        *(
            np.empty((0, *shape), np.float32) if tensor is None else tensor.detach().numpy()
            for tensor, shape in zip(given, shapes, strict=True)
        )
    )


def _camera(pose: Tensor, picture: ImagePlane, options: RasterOptions) -> Camera:
    least = _LEAST_SPREAD * picture.pixel_angle**2
    return Camera(
        np.ascontiguousarray(pose.detach().numpy()),
        max(options.filter_variance(picture.pixel_angle), least),
        options.lowpass == "angular",
        options.near,
    )


def _draw_picture(
    scene: tuple[GaussianArrays, Camera, ProjectedGaussians],
    picture: ImagePlane,
    options: RasterOptions,
    sums: np.ndarray,
    notes: _Notes,
    needs_grad: bool,
    workspace: Workspace,
    threads: int,
) -> Projection | None:
    """Write one picture's sums, and return what its backward needs."""
    workspace, observed = workspace if needs_grad else Workspace(), scene[2]
    with notes.timed("boxes"):
        records, boxes = _place(scene, picture, options, workspace, threads)
    distances = observed.radii
    if options.order == "z" and not picture.is_panorama:
        with notes.timed("sort"):
            towards = picture.rotation[:, 2].numpy().copy()
            distances = compute_depths(observed.records, observed.radii, towards, workspace, threads)
    plane, shown = tabulate_pixels(picture, exact=options.kernel == "ray"), Projection(records, boxes, distances)
    bands = intersect_tiles(boxes, picture.size, slots=needs_grad, threads=threads, limit=tiling.MAX_INTERSECTIONS)
    while True:
        with notes.timed("bin"):
            lists = next(bands, None)
        if lists is None:
            break
        with notes.timed("sort"):
            sort_front_to_back(lists, distances, threads)
        whole = needs_grad and len(lists.starts) == 1 + math.prod(plane.tiles)
        with notes.timed("raster"):
            room = allocate_saved(lists.starts, lists.workspace) if whole else None
            rasterize_forward(
                records, observed.values, lists.intersections, lists.starts, plane, sums,
                first_row=lists.first_row, saved=room, threads=threads,
            )  # fmt: skip
        notes.intersections += len(lists.intersections)
        given = observed.records, observed.radii
        own = sum(part.nbytes for part in (records, distances) if not any(part is other for other in given))
        listed = sum(
            part.nbytes for part in (lists.intersections, lists.starts, lists.slots, lists.offsets, *(room or ()))
        )
        notes.bytes = max(notes.bytes, own + boxes.nbytes + listed)
        if whole:
            shown = shown._replace(lists=lists, saved=room)
        del lists
    notes.visible += int(np.count_nonzero(boxes.view(np.int64) != tiling.EMPTY_BOX))
    return shown if needs_grad else None


def _place(
    scene: tuple[GaussianArrays, Camera, ProjectedGaussians],
    picture: ImagePlane,
    options: RasterOptions,
    workspace: Workspace,
    threads: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Records and boxes on a picture."""
    if options.kernel == "ewa":
        return project_ewa(*scene, picture, options.dilation, EWA_NEAR_FACTOR * options.near, workspace, threads)
    return scene[2].records, find_bounding_boxes(scene[2].records, picture, workspace, threads)


def _slot_gradients(
    scene: tuple[GaussianArrays, Camera, ProjectedGaussians],
    pictures: list[ImagePlane],
    options: RasterOptions,
    projections: list[Projection],
    sums: np.ndarray,
    grad_sums: np.ndarray,
    workspace: Workspace,
    threads: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Gradients of the camera's records and values in slots, the classic kernel's totals, and where slots begin."""
    fields, camera, observed = scene
    num, num_values = observed.values.shape
    exact = options.kernel == "ray"
    alone = exact and len(pictures) == 1 and projections[0].lists is not None
    total_records = np.zeros((num if exact and not alone else 0, RECORD_SIZE), np.float32)
    totals = np.zeros((0 if exact else num, EWA_GRAD_SIZE))
    total_values = np.zeros((0 if alone else num, num_values), np.float32)
    pieces = -(-num // GAUSSIANS_PER_ITEM)
    for number, (picture, projection) in enumerate(zip(pictures, projections, strict=True)):
        plane = tabulate_pixels(picture, exact=exact)
        bands = [projection.lists] if projection.lists else intersect_tiles(
            projection.boxes, picture.size, slots=True, threads=threads, limit=tiling.MAX_INTERSECTIONS
        )  # fmt: skip
        for lists in bands:
            room = projection.kept
            if room is None:  # drawn once more: what many bands would have to keep is too much
                sort_front_to_back(lists, projection.distances, threads)
                room = allocate_saved(lists.starts, lists.workspace)
                rasterize_forward(
                    projection.records, observed.values, lists.intersections, lists.starts, plane, sums[number],
                    first_row=lists.first_row, saved=room, threads=threads,
                )  # fmt: skip
            band = workspace if alone else Workspace()
            grad_records = band.array((len(lists.intersections), RECORD_SIZE), np.float32)
            grad_values = band.array((len(lists.intersections), num_values), np.float32)
            rasterize_backward(
                projection.records, observed.values, lists.intersections, lists.starts, lists.slots, plane,
                sums[number], room, grad_sums[number], grad_records, grad_values, first_row=lists.first_row,
                threads=threads,
            )  # fmt: skip
            if alone:
                return grad_records, grad_values, totals, lists.offsets
            offsets = lists.offsets
            if exact:
                parallel_for(_adding(offsets, grad_records, total_records), pieces, threads)
            else:
                backpropagate_ewa(fields, camera, picture, options.dilation, grad_records, offsets, totals, threads)
            parallel_for(_adding(offsets, grad_values, total_values), pieces, threads)
    return total_records, total_values, totals, np.arange(num + 1)


def _adding(offsets: np.ndarray, slots: np.ndarray, totals: np.ndarray) -> Any:
    return lambda piece: accumulate_slots(piece, offsets, slots, totals)
