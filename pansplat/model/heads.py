"""Residual Gaussian heads: from features to Gaussians on the lattices of a spherical pyramid, coarse to fine.

The head of a level is a small CNN. It reads the image, the features, the refined cost volume and the map of the coarser
level, and adds its output to that map. The sum is sampled at each lattice point. A linear layer maps the sample to the
parameters of one Gaussian, and the adapter computes the Gaussian in the world from them. The heads run tile by tile to
bound memory.

Source: PanSplat, sections 3.3 and 3.4 and Figure 3; docs/official.md, sections 8 and 9.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

import torch
from jaxtyping import Float, Integer
from msgspec import Meta
from torch import Tensor, nn
from torch.nn import functional

from pansplat.errors import InputError
from pansplat.gaussians.harmonics import rotation_matrices
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.equirect import directions_from_uv
from pansplat.geometry.pose import multiply_quats, quats_from_rotations
from pansplat.model.cost_volume import Depths, LevelDepth
from pansplat.model.layers import Compat, Factor, Images, PerView, Poses, Precision, Size, autocast_convolutions
from pansplat.model.tiles import (
    Margins,
    Tile,
    Window,
    crop_window,
    make_lattice_uv,
    make_tiles,
    move_points,
    sample_panorama,
    sample_window,
)

_SCALE_UNIT = 0.2  # pixels of the map that a scale of 1 stands for
# The polar axis of the network's harmonics is y: their k-th function of d is the 3DGS function of _POLAR_Y @ d.
_POLAR_Y = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
_MAX_HEIGHT = 512  # rows of the cost volume's input


@dataclass(frozen=True)
class AdapterConfig:
    """Degree of the colours and range of the scales; shipped weights fix all of it."""

    degree: Annotated[int, Meta(ge=0, le=4)] = 4
    """Degree of the spherical harmonics."""
    min_scale: Factor = 0.5
    """Smallest standard deviation, in fifths of a map pixel's angle."""
    max_scale: Factor = 15.0
    """Largest standard deviation, in fifths of a map pixel's angle."""

    @property
    def num_parameters(self) -> int:
        """Parameters of a Gaussian: 3 of scale, 4 of rotation, (degree + 1)^2 harmonics for each of 3 colours."""
        return 7 + 3 * (self.degree + 1) ** 2


@dataclass(frozen=True)
class HeadsConfig:
    """Shape of the heads."""

    depth: Literal["refined", "swept"] = "refined"
    """Depth and opacity from logits of the head, or the depth and confidence of the cost volume."""
    feature_channels: Annotated[tuple[Size, ...], Meta(max_length=16)] = (128, 96, 64, 32)
    """Channels of the feature maps, coarse to fine."""
    candidates: Size = 32
    """Depth candidates of the finest swept level."""
    layers: Annotated[int, Meta(ge=1, le=64)] = 3
    """Convolutions of each level."""
    adapter: AdapterConfig = field(default_factory=AdapterConfig)

    @property
    def outputs(self) -> int:
        """Outputs per point: 2 of offset, the adapter's parameters, and logits of depth and opacity if refined."""
        return 2 + self.adapter.num_parameters + (self.candidates + 1 if self.depth == "refined" else 0)


@dataclass(frozen=True)
class MatchedViews:
    """Images, features and depths of all views: everything that the heads read."""

    images: Images
    """RGB in [0, 1], at full resolution."""
    features: Sequence[Float[Tensor, "batch view _ _ _"]]
    """Feature maps, coarse to fine; of resized images if `images` are higher than 512."""
    depths: Depths
    cam2world: Poses
    near: PerView
    far: PerView


@dataclass(frozen=True)
class ViewInputs:
    """Inputs of the heads for one view of one batch item."""

    image: Float[Tensor, "3 height width"]
    features: list[Float[Tensor, "_ _ _"]]
    """Feature maps, coarse to fine."""
    logits: Float[Tensor, "candidate h w"]
    candidates: Float[Tensor, "candidate h w"]
    inverse_depth: Float[Tensor, "rows columns"]
    confidence: Float[Tensor, "rows columns"]
    cam2world: Float[Tensor, "4 4"]
    near: Float[Tensor, ""]
    far: Float[Tensor, ""]
    view: int


