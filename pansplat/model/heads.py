"""Residual Gaussian heads: from features to Gaussians on the lattices of a pyramid, coarse to fine.

Each level's small CNN reads the image, the view's features, the refined cost volume and what the coarser level
passed on, and adds to that. A point of the level's lattice reads the sum, and a linear layer turns what it reads
into one Gaussian. All of it runs tile by tile where memory asks for it.

Source: PanSplat, sections 3.3 and 3.4, figure 3; OFFICIAL.md, section 8.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Float, Integer
from torch import Tensor, nn
from torch.nn import functional

from pansplat.errors import InputError
from pansplat.gaussians.harmonics import rotation_matrices
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.equirect import directions_from_uv
from pansplat.geometry.pose import multiply_quats, quats_from_rotations
from pansplat.model.cost_volume import Depths, LevelDepth
from pansplat.model.layers import Compat, Precision, autocast_convolutions
from pansplat.model.tiles import (
    Lattice,
    Margins,
    Tile,
    Window,
    crop_window,
    lattice_uv,
    move_points,
    sample_panorama,
    sample_window,
    tile_grid,
)


@dataclass(frozen=True)
class AdapterConfig:
    """Ranges of what the network may predict; shipped weights fix all of it."""

    degree: int = 4
    """Degree of the spherical harmonics."""
    min_scale: float = 0.5
    """Smallest standard deviation, in fifths of a map pixel's angle."""
    max_scale: float = 15.0
    """Largest standard deviation, in fifths of a map pixel's angle."""

    @property
    def num_parameters(self) -> int:
        """Numbers a Gaussian: 3 scale, 4 rotation, 3 colours of (degree + 1)^2 harmonics."""
        return 7 + 3 * (self.degree + 1) ** 2


@dataclass(frozen=True)
class HeadsConfig:
    """Shape of the heads; the switches are the paper's ablations."""

    lattice: Lattice = "fibonacci"
    """Where Gaussians stand: evenly on the sphere, or one a pixel."""
    levels: Literal["pyramid", "single"] = "pyramid"
    """Heads on all four levels, or on the finest only."""
    emitted: Literal["all", "finest"] = "all"
    """Which levels make Gaussians; coarser ones may serve the finest only."""
    residual: bool = True
    """Whether a level reads, and adds to, what the coarser one passes on."""
    depth: Literal["refined", "swept"] = "refined"
    """Depth and opacity from the head's own logits, or the sweep's depth and confidence as they are."""
    feature_channels: tuple[int, ...] = (128, 96, 64, 32)
    """Channels of the feature maps, coarse to fine."""
    candidates: int = 32
    """Depth candidates of the finest sweep."""
    layers: int = 3
    """Convolutions a level."""
    adapter: AdapterConfig = field(default_factory=AdapterConfig)

    @property
    def outputs(self) -> int:
        """Numbers a point: 2 offset, the adapter's, and the logits of depth and opacity where they are refined."""
        return 2 + self.adapter.num_parameters + (self.candidates + 1 if self.depth == "refined" else 0)


@dataclass(frozen=True)
class ViewInputs:
    """What the heads know of one view. Maps are (channel, height, width)."""

    image: Float[Tensor, "3 height width"]
    features: list[Float[Tensor, "_ _ _"]]
    """Coarse to fine."""
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
    """The Gaussians of one tile: a set a batch item, and where they stand among those of all tiles."""

    gaussians: list[Gaussians]
    index: Integer[Tensor, "n"]
    """Place of each in the untiled order: level coarse to fine, then view, then lattice point."""


class LevelHead(nn.Module):
    """The CNN of one level, and the linear layer that its lattice points read it through."""

    def __init__(self, inputs: int, config: HeadsConfig, compat: Compat) -> None:
        super().__init__()
        hidden = 2 * config.outputs
        last = hidden if config.lattice == "fibonacci" else config.outputs
        widths = [inputs, *[hidden] * (config.layers - 1), last]
        padding = 1 if compat == "official" else 0
        self.convs = nn.ModuleList(
            nn.Conv2d(before, after, 3, padding=padding) for before, after in itertools.pairwise(widths)
        )
        # One Gaussian a pixel needs no layer of its own: the map holds its numbers.
        self.linear = nn.Linear(hidden, config.outputs) if config.lattice == "fibonacci" else nn.Identity()

    def forward(self, inputs: Sequence[Float[Tensor, "_ height width"]]) -> Float[Tensor, "1 hidden h w"]:
        kind = inputs[0].device.type
        dtype = torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else inputs[0].dtype
        maps = concatenate_channels(inputs, dtype)  # the largest map: freed after the first convolution
        for index, conv in enumerate(self.convs):
            if index > 0:
                maps = functional.gelu(maps)
            maps = conv(maps)
        return maps


