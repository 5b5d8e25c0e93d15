"""The image on the screen, and right of a divider the photograph that it is compared with."""

from __future__ import annotations

import math
from dataclasses import dataclass

import moderngl
import numpy as np
from jaxtyping import Float

from pansplat_viewer.draw.programs import Programs
from pansplat_viewer.scene import camera as cameras


@dataclass(frozen=True)
class RightSide:
    """A photograph right of the divider."""

    texture: moderngl.Texture  # top row first
    pose: Float[np.ndarray, "4 4"]  # camera to world
    split: float = 0.0  # place of the divider, a fraction of the width


class Presenter:
    """Draws images to the screen."""

    def __init__(self, ctx: moderngl.Context) -> None:
        """Compile the program."""
        self.ctx = ctx
        self._programs = Programs(ctx)
        self._program = self._programs.present()
        self._triangle = ctx.vertex_array(self._program, [])
        self._program["image"], self._program["fading"], self._program["right"] = range(3)

    def draw(
        self,
        image: moderngl.Texture,
        target: moderngl.Framebuffer,
        camera: cameras.Camera,
        *,
        right: RightSide | None = None,
        fading: moderngl.Texture | None = None,
        weight: float = 1.0,
    ) -> None:
        """Fill `target` with the image of `camera`, and the part right of the divider with `right`.

        A photograph is sampled by direction only: it has no parallax and matches exactly at its own camera. The image
        is mixed with `fading`, the image of another scene; `weight` is that of the first, 0 to 1.
        """
        if right is None and fading is None and target.viewport == (0, 0, *image.size) and image.dtype == "f1":
            self._copy(image, target)
            return
        target.use()
        self.ctx.disable(moderngl.DEPTH_TEST | moderngl.BLEND | moderngl.CULL_FACE)
        side = image if right is None else right.texture
        for unit, texture in enumerate((image, fading or image, side)):
            texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
            texture.use(unit)
        self._program["weight"] = weight
        self._program["split"] = 2.0 if right is None else right.split
        if right is not None:
            rotation = right.pose[:3, :3].T @ camera.rotation
            self._program["camera_to_photo"] = tuple(rotation.T.ravel().tolist())  # column by column
            width, height = target.viewport[2:]
            tangent = math.tan(math.radians(camera.vertical_fov_degrees) / 2)
            self._program["tangent"] = (tangent * width / height, tangent)
        self._triangle.render(moderngl.TRIANGLES, vertices=3)

    def draw_photograph(self, photograph: RightSide, target: moderngl.Framebuffer, camera: cameras.Camera) -> None:
        """Fill `target` with a photograph, at an infinite distance around its camera."""
        self.draw(photograph.texture, target, camera, right=photograph)

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

    def draw(self, photograph: RightSide, camera: cameras.Camera, size: tuple[int, int]) -> moderngl.Texture:
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