@dataclass(frozen=True)
class TileGaussians:
    """The Gaussians of one tile, one set for each batch item."""

    gaussians: list[Gaussians]
    index: Integer[Tensor, "n"]
    """Index of each Gaussian in the untiled order: level coarse to fine, then view, then lattice point."""


class LevelHead(nn.Module):
    """The CNN of one level, and the linear layer that is applied to its samples at lattice points."""

    def __init__(self, inputs: int, config: HeadsConfig, compat: Compat) -> None:
        super().__init__()
        self.config = config
        self.compat: Compat = compat
        hidden = 2 * config.outputs
        widths = [inputs, *[hidden] * config.layers]
        padding = 1 if compat == "official" else 0
        self.convs = nn.ModuleList(
            nn.Conv2d(before, after, 3, padding=padding) for before, after in itertools.pairwise(widths)
        )
        self.linear = nn.Linear(hidden, config.outputs)

    def forward(self, inputs: Sequence[Float[Tensor, "_ height width"]]) -> Float[Tensor, "1 hidden h w"]:
        kind = inputs[0].device.type
        dtype = torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else inputs[0].dtype
        maps = concatenate_channels(inputs, dtype)  # the largest map is freed after the first convolution
        for index, conv in enumerate(self.convs):
            if index > 0:
                maps = functional.gelu(maps)
            maps = conv(maps)
        return maps

    def decode_gaussians(
        self,
        refined: Float[Tensor, "hidden h w"],
        window: Window,
        tile: Tile,
        view: ViewInputs,
        *,
        height: int,
        level: int,
        colored: bool,
    ) -> Gaussians:
        """Sample a level's map at the lattice points of a tile and decode the samples into Gaussians.

        Args:
            refined: the part of the level's map inside `window`.
            height: rows of the whole map.
            colored: whether to add the colour of the image to the harmonics.
        """
        config, compat = self.config, self.compat
        uv = make_lattice_uv(height, exact=compat == "fixed")
        uv = uv[tile.contains(uv)].to(refined.device)
        outputs = self.linear(sample_window(refined, window, height, uv))
        sizes = (2, config.adapter.num_parameters, config.outputs - 2 - config.adapter.num_parameters)
        offsets, parameters, logits = outputs.split(sizes, dim=-1)

        def sample_resized(source: Float[Tensor, "channel _ _"]) -> Float[Tensor, "n channel"]:
            return sample_window(crop_window(source, height, window, compat), window, height, uv)

        if config.depth == "refined":
            probabilities = torch.softmax(logits[:, :-1], dim=-1)
            inverse_depths = (probabilities * sample_panorama(view.candidates, uv, compat)).sum(dim=-1)
            opacities = torch.sigmoid(logits[:, -1])
        else:
            inverse_depths = sample_resized(view.inverse_depth[None])[:, 0]
            opacities = torch.sigmoid(sample_resized(view.confidence[None])[:, 0])
        return adapt_gaussians(
            parameters,
            move_points(uv, offsets, height),
            1 / inverse_depths.clamp(1 / view.far, 1 / view.near),
            opacities,
            view.cam2world,
            map_height=height,
            colors=sample_resized(view.image) if colored else None,
            level=level,
            view=view.view,
            config=config.adapter,
            compat=compat,
        )


