"""How training draws its pictures: whole, or part by part for two-step backpropagation.

Source: PanSplat, sections 3.4 and 3.6; OFFICIAL.md, section 10.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.gaussians.gaussians import Gaussians
from pansplat.gaussians.harmonics_official import as_the_original_draws
from pansplat.geometry.blending import blend_weights
from pansplat.geometry.cubemap import face_poses
from pansplat.render.blend import blend
from pansplat.render.rasterize import Rendering, rasterize
from pansplat.render.stitching import stitch_faces
from pansplat.training.config import Mixing, Style

_FACES = 6


@dataclass(frozen=True)
class Layer:
    """A part of a picture that can be drawn by itself.

    Attributes:
        view: whose Gaussians it shows; None for all views'.
        face: number of the cube's face; None for the whole panorama.
    """

    view: int | None
    face: int | None


@dataclass(frozen=True)
class Drawing:
    """How to draw.

    Attributes:
        style, mixing: see `MemoryConfig`.
        height: of the panorama, pixels; it is twice as wide.
    """

    style: Style
    mixing: Mixing
    height: int

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the panorama, pixels."""
        return self.height, 2 * self.height

    @property
    def face_size(self) -> int:
        """Pixels; half the height, as in the original."""
        return self.height // 2

    def layers(self, views: int) -> list[Layer]:
        """All parts of a picture: view by view if they are mixed, face by face if there are faces."""
        shown = [None] if self.mixing == "joint" else list(range(views))
        faces = [None] if self.style == "panorama" else list(range(_FACES))
        return [Layer(view, face) for view in shown for face in faces]

    def draw(
        self, gaussians: Gaussians, cam2world: Float[Tensor, "4 4"], context: Float[Tensor, "view 4 4"]
    ) -> Float[Tensor, "3 height width"]:
        """The panorama, in one graph.

        Args:
            cam2world: of the picture.
            context: of the input views, for how they are mixed.
        """
        shown = [None] if self.mixing == "joint" else list(range(len(context)))
        pictures = [self._whole(self._of(gaussians, view), cam2world) for view in shown]
        return self._mixed(pictures, cam2world, context)

    def draw_layer(
        self, gaussians: Gaussians, cam2world: Float[Tensor, "4 4"], layer: Layer
    ) -> Float[Tensor, "4 rows columns"]:
        """Colour and opacity of one part."""
        shown = self._of(gaussians, layer.view)
        if layer.face is None:
            picture = self._whole(shown, cam2world)
        else:
            pose = face_poses(cam2world.double())[layer.face]
            picture = rasterize(shown, pose, size=(self.face_size,) * 2, layout="pinhole", **self._kernel())
        return torch.cat((picture.color, picture.alpha[None]))

    def compose(
        self,
        layers: Sequence[Float[Tensor, "4 rows columns"]],
        cam2world: Float[Tensor, "4 4"],
        context: Float[Tensor, "view 4 4"],
    ) -> Float[Tensor, "3 height width"]:
        """The panorama of all parts, in the order of `layers`."""
        each = 1 if self.style == "panorama" else _FACES
        pictures = []
        for start in range(0, len(layers), each):
            sums = layers[start]
            if self.style != "panorama":
                stitching = "official" if self.style == "original" else "seamless"
                sums = stitch_faces(torch.stack(list(layers[start : start + each])), self.size, stitching=stitching)
            pictures.append(Rendering(sums[:3], sums[3], torch.zeros_like(sums[3])))
        return self._mixed(pictures, cam2world, context)

    def _mixed(self, pictures: list[Rendering], cam2world: Tensor, context: Tensor) -> Float[Tensor, "3 height width"]:
        if self.mixing == "joint":
            return pictures[0].color
        weights = blend_weights(cam2world[:3, 3].double(), context[:, :3, 3].double())
        return blend(pictures, weights.to(pictures[0].color)).color

    def _of(self, gaussians: Gaussians, view: int | None) -> Gaussians:
        if self.style == "original":
            gaussians = replace(gaussians, harmonics=as_the_original_draws(gaussians.harmonics))
        return gaussians if view is None else gaussians.select((gaussians.views == view).nonzero()[:, 0])

    def _whole(self, gaussians: Gaussians, cam2world: Tensor) -> Rendering:
        if self.style == "panorama":
            return rasterize(gaussians, cam2world, size=self.size)
        stitching = "official" if self.style == "original" else "seamless"
        return rasterize(
            gaussians,
            cam2world,
            size=self.size,
            layout="cubemap",
            face_size=self.face_size,
            stitching=stitching,
            **self._kernel(),
        )

    def _kernel(self) -> dict[str, str]:
        if self.style == "original":
            return {"kernel": "ewa", "order": "z", "lowpass": "3dgs"}
        return {"kernel": "ray", "order": "radial", "lowpass": "angular"}
