"""A scene's Gaussians on the CPU: arrays, colours, sort order, selection and culling.

Colours and radial order depend on the position of the camera and not on its rotation (`sort_splats`).
"""

import functools
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt

from pansplat.gaussians.harmonics import harmonics_basis
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.rendering.cpu.display import NO_LAYER, Selection, mark_in_view
from pansplat.rendering.cpu.tiling import radix_argsort
from pansplat.system.kernels import parallel_for_slices
from pansplat_viewer.core.camera import Pinhole
from pansplat_viewer.draw.color_maps import color_by_label

# Gaussians whose harmonics are evaluated together. Fits the cache, and is below the size at which torch starts threads,
# which would cost more time than it saves.
_CHUNK_SIZE = 1 << 13


@dataclass(frozen=True, eq=False)
class Splats:
    """The finite Gaussians of a scene in float32, in world axes moved by `origin`.

    Attributes:
        origin: subtracted from world positions, metres, float64. Keeps float32 accurate for scenes that are far from
            the world's origin.
        reach: sqrt(2 ln(255 opacity)); a Gaussian is visible up to this number of standard deviations, 0 is nowhere.
        levels, views: labels.
        harmonics: coefficients; Gaussians are the last axis, so that sums over coefficients read memory in order.
    """

    origin: Float[np.ndarray, "3"]
    means: Float[np.ndarray, "n 3"]  # moved centres
    opacities: Float[np.ndarray, "n"]  # peak opacities
    reach: Float[np.ndarray, "n"]
    extent: Float[np.ndarray, "n"]  # reach times the largest standard deviation, metres
    levels: Int[np.ndarray, "n"]
    views: Int[np.ndarray, "n"]
    geometry: Float[np.ndarray, "n 12"]  # rows that the shaders read: mean, opacity; quaternion; scales, 0
    harmonics: Float[np.ndarray, "k 3 n"]
    base_colors: Float[np.ndarray, "n 4"] | None  # colours if they do not depend on the direction (degree 0), else None
    view_positions: Float[np.ndarray, "view 3"]  # camera centres of the context views in the world
    num_views: int  # number of context views that have Gaussians or a camera

    def __len__(self) -> int:
        return self.means.shape[0]

    @functools.cached_property
    def balls(self) -> Float[np.ndarray, "5 n"]:
        """Rows x, y, z, extent and reach."""
        return np.stack((*self.means.T, self.extent, self.reach))

    @staticmethod
    def from_scene(
        scene: Scene, report: Callable[[float], None] = lambda done: None, *, with_rows: bool = True
    ) -> "Splats":
        """Return the scene's finite Gaussians.

        Args:
            scene: the scene.
            report: called with the fraction done, by any thread; an exception ends the work.
            with_rows: whether `geometry`, `harmonics` and `base_colors` are filled; else they have no Gaussians.
        """
        gaussians = drop_not_finite(scene.gaussians, lambda done: report(0.3 * done))
        positions, num = scene.cam2world[:, :3, 3].double().cpu().numpy(), len(gaussians)
        origin, rows, coefficients = _choose_origin(positions, gaussians.means), num * with_rows, gaussians.harmonics
        splats = Splats(
            origin=origin,
            means=np.empty((num, 3), np.float32),
            opacities=np.empty(num, np.float32),
            reach=np.empty(num, np.float32),
            extent=np.empty(num, np.float32),
            levels=gaussians.levels.detach().numpy().astype(np.int32),
            views=gaussians.views.detach().numpy().astype(np.int32),
            geometry=np.zeros((rows, 12), np.float32),
            harmonics=np.empty((coefficients.shape[1], 3, rows), np.float32),
            base_colors=np.zeros((rows, 4), np.float32) if with_rows and gaussians.degree == 0 else None,
            view_positions=positions,
            num_views=max(len(positions), int(gaussians.views.max()) + 1 if num else 0),
        )
        fields = (gaussians.means, gaussians.opacities, gaussians.scales, gaussians.quats, coefficients)
        sources = [values.detach().numpy() for values in fields]

        def convert(part: slice) -> None:
            means, opacities, scales, quats, harmonics = (source[part] for source in sources)
            splats.means[part], splats.opacities[part] = means - origin, opacities
            splats.reach[part] = np.sqrt(2.0 * np.log(np.maximum(splats.opacities[part] * 255.0, 1.0)))
            scales = np.abs(scales.astype(np.float32))
            splats.extent[part] = splats.reach[part] * np.maximum.reduce([scales[:, axis] for axis in range(3)])
            if not with_rows:
                return
            geometry = splats.geometry[part]
            geometry[:, 0:3], geometry[:, 3] = splats.means[part], splats.opacities[part]
            geometry[:, 4:8], geometry[:, 8:11] = quats, scales
            splats.harmonics[..., part] = harmonics.transpose(1, 2, 0)
            if splats.base_colors is not None:
                colors = 0.5 + splats.harmonics[0, :, part].T / (2 * math.sqrt(math.pi))
                splats.base_colors[part, :3] = np.maximum(colors, 0)

        parallel_for_slices(convert, num, lambda done: report(0.3 + 0.7 * done))
        return splats

    def evaluate_colors(self, position: tuple[float, float, float]) -> Float[np.ndarray, "n 4"]:
        """Return RGB and a padding column of all splats, seen from a camera position in the moved frame."""
        colors = np.zeros((len(self), 4), np.float32)
        means = torch.from_numpy(self.means)
        center = torch.tensor(position, dtype=torch.float32)
        degree = math.isqrt(len(self.harmonics)) - 1
        for start in range(0, len(self), _CHUNK_SIZE):
            chunk = slice(start, start + _CHUNK_SIZE)
            directions = torch.nn.functional.normalize(means[chunk] - center, dim=-1)
            values = np.ascontiguousarray(harmonics_basis(directions, degree).numpy().T)
            sums = np.full((3, values.shape[1]), 0.5, np.float32)
            for value, coefficients in zip(values, self.harmonics, strict=True):
                sums += value * coefficients[:, chunk]
            colors[chunk, :3] = np.maximum(sums, 0).T
        return colors

    def color_by(self, display: Literal["levels", "views"]) -> Float[np.ndarray, "n 4"]:
        """Return the colours of all splats that show a label, and a padding column."""
        return np.pad(color_by_label(getattr(self, display)), ((0, 0), (0, 1)))

    def select(self, levels: frozenset[int] | None, view: int | None) -> Bool[np.ndarray, "n"]:
        """Return a mask of the splats of levels and a view, None for all, that can be visible."""
        selected = self.reach > 0
        if levels is not None:
            selected &= np.isin(self.levels, list(levels))
        if view is not None:
            selected &= self.views == view
        return selected


