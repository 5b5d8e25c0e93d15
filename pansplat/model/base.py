"""The base of both networks: they match views, then lift Gaussians tile by tile."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from torch import nn

from pansplat.gaussians.scene import Gaussians
from pansplat.model.cost_volume import Depths
from pansplat.model.heads import TileGaussians, merge_tiles
from pansplat.model.layers import Compat, Images, PerView, Poses
from pansplat.model.weights import ModelName


@dataclass(frozen=True)
class Prediction:
    """Output of a network.

    Attributes:
        gaussians: one set for each batch item, labelled with level and view.
        matched: intermediate features and depths.
    """

    gaussians: list[Gaussians]
    matched: Any

    @property
    def depths(self) -> Depths:
        """Depth of each view at the swept levels, coarse to fine."""
        return self.matched.depths


class Network(nn.Module):
    """A network from posed panoramas to Gaussians.

    Attributes:
        model: its name in files of weights.
        config: a dataclass with the shape of the network.
        compat: "official" computes the numbers of the official code with its defects; "fixed" corrects them.
    """

    model: ModelName
    config: Any
    compat: Compat

    def match_views(self, images: Images, cam2world: Poses, near: PerView, far: PerView) -> Any:
        """Features and depths of all views; the result has an attribute `depths` of type `Depths`."""
        raise NotImplementedError

    def lift_gaussians(
        self, matched: Any, *, tiles: int = 1, only: Sequence[int] | None = None
    ) -> Iterator[TileGaussians]:
        """Yield Gaussians tile by tile to bound memory, or all at once for a network without tiles.

        Args:
            tiles: tiles along each side of the panorama.
            only: row-major indices of the tiles to compute; by default all.
        """
        raise NotImplementedError

    def forward(self, images: Images, cam2world: Poses, near: PerView, far: PerView, *, tiles: int = 1) -> Prediction:
        """Predict from posed panoramas.

        Args:
            near, far: bounds of the depth, metres.
        """
        matched = self.match_views(images, cam2world, near, far)
        return Prediction(merge_tiles(list(self.lift_gaussians(matched, tiles=tiles)), self.compat), matched)