class GaussianHeads(nn.Module):
    """Heads of all levels. Any number of views: each is lifted by itself.

    Args:
        precision: number type of the convolutions; all else is in the inputs' type.
    """

    def __init__(self, config: HeadsConfig, compat: Compat, precision: Precision = "float32") -> None:
        super().__init__()
        self.config = config
        self.compat: Compat = compat
        self.precision: Precision = precision
        chained = config.levels == "pyramid" and config.residual
        self.margins = Margins.of(config.layers, compat, chained=chained)
        passed_on = (2 if config.lattice == "fibonacci" else 1) * config.outputs
        first = len(config.feature_channels) - 1 if config.levels == "single" else 0
        self.levels = nn.ModuleList(
            LevelHead(3 + channels + config.candidates + (passed_on if chained and index > 0 else 0), config, compat)
            for index, channels in enumerate(config.feature_channels[first:])
        )

    def forward(
        self,
        images: Float[Tensor, "batch view 3 height width"],
        features: Sequence[Float[Tensor, "batch view _ _ _"]],
        depths: Depths,
        cam2world: Float[Tensor, "batch view 4 4"],
        near: Float[Tensor, "batch view"],
        far: Float[Tensor, "batch view"],
        *,
        tiles: int = 1,
    ) -> list[Gaussians]:
        """The Gaussians of each batch item.

        Order: level coarse to fine, then view, then lattice point. With `compat="official"` and several tiles the
        tile comes first, as in the original.

        Args:
            images: RGB in [0, 1], at full resolution.
            features: maps of every level, coarse to fine; resized where the images are larger than theirs.
            tiles: tiles along each side of the panorama. With `compat="fixed"` the result is the same for any number.

        Raises:
            InputError: when the height cannot be divided into levels and tiles.
        """
        parts = list(self.iterate_tiles(images, features, depths, cam2world, near, far, tiles=tiles))
        return merge_tiles(parts, self.compat)

    def iterate_tiles(
        self,
        images: Float[Tensor, "batch view 3 height width"],
        features: Sequence[Float[Tensor, "batch view _ _ _"]],
        depths: Depths,
        cam2world: Float[Tensor, "batch view 4 4"],
        near: Float[Tensor, "batch view"],
        far: Float[Tensor, "batch view"],
        *,
        tiles: int = 1,
        only: Sequence[int] | None = None,
    ) -> Iterator[TileGaussians]:
        """One tile's Gaussians after another, so that no more than one tile's maps are in memory.

        Args:
            only: numbers of the tiles wanted, row by row from 0; by default all. A tile alone is what it is among
                all, with gradients too: two-step backpropagation makes them one by one.

        Raises:
            InputError: when the height cannot be divided into levels and tiles.
        """
        height = images.shape[-2]
        self._require_divisible(height, tiles)
        items = split_views(images, features, depths.levels[-1], cam2world, near, far)
        grid = tile_grid(tiles)
        for tile in grid if only is None else [grid[number] for number in only]:
            gaussians = []
            for item in items:
                by_view = [self._lift_view(view, tile) for view in item]
                gaussians.append(Gaussians.cat([part for level in zip(*by_view, strict=True) for part in level]))
            yield TileGaussians(gaussians, untiled_index(tile, self.points(height), images.shape[1]))

    def heights(self, height: int) -> list[int]:
        """Rows of each level's map, coarse to fine, for images of a height."""
        return [height >> level for level in range(len(self.levels) - 1, -1, -1)]

    def points(self, height: int) -> list[Float[Tensor, "n 2"]]:
        """Normalised panorama coordinates of the lattice points of each emitting level, coarse to fine."""
        heights = self.heights(height)
        if self.config.emitted == "finest":
            heights = heights[-1:]
        return [lattice_uv(self.config.lattice, rows, exact=self.compat == "fixed") for rows in heights]

    def _lift_view(self, view: ViewInputs, tile: Tile) -> list[Gaussians]:
        """One view's Gaussians inside a tile, by emitting level, coarse to fine."""
        gaussians, passed_on = [], None
        heights = self.heights(view.image.shape[-2])
        features = view.features[-len(heights) :]
        for index, (head, height, feature) in enumerate(zip(self.levels, heights, features, strict=True)):
            window = tile.window(height)
            around, known = window.expand(self.margins.input), window.expand(self.margins.output)
            inputs = [crop_window(source, height, around, self.compat) for source in (view.image, feature, view.logits)]
            if passed_on is not None:
                passed_on = _twice_as_fine(passed_on, self.margins)
                inputs.append(passed_on[0])
            with autocast_convolutions(self.precision, feature.device):
                refined = head(inputs).to(feature.dtype)
            if passed_on is not None:
                lost = self.margins.input - self.margins.output
                refined = refined + _cropped(passed_on, lost)
            passed_on = refined if self.config.residual else None
            level = len(heights) - 1 - index
            if level == 0 or self.config.emitted == "all":
                # Finer levels add to the colours of the coarsest.
                read = decode_gaussians(
                    head, refined[0], known, tile, view, height=height, level=level, colored=index == 0,
                    config=self.config, compat=self.compat,
                )  # fmt: skip
                gaussians.append(read)
        return gaussians

    def _require_divisible(self, height: int, tiles: int) -> None:
        coarsest = self.heights(height)[0]
        factor = tiles << (len(self.levels) - 1)
        if tiles < 1 or height % factor:
            raise InputError(
                f"{tiles}x{tiles} tiles on {len(self.levels)} levels need a height that {factor} divides, got "
                f"{height}; choose another height or fewer tiles"
            )
        if self.compat == "fixed" and coarsest < self.margins.input:
            least = self.margins.input << (len(self.levels) - 1)
            raise InputError(f"the heads need panoramas at least {least} pixels high, got {height}; enlarge them")


