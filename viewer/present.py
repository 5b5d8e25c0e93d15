"""Puts the rendered picture on the screen, beside the input photograph it is compared with."""

import math

import moderngl
import numpy as np
from jaxtyping import Float

_VERTEX = """
#version 330
out vec2 uv;
void main() {
    vec2 corner = vec2((gl_VertexID << 1) & 2, gl_VertexID & 2);  // one triangle over the whole screen
    uv = corner;
    gl_Position = vec4(2.0 * corner - 1.0, 0.0, 1.0);
}
"""

_FRAGMENT = """
#version 330
const float PI = 3.14159265358979;
uniform sampler2D picture;      // bottom row first
uniform sampler2D photograph;   // equirectangular, top row first
uniform float split;            // the photograph is right of this fraction of the width
uniform vec2 tangent;           // of half the horizontal and vertical field of view
uniform mat3 camera_to_photo;   // rotation, OpenCV axes
in vec2 uv;
out vec4 color;
void main() {
    vec3 rgb;
    if (uv.x < split) {
        rgb = texture(picture, uv).rgb;
    } else {
        vec2 ray = (2.0 * uv - 1.0) * tangent;
        vec3 d = camera_to_photo * vec3(ray.x, -ray.y, 1.0);
        vec2 at = vec2(atan(d.x, d.z) / (2.0 * PI) + 0.5, atan(d.y, length(d.xz)) / PI + 0.5);
        rgb = textureLod(photograph, at, 0.0).rgb;  // explicit level: no seam of derivatives at +-180 degrees
    }
    color = vec4(rgb, 1.0);
}
"""


class Presenter:
    """Draws one full-screen triangle; owns the input photographs' textures."""

    def __init__(self, ctx: moderngl.Context) -> None:
        self.ctx = ctx
        self._program = ctx.program(vertex_shader=_VERTEX, fragment_shader=_FRAGMENT)
        self._triangle = ctx.vertex_array(self._program, [])
        self._program["picture"], self._program["photograph"] = 0, 1
        self._photos: list[moderngl.Texture] = []
        self._poses: Float[np.ndarray, "view 4 4"] = np.zeros((0, 4, 4))

    @property
    def photo_count(self) -> int:
        """How many photographs can be shown."""
        return len(self._photos)

    def upload_photos(
        self,
        images: Float[np.ndarray, "view height width 3"] | None,
        cam2world: Float[np.ndarray, "view 4 4"],
    ) -> None:
        """Replace the photographs; RGB in [0, 1] panoramas with their poses, or None."""
        for photo in self._photos:
            photo.release()
        self._photos, self._poses = [], cam2world
        for image in images if images is not None else ():
            height, width = image.shape[:2]
            pixels = np.ascontiguousarray((np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8))
            texture = self.ctx.texture((width, height), 3, pixels.tobytes(), alignment=1)
            texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
            texture.repeat_x, texture.repeat_y = True, False
            self._photos.append(texture)

    def draw(
        self,
        picture: moderngl.Texture,
        target: moderngl.Framebuffer,
        *,
        photo: int | None = None,
        split: float = 1.0,
        cam2world: Float[np.ndarray, "4 4"] | None = None,
        vertical_fov_degrees: float = 90.0,
    ) -> None:
        """Fill `target` with the picture, and right of `split` with photograph `photo` in the same direction.

        The photograph is drawn by direction alone: from its own place it shows exactly the camera's view.
        """
        target.use()
        self.ctx.disable(moderngl.DEPTH_TEST | moderngl.BLEND | moderngl.CULL_FACE)
        picture.filter = (moderngl.LINEAR, moderngl.LINEAR)
        picture.use(0)
        if photo is None or cam2world is None or photo >= len(self._photos):
            self._program["split"] = 2.0
            picture.use(1)
        else:
            self._program["split"] = split
            self._photos[photo].use(1)
            turn = self._poses[photo][:3, :3].T @ cam2world[:3, :3]
            self._program["camera_to_photo"] = tuple(turn.T.ravel().tolist())  # column by column
            width, height = target.viewport[2:]
            tangent = math.tan(math.radians(vertical_fov_degrees) / 2)
            self._program["tangent"] = (tangent * width / height, tangent)
        self._triangle.render(moderngl.TRIANGLES, vertices=3)

    def release(self) -> None:
        """Free the GL objects."""
        self.upload_photos(None, np.zeros((0, 4, 4)))
        self._triangle.release()
        self._program.release()
