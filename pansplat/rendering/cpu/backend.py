"""The CPU backend: runs the stages from torch tensors to the sums of image planes, and back to gradients.

Source: docs/rendering.md; docs/rasterizer.md describes the stages and their cost.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering import reference
from pansplat.rendering.cpu import tiling  # a module, because tests lower its MAX_INTERSECTIONS
from pansplat.rendering.cpu.columns import rasterize_columns
from pansplat.rendering.cpu.projection import GaussianArrays, project_gaussians
from pansplat.rendering.cpu.projection_backward import GaussianGradients, accumulate_slots, backpropagate_projection
from pansplat.rendering.cpu.rasterize import VALUE_LANES, SavedForBackward, allocate_saved, rasterize_forward
from pansplat.rendering.cpu.rasterize_backward import rasterize_backward
from pansplat.rendering.cpu.records import RECORD_SIZE, PixelTables, tabulate_pixels
from pansplat.rendering.cpu.tiling import (
    LARGEST_SIDE,
    TileIntersections,
    find_bounding_boxes,
    intersect_tiles,
    sort_front_to_back,
)
from pansplat.rendering.cpu.view import CameraView, Statistics, make_camera
from pansplat.rendering.image_planes import ImagePlane
from pansplat.rendering.rasterize import RasterOptions
from pansplat.system.kernels import Workspace, pooled_empty, thread_count


class _PlaneState(NamedTuple):
    """What the backward reads of one image plane; tiles and transmittances only if all tiles fit one band."""

    boxes: np.ndarray
    tiles: TileIntersections | None = None
    saved: SavedForBackward | None = None


def rasterize_planes(
    gaussians: Gaussians,
    pose: Float[Tensor, "4 4"],
    planes: list[ImagePlane],
    options: RasterOptions,
) -> Float[Tensor, "plane sums height width"]:
    """Rasterise by numba kernels, in float32; see `pansplat.rendering.rasterize.RasterBackend`."""
    if options.kernel != "ray" or gaussians.harmonics.shape[2] != 3:
        raise InputError(
            f"backend 'numba' has kernel 'ray' and three channels only, got kernel {options.kernel!r} and "
            f"{gaussians.harmonics.shape[2]} channels; use backend='torch'"
        )
    if gaussians.means.device.type != "cpu":
        raise InputError(
            f"backend 'numba' needs Gaussians in main memory, got them on {gaussians.means.device}; use "
            "backend='auto', or move them with gaussians.to(device='cpu')"
        )
    if max(planes[0].size) > LARGEST_SIDE:
        raise InputError(
            f"`size` must be at most {LARGEST_SIDE} pixels a side for backend 'numba', got {planes[0].size}; "
            "choose a smaller size, or use backend='torch'"
        )
    fields = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.harmonics
    tensors = tuple(field.to(torch.float32).contiguous() for field in fields)
    has_grad = any(tensor.requires_grad for tensor in (*tensors, pose)) and torch.is_grad_enabled()
    if planes[0].eye_offset and has_grad:  # stereo with gradients is too rare for kernels of its own
        return reference.rasterize_planes(gaussians, pose, planes, options)
    sums = _Rasterize.apply(pose, planes, options.near, torch.is_grad_enabled(), *tensors)
    return sums.to(gaussians.means.dtype)


class _Rasterize(torch.autograd.Function):
    """The sums of all image planes, differentiable once in the tensors and the pose."""

    @staticmethod
    def forward(
        ctx: Any,
        pose: Tensor,
        planes: list[ImagePlane],
        near: float,
        grad_enabled: bool,
        *tensors: Tensor,
    ) -> Tensor:
        """Sums; `tensors` are the fields of GaussianArrays."""
        gaussians, camera = GaussianArrays.from_tensors(tensors), make_camera(pose, planes[0], near)
        threads, workspace = thread_count(), Workspace()
        needs_grad = grad_enabled and any(ctx.needs_input_grad)  # needs_input_grad itself ignores no_grad
        projected = project_gaussians(gaussians, camera, workspace, threads)
        view = CameraView(gaussians, camera, projected, threads)
        sums = pooled_empty((len(planes), VALUE_LANES + 1, *planes[0].size), np.float32)
        states = [
            rasterize_plane(view, plane, plane_sums, Statistics(), workspace if needs_grad else None)
            for plane, plane_sums in zip(planes, sums, strict=True)
        ]
        result = torch.from_numpy(sums)
        if needs_grad:  # the workspace is kept because it owns the arrays of `projected` and `states`
            ctx.save_for_backward(*tensors, pose, result)
            ctx.saved = planes, near, projected, states, workspace, threads
        return result

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():  # the caller chose create_graph=True
            raise RuntimeError("second derivatives of a rendering are not available; drop create_graph=True")
        *tensors, pose, sums = ctx.saved_tensors
        planes, near, projected, states, _workspace, threads = ctx.saved
        gaussians, camera = GaussianArrays.from_tensors(tensors), make_camera(pose, planes[0], near)
        view = CameraView(gaussians, camera, projected, threads)
        needs_pose, _, _, _, *needed = ctx.needs_input_grad
        grads = [
            torch.from_numpy(pooled_empty(tuple(tensor.shape), np.float32)) if is_needed else None
            for tensor, is_needed in zip(tensors, needed, strict=True)
        ]
        workspace = Workspace()
        grad_sums = grad_outputs[0].contiguous().numpy()
        slots = _backpropagate_planes(view, planes, states, sums.numpy(), grad_sums, workspace)
        outputs = (
            np.empty((0, *array.shape[1:]), np.float32) if grad is None else grad.numpy()
            for array, grad in zip(gaussians, grads, strict=True)
        )
        gradients = GaussianGradients(*outputs, pose=np.empty((3 if needs_pose else 0, 4)))
        gradients = backpropagate_projection(gaussians, camera, projected, *slots, gradients, threads)
        grad_pose = None
        if needs_pose:
            grad_pose = torch.zeros_like(pose)
            grad_pose[:3] = torch.from_numpy(gradients.pose)
        return (grad_pose, None, None, None, *grads)


def rasterize_plane(
    view: CameraView, plane: ImagePlane, sums: np.ndarray, statistics: Statistics, saved_in: Workspace | None = None
) -> _PlaneState | None:
    """Write the sums of one image plane.

    Args:
        saved_in: memory for the state that the backward reads.

    Returns:
        This state, or None without `saved_in`.
    """
    projected, threads, needs_grad = view.projected, view.threads, saved_in is not None
    if plane.eye_offset:
        rasterize_columns(view, plane, sums)
        return None
    workspace = saved_in or Workspace()
    with statistics.timed("bound"):
        boxes = find_bounding_boxes(projected.records, plane, workspace, threads)
    tables, state = tabulate_pixels(plane), _PlaneState(boxes)
    bands = intersect_tiles(boxes, plane.size, slots=needs_grad, threads=threads, limit=tiling.MAX_INTERSECTIONS)
    while True:
        with statistics.timed("intersect"):
            tiles = next(bands, None)
        if tiles is None:
            break
        with statistics.timed("sort"):
            sort_front_to_back(tiles, projected.radii, threads)
        is_whole_image = len(tiles.starts) == 1 + math.prod(tables.tiles)
        saved = allocate_saved(tiles.starts, tiles.workspace) if needs_grad and is_whole_image else None
        with statistics.timed("rasterize"):
            _rasterize_band(view, tiles, tables, sums, saved)
        if saved is not None:
            state = state._replace(tiles=tiles, saved=saved)
        del tiles  # the next band reuses their memory
    statistics.visible += int(np.count_nonzero(boxes.view(np.int64) != tiling.EMPTY_BOX))
    return state if needs_grad else None


def _rasterize_band(
    view: CameraView, tiles: TileIntersections, tables: PixelTables, sums: np.ndarray, saved: SavedForBackward | None
) -> None:
    """Write the sums of a band of tile rows."""
    rasterize_forward(
        view.projected.records, view.projected.values, tiles.intersections, tiles.starts, tables, sums,
        first_row=tiles.first_row, saved=saved, threads=view.threads, min_transmittance=view.min_transmittance,
    )  # fmt: skip


def _backpropagate_planes(
    view: CameraView,
    planes: list[ImagePlane],
    states: list[_PlaneState],
    sums: np.ndarray,
    grad_sums: np.ndarray,
    workspace: Workspace,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gradients of records and values by slot, and the first slot of each Gaussian.

    With one image plane in one band the slots are those of its intersections; otherwise each Gaussian has one.
    """
    projected, threads = view.projected, view.threads
    num = len(projected.values)
    is_single = len(planes) == 1 and states[0].tiles is not None
    total_records = np.zeros((0 if is_single else num, RECORD_SIZE), np.float32)
    total_values = np.zeros((0 if is_single else num, VALUE_LANES), np.float32)
    for plane, state, plane_sums, plane_grads in zip(planes, states, sums, grad_sums, strict=True):
        tables = tabulate_pixels(plane)
        bands = [state.tiles] if state.tiles else intersect_tiles(
            state.boxes, plane.size, slots=True, threads=threads, limit=tiling.MAX_INTERSECTIONS
        )  # fmt: skip
        for tiles in bands:
            saved = state.saved
            if saved is None:  # rasterise again: the transmittances of all bands would take too much memory
                sort_front_to_back(tiles, projected.radii, threads)
                saved = allocate_saved(tiles.starts, tiles.workspace)
                _rasterize_band(view, tiles, tables, plane_sums, saved)
            band_workspace = workspace if is_single else Workspace()
            grad_records = band_workspace.array((len(tiles.intersections), RECORD_SIZE), np.float32)
            grad_values = band_workspace.array((len(tiles.intersections), VALUE_LANES), np.float32)
            rasterize_backward(
                projected.records, projected.values, tiles.intersections, tiles.starts, tiles.slots, tables, plane_sums,
                saved, plane_grads, grad_records, grad_values, first_row=tiles.first_row, threads=threads,
            )  # fmt: skip
            if is_single:
                return grad_records, grad_values, tiles.offsets
            accumulate_slots(tiles.offsets, grad_records, total_records, threads)
            accumulate_slots(tiles.offsets, grad_values, total_values, threads)
    return total_records, total_values, np.arange(num + 1)
