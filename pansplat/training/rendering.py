"""Rendering of target panoramas in training: as a whole, or part by part for two-step deferred backpropagation.

A part is a cube face, or a strip of rows of a panorama. Each part is rendered from the Gaussians visible in it, which
bounds the memory of its graph. `rasterize` has no argument for strips: a strip is cut from a panorama of the
strip's Gaussians.

Source: PanSplat, sections 3.4 and 3.6; docs/official.md, section 10; docs/rendering.md, section 5 (visibility).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.cubemap import face_poses
from pansplat.geometry.pose import blend_weights
from pansplat.rendering.blend import blend
from pansplat.rendering.image_planes import ImagePlane, image_planes, stitch_faces
from pansplat.rendering.official import official_face_size
from pansplat.rendering.projection import compute_footprints, is_in_image, project_gaussians
from pansplat.rendering.rasterize import RasterOptions, Rendering, rasterize
from pansplat.training.config import Mixing, Style

_FACES = 6
_STRIPS = 6  # parts of equal area on the sphere
_OPTIONS = RasterOptions()
_CHUNK = 1 << 16  # Gaussians per visibility test, whose geometry is float64


@dataclass(frozen=True)
class ImagePart:
    """A part of a panorama that is rendered separately.

    Attributes:
        view: index of the input view whose Gaussians are rendered; None for the Gaussians of all views.
        index: number of the cube face, or of the strip of rows from the top.
    """

    view: int | None
    index: int


@dataclass(frozen=True)
class TargetRenderer:
    """Renders target panoramas.

    Attributes:
        style, mixing: see `MemoryConfig`.
        height: height of the panorama, pixels; it is twice as wide.
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
        """Side of a cube face, pixels."""
        return official_face_size(self.height)

    def list_parts(self, views: int) -> list[ImagePart]:
        """All parts of a panorama: the faces or strips of each view, or of all views jointly."""
        return [ImagePart(view, index) for view in self._view_choices(views) for index in range(self._parts_per_view)]

    def find_visible(
        self, gaussians: Gaussians, cam2world: Float[Tensor, "4 4"], parts: Sequence[ImagePart]
    ) -> list[Bool[Tensor, "n"]]:
        """A mask for each part: the Gaussians that `render_part` needs."""
        masks = find_visible_gaussians(gaussians, cam2world, self._regions(gaussians.means.device))
        return [
            masks[part.index] if part.view is None else masks[part.index] & (gaussians.views == part.view)
            for part in parts
        ]

    def render(
        self, gaussians: Gaussians, cam2world: Float[Tensor, "4 4"], context: Float[Tensor, "view 4 4"]
    ) -> Float[Tensor, "3 height width"]:
        """The panorama, rendered in one graph.

        Args:
            cam2world: pose of the panorama.
            context: poses of the input views, for the blend weights.
        """
        panoramas = [
            self._render_panorama(
                gaussians if view is None else gaussians.select((gaussians.views == view).nonzero()[:, 0]), cam2world
            )
            for view in self._view_choices(len(context))
        ]
        return self._blend(panoramas, cam2world, context)

    def render_batch(
        self,
        scenes: Sequence[Gaussians],
        targets: Float[Tensor, "batch target 4 4"],
        contexts: Float[Tensor, "batch view 4 4"],
    ) -> Float[Tensor, "batch target 3 height width"]:
        """The panoramas of all targets, see `render`."""
        items = zip(scenes, targets, contexts, strict=True)
        return torch.stack(
            [torch.stack([self.render(scene, pose, context) for pose in poses]) for scene, poses, context in items]
        )

    def render_part(
        self, gaussians: Gaussians, cam2world: Float[Tensor, "4 4"], part: ImagePart
    ) -> Float[Tensor, "4 rows columns"]:
        """Colour and opacity of one part.

        Args:
            gaussians: the Gaussians that `find_visible` selects for the part, in their original order.
        """
        if self.style == "panorama":
            first, end = self._strip_rows(part.index)
            image = self._render_panorama(gaussians, cam2world)
            return torch.cat((image.color, image.alpha[None]))[:, first:end]
        pose = face_poses(cam2world.double())[part.index]
        image = rasterize(gaussians, pose, size=(self.face_size, self.face_size), layout="pinhole")
        return torch.cat((image.color, image.alpha[None]))

    def compose(
        self,
        parts: Sequence[Float[Tensor, "4 rows columns"]],
        cam2world: Float[Tensor, "4 4"],
        context: Float[Tensor, "view 4 4"],
    ) -> Float[Tensor, "3 height width"]:
        """The panorama composed of all rendered parts, in the order of `list_parts`."""
        panoramas = []
        for start in range(0, len(parts), self._parts_per_view):
            images = list(parts[start : start + self._parts_per_view])
            if self.style == "panorama":
                image = torch.cat(images, dim=1)
            else:
                image = stitch_faces(torch.stack(images), self.size)
            panoramas.append(Rendering(image[:3], image[3], torch.zeros_like(image[3])))
        return self._blend(panoramas, cam2world, context)

    def _view_choices(self, views: int) -> list[int | None]:
        """Views that are rendered separately; [None] when all are rendered jointly."""
        return [None] if self.mixing == "joint" else list(range(views))

    @property
    def _parts_per_view(self) -> int:
        return _STRIPS if self.style == "panorama" else _FACES

    def _strip_rows(self, strip: int) -> tuple[int, int]:
        """First row of a strip, and the first row after it."""
        first, end = (
            round(self.height * (0.5 + math.asin(2 * edge / _STRIPS - 1) / math.pi)) for edge in (strip, strip + 1)
        )
        return first, end

    def _regions(self, device: torch.device) -> list[Region]:
        layout = "equirect" if self.style == "panorama" else "cubemap"
        planes = image_planes(layout, self.size, vertical_fov_degrees=90.0, face_size=self.face_size, device=device)
        if self.style == "panorama":
            return [Region(planes[0], *self._strip_rows(strip)) for strip in range(_STRIPS)]
        return [Region(plane, 0, self.face_size) for plane in planes]

    def _blend(self, panoramas: list[Rendering], cam2world: Tensor, context: Tensor) -> Float[Tensor, "3 height width"]:
        if self.mixing == "joint":
            return panoramas[0].color
        weights = blend_weights(cam2world[:3, 3].double(), context[:, :3, 3].double())
        return blend(panoramas, weights.to(panoramas[0].color)).color

    def _render_panorama(self, gaussians: Gaussians, cam2world: Tensor) -> Rendering:
        if self.style == "panorama":
            return rasterize(gaussians, cam2world, size=self.size)
        return rasterize(gaussians, cam2world, size=self.size, layout="cubemap", face_size=self.face_size)