def decode_gaussians(
    head: LevelHead,
    refined: Float[Tensor, "hidden h w"],
    known: Window,
    tile: Tile,
    view: ViewInputs,
    *,
    height: int,
    level: int,
    colored: bool,
    config: HeadsConfig,
    compat: Compat,
) -> Gaussians:
    """The Gaussians that a tile's lattice points read off a level's map.

    Args:
        refined: the map, of which the window `known` is at hand.
        height: rows of the whole map.
        colored: whether the harmonics add to the image's colour.
    """
    uv = lattice_uv(config.lattice, height, exact=compat == "fixed")
    uv = uv[tile.contains(uv)].to(refined.device)
    numbers = head.linear(sample_window(refined, known, height, uv))
    sizes = (2, config.adapter.num_parameters, config.outputs - 2 - config.adapter.num_parameters)
    offsets, parameters, logits = numbers.split(sizes, dim=-1)

    def resized(source: Float[Tensor, "channel _ _"]) -> Float[Tensor, "n channel"]:
        return sample_window(crop_window(source, height, known, compat), known, height, uv)

    if config.depth == "refined":
        probabilities = torch.softmax(logits[:, :-1], dim=-1)
        inverse_depths = (probabilities * sample_panorama(view.candidates, uv, compat)).sum(dim=-1)
        opacities = torch.sigmoid(logits[:, -1])
    else:
        inverse_depths = resized(view.inverse_depth[None])[:, 0]
        opacities = torch.sigmoid(resized(view.confidence[None])[:, 0])
    return adapt_gaussians(
        parameters,
        move_points(uv, offsets, config.lattice, height),
        1 / inverse_depths.clamp(1 / view.far, 1 / view.near),
        opacities,
        view.cam2world,
        map_height=height,
        colors=resized(view.image) if colored else None,
        level=level,
        view=view.view,
        config=config.adapter,
        compat=compat,
    )


def untiled_index(tile: Tile, lattices: Sequence[Float[Tensor, "_ 2"]], views: int) -> Integer[Tensor, "n"]:
    """Where a tile's Gaussians stand among those of the whole panorama: by level, then view, then point."""
    places, start = [], 0
    for uv in lattices:
        inside = tile.contains(uv).nonzero()[:, 0]
        places += [start + view * len(uv) + inside for view in range(views)]
        start += views * len(uv)
    return torch.cat(places)


def merge_tiles(parts: Sequence[TileGaussians], compat: Compat) -> list[Gaussians]:
    """All tiles' Gaussians of each batch item, in untiled order; in the original's, which is by tile, if official."""
    if len(parts) == 1:
        return parts[0].gaussians
    places = [part.index for part in parts]
    if compat == "official":
        places = list(torch.arange(sum(map(len, places))).split([len(index) for index in places]))
    return [_put(sets, places) for sets in zip(*(part.gaussians for part in parts), strict=True)]


