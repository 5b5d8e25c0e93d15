"""3D Gaussians in world axes, and the scene that they belong to."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Integer
from torch import Tensor

from pansplat.errors import InputError
from pansplat.gaussians.harmonics import rotate_harmonics
from pansplat.geometry.pose import interpolate_poses, multiply_quats, quats_from_rotations, rotations_from_quats
from pansplat.geometry.world import USER_FRAME, WorldFrame
from pansplat.system.descriptions import describe_count, describe_range, list_first

Gains = tuple[tuple[float, ...], ...]
"""Factors of R, G and B for each view's photograph."""

Starts = tuple[tuple[float, float] | None, ...]
"""For each panorama the view that a visitor sees first: its yaw (to the right) and pitch (below the horizon), radians;
None if there is none."""


@dataclass(frozen=True)
class SceneTour:
    """How the views of a scene of a whole tour are connected.

    Attributes:
        overlaps: edges of the tour's graph: two views, the smaller one first, and their overlap, 0 through a wall. A
            view without another edge has one to itself, with 1.
        links: ways from one view towards another: both views, yaw and pitch in radians (as of `Starts`), and text.
        approximate: about where views are that are not placed: view, the view that it is beside, to the right and
            forward of that camera in the user's unit, and yaw relative to it (to the right, radians).
    """

    overlaps: tuple[tuple[int, int, float], ...]
    links: tuple[tuple[int, int, float, float, str], ...] = ()
    approximate: tuple[tuple[int, int, float, float, float], ...] = ()

    def select(self, views: Sequence[int]) -> SceneTour:
        """The tour of some views, which are numbered anew."""
        new = {old: number for number, old in enumerate(views)}
        overlaps, links, approximate = (
            tuple((new[a], new[b], *rest) for a, b, *rest in rows if a in new and b in new)
            for rows in (self.overlaps, self.links, self.approximate)
        )
        joined = {view for a, b, _ in overlaps for view in (a, b)}
        alone = ((view, view, 1.0) for view in range(len(new)) if view not in joined)
        return SceneTour((*overlaps, *alone), links, approximate)


