"""From surfaces to Gaussians: the spherical pyramid on Fibonacci lattices.

The fine levels 0 and 1 are discs on the surface, broken at its jumps, and only where a coarser disc would lose
picture detail. The coarse levels 2 and 3 are a closed sheet a little behind it, hung on the far side of every
jump and stretched over the gap, so that nothing is empty where the camera moves and looks behind things. Points
that another view certainly sees through are dropped.

Source: PanSplat, section 3.3 (lattices and levels).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.fibonacci import fibonacci_directions, lattice_size
from pansplat.geometry.pose import quats_from_rotations
from pansplat.sweep.search import PosedImages
from pansplat.sweep.sphere import nearest_pixel, pad_sphere, pixel_coordinates, resize_sphere
from pansplat.sweep.surface import (
    AGREES,
    SEEN_THROUGH,
    Surface,
    agreement,
    guided_upsample,
    relation,
    world_points,
)

NUM_LEVELS = 4
_SH_0 = 0.28209479177387814  # Y_0
_MAX_LENGTH = 0.2  # a disc's longest standard deviation over its distance
_FREE_SPACE = 0.5  # no Gaussian is nearer to an input camera than this fraction of `near`


@dataclass(frozen=True)
class LiftConfig:
    """How surfaces become Gaussians."""

    footprint: float = 0.7
    """Standard deviation of a disc, in lattice spacings."""
    thickness: float = 0.1
    """Standard deviation across the surface, relative to the disc's."""
    max_stretch: tuple[float, float, float, float] = (4.0, 4.0, 12.0, 24.0)
    """Longest axis of a disc over its footprint, by level."""
    sheet_depth: tuple[float, float] = (1.02, 1.04)
    """Depth of the sheets of levels 2 and 3 relative to the surface."""
    sheet_reach: tuple[int, int] = (4, 8)
    """How far a sheet shows the far side over a jump, in pixels of its level."""
    detail: float = 0.02
    """Colour error up to which a coarser disc stands for finer ones."""
    jump: float = 0.06
    """Relative change of inverse depth from pixel to pixel that is a jump."""
    sure_opacity: float = 0.95
    """Where another view agrees."""
    alone_opacity: float = 0.9
    """Where only this view sees the surface."""
    doubted_opacity: float = 0.8
    """Where another view sees through, but is not sure itself."""


def lift(posed: PosedImages, surfaces: list[Surface], config: LiftConfig) -> Gaussians:
    """The Gaussians of all views and levels, ordered by level, then view, then lattice point."""
    height = posed.images.shape[1]
    if surfaces[0].height != height:
        surfaces = [
            guided_upsample(s, resize_sphere(image, s.height), image)
            for s, image in zip(surfaces, posed.images, strict=True)
        ]
    sure = [agreement(surfaces, posed.cam2world, view) for view in range(len(surfaces))]
    surfaces = [_clear_the_way(posed, surfaces, sure, view, config) for view in range(len(surfaces))]
    parts = [
        _lift_level(posed, surfaces, sure, view, level, config)
        for level in range(NUM_LEVELS)
        for view in range(len(surfaces))
    ]
    return Gaussians.cat(parts)


def _clear_the_way(
    posed: PosedImages, surfaces: list[Surface], sure: list[np.ndarray], view: int, config: LiftConfig
) -> Surface:
    """The surface with what other views surely see through moved back to the sheet behind it."""
    surface = surfaces[view]
    points = world_points(surface, posed.cam2world[view])
    _, kept = _opacity(points.reshape(-1, 3), posed, surfaces, sure, view, config)
    wrong = ~kept.reshape(surface.inverse_depth.shape)
    far = _far_side(surface.inverse_depth, posed.masks[view], 2, config)
    behind = np.minimum(surface.inverse_depth, resize_sphere(far, surface.height))
    return Surface(np.where(wrong, behind, surface.inverse_depth), surface.family)