@dataclass(frozen=True)
class Region:
    """Rows `first` to `end` (exclusive) of an image plane."""

    plane: ImagePlane
    first: int
    end: int


@torch.no_grad()
def find_visible_gaussians(
    gaussians: Gaussians, cam2world: Float[Tensor, "4 4"], regions: Sequence[Region]
) -> list[Bool[Tensor, "n"]]:
    """A mask for each region: the Gaussians that may reach one of its pixels. The others do not affect its colours.

    Args:
        cam2world: pose of the camera of all image planes.
        regions: regions of image planes of one size and kind.
    """
    pose = cam2world.double().to(gaussians.means.device)
    found: list[list[Tensor]] = [[] for _ in regions]
    for start in range(0, len(gaussians), _CHUNK):
        projected = project_gaussians(
            _without_colours(gaussians, slice(start, start + _CHUNK)),
            pose,
            filter_variance=_OPTIONS.filter_variance(regions[0].plane.pixel_angle),
            exact=True,
        )
        for region, masks in zip(regions, found, strict=True):
            boxes = compute_footprints(projected, region.plane, _OPTIONS)[1]
            masks.append(is_in_image(boxes, region.plane, (region.first, region.end)))
    return [torch.cat(masks) if masks else torch.zeros(0, dtype=torch.bool) for masks in found]


def _without_colours(gaussians: Gaussians, rows: slice) -> Gaussians:
    """A slice of the Gaussians as views of their memory, with zero harmonics of degree 0."""
    g = gaussians
    geometry = (field[rows] for field in (g.means, g.scales, g.quats, g.opacities))
    return Gaussians(*geometry, g.harmonics[rows, :1] * 0, g.levels[rows], g.views[rows])
