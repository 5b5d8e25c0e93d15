"""Images for a screen: the forward pass alone, of the Gaussians in view, in several layers, with 8 bits per channel.

A layer is the image of one set of Gaussians, such as those of one input view. All layers share the selection and the
projection. Records are in world axes, so one image plane differs from another by its rotation only. Pixels are uint32
words, red in the lowest byte and 255 in the highest.

Source: docs/rendering.md, sections 4 and 7; docs/viewer.md.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, UInt32

from pansplat.geometry.cubemap import face_rotations
from pansplat.rendering.blend import blend
from pansplat.rendering.cpu.backend import rasterize_plane
from pansplat.rendering.cpu.projection import GaussianArrays, ProjectedGaussians, project_gaussians
from pansplat.rendering.cpu.simd import load_scalar, prefetch, store_scalar
from pansplat.rendering.cpu.view import CameraView, Statistics, make_camera
from pansplat.rendering.image_planes import ImagePlane
from pansplat.rendering.rasterize import normalise_sums
from pansplat.system.kernels import (
    Workspace,
    inline_kernel,
    kernel,
    parallel_for,
    parallel_for_slices,
    pooled_empty,
    thread_count,
)

MIN_TRANSMITTANCE = 2.0**-10
"""A pixel of a display image is finished at this transmittance: a quarter of a step of 8 bits."""

NO_LAYER = -1
"""Label of Gaussians that are not drawn."""

_PARTS_PER_THREAD = 4
_SELECTED_AT_ONCE = 1024  # Gaussians; their marks fit the L1 cache
_PREFETCH_AHEAD = 16  # Gaussians between the prefetch of a row and its use
_GEOMETRY = 11  # numbers of a row before the harmonics: mean, opacity, quaternion, scales
_LINE_SIZE = 16  # float32 numbers in a cache line
_ROWS_PER_ITEM = 16
_EVEN_BYTES = np.uint32(0x00FF00FF)
_FRACTION_BITS = 8  # bits of the weight of a neighbouring pixel, after the binary point


class Selection(NamedTuple):
    """The cone of directions that is drawn: the intersection of half spaces through the camera centre.

    Attributes:
        normals: (plane, 3) inward unit normals, world axes.
        deviation: a bound of a Gaussian's widening by the filter, in standard deviations per distance, radians.
    """

    normals: Float[np.ndarray, "plane 3"]
    deviation: float


@dataclass(frozen=True, eq=False)
class Layers:
    """The layers of one image plane before background and normalisation.

    Attributes:
        sums: sums of weight x (RGB, radial distance, 1), for each layer.
        selected: Gaussians in view.
        statistics: counts and seconds by stage.
    """

    sums: Float[np.ndarray, "layer 5 height width"]
    selected: int
    statistics: Statistics


class DisplayScene:
    """The Gaussians of a scene, one row of whole cache lines each, so that those in view are read at random."""

    def __init__(
        self,
        means: Float[np.ndarray, "n 3"],
        opacities: Float[np.ndarray, "n"],
        quats: Float[np.ndarray, "n 4"],
        scales: Float[np.ndarray, "n 3"],
        harmonics: Float[np.ndarray, "n k 3"],
        reach: Float[np.ndarray, "n"],
        report: Callable[[float], None] = lambda done: None,
    ) -> None:
        """Copy the Gaussians.

        Args:
            means, opacities, quats, scales, harmonics: finite.
            reach: a Gaussian is visible up to this number of standard deviations.
            report: called with the fraction done; an exception ends the work.
        """
        num, self._num_coefficients = len(means), harmonics.shape[1]
        size = -(-(_GEOMETRY + 3 * self._num_coefficients) // _LINE_SIZE) * _LINE_SIZE
        self._workspace = Workspace()
        self._rows = self._workspace.array((num, size), np.float32)
        self._balls = np.empty((5, num), np.float32)

        def copy(part: slice) -> None:
            rows, balls = self._rows[part], self._balls[:, part]
            rows[:, 0:3], rows[:, 3] = means[part], opacities[part]
            rows[:, 4:8], rows[:, 8:11] = quats[part], scales[part]
            rows[:, _GEOMETRY : _GEOMETRY + 3 * self._num_coefficients] = harmonics[part].reshape(len(rows), -1)
            balls[:3], balls[4] = rows[:, 0:3].T, reach[part]
            balls[3] = balls[4] * np.maximum.reduce([rows[:, axis] for axis in (8, 9, 10)])

        parallel_for_slices(copy, num, report)

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def means(self) -> Float[np.ndarray, "n 3"]:
        """The centres of the Gaussians, metres."""
        return self._rows[:, 0:3]

    @property
    def quats(self) -> Float[np.ndarray, "n 4"]:
        """The rotations of the Gaussians, quaternions wxyz."""
        return self._rows[:, 4:8]

    @property
    def scales(self) -> Float[np.ndarray, "n 3"]:
        """The standard deviations of the Gaussians along their axes, metres."""
        return self._rows[:, 8:11]

    def with_colors(self, colors: Float[np.ndarray, "n 3"]) -> "DisplayScene":
        """The same Gaussians with colours that do not depend on the direction."""
        harmonics = ((colors - 0.5) * (2 * math.sqrt(math.pi)))[:, None]
        return DisplayScene(self.means, self._rows[:, 3], self.quats, self.scales, harmonics, self._balls[4])

    def rasterize(
        self,
        position: Float[np.ndarray, "3"],
        plane: ImagePlane,
        labels: Int[np.ndarray, "n"],
        num_layers: int,
        near: float,
        *,
        selection: Selection | None = None,
        min_transmittance: float = MIN_TRANSMITTANCE,
        shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> Layers:
        """Rasterise the layers of an image plane.

        Args:
            position: camera centre.
            plane: its rotation is from its axes to the world's.
            labels: layer of each Gaussian, int16, or `NO_LAYER`.
            num_layers: number of layers.
            near: Gaussians whose mean is nearer are not drawn, metres.
            selection: leaves out Gaussians that are not in view.
            min_transmittance: a pixel is finished at this transmittance or below.
            shift: see `project_gaussians`.
        """
        statistics, threads, workspace = Statistics(), thread_count(), Workspace()
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, 3] = torch.from_numpy(np.asarray(position, np.float64))
        camera = make_camera(pose, plane, near)
        sums = pooled_empty((num_layers, 5, *plane.size), np.float32)
        with statistics.timed("select"):
            gaussians, ends = self._select(camera.pose[:3, 3], labels, num_layers, selection, workspace)
        with statistics.timed("project"):
            projected = project_gaussians(gaussians, camera, workspace, threads, shift)
        start = 0
        for end, layer_sums in zip(ends, sums, strict=True):
            part = slice(start, end)
            layer = ProjectedGaussians(*(array[part] for array in projected))
            arrays = GaussianArrays(*(array[part] for array in gaussians))
            view = CameraView(arrays, camera, layer, threads, min_transmittance)
            rasterize_plane(view, plane, layer_sums, statistics)
            start = end
        return Layers(sums, ends[-1] if ends else 0, statistics)

    def _select(
        self,
        position: np.ndarray,
        labels: np.ndarray,
        num_layers: int,
        selection: Selection | None,
        workspace: Workspace,
    ) -> tuple[GaussianArrays, list[int]]:
        """Copy the Gaussians in view, layer by layer in index order; returns them and the end of each layer."""
        edges, marks, counts = mark_in_view(self._balls, position, selection, labels, num_layers)
        ends = np.cumsum(counts.sum(axis=0))
        positions = ends - counts.sum(axis=0) + np.cumsum(counts, axis=0) - counts
        total, coefficients = int(counts.sum()), self._num_coefficients
        means, quats = workspace.array((total, 3), np.float32), workspace.array((total, 4), np.float32)
        scales, opacities = workspace.array((total, 3), np.float32), workspace.array(total, np.float32)
        harmonics = workspace.array((total, coefficients, 3), np.float32)
        outputs = means.reshape(-1), quats.reshape(-1), scales.reshape(-1), opacities, harmonics.reshape(-1)
        rows = self._rows.reshape(-1), self._rows.shape[1], 3 * coefficients
        parallel_for(partial(_copy_marked, edges, marks, positions, *rows, *outputs), len(counts), thread_count())
        return GaussianArrays(means, quats, scales, opacities, harmonics), ends.tolist()


def mark_in_view(
    balls: Float[np.ndarray, "5 n"],
    position: Float[np.ndarray, "3"],
    selection: Selection | None,
    labels: Int[np.ndarray, "label"],
    num_layers: int = 1,
) -> tuple[Int[np.ndarray, "edge"], Int[np.ndarray, "n"], Int[np.ndarray, "part layer"]]:
    """Frustum culling: the layer of each Gaussian that may be in view, else `NO_LAYER`; conservative.

    Args:
        balls: rows x, y and z of the centre, radius that a Gaussian reaches, and the same in standard deviations.
        position: camera centre.
        selection: the cone in view; None keeps all Gaussians.
        labels: layer of each Gaussian, int16, or `NO_LAYER`.

    Returns:
        Ends of parts of the scene, the layers (int16), and the number of Gaussians of each part and layer.
    """
    num, threads = balls.shape[1], thread_count()
    if len(labels) != num or not NO_LAYER <= labels.min(initial=NO_LAYER) <= labels.max(initial=-1) < num_layers:
        raise ValueError(f"`labels` must hold {num} numbers from {NO_LAYER} to {num_layers - 1}")
    parts = _PARTS_PER_THREAD * threads
    edges = np.linspace(0, num, parts + 1).astype(np.int64)
    marks, counts = pooled_empty(num, np.int16), np.zeros((parts, num_layers), np.int64)
    normals, deviation = selection or (np.zeros((0, 3)), 0.0)
    offsets = normals @ position
    mark = partial(
        _mark_in_view, edges, balls, position.astype(np.float32), np.ascontiguousarray(normals, np.float32),
        offsets.astype(np.float32), np.float32(1.001 * deviation), labels, marks, counts,
    )  # fmt: skip
    parallel_for(mark, parts, threads)
    return edges, marks, counts


@kernel
def _mark_in_view(edges, balls, position, normals, offsets, deviation, labels, marks, counts, part):
    """Write the layer of each Gaussian that is in view, else NO_LAYER, and count the Gaussians of each layer."""
    x, y, z, extent, reach = balls[0], balls[1], balls[2], balls[3], balls[4]
    p_x, p_y, p_z = position[0], position[1], position[2]
    bounds, seen = np.empty(_SELECTED_AT_ONCE, np.float32), np.empty(_SELECTED_AT_ONCE, np.float32)
    for first in range(edges[part], edges[part + 1], _SELECTED_AT_ONCE):
        count = min(_SELECTED_AT_ONCE, edges[part + 1] - first)
        for i in range(count):
            d_x, d_y, d_z = (
                load_scalar(x, first + i) - p_x,
                load_scalar(y, first + i) - p_y,
                load_scalar(z, first + i) - p_z,
            )
            distance = math.sqrt(d_x * d_x + d_y * d_y + d_z * d_z)
            bound = distance * (deviation * load_scalar(reach, first + i) + np.float32(1e-5))
            store_scalar(bounds, i, bound + np.float32(1.001) * load_scalar(extent, first + i))
            store_scalar(seen, i, np.float32(0) if load_scalar(reach, first + i) > np.float32(0) else -np.float32(1))
        for k in range(normals.shape[0]):
            n_x, n_y, n_z, offset = normals[k, 0], normals[k, 1], normals[k, 2], offsets[k]
            for i in range(count):
                ahead = n_x * load_scalar(x, first + i) + n_y * load_scalar(y, first + i)
                ahead += n_z * load_scalar(z, first + i) + (load_scalar(bounds, i) - offset)
                store_scalar(seen, i, min(load_scalar(seen, i), ahead))
        for i in range(count):
            label = load_scalar(labels, first + i)
            layer = label if load_scalar(seen, i) >= np.float32(0) else np.int16(NO_LAYER)
            store_scalar(marks, first + i, layer)
            if layer >= 0:
                counts[part, layer] += 1


@kernel
def _copy_marked(
    edges, marks, positions, rows, row_size, num_harmonics, means, quats, scales, opacities, harmonics, part
):  # fmt: skip
    """Copy the rows of the marked Gaussians of one part to separate arrays, from each layer's position on."""
    last = len(marks) - 1
    for g in range(edges[part], edges[part + 1]):
        label = load_scalar(marks, g)
        if load_scalar(marks, min(g + _PREFETCH_AHEAD, last)) >= 0:
            prefetch(rows, row_size * min(g + _PREFETCH_AHEAD, last))
        if label >= 0:
            to, row = positions[part, label], row_size * g
            positions[part, label] = to + 1
            for i in range(3):
                store_scalar(means, 3 * to + i, load_scalar(rows, row + i))
                store_scalar(scales, 3 * to + i, load_scalar(rows, row + 8 + i))
            store_scalar(opacities, to, load_scalar(rows, row + 3))
            for i in range(4):
                store_scalar(quats, 4 * to + i, load_scalar(rows, row + 4 + i))
            for i in range(num_harmonics):
                store_scalar(harmonics, num_harmonics * to + i, load_scalar(rows, row + _GEOMETRY + i))