def _far_side(inverse: np.ndarray, mask: np.ndarray, level: int, config: LiftConfig) -> np.ndarray:
    """Inverse depth of the surface at a coarse level's size, the far side of every jump spread over it."""
    height = inverse.shape[0] >> level
    reach = min(config.sheet_reach[level - 2], height // 4)
    usable = np.where(mask, inverse, np.float32(inverse.max()))
    far = usable.reshape(height, 1 << level, 2 * height, 1 << level).min(axis=(1, 3))
    far = pad_sphere(_spread(far, reach, largest=False), 2 * reach)
    return cv2.GaussianBlur(far, (0, 0), reach / 2)[2 * reach : -2 * reach, 2 * reach : -2 * reach]


def _lift_level(
    posed: PosedImages,
    surfaces: list[Surface],
    sure: list[np.ndarray],
    view: int,
    level: int,
    config: LiftConfig,
) -> Gaussians:
    image, inverse, mask = posed.images[view], surfaces[view].inverse_depth, posed.masks[view]
    height = image.shape[0] >> level
    picture = resize_sphere(image, height)
    if level < 2:
        shape = resize_sphere(inverse, height) if level else inverse
        wanted = mask & (_needed_level(image, inverse, config) == level)
    else:
        picture, shape = _sheet(image, inverse, mask, level, config)
        wanted = mask
    count = lattice_size(2 * height)
    rays = fibonacci_directions(count).numpy()
    row, column = nearest_pixel(rays, mask.shape[0])
    chosen = wanted[row, column]
    rays = rays[chosen]
    row, column = nearest_pixel(rays, height)
    rho = np.maximum(shape[row, column].astype(np.float64), 1e-6)
    pose = posed.cam2world[view]
    points = (rays / rho[:, None]) @ pose[:3, :3].T + pose[:3, 3]
    opacity, kept = _opacity(points, posed, surfaces, sure, view, config)
    spacing = math.sqrt(4 * math.pi / count)
    rays, rho, points, opacity = rays[kept], rho[kept], points[kept], opacity[kept]
    row, column = row[kept], column[kept]
    slope = _slopes(shape, config.jump if level < 2 else math.inf)[row, column]
    axes, scales = _discs(rays, rho, slope, spacing, level, config)
    color = _bilinear(picture, rays)
    quats = quats_from_rotations(torch.from_numpy(pose[:3, :3] @ axes))
    return Gaussians(
        means=torch.from_numpy(points).float(),
        scales=torch.from_numpy(scales).float(),
        quats=quats.float(),
        opacities=torch.from_numpy(opacity).float(),
        harmonics=torch.from_numpy((color - 0.5) / _SH_0).float()[:, None, :],
        levels=torch.full((len(points),), level, dtype=torch.uint8),
        views=torch.full((len(points),), view, dtype=torch.uint8),
    )


def _bilinear(image: np.ndarray, rays: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    x, y = (c + 0.5 for c in pixel_coordinates(rays, height))  # of the padded image
    x0, y0 = np.clip(x.astype(np.int64), 0, width), np.clip(y.astype(np.int64), 0, height)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    padded = pad_sphere(image, 1)
    top = padded[y0, x0] * (1 - fx) + padded[y0, x0 + 1] * fx
    return top * (1 - fy) + (padded[y0 + 1, x0] * (1 - fx) + padded[y0 + 1, x0 + 1] * fx) * fy


def _spread(values: np.ndarray, radius: int, *, largest: bool) -> np.ndarray:
    """Largest or smallest value within `radius` pixels, across the image's left and right edge."""
    window = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    padded = pad_sphere(values, radius)
    grown = cv2.dilate(padded, window) if largest else cv2.erode(padded, window)
    return grown[radius:-radius, radius:-radius]


def _needed_level(image: np.ndarray, inverse: np.ndarray, config: LiftConfig) -> np.ndarray:
    """Level (h, w), 0 or 1, of the coarsest disc that keeps the picture's detail and the surface's jumps."""
    height = image.shape[0]
    coarse = resize_sphere(resize_sphere(image, height // 2), height)
    error = np.abs(image - coarse).max(axis=2)
    near, far = _spread(inverse, 1, largest=True), _spread(inverse, 1, largest=False)
    fine = (error > config.detail) | (near > far * (1 + config.jump))
    return np.where(_spread(fine.astype(np.uint8), 2, largest=True) > 0, 0, 1)


def _sheet(
    image: np.ndarray, inverse: np.ndarray, mask: np.ndarray, level: int, config: LiftConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Picture and inverse depth of a sheet's level: the far side of the surface, and the far side's colours."""
    height = image.shape[0] >> level
    far = _far_side(inverse, mask, level, config)
    # Colours of what lies at least as far as the sheet, spread over the gaps in between.
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
    blank = filled_weight < 1e-3
    picture = filled_color / np.maximum(filled_weight, 1e-3)[..., None]
    picture[blank] = resize_sphere(image, height)[blank]
    return picture.astype(np.float32), (far / config.sheet_depth[level - 2]).astype(np.float32)


def _opacity(
    points: np.ndarray,
    posed: PosedImages,
    surfaces: list[Surface],
    sure: list[np.ndarray],
    view: int,
    config: LiftConfig,
) -> tuple[np.ndarray, np.ndarray]:
    """Opacity (n) by what the other views say, and which points to keep: not those surely seen through."""
    opacity = np.full(len(points), config.alone_opacity)
    kept = np.ones(len(points), bool)
    for other, surface in enumerate(surfaces):
        if other == view:
            continue
        said, _ = relation(points, surface, posed.cam2world[other], config.jump)
        local = (points - posed.cam2world[other, :3, 3]) @ posed.cam2world[other, :3, :3]
        row, column = nearest_pixel(local, surface.height)
        certain = sure[other][row, column] & posed.masks[other][row, column]
        opacity[said == AGREES] = config.sure_opacity
        through = said == SEEN_THROUGH
        opacity[through & ~certain] = config.doubted_opacity
        kept &= ~(through & certain) & (np.linalg.norm(local, axis=-1) > _FREE_SPACE * posed.near)
    return opacity, kept


def _slopes(inverse: np.ndarray, jump: float) -> np.ndarray:
    """Change of log inverse depth (h, w, 2) per radian to the east and south; zero across a jump."""
    height, width = inverse.shape
    padded = np.log(np.maximum(pad_sphere(inverse, 1), 1e-6))
    east = (padded[1:-1, 2:] - padded[1:-1, :-2]) / 2
    south = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / 2
    east = np.where(np.abs(east) > jump, 0, east)
    south = np.where(np.abs(south) > jump, 0, south)
    latitude = ((np.arange(height) + 0.5) / height - 0.5) * math.pi
    pixel = math.pi / height
    narrow = np.maximum(np.cos(latitude), 1 / width)[:, None]
    return np.stack((east / (pixel * narrow), south / pixel), axis=-1)


def _discs(
    rays: np.ndarray, rho: np.ndarray, slope: np.ndarray, spacing: float, level: int, config: LiftConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Axes (n, 3, 3) in the camera frame, as columns, and standard deviations (n, 3) of discs on the surface."""
    longitude = np.arctan2(rays[:, 0], rays[:, 2])  # zero at the poles, where any will do
    east = np.stack((np.cos(longitude), np.zeros(len(rays)), -np.sin(longitude)), axis=-1)
    south = np.cross(rays, east)
    # X = ray / rho, so dX / angle = (direction - ray * dlog(rho) / angle) / rho.
    steepest = np.linalg.norm(slope, axis=-1)
    # A disc hung almost along its ray must end well before the camera.
    limit = min(config.max_stretch[level], _MAX_LENGTH / (config.footprint * spacing))
    slope = slope * np.minimum(1, limit / np.maximum(steepest, 1e-9))[:, None]
    steepest = np.minimum(steepest, limit)
    uphill = np.where(steepest[:, None] > 1e-6, slope / np.maximum(steepest, 1e-6)[:, None], (1.0, 0.0))
    along = uphill[:, :1] * east + uphill[:, 1:] * south
    across = -uphill[:, 1:] * east + uphill[:, :1] * south
    long = along - steepest[:, None] * rays
    stretch = np.linalg.norm(long, axis=-1)
    long = long / stretch[:, None]
    axes = np.stack((long, across, np.cross(long, across)), axis=-1)
    size = config.footprint * spacing / rho
    return axes, np.stack((size * stretch, size, size * config.thickness), axis=-1)