class GaussianHeads(nn.Module):
    """Heads of all levels, applied to each view independently.

    Args:
        precision: number type of the convolutions; everything else has the inputs' type.
    """

    def __init__(self, config: HeadsConfig, compat: Compat, precision: Precision = "float32") -> None:
        super().__init__()
        self.config = config
        self.compat: Compat = compat
        self.precision: Precision = precision
        self.margins = Margins.of(config.layers, compat, chained=True)
        self.levels = nn.ModuleList(
            LevelHead(3 + channels + config.candidates + (2 * config.outputs if index > 0 else 0), config, compat)
            for index, channels in enumerate(config.feature_channels)
        )

    def forward(self, matched: MatchedViews, *, tiles: int = 1) -> list[Gaussians]:
        """Compute the Gaussians of each batch item.

        They are ordered by level (coarse to fine), view and lattice point. With `compat="official"` and several tiles
        they are ordered by tile first.

        Args:
            tiles: tiles along each side of the panorama. With `compat="fixed"` the result does not depend on it.
        """
        return merge_tiles(list(self.iterate_tiles(matched, tiles=tiles)), self.compat)

    def iterate_tiles(
        self, matched: MatchedViews, *, tiles: int = 1, only: Sequence[int] | None = None
    ) -> Iterator[TileGaussians]:
        """Yield the Gaussians tile by tile; at most one tile's maps are in memory.

        Args:
            only: row-major indices of the tiles to compute; by default all. The Gaussians and gradients of a tile do
                not depend on the other tiles.
        """
        height = matched.images.shape[-2]
        self._require_divisible(height, tiles)
        items = split_views(matched)
        grid = make_tiles(tiles)
        for tile in grid if only is None else [grid[number] for number in only]:
            gaussians = []
            for item in items:
                by_view = [self._lift_view(view, tile) for view in item]
                gaussians.append(Gaussians.cat([part for level in zip(*by_view, strict=True) for part in level]))
            yield TileGaussians(
                gaussians, compute_untiled_index(tile, self.make_points(height), matched.images.shape[1])
            )

    def compute_heights(self, height: int) -> list[int]:
        """Rows of each level's map, coarse to fine."""
        return [height >> level for level in range(len(self.levels) - 1, -1, -1)]

    def make_points(self, height: int) -> list[Float[Tensor, "n 2"]]:
        """Normalised panorama coordinates of the lattice points of each level, coarse to fine."""
        return [make_lattice_uv(rows, exact=self.compat == "fixed") for rows in self.compute_heights(height)]

    def _lift_view(self, view: ViewInputs, tile: Tile) -> list[Gaussians]:
        """Compute one view's Gaussians inside a tile, by level, coarse to fine."""
        gaussians, coarser = [], None
        heights = self.compute_heights(view.image.shape[-2])
        for index, (head, height, feature) in enumerate(zip(self.levels, heights, view.features, strict=True)):
            window = tile.window(height)
            input_window = window.expand(self.margins.input)
            inputs = [
                crop_window(source, height, input_window, self.compat) for source in (view.image, feature, view.logits)
            ]
            if coarser is not None:
                coarser = _upsample_with_margin(coarser, self.margins)
                inputs.append(coarser[0])
            with autocast_convolutions(self.precision, feature.device):
                refined = head(inputs).to(feature.dtype)
            if coarser is not None:
                refined = refined + _crop_border(coarser, self.margins.input - self.margins.output)
            coarser, level = refined, len(heights) - 1 - index
            # Only the coarsest level adds its harmonics to the colour of the image.
            output_window = window.expand(self.margins.output)
            gaussians.append(
                head.decode_gaussians(
                    refined[0], output_window, tile, view, height=height, level=level, colored=index == 0
                )
            )
        return gaussians

    def _require_divisible(self, height: int, tiles: int) -> None:
        coarsest = self.compute_heights(height)[0]
        factor = tiles << (len(self.levels) - 1)
        if tiles < 1 or height % factor:
            raise InputError(
                f"{tiles}x{tiles} tiles on {len(self.levels)} levels need a height that {factor} divides, got "
                f"{height}; choose another height or fewer tiles"
            )
        if self.compat == "fixed" and coarsest < self.margins.input:
            lowest = self.margins.input << (len(self.levels) - 1)
            raise InputError(f"the heads need panoramas at least {lowest} pixels high, got {height}; enlarge them")


def compute_untiled_index(tile: Tile, lattices: Sequence[Float[Tensor, "_ 2"]], views: int) -> Integer[Tensor, "n"]:
    """Compute the indices of a tile's Gaussians in the untiled order: level, then view, then point."""
    indices, start = [], 0
    for uv in lattices:
        inside = tile.contains(uv).nonzero()[:, 0]
        indices += [start + view * len(uv) + inside for view in range(views)]
        start += views * len(uv)
    return torch.cat(indices)


def merge_tiles(parts: Sequence[TileGaussians], compat: Compat) -> list[Gaussians]:
    """Merge the Gaussians of all tiles for each batch item: in the untiled order, or ordered by tile if official."""
    if len(parts) == 1:
        return parts[0].gaussians
    indices = [part.index for part in parts]
    if compat == "official":
        indices = list(torch.arange(sum(map(len, indices))).split([len(index) for index in indices]))
    return [_scatter(sets, indices) for sets in zip(*(part.gaussians for part in parts), strict=True)]


