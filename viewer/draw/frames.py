"""Frames: the camera of an image, how its layers are stored, and their weights. Needs no OpenGL."""

from __future__ import annotations

import math
from collections.abc import Hashable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from pansplat.errors import InputError
from pansplat.geometry.pose import blend_weights
from pansplat_viewer.core.camera import Pinhole, create_face_cameras, find_faces_in_view
from pansplat_viewer.core.settings import DrawSettings
from pansplat_viewer.draw.splats import SortedSplats, Splats

_MAX_CACHED_FACE_SIZE = 2048  # pixels; six faces take 200 MB at 16 bits


@dataclass(frozen=True, eq=False)
class Frame:
    """One image to draw: camera, size and settings, and the values that follow from them."""

    rotation: Float[np.ndarray, "3 3"]  # camera to world
    position: tuple[float, float, float]  # camera centre in the splats' moved frame
    world_position: Float[np.ndarray, "3"]  # camera centre, metres
    size: tuple[int, int]  # (width, height) at which the image is drawn, pixels
    settings: DrawSettings
    full_size: tuple[int, int]  # (width, height) without `settings.scale`

    @staticmethod
    def create(splats: Splats, cam2world: np.ndarray, size: tuple[int, int], settings: DrawSettings) -> Frame:
        """Check the arguments and return the frame."""
        if cam2world.shape != (4, 4) or not np.isfinite(cam2world).all():
            raise InputError(f"`cam2world` must be a finite 4x4 matrix, got {cam2world.tolist()}")
        width, height = (int(length) for length in size)
        if width < 1 or height < 1:
            raise InputError(f"`size` must be at least 1x1 pixel, got {width}x{height}")
        moved = cam2world[:3, 3] - splats.origin
        position = (float(moved[0]), float(moved[1]), float(moved[2]))
        drawn = max(round(width * settings.scale), 1), max(round(height * settings.scale), 1)
        return Frame(cam2world[:3, :3], position, cam2world[:3, 3], drawn, settings, (width, height))

    @property
    def has_faces(self) -> bool:
        """Whether layers are six cube faces, each with one extra pixel on each side, which the texture unit can filter;
        else one image of the frame's size."""
        return self.settings.cached and self.face_size <= _MAX_CACHED_FACE_SIZE

    @property
    def focal(self) -> float:
        """Focal length, pixels."""
        return 0.5 * self.size[1] / math.tan(0.5 * math.radians(self.settings.vertical_fov_degrees))

    @property
    def face_size(self) -> int:
        """Side of a cube face without border, pixels: the resolution of the image's centre."""
        return max(math.ceil(2 * self.focal), 1)

    @property
    def _pinhole(self) -> Pinhole:
        return Pinhole(self.rotation, self.position, self.focal, *self.size)

    def create_layer_cameras(self) -> list[Pinhole]:
        """Return the cameras of a layer's parts: one, or one for each cube face."""
        return create_face_cameras(self.position, self.face_size, 1) if self.has_faces else [self._pinhole]

    def find_parts_in_view(self) -> list[int]:
        """Return the indices of the layer parts that the frame reads."""
        return find_faces_in_view(self.rotation, self._pinhole.half_size) if self.has_faces else [0]

    def create_layer_key(self, splats: SortedSplats) -> tuple[Hashable, ...]:
        """Return the values that a layer's content depends on, except its set of Gaussians."""
        s = self.settings
        key = (splats, self.position, s.levels, s.near, s.shift, s.splat_colors)
        return key if self.has_faces else (*key, self.rotation.tobytes(), self.focal)


def choose_layer_weights(frame: Frame, splats: Splats, min_weight: float) -> dict[int | None, float]:
    """Return each layer's weight by its view (None: all Gaussians)."""
    settings, num_views = frame.settings, splats.num_views
    mode = settings.mode
    if mode == "joint":
        return {None: 1.0}
    if mode == "view" and not 0 <= settings.view < max(num_views, 1):
        raise InputError(f"`view` must be 0..{max(num_views, 1) - 1} in this scene, got {settings.view}")
    if mode == "view":
        return {settings.view: 1.0}
    if num_views < 2:
        return {None: 1.0}
    positions = splats.view_positions
    if len(positions) != num_views:
        raise InputError(
            f"mode deferred needs the camera of each context view, the scene has {len(positions)} cameras "
            f"for {num_views} views; use mode joint"
        )
    forward = torch.from_numpy(frame.rotation[:, 2].astype(np.float64))
    weights = blend_weights(torch.from_numpy(frame.world_position.copy()), torch.from_numpy(positions), forward)
    return {view: max(weight, min_weight) for view, weight in enumerate(weights.tolist())}
