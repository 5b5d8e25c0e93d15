"""Frames: the camera of an image, how its layers are stored, and their weights. Needs no OpenGL."""

from __future__ import annotations

import math
from collections.abc import Hashable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import torch
from jaxtyping import Float

from pansplat.errors import InputError
from pansplat.geometry.pose import blend_weights
from pansplat_viewer.core.camera import Pinhole, create_face_cameras, find_faces_in_view
from pansplat_viewer.core.settings import DrawSettings
from pansplat_viewer.draw.splats import SortedSplats, Splats

_MAX_CACHED_FACE_SIZE = 2048  # pixels; six faces take 200 MB at 16 bits


class LayerStorage(IntEnum):
    """How a layer is stored; the constant LAYER_STORAGE of shaders/accumulate.frag.

    IMAGE is one image of the frame's size. PADDED_FACES are six cube faces with one extra pixel on each side, which
    the texture unit can filter. FACES are six cube faces without border, interpolated in float32 by the shader.
    """

    IMAGE = 0
    PADDED_FACES = 1
    FACES = 2


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
    def storage(self) -> LayerStorage:
        """How this frame's layers are stored."""
        if self.settings.layout == "equirect":
            return LayerStorage.FACES
        if self.settings.cached and self.face_size <= _MAX_CACHED_FACE_SIZE:
            return LayerStorage.PADDED_FACES
        return LayerStorage.IMAGE

    @property
    def focal(self) -> float:
        """Focal length of a pinhole image, pixels."""
        return 0.5 * self.size[1] / math.tan(0.5 * math.radians(self.settings.vertical_fov_degrees))

    @property
    def face_size(self) -> int:
        """Side of a cube face without border, pixels: the resolution of the equator, or of the image's centre."""
        if self.settings.layout == "equirect":
            return max(round(2 * self.size[1] / math.pi), 1)
        return max(math.ceil(2 * self.focal), 1)

    @property
    def faces_to_world(self) -> Float[np.ndarray, "3 3"]:
        """Axes of the cube: those of the panorama camera, or of the world for faces that serve every rotation."""
        return self.rotation if self.settings.layout == "equirect" else np.eye(3)

    @property
    def camera_to_faces(self) -> Float[np.ndarray, "3 3"]:
        """Rotation from the camera's axes to the cube's."""
        return self.faces_to_world.T @ self.rotation

    @property
    def _pinhole(self) -> Pinhole:
        return Pinhole(self.rotation, self.position, self.focal, *self.size)

    def create_layer_cameras(self) -> list[Pinhole]:
        """Return the cameras of a layer's parts: one, or one for each cube face."""
        if self.storage == LayerStorage.IMAGE:
            return [self._pinhole]
        border = 1 if self.storage == LayerStorage.PADDED_FACES else 0
        return create_face_cameras(self.faces_to_world, self.position, self.face_size, border)

    def find_parts_in_view(self) -> list[int]:
        """Return the indices of the layer parts that the frame reads."""
        if self.storage == LayerStorage.IMAGE:
            return [0]
        if self.storage == LayerStorage.FACES:
            return list(range(6))
        return find_faces_in_view(self.camera_to_faces, self._pinhole.half_size)

    def create_layer_key(self, splats: SortedSplats) -> tuple[Hashable, ...]:
        """Return the values that a layer's content depends on, except its set of Gaussians."""
        s = self.settings
        key = (splats, self.position, s.levels, s.near, s.shift, s.splat_colors)
        if self.storage == LayerStorage.IMAGE:
            return (*key, self.rotation.tobytes(), self.focal)
        return (*key, self.faces_to_world.tobytes())


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
    forward = torch.from_numpy(frame.rotation[:, 2].astype(np.float64)) if settings.layout == "pinhole" else None
    weights = blend_weights(torch.from_numpy(frame.world_position.copy()), torch.from_numpy(positions), forward)
    return {view: max(weight, min_weight) for view, weight in enumerate(weights.tolist())}