def _put(sets: Sequence[Gaussians], places: Sequence[Integer[Tensor, "_"]]) -> Gaussians:
    """Sets in one, each at its places; written there at once, since all of them are gigabytes in 4K."""
    fields = {}
    for name in (f.name for f in dataclasses.fields(Gaussians)):
        example = getattr(sets[0], name)
        fields[name] = torch.empty(sum(map(len, sets)), *example.shape[1:], dtype=example.dtype, device=example.device)
        for part, index in zip(sets, places, strict=True):
            fields[name].index_copy_(0, index.to(example.device), getattr(part, name))
    return Gaussians(**fields)


def concatenate_channels(
    maps: Sequence[Float[Tensor, "_ height width"]], dtype: torch.dtype
) -> Float[Tensor, "1 channel height width"]:
    """Maps as channels of one, channels last: a fifth of the time of `torch.cat` and a change of layout."""
    channels = [len(part) for part in maps]
    shape = (1, sum(channels), *maps[0].shape[1:])
    whole = torch.empty(shape, dtype=dtype, device=maps[0].device, memory_format=torch.channels_last)
    for start, part in zip(itertools.accumulate([0, *channels]), maps, strict=False):
        whole[0, start : start + len(part)] = part
    return whole


def split_views(
    images: Float[Tensor, "batch view 3 height width"],
    features: Sequence[Float[Tensor, "batch view _ _ _"]],
    depth: LevelDepth,
    cam2world: Float[Tensor, "batch view 4 4"],
    near: Float[Tensor, "batch view"],
    far: Float[Tensor, "batch view"],
) -> list[list[ViewInputs]]:
    """Each batch item's views, one by one."""
    return [
        [
            ViewInputs(
                image=images[item, view],
                features=[maps[item, view] for maps in features],
                logits=depth.logits[item, view],
                candidates=depth.candidates[item, view],
                inverse_depth=depth.inverse_depth[item, view],
                confidence=depth.confidence[item, view],
                cam2world=cam2world[item, view],
                near=near[item, view],
                far=far[item, view],
                view=view,
            )
            for view in range(images.shape[1])
        ]
        for item in range(len(images))
    ]


def _twice_as_fine(maps: Float[Tensor, "1 hidden height width"], margins: Margins) -> Float[Tensor, "1 hidden h w"]:
    """A level's map and its margin on the next level's pixels, cut to the margin that the next CNN reads."""
    raised = functional.interpolate(maps, scale_factor=2, mode="bilinear", align_corners=False)
    return _cropped(raised, 2 * margins.output - margins.input)


def _cropped(maps: Float[Tensor, "1 hidden height width"], margin: int) -> Float[Tensor, "1 hidden h w"]:
    return maps[..., margin : maps.shape[-2] - margin, margin : maps.shape[-1] - margin]


_SCALE_UNIT = 0.2  # a scale of 1 spans this part of a map pixel
# The network's colours are in harmonics whose polar axis is y, in the cyclic order y, z, x of the 3DGS axes: with
# these camera axes in rows, its k-th function along d is the 3DGS one along _POLAR_Y d.
_POLAR_Y = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))


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
    """Gaussians of one view and level.

    Args:
        parameters: raw [3 scale | 4 rotation xyzw, camera axes | 3 x (degree + 1)^2 harmonics, colour by colour].
        uv: where on the panorama, normalised.
        depths: radial distance from the camera, metres.
        opacities: in [0, 1].
        map_height: rows of the level's map; a scale is a multiple of its pixel's angle times the depth.
        colors: RGB in [0, 1] that the harmonics are added to, or None where a level adds to no colour.
        level, view: labels of the Gaussians.
    """
    camera = cam2world[:3, :3].double()
    directions = directions_from_uv(uv) @ camera.to(uv).T
    scale_part, rotation_part, harmonics_part = parameters.split((3, 4, config.num_parameters - 7), dim=-1)
    scales = config.min_scale + (config.max_scale - config.min_scale) * torch.sigmoid(scale_part)
    pixel_radians = math.pi / map_height
    # Divided as the original divides: a quaternion of length 0 is not made one of length 1.
    own = rotation_part.roll(1, dims=-1)  # xyzw to wxyz
    own = own / (own.norm(dim=-1, keepdim=True) + 1e-8)
    turn = quats_from_rotations(camera).to(own)
    return Gaussians(
        means=cam2world[:3, 3].to(depths) + depths[:, None] * directions,
        scales=scales * (_SCALE_UNIT * pixel_radians) * depths[:, None],
        quats=multiply_quats(turn.expand_as(own), own),
        opacities=opacities,
        harmonics=_world_harmonics(harmonics_part, colors, camera, config.degree, compat),
        levels=torch.full(depths.shape, level, dtype=torch.uint8, device=depths.device),
        views=torch.full(depths.shape, view, dtype=torch.uint8, device=depths.device),
    )


