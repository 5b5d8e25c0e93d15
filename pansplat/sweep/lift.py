"""From surfaces to Gaussians: the spherical Gaussian pyramid on Fibonacci lattices.

Levels 0 and 1 are discs on the surface, with gaps at depth discontinuities; level 0 is used only where level 1 would
lose image detail. Where a large panorama has detail that a lattice of half its height would lose, finer lattices
replace the points of level 0. Levels 2 and 3 are a closed background layer slightly behind the surface: at every
discontinuity it continues the far side, so that a moving camera sees no holes. Points in the consistent free
space of more other views than confirm them are removed.

Source: PanSplat, section 3.3 (lattices and levels).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numba as nb
import numpy as np
import torch

from pansplat.gaussians.harmonics import SH_0
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.equirect import row_weights, sample_equirect, uv_from_directions
from pansplat.geometry.fibonacci import fibonacci_directions, lattice_size
from pansplat.sweep.panoramas import (
    for_point_ranges,
    locate_pixel,
    nearest_pixel,
    pad_sphere,
    resize_mask,
    resize_sphere,
)
from pansplat.sweep.surface import (
    CONSISTENT,
    FREE_SPACE,
    PosedImages,
    Surface,
    classify_visibility,
    consistency_mask,
    guided_upsample,
)
from pansplat.system.kernels import cached_njit

_Lattice = tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]
"""Rays (n, 3) of a lattice, the same for all views, and the pixels (rows, columns) of a panorama that hold them."""

NUM_LEVELS = 4  # PanSplat, section 3.3
_MAX_LENGTH = 0.2  # largest standard deviation of a disc, relative to its distance
_MIN_DISTANCE = 0.5  # smallest distance of a Gaussian from an input camera, relative to `near`


# Sizes of the Gaussians
_FOOTPRINT = 0.7  # standard deviation of a disc, in lattice spacings
_FINE_FOOTPRINT = 0.6  # standard deviation of a disc on a lattice finer than the surface, in lattice spacings
_THICKNESS = 0.1  # standard deviation across the surface, relative to the disc's
_MAX_STRETCH = (4.0, 4.0, 12.0, 24.0)  # largest ratio of a disc's long axis to its short one, by level
_BACKGROUND_DEPTH = (1.02, 1.04)  # depth of levels 2 and 3 relative to the background
_BACKGROUND_REACH = (4, 8)  # pixels of the level by which the background is extended in front of a discontinuity

# Levels
_SURFACE_HEIGHT = 512  # taller panoramas have surfaces of a half, a quarter ... of their height, not below this
_MAX_COLOR_ERROR = 0.02  # largest error of a colour that level 1 draws
_FINE_COLOR_ERROR = 0.015  # largest colour error of a lattice where no finer one replaces it
_FINE_POINTS = 780_000  # points of a view on the finer lattices; where they do not suffice, a larger error is allowed
_DISCONTINUITY = 0.15  # relative change of inverse depth between pixels at a discontinuity

# Relative difference of depth up to which another view confirms a point, and beyond which it may remove it: more than
# in `consistency_mask`, which chooses the pixels that may remove points.
_DEPTH_TOLERANCE = 0.15
_CONSISTENT_OPACITY = 0.95  # opacity where another view is consistent
_SINGLE_VIEW_OPACITY = 0.9  # opacity where no other view sees the surface
_UNCERTAIN_OPACITY = 0.8  # opacity in the free space of another view whose own surface is not consistent with any view


def lift(posed: PosedImages, surfaces: list[Surface], neighbours: Sequence[Sequence[int]]) -> Gaussians:
    """The Gaussians of all views and levels, ordered by level, then view, then lattice (finest first) and point.

    Args:
        neighbours: the other views whose surfaces confirm or contradict those of each view.
    """
    photographs, heights = posed.images, _lattice_heights(posed.images.shape[1], _SURFACE_HEIGHT)
    posed = posed.resize(heights[-1])
    if surfaces[0].height != heights[-1]:
        surfaces = [
            guided_upsample(s, resize_sphere(image, s.height), image)
            for s, image in zip(surfaces, posed.images, strict=True)
        ]
    views = range(len(surfaces))
    consistent = [consistency_mask(surfaces, posed.cam2world, view, neighbours[view]) for view in views]
    scene = _PosedSurfaces(posed, surfaces, neighbours, consistent)
    fine = [_choose_fine_pixels(image, heights) for image in photographs]
    parts = []
    for level in range(NUM_LEVELS):
        lattice = _locate_lattice(heights[-1] >> level, heights[-1])
        for view in views:
            if level == 0:
                parts += [
                    _lift_fine(scene, view, resize_sphere(photographs[view], height), chosen)
                    for height, chosen in zip(heights[:-1], fine[view][:-1], strict=True)
                ]
            parts.append(_lift_level(scene, view, level, lattice, fine[view][-1]))
    return Gaussians.cat(parts)


def _background_inverse_depth(inverse: np.ndarray, mask: np.ndarray, level: int) -> np.ndarray:
    """Inverse depth at a coarse level's size, with the far side extended over every discontinuity."""
    height = inverse.shape[0] >> level
    reach = min(_BACKGROUND_REACH[level - 2], height // 4)
    valid = np.where(mask, inverse, np.float32(inverse.max()))
    far = valid.reshape(height, 1 << level, 2 * height, 1 << level).min(axis=(1, 3))
    far = pad_sphere(_window_extremum(far, reach, largest=False), 2 * reach)
    return cv2.GaussianBlur(far, (0, 0), reach / 2)[2 * reach : -2 * reach, 2 * reach : -2 * reach]


@dataclass(frozen=True, eq=False)
class _PosedSurfaces:
    """The panoramas at the height of the surfaces, the surfaces, and where each is consistent with another."""

    posed: PosedImages
    surfaces: list[Surface]
    neighbours: Sequence[Sequence[int]]
    consistent: list[np.ndarray]


def _lattice_heights(height: int, surface_height: int) -> list[int]:
    """Heights of level 0's lattices, finest first; each is twice the next, and the last is the surface's."""
    finer = max((height // surface_height).bit_length() - 1, 0)
    base = height if not finer else 8 * round(height / (8 << finer))
    return [base << n for n in range(finer, -1, -1)]


def _choose_fine_pixels(image: np.ndarray, heights: list[int]) -> list[np.ndarray]:
    """Masks (h, 2h) of the pixels that each lattice finer than the surface holds, and of those that any of them holds.

    A lattice is replaced by a finer one where it would lose detail of the panorama.
    """
    errors = []
    for height, coarser in itertools.pairwise(heights):
        detail = resize_sphere(image, height)
        errors.append(np.abs(detail - resize_sphere(resize_sphere(detail, coarser), height)).max(axis=2))
    limit = _FINE_COLOR_ERROR
    while True:
        masks, count = [], 0.0
        finer = np.zeros((heights[0], 2 * heights[0]), bool)
        for height, error in zip(heights[:-1], errors, strict=True):
            split = _any_in_blocks((error > limit) | finer)
            masks.append(np.repeat(np.repeat(split, 2, axis=0), 2, axis=1) & ~finer)
            count += lattice_size(2 * height) * _area_fraction(masks[-1])
            finer = split
        if count <= _FINE_POINTS:
            return [*masks, finer]
        limit *= max(1.05, (count / _FINE_POINTS) ** 0.5)


def _any_in_blocks(mask: np.ndarray) -> np.ndarray:
    """Whether any pixel of each block of 2 x 2 is set."""
    return mask[0::2, 0::2] | mask[1::2, 0::2] | mask[0::2, 1::2] | mask[1::2, 1::2]


def _area_fraction(mask: np.ndarray) -> float:
    """Fraction of the sphere that a mask (h, w) covers."""
    areas = row_weights(len(mask)).numpy()
    return float(mask.mean(axis=1) @ areas / areas.sum())


def _lift_fine(scene: _PosedSurfaces, view: int, image: np.ndarray, chosen: np.ndarray) -> Gaussians:
    """The points of level 0 on a lattice that is finer than the surface."""
    chosen = chosen & resize_mask(scene.posed.masks[view], len(image))
    fine = guided_upsample(scene.surfaces[view], scene.posed.images[view], image, chosen)
    return _lift_lattice(scene, view, 0, _locate_lattice(len(image), len(image)), image, fine.inverse_depth, chosen)


def _lift_level(scene: _PosedSurfaces, view: int, level: int, lattice: _Lattice, replaced: np.ndarray) -> Gaussians:
    """The points of a level that finer lattices do not replace."""
    image, inverse, mask = scene.posed.images[view], scene.surfaces[view].inverse_depth, scene.posed.masks[view]
    if level >= 2:
        # No other view shows what a single one masks, and its depth is the prior's: the background continues there.
        covered = mask if len(scene.surfaces) > 1 else np.ones_like(mask)
        color, inverse = _background_layer(image, inverse, mask, covered, level)
        return _lift_lattice(scene, view, level, lattice, color, inverse, covered)
    needed = mask & ~replaced & (_choose_levels(image, inverse) == level)
    height = len(image) >> level
    resized = resize_sphere(image, height), resize_sphere(inverse, height)
    return _lift_lattice(scene, view, level, lattice, *resized, needed)


def _lift_lattice(
    scene: _PosedSurfaces,
    view: int,
    level: int,
    lattice: _Lattice,
    image: np.ndarray,
    inverse: np.ndarray,
    needed: np.ndarray,
) -> Gaussians:
    """The points of a lattice with the spacing of the image's pixels, where they are needed."""
    pose = np.ascontiguousarray(scene.posed.cam2world[view], np.float64)
    rays, pixel = lattice
    spacing = math.sqrt(4 * math.pi / len(rays))
    rays = rays[needed[pixel]]
    inverse_depth = np.maximum(inverse[nearest_pixel(rays, len(inverse))].astype(np.float64), 1e-6)
    points = (rays / inverse_depth[:, None]) @ pose[:3, :3].T + pose[:3, 3]
    opacity, kept = _estimate_opacity(points, scene, view)
    rays, inverse_depth, points, opacity = rays[kept], inverse_depth[kept], points[kept], opacity[kept]
    sloped = inverse if level else scene.surfaces[view].inverse_depth
    gradient = _differentiate_log(sloped, _DISCONTINUITY if level < 2 else math.inf)
    is_fine = len(image) > scene.surfaces[view].height
    size = spacing * (_FINE_FOOTPRINT if is_fine else _FOOTPRINT)
    # A disc that is nearly parallel to its ray must end well before the camera.
    steepest = min(_MAX_STRETCH[level], _MAX_LENGTH / size)
    quats, scales = np.empty((len(rays), 4), np.float32), np.empty((len(rays), 3), np.float32)
    shape = rays, inverse_depth, gradient, size, steepest, _THICKNESS, pose, quats, scales
    for_point_ranges(partial(_shape_discs, *shape), len(rays))
    color = sample_equirect(torch.from_numpy(image).permute(2, 0, 1), uv_from_directions(torch.from_numpy(rays)))
    return Gaussians(
        means=torch.from_numpy(points).float(),
        scales=torch.from_numpy(scales),
        quats=torch.from_numpy(quats),
        opacities=torch.from_numpy(opacity),
        harmonics=((color.T - 0.5) / SH_0).contiguous()[:, None],
        levels=torch.full((len(points),), level, dtype=torch.uint8),
        views=torch.full((len(points),), view, dtype=torch.uint8),
    )


def _locate_lattice(rows: int, height: int) -> _Lattice:
    """The lattice with the spacing of the pixels of `rows` rows, in a panorama of `height` rows."""
    rays = fibonacci_directions(lattice_size(2 * rows)).numpy()
    return rays, nearest_pixel(rays, height)


def _window_extremum(values: np.ndarray, radius: int, *, largest: bool) -> np.ndarray:
    """Largest or smallest value within `radius` pixels on the sphere."""
    window = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    padded = pad_sphere(values, radius)
    grown = cv2.dilate(padded, window) if largest else cv2.erode(padded, window)
    return grown[radius:-radius, radius:-radius]


def _choose_levels(image: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Level (h, w), 0 or 1: the coarser where it keeps the image's detail and the surface's discontinuities."""
    height = image.shape[0]
    coarse = resize_sphere(resize_sphere(image, height // 2), height)
    error = np.abs(image - coarse).max(axis=2)
    near, far = _window_extremum(inverse, 1, largest=True), _window_extremum(inverse, 1, largest=False)
    fine = (error > _MAX_COLOR_ERROR) | (near > far * (1 + _DISCONTINUITY))
    return np.where(_window_extremum(fine.astype(np.uint8), 2, largest=True) > 0, 0, 1)


def _background_layer(
    image: np.ndarray, inverse: np.ndarray, mask: np.ndarray, covered: np.ndarray, level: int
) -> tuple[np.ndarray, np.ndarray]:
    """Image and inverse depth of the background at level 2 or 3.

    Args:
        mask, covered: where the image shows the scene, and where the depth is that of the scene.
    """
    height = image.shape[0] >> level
    far = _background_inverse_depth(inverse, covered, level)
    # Colours of the pixels at or behind the layer, extrapolated over the gaps between them.
    behind = mask & (inverse <= (1 + _DISCONTINUITY) * resize_sphere(far, image.shape[0]))
    weight = resize_sphere(behind.astype(np.float32), height)
    color = resize_sphere(image * behind[..., None], height)
    filled_color, filled_weight = color.copy(), weight.copy()
    for radius in (r for r in (1, 2, 4, 8, 16) if 3 * r <= height):
        margin = 3 * radius
        inside = (slice(margin, -margin), slice(margin, -margin))
        wide_color = cv2.GaussianBlur(pad_sphere(color, margin), (0, 0), radius)[inside]
        wide_weight = cv2.GaussianBlur(pad_sphere(weight, margin), (0, 0), radius)[inside]
        missing = np.clip(1 - filled_weight, 0, 1)
        filled_color += missing[..., None] * wide_color
        filled_weight += missing * wide_weight
    unknown = filled_weight < 1e-3
    color_map = filled_color / np.maximum(filled_weight, 1e-3)[..., None]
    color_map[unknown] = resize_sphere(image, height)[unknown]
    return color_map.astype(np.float32), (far / _BACKGROUND_DEPTH[level - 2]).astype(np.float32)


def _estimate_opacity(points: np.ndarray, scene: _PosedSurfaces, view: int) -> tuple[np.ndarray, np.ndarray]:
    """Opacity (n) by consistency with the other views, and a mask of the points to keep.

    A point in the consistent free space of more views than confirm it is not kept.
    """
    posed = scene.posed
    confirmed, contradicted, doubtful, near = np.zeros((4, len(points)), np.int16)
    for other in scene.neighbours[view]:
        certain = scene.consistent[other] & posed.masks[other]
        classes, distances, pixel = classify_visibility(
            points, scene.surfaces[other], posed.cam2world[other], _DEPTH_TOLERANCE
        )
        is_free = classes == FREE_SPACE
        confirmed += classes == CONSISTENT
        contradicted += is_free & certain[pixel]
        doubtful += is_free & ~certain[pixel]
        near += distances <= _MIN_DISTANCE * posed.near
    opacity = np.where(doubtful > 0, np.float32(_UNCERTAIN_OPACITY), np.float32(_SINGLE_VIEW_OPACITY))
    opacity[confirmed > 0] = _CONSISTENT_OPACITY
    return opacity, (near == 0) & (contradicted <= confirmed)


def _differentiate_log(inverse: np.ndarray, discontinuity: float) -> np.ndarray:
    """Gradient (h, w, 2) of the logarithm of inverse depth per radian to the east and south; 0 at a discontinuity."""
    height, width = inverse.shape
    padded = np.log(np.maximum(pad_sphere(inverse, 1), 1e-6))
    east = (padded[1:-1, 2:] - padded[1:-1, :-2]) / 2
    south = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / 2
    east = np.where(np.abs(east) > discontinuity, 0, east)
    south = np.where(np.abs(south) > discontinuity, 0, south)
    latitude = ((np.arange(height) + 0.5) / height - 0.5) * math.pi
    pixel = math.pi / height
    shrink = np.maximum(np.cos(latitude), 1 / width)[:, None]  # width of a pixel relative to the equator
    return np.stack((east / (pixel * shrink), south / pixel), axis=-1)


@cached_njit(nogil=True)
def _shape_discs(rays, inverse_depth, gradient, size, steepest, thickness, cam2world, quats, scales, first, end):
    """Write quaternions (n, 4, wxyz) in the world, and standard deviations (n, 3), of discs on the surface.

    Args:
        rays: (n, 3) float64, camera axes.
        gradient: (h, w, 2) see `_differentiate_log`.
        size: standard deviation of a disc across its ray, radians.
        steepest: largest gradient that a disc follows.
        thickness: standard deviation across the surface, relative to the disc's.
    """
    axes = np.empty((3, 3))
    for n in range(first, end):
        x, y, z = rays[n]
        flat = math.sqrt(x * x + z * z)
        east_x, east_z = (z / flat, -x / flat) if flat > 0 else (1.0, 0.0)
        south_x, south_y, south_z = y * east_z, z * east_x - x * east_z, -y * east_x
        row, column = locate_pixel(x, y, z, len(gradient))
        to_east, to_south = np.float64(gradient[row, column, 0]), np.float64(gradient[row, column, 1])
        steepness = math.sqrt(to_east * to_east + to_south * to_south)
        if steepness > 1e-6:
            to_east, to_south = to_east / steepness, to_south / steepness
        else:
            to_east, to_south = 1.0, 0.0
        steepness = min(steepness, steepest)
        # X = ray / inverse_depth, so dX = (direction - ray * dlog(inverse_depth)) / inverse_depth per radian.
        stretch = math.sqrt(1 + steepness * steepness)
        long_x = (to_east * east_x + to_south * south_x - steepness * x) / stretch
        long_y = (to_south * south_y - steepness * y) / stretch
        long_z = (to_east * east_z + to_south * south_z - steepness * z) / stretch
        across_x, across_y = to_east * south_x - to_south * east_x, to_east * south_y
        across_z = to_east * south_z - to_south * east_z
        for i in range(3):
            a, b, c = cam2world[i, 0], cam2world[i, 1], cam2world[i, 2]
            axes[i, 0] = a * long_x + b * long_y + c * long_z
            axes[i, 1] = a * across_x + b * across_y + c * across_z
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            axes[i, 2] = axes[j, 0] * axes[k, 1] - axes[k, 0] * axes[j, 1]
        _write_quat(axes, quats[n])
        sigma = size / inverse_depth[n]
        scales[n, 0], scales[n, 1], scales[n, 2] = sigma * stretch, sigma, sigma * thickness


@nb.njit(inline="always")
def _write_quat(m, quat):
    """As `pansplat.geometry.pose.quats_from_rotations`, for one rotation (3, 3)."""
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    best, largest = 0, trace  # the largest component: w, x, y or z
    for i in range(3):
        if 2 * m[i, i] - trace > largest:
            best, largest = i + 1, 2 * m[i, i] - trace
    turned_x, turned_y, turned_z = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    xy, xz, yz = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    if best == 0:
        w, x, y, z = 1 + largest, turned_x, turned_y, turned_z
    elif best == 1:
        w, x, y, z = turned_x, 1 + largest, xy, xz
    elif best == 2:
        w, x, y, z = turned_y, xy, 1 + largest, yz
    else:
        w, x, y, z = turned_z, xz, yz, 1 + largest
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    norm = -norm if w < 0 else norm
    quat[0], quat[1], quat[2], quat[3] = w / norm, x / norm, y / norm, z / norm