def _scatter(sets: Sequence[Gaussians], indices: Sequence[Integer[Tensor, "_"]]) -> Gaussians:
    """Write each set to its indices of one new set; in 4K a second copy would take gigabytes."""
    fields = {}
    for name in (f.name for f in dataclasses.fields(Gaussians)):
        example = getattr(sets[0], name)
        fields[name] = torch.empty(sum(map(len, sets)), *example.shape[1:], dtype=example.dtype, device=example.device)
        for part, index in zip(sets, indices, strict=True):
            fields[name].index_copy_(0, index.to(example.device), getattr(part, name))
    return Gaussians(**fields)


def concatenate_channels(
    maps: Sequence[Float[Tensor, "_ height width"]], dtype: torch.dtype
) -> Float[Tensor, "1 channel height width"]:
    """Concatenate channels in channels-last layout, 5 times faster than `torch.cat` and a layout change."""
    channels = [len(part) for part in maps]
    shape = (1, sum(channels), *maps[0].shape[1:])
    joined = torch.empty(shape, dtype=dtype, device=maps[0].device, memory_format=torch.channels_last)
    for start, part in zip(itertools.accumulate([0, *channels]), maps, strict=False):
        joined[0, start : start + len(part)] = part
    return joined


def split_views(matched: MatchedViews) -> list[list[ViewInputs]]:
    """Split into inputs of single views, by batch item and view, with the depth of the finest swept level."""
    depth = matched.depths.levels[-1]
    return [
        [
            ViewInputs(
                image=matched.images[item, view],
                features=[maps[item, view] for maps in matched.features],
                logits=depth.logits[item, view],
                candidates=depth.candidates[item, view],
                inverse_depth=depth.inverse_depth[item, view],
                confidence=depth.confidence[item, view],
                cam2world=matched.cam2world[item, view],
                near=matched.near[item, view],
                far=matched.far[item, view],
                view=view,
            )
            for view in range(matched.images.shape[1])
        ]
        for item in range(len(matched.images))
    ]


def _upsample_with_margin(
    maps: Float[Tensor, "1 hidden height width"], margins: Margins
) -> Float[Tensor, "1 hidden h w"]:
    """Double the size of a level's map and crop it to the margin that the next level reads."""
    upsampled = functional.interpolate(maps, scale_factor=2, mode="bilinear", align_corners=False)
    return _crop_border(upsampled, 2 * margins.output - margins.input)


def _crop_border(maps: Float[Tensor, "1 hidden height width"], margin: int) -> Float[Tensor, "1 hidden h w"]:
    return maps[..., margin : maps.shape[-2] - margin, margin : maps.shape[-1] - margin]


def adapt_gaussians(
    parameters: Float[Tensor, "n parameter"],
    uv: Float[Tensor, "n 2"],
    depths: Float[Tensor, "n"],
    opacities: Float[Tensor, "n"],
    cam2world: Float[Tensor, "4 4"],
    *,
    map_height: int,
    colors: Float[Tensor, "n 3"] | None,
    level: int,
    view: int,
    config: AdapterConfig,
    compat: Compat,
) -> Gaussians:
    """Compute the Gaussians of one view and level from network outputs.

    Args:
        parameters: raw [3 scale | 4 rotation xyzw, camera axes | 3 x (degree + 1)^2 harmonics, colour by colour].
        uv: positions on the panorama, normalised.
        depths: radial distance from the camera, metres.
        opacities: in [0, 1].
        map_height: rows of the level's map; scales are multiples of the angle of its pixels times the depth.
        colors: RGB in [0, 1], added to the constant harmonic.
        level, view: labels of the Gaussians.

    Source: PanSplat, section 3.3; docs/official.md, section 9.
    """
    camera = cam2world[:3, :3].double()
    directions = directions_from_uv(uv) @ camera.to(uv).T
    scale_part, rotation_part, harmonics_part = parameters.split((3, 4, config.num_parameters - 7), dim=-1)
    scales = config.min_scale + (config.max_scale - config.min_scale) * torch.sigmoid(scale_part)
    pixel_radians = math.pi / map_height
    # The official normalisation: a zero quaternion stays zero.
    quats = rotation_part.roll(1, dims=-1)  # the network's order is xyzw, ours wxyz
    quats = quats / (quats.norm(dim=-1, keepdim=True) + 1e-8)
    camera_quat = quats_from_rotations(camera).to(quats)
    return Gaussians(
        means=cam2world[:3, 3].to(depths) + depths[:, None] * directions,
        scales=scales * (_SCALE_UNIT * pixel_radians) * depths[:, None],
        quats=multiply_quats(camera_quat.expand_as(quats), quats),
        opacities=opacities,
        harmonics=_rotate_harmonics_to_world(harmonics_part, colors, camera, config.degree, compat),
        levels=torch.full(depths.shape, level, dtype=torch.uint8, device=depths.device),
        views=torch.full(depths.shape, view, dtype=torch.uint8, device=depths.device),
    )