def world_harmonics_rotation(rotation: Float[Tensor, "3 3"], compat: Compat) -> Float[Tensor, "3 3"]:
    """Rotation from the axes in which the network's colours are 3DGS harmonics to the world's.

    The original turns colours by the camera's rotation with x and z reversed, which is right only for a turn
    about y (OFFICIAL.md, trap T3). Its rasteriser moreover reads z for y in coefficient 14 and leaves out degree 4
    (trap T4); that is the drawing's business, not the prediction's.
    """
    if compat == "official":
        reverse = torch.tensor((-1.0, 1.0, -1.0)).to(rotation)
        rotation = reverse[:, None] * rotation * reverse
    return rotation @ torch.tensor(_POLAR_Y).to(rotation).T


def _world_harmonics(
    raw: Float[Tensor, "n parameter"],
    colors: Float[Tensor, "n 3"] | None,
    camera: Float[Tensor, "3 3"],
    degree: int,
    compat: Compat,
) -> Float[Tensor, "n k 3"]:
    """Harmonics in the world from raw ones in camera axes: damped by degree, on a base colour."""
    harmonics = raw.unflatten(-1, (3, -1)) * _damping(degree).to(raw)
    if colors is not None:
        base = 2 * (colors - 0.5)
        harmonics = torch.cat((harmonics[..., :1] + base[..., None], harmonics[..., 1:]), dim=-1)
    turn = rotation_matrices(world_harmonics_rotation(camera, compat), degree).to(raw)
    # One product of two matrices: of strided harmonics, torch would make one for each Gaussian.
    turned = harmonics.reshape(-1, harmonics.shape[-1]) @ turn.T
    return turned.view(harmonics.shape).transpose(-1, -2)


def _damping(degree: int) -> Float[Tensor, "k"]:
    """Factor of each raw coefficient: higher degrees start close to nothing."""
    factors = [1.0] + [0.1 * 0.25**band for band in range(1, degree + 1) for _ in range(2 * band + 1)]
    return torch.tensor(factors, dtype=torch.float64)


_MAX_HEIGHT = 512  # of the panoramas that the cost volume sees


AUXILIARY_HEADS = HeadsConfig(depth="swept", layers=2, feature_channels=(128, 96, 64))
"""Their shape in the original; the features are those of the swept levels, coarse to fine."""


class AuxiliaryHeads(nn.Module):
    """One head a level of the cost volume, each on its own, all with maps half as high as the swept images."""

    def __init__(self, config: HeadsConfig, compat: Compat) -> None:
        super().__init__()
        self.config = config
        self.compat: Compat = compat
        self.margins = Margins.of(config.layers, compat, chained=False)
        self.levels = nn.ModuleList(
            LevelHead(3 + channels + config.candidates, config, compat) for channels in config.feature_channels
        )

    def forward(
        self,
        images: Float[Tensor, "batch view 3 height width"],
        features: Sequence[Float[Tensor, "batch view _ _ _"]],
        depths: Depths,
        cam2world: Float[Tensor, "batch view 4 4"],
        near: Float[Tensor, "batch view"],
        far: Float[Tensor, "batch view"],
    ) -> list[list[Gaussians]]:
        """For each level of the cost volume, coarse to fine, the Gaussians of each batch item."""
        items = split_views(images, features, depths.levels[-1], cam2world, near, far)
        return [
            [
                Gaussians.cat([self._lift_view(index, item, view, depth) for view in views])
                for item, views in enumerate(items)
            ]
            for index, depth in enumerate(depths.levels)
        ]

    def _lift_view(self, index: int, item: int, view: ViewInputs, depth: LevelDepth) -> Gaussians:
        height = min(view.image.shape[-2], _MAX_HEIGHT) // 2
        whole = Tile(0, 0, 1)
        around = whole.window(height).expand(self.margins.input)
        inputs = (view.image, view.features[index], view.logits)
        refined = self.levels[index]([crop_window(source, height, around, self.compat) for source in inputs])
        at = (item, view.view)
        own = dataclasses.replace(view, inverse_depth=depth.inverse_depth[at], confidence=depth.confidence[at])
        return decode_gaussians(
            self.levels[index],
            refined[0],
            whole.window(height).expand(self.margins.output),
            whole,
            own,
            height=height,
            level=depth.level,
            colored=True,
            config=self.config,
            compat=self.compat,
        )
