"""Heads that make each level of the cost volume answer for itself, where no true depth is known.

Training on real panoramas draws the Gaussians of every cost-volume level by itself. These heads make them: smaller
ones, with the level's own depth and confidence as they are. They are dropped after training.

Source: PanSplat, section 3.5 (real data); OFFICIAL.md, section 8 (auxiliary heads).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor, nn

from pansplat.gaussians.scene import Gaussians
from pansplat.model.cost_volume import Depths, LevelDepth
from pansplat.model.heads import HeadsConfig, LevelHead, ViewInputs, read_points, views_of
from pansplat.model.layers import Compat
from pansplat.model.tiles import Margins, Tile, cut

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
        items = views_of(images, features, depths.levels[-1], cam2world, near, far)
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
        around = whole.window(height).grown(self.margins.input)
        inputs = (view.image, view.features[index], view.logits)
        refined = self.levels[index]([cut(source, height, around, self.compat) for source in inputs])
        at = (item, view.view)
        own = dataclasses.replace(view, inverse_depth=depth.inverse_depth[at], confidence=depth.confidence[at])
        return read_points(
            self.levels[index],
            refined[0],
            whole.window(height).grown(self.margins.output),
            whole,
            own,
            height=height,
            level=depth.level,
            colored=True,
            config=self.config,
            compat=self.compat,
        )