def compute_harmonics_rotation(rotation: Float[Tensor, "3 3"], compat: Compat) -> Float[Tensor, "3 3"]:
    """Compute the rotation to world axes from the axes in which the network's colours are 3DGS harmonics.

    The official code rotates colours by the camera's rotation with x and z reversed, which is correct for rotations
    about y only (docs/paper.md, T3).
    """
    if compat == "official":
        reverse = torch.tensor((-1.0, 1.0, -1.0)).to(rotation)
        rotation = reverse[:, None] * rotation * reverse
    return rotation @ torch.tensor(_POLAR_Y).to(rotation).T


def _rotate_harmonics_to_world(
    raw: Float[Tensor, "n parameter"],
    colors: Float[Tensor, "n 3"] | None,
    camera: Float[Tensor, "3 3"],
    degree: int,
    compat: Compat,
) -> Float[Tensor, "n k 3"]:
    """Scale raw harmonics by degree, add a base colour, and rotate them from camera to world axes."""
    harmonics = raw.unflatten(-1, (3, -1)) * _make_degree_factors(degree).to(raw)
    if colors is not None:
        base = 2 * (colors - 0.5)
        harmonics = torch.cat((harmonics[..., :1] + base[..., None], harmonics[..., 1:]), dim=-1)
    rotation = rotation_matrices(compute_harmonics_rotation(camera, compat), degree).to(raw)
    # Reshaped to one matrix product; with strided harmonics torch would compute one product per Gaussian.
    rotated = harmonics.reshape(-1, harmonics.shape[-1]) @ rotation.T
    return rotated.view(harmonics.shape).transpose(-1, -2)


def _make_degree_factors(degree: int) -> Float[Tensor, "k"]:
    """Factors of the raw coefficients: 1 for degree 0, 0.1 / 4^n for degree n."""
    factors = [1.0] + [0.1 * 0.25**band for band in range(1, degree + 1) for _ in range(2 * band + 1)]
    return torch.tensor(factors, dtype=torch.float64)


class AuxiliaryHeads(nn.Module):
    """Heads that compute Gaussians from single levels of the cost volume, for training on real panoramas only.

    The Gaussians have the depth and confidence of the level. A loss on their images trains each level without true
    depth. The heads are independent; their maps have half the height of the cost volume's input.

    Source: PanSplat, section 3.5 (real data); docs/official.md, section 8 (auxiliary heads).
    """

    def __init__(self, config: HeadsConfig, compat: Compat) -> None:
        super().__init__()
        self.config = config
        self.compat: Compat = compat
        self.margins = Margins.of(config.layers, compat, chained=False)
        self.levels = nn.ModuleList(
            LevelHead(3 + channels + config.candidates, config, compat) for channels in config.feature_channels
        )

    def forward(self, matched: MatchedViews) -> list[list[Gaussians]]:
        """Compute the Gaussians by level of the cost volume (coarse to fine) and batch item."""
        items = split_views(matched)
        return [
            [
                Gaussians.cat([self._lift_view(index, item, view, depth) for view in views])
                for item, views in enumerate(items)
            ]
            for index, depth in enumerate(matched.depths.levels)
        ]

    def _lift_view(self, index: int, item: int, view: ViewInputs, depth: LevelDepth) -> Gaussians:
        height = min(view.image.shape[-2], _MAX_HEIGHT) // 2
        panorama = Tile(0, 0, 1)
        input_window = panorama.window(height).expand(self.margins.input)
        inputs = (view.image, view.features[index], view.logits)
        head = self.levels[index]
        refined = head([crop_window(source, height, input_window, self.compat) for source in inputs])
        item_and_view = (item, view.view)
        swept = dataclasses.replace(
            view, inverse_depth=depth.inverse_depth[item_and_view], confidence=depth.confidence[item_and_view]
        )
        output_window = panorama.window(height).expand(self.margins.output)
        return head.decode_gaussians(
            refined[0], output_window, panorama, swept, height=height, level=depth.level, colored=True
        )
