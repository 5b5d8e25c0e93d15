"""What one batch teaches: its losses, and their gradients at the parameters."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from pansplat.data.views import Batch
from pansplat.model.heads import AuxiliaryHeads
from pansplat.model.mvsplat import MVSplat
from pansplat.model.pansplat import PanSplat
from pansplat.training.config import MemoryConfig
from pansplat.training.deferred import Problem, backpropagate, whole_loss
from pansplat.training.distributed import no_sync
from pansplat.training.losses import LossWeights, Perceptual, auxiliary_loss, depth_loss, image_loss, pixel_weights_of
from pansplat.training.network import matching_is_trainable
from pansplat.training.rendering import TargetRenderer

LOSS_TERMS: tuple[str, ...] = ("loss", "square", "perceptual", "depth", "auxiliary")
"""Names of what is told of a batch's losses."""


def accumulate_gradients(teacher: nn.Module, batches: Sequence[Batch]) -> dict[str, float]:
    """Add the gradients of the batches' mean loss to the parameters'; returns the means of the parts of the loss.

    Args:
        teacher: a `TrainingStep`, or one that `data_parallel` wraps: then the mean over the processes is added.
        batches: of one step, one after another.
    """
    sums, share = dict.fromkeys(LOSS_TERMS, 0.0), 1 / len(batches)
    for number, batch in enumerate(batches, start=1):
        with no_sync(teacher) if number < len(batches) else nullcontext():
            loss, told = teacher(batch, share)
            if loss.requires_grad:
                loss.backward()
        sums = {name: sums[name] + told[name] / len(batches) for name in LOSS_TERMS}
    return sums


class TrainingStep(nn.Module):
    """Losses of batches, and their gradients.

    Args:
        auxiliary: heads for the auxiliary loss; None for none.
        perceptual: None for none.
    """

    def __init__(
        self,
        network: PanSplat | MVSplat,
        auxiliary: AuxiliaryHeads | None,
        perceptual: Perceptual | None,
        weights: LossWeights,
        memory: MemoryConfig,
    ) -> None:
        super().__init__()
        self.network, self.auxiliary, self.perceptual = network, auxiliary, perceptual
        self.weights, self.memory = weights, memory

    def forward(self, batch: Batch, share: float = 1.0) -> tuple[Tensor, dict[str, float]]:
        """`share` times the loss, and the parts of the loss.

        Backpropagated plainly, the loss has its graph and wants `backward()`. Otherwise it has none: its gradients are
        at the parameters already, because they are found piece by piece.
        """
        told = dict.fromkeys(LOSS_TERMS, 0.0)
        weight = next(self.network.parameters())
        batch = as_type(batch, weight.dtype).to(weight.device)
        renderer = TargetRenderer(self.memory.style, self.memory.mixing, batch.images.shape[-2])

        def picture_loss(pictures: Tensor) -> Tensor:
            weights = _masked(batch)
            loss = image_loss(
                pictures.flatten(0, 1), batch.target_images.flatten(0, 1), self.perceptual, self.weights,
                pixel_weights=weights,
            )  # fmt: skip
            told["square"], told["perceptual"] = loss.square.item(), loss.perceptual.item()
            return loss.total

        def map_loss(matched: Any) -> Tensor | None:
            losses = [
                loss
                for loss in (self._depth(batch, matched, told), self._own(batch, matched, renderer, told))
                if loss is not None
            ]
            return sum(losses[1:], losses[0]) if losses else None

        problem = Problem(
            batch.images, batch.cam2world, batch.near, batch.far, batch.target_cam2world, picture_loss, map_loss
        )
        method, tiles, matching = self.memory.backpropagation, self.memory.tiles, matching_is_trainable(self.network)
        if method == "plain":
            loss = whole_loss(problem, self.network, renderer, tiles=tiles, matching_is_trainable=matching)
        else:
            loss = backpropagate(
                problem, self.network, renderer, method=method, tiles=tiles, matching_is_trainable=matching, share=share
            )
        told["loss"] = loss.item()
        return share * loss, told

    def _depth(self, batch: Batch, matched: Any, told: dict[str, float]) -> Tensor | None:
        if batch.depths is None or not self.weights.depth:
            return None
        masks = None if bool(batch.masks.all()) else batch.masks
        loss = depth_loss(
            matched.depths.depth, batch.depths, batch.near, batch.far,
            form=self.weights.depth_form, decay=self.weights.decay, masks=masks,
        )  # fmt: skip
        told["depth"] = loss.item()
        return self.weights.depth * loss

    def _own(self, batch: Batch, matched: Any, renderer: TargetRenderer, told: dict[str, float]) -> Tensor | None:
        """The pictures that each level of the cost volume makes by itself."""
        if self.auxiliary is None:
            return None
        m = matched
        levels = self.auxiliary(m.images, m.features, m.depths, m.cam2world, m.near, m.far)
        pictures = [
            torch.stack(
                [
                    renderer.render(scene, pose, batch.cam2world[item])
                    for item, scene in enumerate(scenes)
                    for pose in batch.target_cam2world[item]
                ]
            )
            for scenes in levels
        ]
        loss = auxiliary_loss(
            pictures, batch.target_images.flatten(0, 1), self.perceptual, self.weights, pixel_weights=_masked(batch)
        )
        told["auxiliary"] = loss.item()
        return loss


def as_type(batch: Batch, dtype: torch.dtype) -> Batch:
    """The batch with its numbers in the network's type."""
    moved = {k: v.to(dtype) for k, v in vars(batch).items() if isinstance(v, Tensor) and v.is_floating_point()}
    return replace(batch, **moved)


def _masked(batch: Batch) -> Tensor | None:
    """How much each pixel of the targets counts; None where all count."""
    masks = batch.target_masks.flatten(0, 1)
    if bool(masks.all()):
        return None
    weights = pixel_weights_of(masks, tuple(masks.shape))
    return None if weights is None else weights.to(batch.images)
