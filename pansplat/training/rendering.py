"""How training draws its pictures: whole, or part by part for two-step backpropagation.

A part is a face of the cube, or a strip of a panorama's rows. Each is drawn of the Gaussians that it can show alone:
that bounds the memory of its graph. The rasteriser knows no strips, so a strip is cut from a panorama of its own
Gaussians; what they paint on other rows is thrown away.

Source: PanSplat, sections 3.4 and 3.6; OFFICIAL.md, section 10.
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
from pansplat.rendering.official import OFFICIAL, official_face_size, official_gaussians
from pansplat.rendering.projection import ProjectedGaussians, compute_footprints, is_in_image, project_gaussians
from pansplat.rendering.rasterize import RasterOptions, Rendering, rasterize
from pansplat.training.config import Mixing, Style

_FACES = 6
_STRIPS = 6  # as many as faces, each as much of the sphere


@dataclass(frozen=True)
class ImagePart:
    """A part of a picture that can be drawn by itself.

    Attributes:
        view: whose Gaussians it shows; None for all views'.
        part: number of the cube's face, or of the strip of rows from the top.
    """

    view: int | None
    part: int


@dataclass(frozen=True)
class TargetRenderer:
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
        return official_face_size(self.height)

    def parts(self, views: int) -> list[ImagePart]:
        """All parts of a picture: view by view if they are mixed, each face by face or strip by strip."""
        shown = [None] if self.mixing == "joint" else list(range(views))
        return [ImagePart(view, part) for view in shown for part in range(self._parts)]

    def visible(
        self, gaussians: Gaussians, cam2world: Float[Tensor, "4 4"], layers: Sequence[ImagePart]
    ) -> list[Bool[Tensor, "n"]]:
        """For each layer, the Gaussians that it is to be drawn of."""
        seen = visible_gaussians(gaussians, cam2world, self._regions(gaussians.means.device), self._options)
        return [
            seen[layer.part] if layer.view is None else seen[layer.part] & (gaussians.views == layer.view)
            for layer in layers
        ]

    def render(
        self, gaussians: Gaussians, cam2world: Float[Tensor, "4 4"], context: Float[Tensor, "view 4 4"]
    ) -> Float[Tensor, "3 height width"]:
        """The panorama, in one graph.

        Args:
            cam2world: of the picture.
            context: of the input views, for how they are mixed.
        """
        shown = [None] if self.mixing == "joint" else list(range(len(context)))
        panoramas = [self._whole(self._of(gaussians, view), cam2world) for view in shown]
        return self._mixed(panoramas, cam2world, context)

    def render_part(
        self, gaussians: Gaussians, cam2world: Float[Tensor, "4 4"], layer: ImagePart
    ) -> Float[Tensor, "4 rows columns"]:
        """Colour and opacity of one part.

        Args:
            gaussians: those that `shown` tells of, in the order of all.
        """
        if self.style == "panorama":
            first, end = self._rows(layer.part)
            picture = self._whole(gaussians, cam2world)
            return torch.cat((picture.color, picture.alpha[None]))[:, first:end]
        pose = face_poses(cam2world.double())[layer.part]
        gaussians = self._of(gaussians, None)
        size = (self.face_size, self.face_size)
        picture = rasterize(gaussians, pose, size=size, layout="pinhole", options=self._options, stitching="seamless")
        return torch.cat((picture.color, picture.alpha[None]))

    def compose(
        self,
        layers: Sequence[Float[Tensor, "4 rows columns"]],
        cam2world: Float[Tensor, "4 4"],
        context: Float[Tensor, "view 4 4"],
    ) -> Float[Tensor, "3 height width"]:
        """The panorama of all parts, in the order of `layers`."""
        panoramas = []
        for start in range(0, len(layers), self._parts):
            own = list(layers[start : start + self._parts])
            if self.style == "panorama":
                sums = torch.cat(own, dim=1)
            else:
                sums = stitch_faces(torch.stack(own), self.size, stitching=self._options.stitching)
            panoramas.append(Rendering(sums[:3], sums[3], torch.zeros_like(sums[3])))
        return self._mixed(panoramas, cam2world, context)

    @property
    def _parts(self) -> int:
        return _STRIPS if self.style == "panorama" else _FACES

    def _rows(self, strip: int) -> tuple[int, int]:
        """The first row of a strip, and the first after it: strips have one area on the sphere."""
        first, end = (
            round(self.height * (0.5 + math.asin(2 * edge / _STRIPS - 1) / math.pi)) for edge in (strip, strip + 1)
        )
        return first, end

    def _regions(self, device: torch.device) -> list[Region]:
        """What the parts show."""
        layout = "equirect" if self.style == "panorama" else "cubemap"
        planes = image_planes(layout, self.size, vertical_fov_degrees=90.0, face_size=self.face_size, device=device)
        if self.style == "panorama":
            return [Region(planes[0], *self._rows(strip)) for strip in range(_STRIPS)]
        return [Region(plane, 0, self.face_size) for plane in planes]

    def _mixed(self, panoramas: list[Rendering], cam2world: Tensor, context: Tensor) -> Float[Tensor, "3 height width"]:
        if self.mixing == "joint":
            return panoramas[0].color
        weights = blend_weights(cam2world[:3, 3].double(), context[:, :3, 3].double())
        return blend(panoramas, weights.to(panoramas[0].color)).color

    def _of(self, gaussians: Gaussians, view: int | None) -> Gaussians:
        if self.style == "original":
            gaussians = official_gaussians(gaussians)
        return gaussians if view is None else gaussians.select((gaussians.views == view).nonzero()[:, 0])

    def _whole(self, gaussians: Gaussians, cam2world: Tensor) -> Rendering:
        if self.style == "panorama":
            return rasterize(gaussians, cam2world, size=self.size)
        return rasterize(
            gaussians,
            cam2world,
            size=self.size,
            layout="cubemap",
            face_size=self.face_size,
            options=self._options,
        )

    @property
    def _options(self) -> RasterOptions:
        return OFFICIAL if self.style == "original" else RasterOptions()


_CHUNK = 1 << 16  # Gaussians at a time: their geometry is float64


@dataclass(frozen=True)
class Region:
    """Rows of a picture.

    Attributes:
        picture: as the rasteriser draws it.
        first, end: the rows, `end` left out.
    """

    picture: ImagePlane
    first: int
    end: int


@torch.no_grad()
def visible_gaussians(
    gaussians: Gaussians, cam2world: Float[Tensor, "4 4"], regions: Sequence[Region], options: RasterOptions
) -> list[Bool[Tensor, "n"]]:
    """For each region, the Gaussians that may reach a pixel in it; the others have no part in its colours.

    Args:
        cam2world: of the camera that has all the regions' pictures.
        regions: of pictures of one size and kind.
        options: as the pictures are drawn.
    """
    pose = cam2world.double().to(gaussians.means.device)
    found: list[list[Tensor]] = [[] for _ in regions]
    for start in range(0, len(gaussians), _CHUNK):
        observed = project_gaussians(
            _piece(gaussians, slice(start, start + _CHUNK)),
            None,
            pose,
            filter_variance=options.filter_variance(regions[0].picture.pixel_angle),
            compensate=options.lowpass == "angular",
            exact=False,
        )
        for region, masks in zip(regions, found, strict=True):
            masks.append(_in_region(observed, region, options))
    return [torch.cat(masks) if masks else torch.zeros(0, dtype=torch.bool) for masks in found]


def _piece(gaussians: Gaussians, rows: slice) -> Gaussians:
    """Some of the Gaussians, as views of their memory and without colours, which do not matter here."""
    g = gaussians
    own = (field[rows] for field in (g.means, g.scales, g.quats, g.opacities))
    return Gaussians(*own, g.harmonics[rows, :1] * 0, g.levels[rows], g.views[rows])


def _in_region(observed: ProjectedGaussians, region: Region, options: RasterOptions) -> Bool[Tensor, "n"]:
    picture, rows = region.picture, (region.first, region.end)
    if options.kernel == "ewa":  # has no box behind the camera
        ahead = observed.direction @ picture.rotation[:, 2] > 0
        seen = torch.zeros_like(ahead)
        boxes = compute_footprints(ProjectedGaussians(*(part[ahead] for part in observed)), picture, options)[1]
        seen[ahead] = is_in_image(boxes, picture, rows)
        return seen
    return is_in_image(compute_footprints(observed, picture, options)[1], picture, rows)
