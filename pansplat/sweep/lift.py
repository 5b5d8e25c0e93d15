"""From surfaces to Gaussians: the spherical Gaussian pyramid on Fibonacci lattices.

Levels 0 and 1 are discs on the surface, with gaps at depth discontinuities; level 0 is used only where level 1 would
lose image detail. Where a large panorama has detail that a lattice of half its height would lose, finer lattices
replace the points of level 0. Levels 2 and 3 are a closed background layer slightly behind the surface: at every
discontinuity it continues the far side, so that a moving camera sees no holes. Points in the consistent free space of
another view are removed.

Source: PanSplat, section 3.3 (lattices and levels).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch

from pansplat.gaussians.harmonics import SH_0
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.equirect import row_weights
from pansplat.geometry.fibonacci import fibonacci_directions, lattice_size
from pansplat.geometry.pose import quats_from_rotations
from pansplat.sweep.search import PosedImages
from pansplat.sweep.surface import (
    CONSISTENT,
    FREE_SPACE,
    Surface,
    classify_visibility,
    consistency_mask,
    guided_upsample,
    list_others,
    nearest_pixel,
    pad_sphere,
    pixel_coordinates,
    resize_mask,
    resize_sphere,
    world_points,
)

NUM_LEVELS = 4
_MAX_LENGTH = 0.2  # largest standard deviation of a disc, relative to its distance
_MIN_DISTANCE = 0.5  # smallest distance of a Gaussian from an input camera, relative to `near`


@dataclass(frozen=True)
class LiftConfig:
    """Settings of the Gaussians' sizes, opacities and levels."""

    surface_height: int = 512
    """Least height of the surface of a panorama of twice this height or more."""
    footprint: float = 0.7
    """Standard deviation of a disc, in lattice spacings."""
    fine_footprint: float = 0.6
    """The same on lattices finer than the surface."""
    thickness: float = 0.1
    """Standard deviation across the surface, relative to the disc's."""
    max_stretch: tuple[float, float, float, float] = (4.0, 4.0, 12.0, 24.0)
    """Largest ratio of a disc's long axis to its short one, by level."""
    background_depth: tuple[float, float] = (1.02, 1.04)
    """Depth of levels 2 and 3 relative to the background."""
    background_reach: tuple[int, int] = (4, 8)
    """Distance over which the background is extended in front of a discontinuity, pixels of the level."""
    detail: float = 0.02
    """Largest colour error of level 1."""
    fine_detail: float = 0.015
    """Largest colour error of a lattice where no finer one replaces it."""
    fine_points: int = 780_000
    """Largest number of a view's points on the finer lattices; a larger error is allowed where they do not suffice."""
    discontinuity: float = 0.15
    """Relative change of inverse depth between pixels at a discontinuity."""
    consistent_opacity: float = 0.95
    """Where another view is consistent."""
    single_view_opacity: float = 0.9
    """Where no other view sees the surface."""
    uncertain_opacity: float = 0.8
    """In the free space of another view whose own surface is not consistent with any view."""


def lift(
    posed: PosedImages,
    surfaces: list[Surface],
    config: LiftConfig,
    neighbours: Sequence[Sequence[int]] | None = None,
) -> Gaussians:
    """The Gaussians of all views and levels, ordered by level, then view, then lattice (finest first) and point.

    Args:
        neighbours: the other views whose surfaces confirm or contradict those of each view; by default all.
    """
    if neighbours is None:
        neighbours = list_others(len(surfaces))
    photographs, heights = posed.images, _lattice_heights(posed.images.shape[1], config.surface_height)
    posed = posed.resize(heights[-1])
    if surfaces[0].height != heights[-1]:
        surfaces = [
            guided_upsample(s, resize_sphere(image, s.height), image)
            for s, image in zip(surfaces, posed.images, strict=True)
        ]
    views = range(len(surfaces))
    consistent = [consistency_mask(surfaces, posed.cam2world, view, neighbours[view]) for view in views]
    scene = _PosedSurfaces(posed, surfaces, neighbours, consistent, config)
    scene = replace(scene, surfaces=[_remove_inconsistent(scene, view) for view in views])
    fine = [_choose_fine_pixels(image, heights, config) for image in photographs]
    parts = []
    for level in range(NUM_LEVELS):
        for view in views:
            if level == 0:
                parts += [
                    _lift_fine(scene, view, resize_sphere(photographs[view], height), chosen)
                    for height, chosen in zip(heights[:-1], fine[view][:-1], strict=True)
                ]
            parts.append(_lift_level(scene, view, level, fine[view][-1]))
    return Gaussians.cat(parts)


