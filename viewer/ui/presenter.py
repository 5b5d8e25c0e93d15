"""The image on the screen: of a scene, or a photograph."""

from __future__ import annotations

import math
from dataclasses import dataclass

import moderngl
import numpy as np
from jaxtyping import Float

from pansplat.tours.route import find_offset
from pansplat_viewer.core import camera as cameras
from pansplat_viewer.draw.programs import Programs


@dataclass(frozen=True)
class PosedPhotograph:
    """A photograph and its camera."""

    texture: moderngl.Texture  # top row first
    pose: Float[np.ndarray, "4 4"]  # camera to world


class Presenter:
    """Draws images to the screen."""

    def __init__(self, ctx: moderngl.Context) -> None:
        """Compile the program."""
        self.ctx = ctx
        self._programs = Programs(ctx)
        self._program = self._programs.present()
        self._triangle = ctx.vertex_array(self._program, [])
        self._program["image"], self._program["fading"], self._program["photograph"] = range(3)

    def draw(
        self,
        image: moderngl.Texture,
        target: moderngl.Framebuffer,
        *,
        fading: moderngl.Texture | None = None,
        weight: float = 1.0,
    ) -> None:
        """Fill `target` with an image, mixed with `fading`, that of another scene; `weight` of the first is 0 to 1."""
        if fading is None and target.viewport == (0, 0, *image.size) and image.dtype == "f1":
            self._copy(image, target)
            return
        self._program["shows_photograph"], self._program["weight"] = False, weight
        self._fill(target, image, fading or image, image)

    def draw_photograph(
        self, photograph: PosedPhotograph, target: moderngl.Framebuffer, camera: cameras.Camera
    ) -> None:
        """Fill `target` with a photograph, on a sphere around its camera."""
        rotation = photograph.pose[:3, :3].T @ camera.rotation
        self._program["camera_to_photo"] = tuple(rotation.T.ravel().tolist())  # column by column
        self._program["beside"] = tuple(find_offset(photograph.pose, np.asarray(camera.position)).tolist())
        width, height = target.viewport[2:]
        tangent = math.tan(math.radians(camera.vertical_fov_degrees) / 2)
        self._program["tangent"] = (tangent * width / height, tangent)
        self._program["shows_photograph"] = True
        self._fill(target, *[photograph.texture] * 3)

    def _fill(self, target: moderngl.Framebuffer, *textures: moderngl.Texture) -> None:
        target.use()
        self.ctx.disable(moderngl.DEPTH_TEST | moderngl.BLEND | moderngl.CULL_FACE)
        for unit, texture in enumerate(textures):
            texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
            texture.use(unit)
        self._triangle.render(moderngl.TRIANGLES, vertices=3)

    def _copy(self, image: moderngl.Texture, target: moderngl.Framebuffer) -> None:
        """Copy an image of the target's size; software OpenGL copies fifty times as fast as it draws."""
        source = self.ctx.framebuffer([image])
        self.ctx.copy_framebuffer(target, source)
        target.use()
        source.release()

    def release(self) -> None:
        """Free the GL objects."""
        self._triangle.release()
        self._programs.release()


class PhotographLayer:
    """The image of a photograph in the direction of a camera, to fade it like the image of a scene."""

    def __init__(self, presenter: Presenter) -> None:
        """`presenter` draws the image."""
        self._presenter = presenter
        self._target: moderngl.Framebuffer | None = None
        self._key: tuple[object, ...] = ()

    def draw(self, photograph: PosedPhotograph, camera: cameras.Camera, size: tuple[int, int]) -> moderngl.Texture:
        """The image of this size (width, height), bottom row first."""
        target = self._target
        if target is None or target.size != size:
            self.release()
            ctx = self._presenter.ctx
            self._target = target = ctx.framebuffer([ctx.texture(size, 4)])
        texture = target.color_attachments[0]
        assert isinstance(texture, moderngl.Texture)
        key = (photograph.texture, camera)
        if key != self._key:
            self._presenter.draw_photograph(photograph, target, camera)
            self._key = key
        return texture

    def release(self) -> None:
        """Free the GL objects."""
        if self._target is not None:
            self._target.color_attachments[0].release()
            self._target.release()
        self._target, self._key = None, ()
