"""A scene's Gaussians as the renderer keeps them: arrays for sorting and culling, buffers for the shaders."""

import math
from dataclasses import dataclass

import moderngl
import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from pansplat.gaussians.harmonics import harmonics_basis
from pansplat.gaussians.scene import Gaussians, Scene

# Gaussians whose harmonics are evaluated at once: what fits the cache, and too little for torch to wake its
# threads, which cost more than they give here.
_CHUNK = 1 << 13


@dataclass(frozen=True, eq=False)
class Splats:
    """The finite Gaussians of a scene in float32, in a frame moved near the origin.

    Attributes:
        origin: what was subtracted from the world's positions, metres, float64. Keeps float32 accurate when
            the world's origin is far away.
        means: moved centres.
        opacities: peak opacities.
        reach: sqrt(2 ln(255 opacity)), how many standard deviations of a Gaussian can be seen; 0 when none.
        extent: reach times the largest standard deviation, metres.
        levels, views: labels.
        geometry: what the shaders read: mean, opacity; quaternion; scales, 0.
        harmonics: coefficients, Gaussians innermost: sums over coefficients run through memory in order.
        base_colors: colours when they are the same from everywhere (degree 0), else None.
        view_positions: camera centres of the context views in the world.
        num_views: context views there are Gaussians or cameras of.
        dropped: Gaussians left out because a number in them is NaN or infinite.
    """

    origin: Float[np.ndarray, "3"]
    means: Float[np.ndarray, "n 3"]
    opacities: Float[np.ndarray, "n"]
    reach: Float[np.ndarray, "n"]
    extent: Float[np.ndarray, "n"]
    levels: Int[np.ndarray, "n"]
    views: Int[np.ndarray, "n"]
    geometry: Float[np.ndarray, "n 12"]
    harmonics: Float[np.ndarray, "k 3 n"]
    base_colors: Float[np.ndarray, "n 4"] | None
    view_positions: Float[np.ndarray, "view 3"]
    num_views: int
    dropped: int

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def has_view_dependent_colors(self) -> bool:
        """Whether colours change with the camera's position."""
        return self.base_colors is None

    @staticmethod
    def from_scene(scene: Scene) -> "Splats":
        """The scene's finite Gaussians."""
        gaussians = scene.gaussians
        finite = _finite(gaussians)
        dropped = int((~finite).sum())
        if dropped:
            gaussians = gaussians.select(finite)
        gaussians = gaussians.to(device="cpu")
        positions = scene.cam2world[:, :3, 3].double().cpu().numpy()
        origin = _origin(positions, gaussians.means)
        means = (gaussians.means.detach().double() - torch.from_numpy(origin)).float().numpy()
        opacities = gaussians.opacities.detach().float().numpy()
        scales = gaussians.scales.detach().float().abs().numpy()
        visible = np.maximum(opacities * 255.0, 1.0)
        reach = np.sqrt(2.0 * np.log(visible)).astype(np.float32)
        geometry = np.zeros((len(means), 12), np.float32)
        geometry[:, 0:3] = means
        geometry[:, 3] = opacities
        geometry[:, 4:8] = gaussians.quats.detach().float().numpy()
        geometry[:, 8:11] = scales
        views = gaussians.views.detach().numpy().astype(np.int32)
        harmonics = gaussians.harmonics.detach().float().permute(1, 2, 0).contiguous().numpy()
        splats = Splats(
            origin=origin,
            means=np.ascontiguousarray(means),
            opacities=opacities,
            reach=reach,
            extent=reach * scales.max(axis=1, initial=0.0),
            levels=gaussians.levels.detach().numpy().astype(np.int32),
            views=views,
            geometry=geometry,
            harmonics=harmonics,
            base_colors=_constant_colors(harmonics) if gaussians.degree == 0 else None,
            view_positions=positions,
            num_views=max(len(positions), int(views.max(initial=-1)) + 1),
            dropped=dropped,
        )
        return splats

    def colors_from(self, position: tuple[float, float, float]) -> Float[np.ndarray, "n 4"]:
        """RGB of all splats seen from a camera position in the moved frame, with a padding column."""
        colors = np.zeros((len(self), 4), np.float32)
        means = torch.from_numpy(self.means)
        centre = torch.tensor(position, dtype=torch.float32)
        degree = math.isqrt(len(self.harmonics)) - 1
        for start in range(0, len(self), _CHUNK):
            part = slice(start, start + _CHUNK)
            directions = torch.nn.functional.normalize(means[part] - centre, dim=-1)
            values = np.ascontiguousarray(harmonics_basis(directions, degree).numpy().T)
            sums = np.full((3, values.shape[1]), 0.5, np.float32)
            for value, coefficients in zip(values, self.harmonics, strict=True):
                sums += value * coefficients[:, part]
            colors[part, :3] = np.maximum(sums, 0).T
        return colors

    def kept(self, levels: frozenset[int] | None, threshold: float, view: int | None) -> Bool[np.ndarray, "n"]:
        """Which splats the level, opacity and view toggles leave and whose opacity can be seen at all."""
        keep = self.reach > 0
        if threshold > 0:
            keep &= self.opacities >= np.float32(threshold)
        if levels is not None:
            keep &= np.isin(self.levels, list(levels))
        if view is not None:
            keep &= self.views == view
        return keep


def _finite(gaussians: Gaussians) -> torch.Tensor:
    fields = (gaussians.means, gaussians.scales, gaussians.quats, gaussians.opacities[:, None])
    finite = torch.stack([torch.isfinite(values).all(dim=-1) for values in fields]).all(dim=0)
    return finite & torch.isfinite(gaussians.harmonics).flatten(1).all(dim=-1)


def _origin(positions: np.ndarray, means: torch.Tensor) -> np.ndarray:
    if len(positions):
        return positions.mean(axis=0)
    if len(means):
        return means.detach().double().median(dim=0).values.numpy()
    return np.zeros(3)


def _constant_colors(harmonics: Float[np.ndarray, "1 3 n"]) -> Float[np.ndarray, "n 4"]:
    colors = np.zeros((harmonics.shape[2], 4), np.float32)
    colors[:, :3] = np.maximum(0.5 + harmonics[0].T / (2 * math.sqrt(math.pi)), 0)
    return colors


class SplatBuffers:
    """The splats on the GPU."""

    def __init__(self, ctx: moderngl.Context, splats: Splats) -> None:
        """Upload the geometry; colours follow with `write_colors`."""
        self.splats = splats
        self.geometry = ctx.buffer(splats.geometry) if len(splats) else ctx.buffer(reserve=48)
        self.colors = ctx.buffer(reserve=max(16 * len(splats), 16), dynamic=True)
        if splats.base_colors is not None and len(splats):
            self.colors.write(splats.base_colors)

    def write_colors(self, colors: Float[np.ndarray, "n 4"]) -> None:
        """Replace the colours."""
        if len(colors):
            self.colors.write(colors)

    def release(self) -> None:
        """Free the buffers."""
        self.geometry.release()
        self.colors.release()