def _background_inverse_depth(inverse: np.ndarray, mask: np.ndarray, level: int, config: LiftConfig) -> np.ndarray:
    """Inverse depth at a coarse level's size, with the far side extended over every discontinuity."""
    height = inverse.shape[0] >> level
    reach = min(config.background_reach[level - 2], height // 4)
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
    config: LiftConfig


def _remove_inconsistent(scene: _PosedSurfaces, view: int) -> Surface:
    """The surface, with the points in other views' consistent free space moved back to the background layer."""
    surface, config = scene.surfaces[view], scene.config
    points = world_points(surface, scene.posed.cam2world[view]).reshape(-1, 3)
    _, kept = _estimate_opacity(points, scene, view)
    far = _background_inverse_depth(surface.inverse_depth, scene.posed.masks[view], 2, config)
    behind = np.minimum(surface.inverse_depth, resize_sphere(far, surface.height))
    return Surface(np.where(kept.reshape(behind.shape), surface.inverse_depth, behind), surface.orientation)


def _lattice_heights(height: int, surface_height: int) -> list[int]:
    """Heights of level 0's lattices, finest first; each is twice the next, and the last is the surface's."""
    finer = max((height // surface_height).bit_length() - 1, 0)
    base = height if not finer else 8 * round(height / (8 << finer))
    return [base << n for n in range(finer, -1, -1)]


def _choose_fine_pixels(image: np.ndarray, heights: list[int], config: LiftConfig) -> list[np.ndarray]:
    """Masks (h, 2h) of the pixels that each lattice finer than the surface holds, and of those that any of them holds.

    A lattice is replaced by a finer one where it would lose detail of the panorama.
    """
    errors = []
    for height, coarser in itertools.pairwise(heights):
        detail = resize_sphere(image, height)
        errors.append(np.abs(detail - resize_sphere(resize_sphere(detail, coarser), height)).max(axis=2))
    limit = config.fine_detail
    while True:
        masks, count = [], 0.0
        finer = np.zeros((heights[0], 2 * heights[0]), bool)
        for height, error in zip(heights[:-1], errors, strict=True):
            split = _any_in_blocks((error > limit) | finer)
            masks.append(np.repeat(np.repeat(split, 2, axis=0), 2, axis=1) & ~finer)
            count += lattice_size(2 * height) * _area_fraction(masks[-1])
            finer = split
        if count <= config.fine_points:
            return [*masks, finer]
        limit *= max(1.05, (count / config.fine_points) ** 0.5)


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
    return _lift_lattice(scene, view, 0, image, fine.inverse_depth, chosen)


def _lift_level(scene: _PosedSurfaces, view: int, level: int, replaced: np.ndarray) -> Gaussians:
    """The points of a level that finer lattices do not replace."""
    image, inverse, mask = scene.posed.images[view], scene.surfaces[view].inverse_depth, scene.posed.masks[view]
    if level >= 2:
        # No other view shows what a single one masks, and its depth is the prior's: the background continues there.
        covered = mask if len(scene.surfaces) > 1 else np.ones_like(mask)
        color, inverse = _background_layer(image, inverse, mask, covered, level, scene.config)
        return _lift_lattice(scene, view, level, color, inverse, covered)
    needed = mask & ~replaced & (_choose_levels(image, inverse, scene.config) == level)
    height = len(image) >> level
    return _lift_lattice(scene, view, level, resize_sphere(image, height), resize_sphere(inverse, height), needed)


def _lift_lattice(
    scene: _PosedSurfaces, view: int, level: int, image: np.ndarray, inverse: np.ndarray, needed: np.ndarray
) -> Gaussians:
    """The points of a lattice with the spacing of the image's pixels, where they are needed."""
    config, pose = scene.config, scene.posed.cam2world[view]
    count = lattice_size(2 * len(image))
    rays = fibonacci_directions(count).numpy()
    row, column = nearest_pixel(rays, len(needed))
    rays = rays[needed[row, column]]
    row, column = nearest_pixel(rays, len(inverse))
    inverse_depth = np.maximum(inverse[row, column].astype(np.float64), 1e-6)
    points = (rays / inverse_depth[:, None]) @ pose[:3, :3].T + pose[:3, 3]
    opacity, kept = _estimate_opacity(points, scene, view)
    spacing = math.sqrt(4 * math.pi / count)
    rays, inverse_depth, points, opacity = rays[kept], inverse_depth[kept], points[kept], opacity[kept]
    sloped = inverse if level else scene.surfaces[view].inverse_depth
    row, column = nearest_pixel(rays, len(sloped))
    gradient = _differentiate_log(sloped, config.discontinuity if level < 2 else math.inf)[row, column]
    is_fine = len(image) > scene.surfaces[view].height
    size = spacing * (config.fine_footprint if is_fine else config.footprint)
    axes, scales = _shape_discs(rays, inverse_depth, gradient, size, level, config)
    color = _sample_bilinear(image, rays)
    quats = quats_from_rotations(torch.from_numpy(pose[:3, :3] @ axes))
    return Gaussians(
        means=torch.from_numpy(points).float(),
        scales=torch.from_numpy(scales).float(),
        quats=quats.float(),
        opacities=torch.from_numpy(opacity).float(),
        harmonics=torch.from_numpy((color - 0.5) / SH_0).float()[:, None, :],
        levels=torch.full((len(points),), level, dtype=torch.uint8),
        views=torch.full((len(points),), view, dtype=torch.uint8),
    )


def _sample_bilinear(image: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Bilinear samples (n, c) of a panorama along rays (n, 3)."""
    height, width = image.shape[:2]
    x, y = (c + 0.5 for c in pixel_coordinates(rays, height))  # of the padded image
    x0, y0 = np.clip(x.astype(np.int64), 0, width), np.clip(y.astype(np.int64), 0, height)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    padded = pad_sphere(image, 1)
    top = padded[y0, x0] * (1 - fx) + padded[y0, x0 + 1] * fx
    return top * (1 - fy) + (padded[y0 + 1, x0] * (1 - fx) + padded[y0 + 1, x0 + 1] * fx) * fy


def _window_extremum(values: np.ndarray, radius: int, *, largest: bool) -> np.ndarray:
    """Largest or smallest value within `radius` pixels on the sphere."""
    window = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    padded = pad_sphere(values, radius)
    grown = cv2.dilate(padded, window) if largest else cv2.erode(padded, window)
    return grown[radius:-radius, radius:-radius]


def _choose_levels(image: np.ndarray, inverse: np.ndarray, config: LiftConfig) -> np.ndarray:
    """Level (h, w), 0 or 1: the coarser where it keeps the image's detail and the surface's discontinuities."""
    height = image.shape[0]
    coarse = resize_sphere(resize_sphere(image, height // 2), height)
    error = np.abs(image - coarse).max(axis=2)
    near, far = _window_extremum(inverse, 1, largest=True), _window_extremum(inverse, 1, largest=False)
    fine = (error > config.detail) | (near > far * (1 + config.discontinuity))
    return np.where(_window_extremum(fine.astype(np.uint8), 2, largest=True) > 0, 0, 1)


def _background_layer(
    image: np.ndarray, inverse: np.ndarray, mask: np.ndarray, covered: np.ndarray, level: int, config: LiftConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Image and inverse depth of the background at level 2 or 3.

    Args:
        mask, covered: where the image shows the scene, and where the depth is that of the scene.
    """
    height = image.shape[0] >> level
    far = _background_inverse_depth(inverse, covered, level, config)
    # Colours of the pixels at or behind the layer, extrapolated over the gaps between them.
    behind = mask & (inverse <= 1.15 * resize_sphere(far, image.shape[0]))
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
    return color_map.astype(np.float32), (far / config.background_depth[level - 2]).astype(np.float32)


def _estimate_opacity(points: np.ndarray, scene: _PosedSurfaces, view: int) -> tuple[np.ndarray, np.ndarray]:
    """Opacity (n) by consistency with the other views, and a mask of the points to keep.

    A point in the consistent free space of more views than confirm it is not kept.
    """
    config, posed = scene.config, scene.posed
    confirmed, contradicted = np.zeros(len(points), np.int8), np.zeros(len(points), np.int8)
    doubtful, kept = np.zeros(len(points), bool), np.ones(len(points), bool)
    for other in scene.neighbours[view]:
        surface = scene.surfaces[other]
        visibility = classify_visibility(points, surface, posed.cam2world[other], config.discontinuity)
        local = (points - posed.cam2world[other, :3, 3]) @ posed.cam2world[other, :3, :3]
        row, column = nearest_pixel(local, surface.height)
        certain = scene.consistent[other][row, column] & posed.masks[other][row, column]
        in_free_space = visibility == FREE_SPACE
        confirmed += visibility == CONSISTENT
        contradicted += in_free_space & certain
        doubtful |= in_free_space & ~certain
        kept &= np.linalg.norm(local, axis=-1) > _MIN_DISTANCE * posed.near
    opacity = np.where(doubtful, config.uncertain_opacity, config.single_view_opacity)
    opacity[confirmed > 0] = config.consistent_opacity
    return opacity, kept & (contradicted <= confirmed)


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


def _shape_discs(
    rays: np.ndarray, inverse_depth: np.ndarray, gradient: np.ndarray, size: float, level: int, config: LiftConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Axes (n, 3, 3) in the camera frame, as columns, and standard deviations (n, 3) of discs on the surface.

    `size` is the standard deviation of a disc across its ray, radians.
    """
    longitude = np.arctan2(rays[:, 0], rays[:, 2])  # 0 at the poles
    east = np.stack((np.cos(longitude), np.zeros(len(rays)), -np.sin(longitude)), axis=-1)
    south = np.cross(rays, east)
    # X = ray / inverse_depth, so dX = (direction - ray * dlog(inverse_depth)) / inverse_depth per radian.
    steepness = np.linalg.norm(gradient, axis=-1)
    # A disc that is nearly parallel to its ray must end well before the camera.
    limit = min(config.max_stretch[level], _MAX_LENGTH / size)
    gradient = gradient * np.minimum(1, limit / np.maximum(steepness, 1e-9))[:, None]
    steepness = np.minimum(steepness, limit)
    ascent = np.where(steepness[:, None] > 1e-6, gradient / np.maximum(steepness, 1e-6)[:, None], (1.0, 0.0))
    along = ascent[:, :1] * east + ascent[:, 1:] * south
    across = -ascent[:, 1:] * east + ascent[:, :1] * south
    long = along - steepness[:, None] * rays
    stretch = np.linalg.norm(long, axis=-1)
    long = long / stretch[:, None]
    axes = np.stack((long, across, np.cross(long, across)), axis=-1)
    sigma = size / inverse_depth
    return axes, np.stack((sigma * stretch, sigma, sigma * config.thickness), axis=-1)
