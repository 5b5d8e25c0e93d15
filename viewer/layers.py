"""Layers: the premultiplied pictures of sets of Gaussians, drawn directly or as six cube faces, and kept."""

import math
from collections.abc import Hashable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, UInt

from pansplat.errors import InputError
from pansplat_viewer.draw import SplatDrawer, filter_of
from pansplat_viewer.order import Ordering, radix_argsort
from pansplat_viewer.pinhole import NUM_FACES, Pinhole, face_cameras, faces_in_sight, focal_of, in_sight
from pansplat_viewer.settings import DrawSettings
from pansplat_viewer.splats import Splats
from pansplat_viewer.targets import Target, TargetStore

_LARGEST_CACHED_FACE = 2048  # pixels; six of them take 200 MB at 16 bits


@dataclass(frozen=True, eq=False)
class Shot:
    """One picture to take.

    Attributes:
        splats: of what.
        rotation: camera to world.
        position: camera centre in the splats' moved frame.
        world_position: camera centre, metres.
        size: (width, height), pixels.
        settings: how.
    """

    splats: Splats
    rotation: Float[np.ndarray, "3 3"]
    position: tuple[float, float, float]
    world_position: Float[np.ndarray, "3"]
    size: tuple[int, int]
    settings: DrawSettings

    @staticmethod
    def make(splats: Splats, cam2world: np.ndarray, size: tuple[int, int], settings: DrawSettings) -> "Shot":
        """Check the arguments of a picture."""
        if cam2world.shape != (4, 4) or not np.isfinite(cam2world).all():
            raise InputError(f"`cam2world` must be a finite 4x4 matrix, got {cam2world.tolist()}")
        width, height = (int(length) for length in size)
        if width < 1 or height < 1:
            raise InputError(f"`size` must be at least 1x1 pixel, got {width}x{height}")
        moved = cam2world[:3, 3] - splats.origin
        position = (float(moved[0]), float(moved[1]), float(moved[2]))
        return Shot(splats, cam2world[:3, :3], position, cam2world[:3, 3], (width, height), settings)

    @property
    def source(self) -> int:
        """How shaders/gather.frag reads the layers: 0 picture, 1 faces by pinhole, 2 faces by panorama."""
        if self.settings.layout == "equirect":
            return 2
        return 1 if self.settings.cached and self.face_size <= _LARGEST_CACHED_FACE else 0

    @property
    def focal(self) -> float:
        """Focal length of a pinhole picture, pixels."""
        return focal_of(self.size[1], self.settings.vertical_fov_degrees)

    @property
    def face_size(self) -> int:
        """Side of a cube face, pixels: asked for, or as fine as the picture's middle."""
        if self.settings.face_size is not None:
            return self.settings.face_size
        if self.settings.layout == "equirect":
            return max(round(2 * self.size[1] / math.pi), 1)
        return max(math.ceil(2 * self.focal), 1)

    @property
    def faces_to_world(self) -> Float[np.ndarray, "3 3"]:
        """Axes of the cube: the panorama camera's own, or the world's when they serve every direction."""
        return self.rotation if self.settings.layout == "equirect" else np.eye(3)

    @property
    def camera_to_faces(self) -> Float[np.ndarray, "3 3"]:
        """Rotation from the camera's axes to the cube's."""
        return self.faces_to_world.T @ self.rotation