@dataclass(frozen=True, eq=False)
class Gaussians:
    """3D Gaussians of one scene.

    Source: PanSplat, section 3.3, in the field's vocabulary (3DGS, gsplat).

    Attributes:
        means: centres in the world, metres.
        scales: standard deviations along the Gaussian's own axes, metres.
        quats: rotation from the Gaussian's axes to the world's, wxyz; need not be normalised.
        opacities: peak opacity, in [0, 1].
        harmonics: real spherical-harmonics coefficients of degree 0..4 in world axes, in the 3DGS order and signs;
            colour in direction d (camera to mean) is max(0, 0.5 + sum_k Y_k(d) c_k). Three channels are RGB;
            the rasteriser accepts any number.
        levels: pyramid level, 0 is the finest.
        views: index of the context view of each Gaussian.
    """

    means: Float[Tensor, "n 3"]
    scales: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    opacities: Float[Tensor, "n"]
    harmonics: Float[Tensor, "n k channel"]
    levels: Integer[Tensor, "n"]
    views: Integer[Tensor, "n"]

    def __post_init__(self) -> None:
        n = self.means.shape[0]
        needed = {"means": (n, 3), "scales": (n, 3), "quats": (n, 4), "opacities": (n,), "levels": (n,), "views": (n,)}
        for name, shape in needed.items():
            got = tuple(getattr(self, name).shape)
            if got != shape:
                raise ValueError(f"`{name}` must have shape {shape} to fit {n} means, got {got}")
        got = tuple(self.harmonics.shape)
        if len(got) != 3 or got[0] != n or got[1] not in (1, 4, 9, 16, 25) or got[2] < 1:
            raise ValueError(f"`harmonics` must have shape ({n}, 1|4|9|16|25, 3), got {got}")

    def __len__(self) -> int:
        return self.means.shape[0]

    def __repr__(self) -> str:
        parts = [f"{len(self):,}"]
        if len(self):
            parts[0] += f" of {describe_count(len(self.views.unique()), 'view')}"
            levels = describe_range(int(self.levels.min()), int(self.levels.max()))
            parts.append(f"level{'s' if ' ' in levels else ''} {levels}")
        parts.append(f"harmonics of degree {self.degree}")
        if self.harmonics.shape[2] != 3:
            parts.append(describe_count(self.harmonics.shape[2], "channel"))
        parts.append(f"{str(self.means.dtype).removeprefix('torch.')} on {self.means.device}")
        return f"<Gaussians: {', '.join(parts)}>"

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics, 0..4."""
        return round(self.harmonics.shape[1] ** 0.5) - 1

    @property
    def covariances(self) -> Float[Tensor, "n 3 3"]:
        """World covariances R diag(s^2) R', square metres."""
        axes = rotations_from_quats(self.quats) * self.scales[:, None, :]
        return axes @ axes.transpose(-1, -2)

    def select(self, index: Tensor) -> Gaussians:
        """The Gaussians of a boolean mask or of indices, in their order."""
        if index.dtype == torch.bool:
            index = index.nonzero()[:, 0]
        return Gaussians(*(getattr(self, f.name)[index] for f in dataclasses.fields(self)))

    def to(self, *, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> Gaussians:
        """The Gaussians in another floating-point type or on another device; labels keep their integer type."""
        values = []
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            values.append(value.to(device=device, dtype=dtype if value.is_floating_point() else None))
        return Gaussians(*values)

    def scaled(self, factor: float, centre: Float[Tensor, "3"] | None = None) -> Gaussians:
        """The Gaussians in a world that is multiplied by a factor, about its origin or another centre."""
        if factor == 1:
            return self
        means = self.means * factor
        if centre is not None:
            means = means + (1 - factor) * centre.to(means)
        return dataclasses.replace(self, means=means, scales=self.scales * factor)

    def rotated(self, rotation: Float[Tensor, "3 3"]) -> Gaussians:
        """The Gaussians after a rotation of the world about its origin; colours turn with it."""
        turn = rotation.to(self.means)
        return dataclasses.replace(
            self,
            means=self.means @ turn.T,
            quats=multiply_quats(quats_from_rotations(turn).expand_as(self.quats), self.quats),
            harmonics=rotate_harmonics(self.harmonics, rotation) if self.degree else self.harmonics,
        )

    @staticmethod
    def cat(parts: Sequence[Gaussians]) -> Gaussians:
        """The Gaussians of all parts in order; the parts must have the same SH degree."""
        if not parts:
            raise ValueError("`parts` must hold at least one set of Gaussians, got none")
        degrees = sorted({part.degree for part in parts})
        if len(degrees) > 1:
            raise ValueError(f"`parts` must share one SH degree, got {degrees}")
        return Gaussians(*(torch.cat([getattr(p, f.name) for p in parts]) for f in dataclasses.fields(Gaussians)))


def empty_gaussians() -> Gaussians:
    """An empty set of Gaussians with harmonics of degree 0."""
    vectors, labels = torch.zeros(0, 3), torch.zeros(0, dtype=torch.uint8)
    return Gaussians(vectors, vectors, torch.zeros(0, 4), torch.zeros(0), torch.zeros(0, 1, 3), labels, labels)


@dataclass(frozen=True, eq=False)
class Scene:
    """Gaussians with the cameras they were predicted from: the result of `predict` and the input of `render`.

    Attributes:
        gaussians: all context views' Gaussians.
        cam2world: poses of the context views, float64, in the order of `gaussians.views`; empty for a file of another
            tool. `frame` brings other poses to their world.
        near, far: depth range of the prediction, metres.
        names: image file name of each context view.
        model: name of the predictor, e.g. "sweep".
        height: of the input panoramas, pixels.
        gains: mean exposure and white balance of each view's photograph, as factors of R, G and B relative to the
            geometric mean of all. The colours of a view's Gaussians are those of its photograph, in joint drawing
            between those of all (`pansplat.rendering.gains`).
        starts: one for each view, or none.
        tour: how the views are connected; None if the scene is not that of a whole tour.
        joint: whether the Gaussians of all views belong in one image, as other programs draw them. Else those of a view
            show its whole surroundings, and images of single views are blended ("deferred").
        frame: where the world of the Gaussians and cameras is in the user's world, that of files.
    """

    gaussians: Gaussians
    cam2world: Float[Tensor, "view 4 4"]
    near: float
    far: float
    names: tuple[str, ...] = ()
    model: str = ""
    height: int = 512
    gains: Gains = ()
    starts: Starts = ()
    tour: SceneTour | None = None
    joint: bool = False
    frame: WorldFrame = USER_FRAME

    def __repr__(self) -> str:
        count = len(self.cam2world)
        names = f" ({list_first(self.names)})" if self.names else ""
        parts = [
            describe_count(len(self.gaussians), "Gaussian"),
            f"{describe_count(count, 'panorama')}{names}" if count else "no input cameras",
            f"near and far {describe_range(self.near, self.far, 'm')}",
        ]
        if self.model:
            parts.append(f"predicted by {self.model} at {self.height}x{2 * self.height}")
        if count > 1:
            parts.append(f"for {'joint drawing' if self.joint else 'deferred blending'}")
        return f"<Scene: {', '.join(parts)}>"

    def scaled(self, factor: float) -> Scene:
        """The scene in a world that is multiplied by a factor; its place in the user's world stays the same."""
        if factor == 1:
            return self
        poses = self.cam2world.clone()
        poses[:, :3, 3] *= factor
        frame = dataclasses.replace(self.frame, unit=self.frame.unit / factor)
        near, far = self.near * factor, self.far * factor
        gaussians = self.gaussians.scaled(factor)
        return dataclasses.replace(self, gaussians=gaussians, cam2world=poses, near=near, far=far, frame=frame)

    def rotated(self, rotation: Float[Tensor, "3 3"]) -> Scene:
        """The scene after a rotation of the user's world about its origin."""
        poses = self.cam2world.clone()
        poses[:, :3] = rotation.to(poses) @ poses[:, :3]
        x, y, z = (rotation.double().cpu() @ torch.tensor(self.frame.origin, dtype=torch.float64)).tolist()
        frame = dataclasses.replace(self.frame, origin=(x, y, z))
        return dataclasses.replace(self, gaussians=self.gaussians.rotated(rotation), cam2world=poses, frame=frame)

    def moved(self, motion: Float[Tensor, "4 4"], frame: WorldFrame) -> Scene:
        """The scene after a rigid motion of its world, which becomes that of a frame."""
        scene = self.rotated(motion[:3, :3])
        poses = scene.cam2world.clone()
        poses[:, :3, 3] += motion[:3, 3].to(poses)
        gaussians = scene.gaussians
        means = (gaussians.means.double() + motion[:3, 3].to(gaussians.means.device)).to(gaussians.means)
        gaussians = dataclasses.replace(gaussians, means=means)
        return dataclasses.replace(scene, gaussians=gaussians, cam2world=poses, frame=frame)

    def pose_between(self, fraction: float) -> Float[Tensor, "4 4"]:
        """The pose at a fraction from the first context camera (0) to the last (1); an InputError without cameras."""
        if not 0 <= fraction <= 1:
            raise InputError(f"`fraction` must be from 0, the first camera, to 1, the last one, got {fraction}")
        if not len(self.cam2world):
            raise InputError("the scene has no input cameras to interpolate; give a pose instead")
        return interpolate_poses(self.cam2world[0], self.cam2world[-1], fraction)


def prune(gaussians: Gaussians, *, degree: int | None = None, min_opacity: float = 0.0) -> Gaussians:
    """The Gaussians with at least a minimum opacity, and their harmonics up to a degree.

    Args:
        degree: highest degree that is kept; None keeps all.
        min_opacity: in [0, 1]; Gaussians below 1/255 are invisible.
    """
    if min_opacity > 0:
        gaussians = gaussians.select(gaussians.opacities >= min_opacity)
    if degree is None or degree >= gaussians.degree:
        return gaussians
    return dataclasses.replace(gaussians, harmonics=gaussians.harmonics[:, : (degree + 1) ** 2])