# --- layers to pixels ---


def blend_layers(
    sums: Float[np.ndarray, "layer 5 height width"],
    weights: Float[np.ndarray, "layer"],
    background: tuple[float, float, float],
) -> tuple[Float[np.ndarray, "height width 4"], Float[np.ndarray, "height width"]]:
    """RGB over the background and alpha, and depth, of weighted layers.

    Source: docs/rendering.md, section 7, with positive weights.
    """
    behind = torch.tensor(background, dtype=torch.float32)
    layers = [normalise_sums(torch.from_numpy(layer), behind) for layer in sums]
    image = blend(layers, torch.as_tensor(weights, dtype=torch.float32))
    return torch.cat((image.color, image.alpha[None])).movedim(0, 2).contiguous().numpy(), image.depth.numpy()


def blend_to_pixels(
    sums: Float[np.ndarray, "layer 5 height width"],
    weights: Float[np.ndarray, "layer"],
    background: tuple[float, float, float],
    pixels: UInt32[np.ndarray, "height width"],
    *,
    bottom_up: bool = False,
) -> None:
    """Write the image of `blend_layers` with 8 bits per channel.

    Args:
        sums, weights, background: as in `blend_layers`.
        pixels: written.
        bottom_up: write the bottom row first, as OpenGL stores images.
    """
    work = partial(
        _blend_rows, sums, np.asarray(weights, np.float32), np.array(background, np.float32), bottom_up, pixels
    )
    parallel_for(work, -(-pixels.shape[0] // _ROWS_PER_ITEM), thread_count())


@kernel
def _blend_rows(sums, weights, background, bottom_up, pixels, item):
    _, _, height, width = sums.shape
    rgb = np.empty((3, width), np.float32)
    total, coverage = np.empty(width, np.float32), np.empty(width, np.float32)
    for y in range(item * _ROWS_PER_ITEM, min((item + 1) * _ROWS_PER_ITEM, height)):
        _blend_row(sums, weights, background, y, rgb, total, coverage)
        row = pixels[height - 1 - y if bottom_up else y]
        for x in range(width):
            red, green, blue = _to_byte(rgb[0, x]), _to_byte(rgb[1, x]), _to_byte(rgb[2, x])
            row[x] = np.uint32(0xFF000000) | red | green << np.uint32(8) | blue << np.uint32(16)


@inline_kernel
def _to_byte(value):
    clipped = min(max(value, np.float32(0)), np.float32(1))
    return np.uint32(np.int32(clipped * np.float32(255) + np.float32(0.5)))


@inline_kernel
def _blend_row(sums, weights, background, y, rgb, total, coverage):
    """Write RGB over the background of one row."""
    num_layers, width = sums.shape[0], rgb.shape[1]
    for x in range(width):
        total[x] = coverage[x] = np.float32(0)
        rgb[0, x] = rgb[1, x] = rgb[2, x] = np.float32(0)
    for layer in range(num_layers):
        weight = weights[layer] if num_layers > 1 else np.float32(1)
        for x in range(width):
            alpha = min(sums[layer, 4, y, x], np.float32(1))
            total[x] += weight * alpha
            coverage[x] = max(coverage[x], alpha)
            rgb[0, x] += weight * sums[layer, 0, y, x]
            rgb[1, x] += weight * sums[layer, 1, y, x]
            rgb[2, x] += weight * sums[layer, 2, y, x]
    for x in range(width):
        scale = coverage[x] / total[x] if total[x] > np.float32(0) else np.float32(0)
        behind = np.float32(1) - coverage[x]
        rgb[0, x] = rgb[0, x] * scale + behind * background[0]
        rgb[1, x] = rgb[1, x] * scale + behind * background[1]
        rgb[2, x] = rgb[2, x] * scale + behind * background[2]


# --- a rotated view from cube faces ---


@dataclass(frozen=True, eq=False)
class PixelFaces:
    """Six cube faces of one camera position, in world axes, with a border for interpolation.

    Attributes:
        focal: focal length of the faces, pixels; a face covers `2 focal` pixels without its border.
        pixels: faces in the order of `pansplat.geometry.cubemap.FACES`.
    """

    focal: float
    pixels: UInt32[np.ndarray, "face side side"]

    @staticmethod
    def allocate(focal: float) -> "PixelFaces":
        """Faces with undefined content."""
        side = 2 * math.ceil(focal) + 2
        return PixelFaces(focal, np.empty((6, side, side), np.uint32))

    def plane(self, face: int) -> ImagePlane:
        """The image plane of a face, with its border; its rotation is to the world's axes."""
        side = self.pixels.shape[1]
        return ImagePlane((side, side), face_rotations()[face], self.focal)

    def sample(
        self,
        rotation: Float[np.ndarray, "3 3"],
        focal: float,
        pixels: UInt32[np.ndarray, "height width"],
        *,
        bottom_up: bool = False,
    ) -> None:
        """Write the pinhole image of a camera at the same position, by bilinear interpolation.

        Args:
            rotation: camera to world.
            focal: focal length of the image, pixels.
            pixels: written.
            bottom_up: write the bottom row first, as OpenGL stores images.
        """
        to_faces = np.ascontiguousarray(face_rotations().numpy().transpose(0, 2, 1) @ rotation)
        focals = np.float64(self.focal), np.float64(focal)
        work = partial(_sample_rows, self.pixels, *focals, to_faces, bottom_up, pixels)
        parallel_for(work, -(-pixels.shape[0] // _ROWS_PER_ITEM), thread_count())


@kernel
def _sample_rows(faces, face_focal, focal, to_faces, bottom_up, pixels, item):
    """Sample the rows of one item.

    Args:
        faces: pixels.
        face_focal: focal length of the faces.
        focal: focal length of the image.
        to_faces: (face, 3, 3) float64, from camera axes to each face's axes.
        bottom_up: write the bottom row first.
        pixels: written.
        item: number of the block of rows.
    """
    side, (height, width) = faces.shape[1], pixels.shape
    flat = faces.reshape(-1)
    middle, limit = np.float32(0.5 * side - 0.5), 1.0 + 0.5 / face_focal
    start, step = np.empty((6, 3)), np.empty((6, 3))
    corners, fractions = np.empty(width, np.int32), np.empty(width, np.int32)
    for k in range(6):
        for j in range(3):
            step[k, j] = to_faces[k, j, 0] / focal
    for y in range(item * _ROWS_PER_ITEM, min((item + 1) * _ROWS_PER_ITEM, height)):
        down, left = (y + 0.5 - 0.5 * height) / focal, (0.5 - 0.5 * width) / focal
        for k in range(6):
            for j in range(3):
                start[k, j] = to_faces[k, j, 0] * left + to_faces[k, j, 1] * down + to_faces[k, j, 2]
        row = pixels[height - 1 - y if bottom_up else y]
        x = 0
        while x < width:
            face, best = 0, -np.inf
            for k in range(6):  # the face on whose axis the ray is the longest
                ahead = start[k, 2] + x * step[k, 2]
                if ahead > best:
                    best, face = ahead, k
            end = float(width)
            for j in range(2):  # the ray leaves the face where |across| = limit * ahead
                for sign in (-1.0, 1.0):
                    slope = limit * step[face, 2] + sign * step[face, j]
                    if slope < 0:
                        end = min(end, (limit * start[face, 2] + sign * start[face, j]) / -slope)
            after = max(np.int64(math.floor(end)), x + 1)
            _sample_run(
                flat, face * side * side, side, np.float32(face_focal), middle,
                np.float32(start[face, 0]), np.float32(start[face, 1]), np.float32(start[face, 2]),
                np.float32(step[face, 0]), np.float32(step[face, 1]), np.float32(step[face, 2]),
                row, x, after, corners, fractions,
            )  # fmt: skip
            x = after


@inline_kernel
def _sample_run(
    flat, base, side, focal, middle, s_x, s_y, s_z, t_x, t_y, t_z, row, first, end, corners, fractions
):  # fmt: skip
    """Sample pixels `first` to `end` - 1 of a row, whose rays meet one face.

    Positions and look-ups are two loops: LLVM vectorises the first one, and cannot vectorise look-ups.
    """
    largest = np.int32(side) - np.int32(2)
    for x in range(first, end):
        at = np.float32(x)
        scale = focal / (s_z + at * t_z)
        u = np.int32(((s_x + at * t_x) * scale + middle) * np.float32(1 << _FRACTION_BITS))
        v = np.int32(((s_y + at * t_y) * scale + middle) * np.float32(1 << _FRACTION_BITS))
        column = min(max(u >> np.int32(_FRACTION_BITS), np.int32(0)), largest)
        line = min(max(v >> np.int32(_FRACTION_BITS), np.int32(0)), largest)
        store_scalar(corners, x, line * np.int32(side) + column)
        store_scalar(fractions, x, (u & np.int32(255)) | (v & np.int32(255)) << np.int32(8))
    for x in range(first, end):
        corner, fraction = base + np.int64(load_scalar(corners, x)), np.uint32(load_scalar(fractions, x))
        f_x, f_y = fraction & np.uint32(255), fraction >> np.uint32(8)
        upper = _mix(load_scalar(flat, corner), load_scalar(flat, corner + 1), f_x)
        lower = _mix(load_scalar(flat, corner + side), load_scalar(flat, corner + side + 1), f_x)
        store_scalar(row, x, _mix(upper, lower, f_y))


@inline_kernel
def _mix(first, second, fraction):
    """Interpolate the four bytes of two words; `fraction` in 1/256."""
    rest = np.uint32(256) - fraction
    half = np.uint32(0x00800080)
    even = (first & _EVEN_BYTES) * rest + (second & _EVEN_BYTES) * fraction + half
    odd = (first >> np.uint32(8) & _EVEN_BYTES) * rest + (second >> np.uint32(8) & _EVEN_BYTES) * fraction + half
    return (even >> np.uint32(8) & _EVEN_BYTES) | (odd & ~_EVEN_BYTES)