@dataclass(eq=False)
class LayerPainter:
    """Draws the layers that a shot needs and does not find as they were left.

    Attributes:
        drawer: draws splats.
        targets: keeps layers.
        largest_texture: GL's limit, pixels.
        visible, drawn, painted: Gaussians left by the toggles, splats sent, and whether anything was drawn
            for this shot.
        in_use: names of this shot's targets.
    """

    drawer: SplatDrawer
    targets: TargetStore
    largest_texture: int
    visible: int = 0
    drawn: int = 0
    painted: bool = False
    in_use: set[Hashable] = field(default_factory=set)
    _shot: Shot | None = None
    _ordering: Ordering | None = None
    _with_depth: bool = False
    _kept: dict[Hashable, np.ndarray] = field(default_factory=dict)

    @property
    def with_depth(self) -> bool:
        """Whether layers carry depth."""
        return self._with_depth

    def start(self, shot: Shot, ordering: Ordering, *, with_depth: bool) -> None:
        """Begin a shot."""
        self._shot, self._ordering, self._with_depth = shot, ordering, with_depth
        self.visible = self.drawn = 0
        self.painted = False
        self.in_use = set()

    def layer(self, view: int | None) -> Target:
        """The layer of one view's Gaussians, or of all (None), with everything the shot looks up drawn."""
        shot = self._shot
        assert shot is not None
        keep = self._keep(view)
        self.visible += int(np.count_nonzero(keep))
        name = ("picture", "turning faces", "panorama faces")[shot.source], view
        self.in_use.add(name)
        if shot.source == 0:
            size, key = shot.size, (*self._key(), shot.rotation.tobytes(), shot.focal)
            cameras, needed = [Pinhole(shot.rotation, shot.position, shot.focal, *size)], [0]
        else:
            # Faces for turning are read by the texture unit, which needs the pixels beyond their edges.
            border = 1 if shot.source == 1 else 0
            cameras = face_cameras(shot.faces_to_world, shot.position, shot.face_size, border)
            needed = self._faces()
            size = 3 * cameras[0].width, 2 * cameras[0].height
            key = (*self._key(), shot.faces_to_world.tobytes())
        target = self.targets.get(name, self._checked(size), depth_components=int(self._with_depth), key=key)
        for part in needed:
            if part not in target.parts:
                width, height = cameras[part].width, cameras[part].height
                self._paint(target, cameras[part], keep, (part % 3 * width, part // 3 * height, width, height))
                target.parts.add(part)
        return target

    def _faces(self) -> list[int]:
        shot = self._shot
        assert shot is not None
        if shot.source == 2:
            return list(range(NUM_FACES))
        half = 0.5 * shot.size[0] / shot.focal, 0.5 * shot.size[1] / shot.focal
        return faces_in_sight(shot.camera_to_faces, half)

    def _key(self) -> tuple[Hashable, ...]:
        """What changes a layer, except its camera."""
        shot, ordering = self._shot, self._ordering
        assert shot is not None and ordering is not None
        s = shot.settings
        return (ordering, shot.position, s.kernel, s.order, s.lowpass, s.levels, s.opacity_threshold, s.near)

    def _keep(self, view: int | None) -> np.ndarray:
        shot = self._shot
        assert shot is not None
        key = (shot.splats, shot.settings.levels, shot.settings.opacity_threshold, view)
        if key not in self._kept:
            if len(self._kept) > 8:
                self._kept.clear()
            self._kept[key] = shot.splats.kept(shot.settings.levels, shot.settings.opacity_threshold, view)
        return self._kept[key]

    def _paint(self, target: Target, camera: Pinhole, keep: np.ndarray, viewport: tuple[int, int, int, int]) -> None:
        shot = self._shot
        assert shot is not None
        indices = self._back_to_front(camera, keep)
        framebuffer = target.framebuffer
        framebuffer.use()
        framebuffer.viewport = framebuffer.scissor = viewport
        framebuffer.clear(0.0, 0.0, 0.0, 0.0)
        self.drawer.draw(camera, indices, shot.settings, viewport)
        framebuffer.scissor = None
        self.drawn += len(indices)
        self.painted = True

    def _back_to_front(self, camera: Pinhole, keep: np.ndarray) -> UInt[np.ndarray, "m"]:
        shot, ordering = self._shot, self._ordering
        assert shot is not None and ordering is not None
        variance, _ = filter_of(shot.settings, camera.focal)
        seen = in_sight(camera, ordering, keep, kernel=shot.settings.kernel, filter_variance=variance)
        if shot.settings.order == "radial":
            return ordering.order[seen[ordering.order]][::-1]
        indices = np.flatnonzero(seen).astype(np.uint32)
        forward = camera.rotation[:, 2]
        depth = shot.splats.means[indices] @ forward.astype(np.float32)
        depth -= np.float32(forward @ np.asarray(camera.position))
        return indices[radix_argsort(depth)][::-1]

    def _checked(self, size: tuple[int, int]) -> tuple[int, int]:
        if max(size) > self.largest_texture:
            raise InputError(
                f"the picture needs a texture of {size[0]}x{size[1]} pixels, this GPU's limit is "
                f"{self.largest_texture}; use a smaller size or face_size"
            )
        return size