def drop_not_finite(gaussians: Gaussians, report: Callable[[float], None] = lambda done: None) -> Gaussians:
    """The Gaussians without NaN and infinity, in main memory; `report` is called with the fraction done."""
    gaussians, finite = gaussians.to(device="cpu"), np.empty(len(gaussians), bool)
    harmonics, opacities = gaussians.harmonics.flatten(1), gaussians.opacities[:, None]
    fields = (gaussians.means, gaussians.scales, gaussians.quats, opacities, harmonics)
    sources = [values.detach().numpy() for values in fields]

    def check(part: slice) -> None:
        slices = [np.isfinite(source[part]) for source in sources]
        finite[part] = True  # usually; the sums over short rows take most of the time
        if not all(values.all() for values in slices):
            finite[part] = np.logical_and.reduce([values.all(axis=1) for values in slices])

    parallel_for_slices(check, len(gaussians), report)
    return gaussians if finite.all() else gaussians.select(torch.from_numpy(finite))


def _choose_origin(positions: np.ndarray, means: torch.Tensor) -> np.ndarray:
    if len(positions):
        return positions.mean(axis=0)
    if len(means):
        return means.detach().double().median(dim=0).values.numpy()
    return np.zeros(3)


@dataclass(frozen=True, eq=False)
class SortedSplats:
    """Splats with the order and colours of one camera position.

    Attributes:
        colors: RGB and padding as seen from the position, or None if colours do not depend on it.
    """

    splats: Splats
    position: tuple[float, float, float]  # camera centre in the splats' moved frame
    order: UInt[np.ndarray, "n"]  # indices by ascending distance, ties by index
    colors: Float[np.ndarray, "n 4"] | None
    milliseconds: float = 0.0  # time of sorting and colours

    def find_back_to_front(
        self, camera: Pinhole, selected: Bool[np.ndarray, "n"], blur: float
    ) -> UInt[np.ndarray, "m"]:
        """Return the indices of the selected splats that can touch the camera's image, farthest first; conservative.

        A splat is bounded by a ball of its reach, widened by the low-pass filter and the blur (radians).
        """
        selection = select_in_view(camera, blur)
        labels = np.where(selected, np.int16(0), np.int16(NO_LAYER))
        _, marks, _ = mark_in_view(self.splats.balls, np.asarray(camera.position), selection, labels)
        return self.order[(marks != NO_LAYER)[self.order]][::-1]


def select_in_view(camera: Pinhole, blur: float) -> Selection:
    """The directions that a camera sees, and how much low-pass filter and blur (radians) widen Gaussians at most."""
    return Selection(camera.compute_side_normals(), camera.filter_deviation + blur)


def sort_splats(splats: Splats, position: tuple[float, float, float]) -> SortedSplats:
    """Sort the splats by distance from a camera position and evaluate their colours."""
    start = time.perf_counter()
    x, y, z = (splats.means[:, axis] - np.float32(position[axis]) for axis in range(3))
    squared = x * x
    squared += y * y
    squared += z * z
    order = radix_argsort(squared)
    colors = splats.evaluate_colors(position) if splats.base_colors is None else None
    milliseconds = 1e3 * (time.perf_counter() - start)
    return SortedSplats(splats, position, order, colors, milliseconds)
