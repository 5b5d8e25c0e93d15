"""Loss and gradients of the batch of one training step."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from pansplat.evaluation.lpips import Lpips
from pansplat.inputs.views import Batch
from pansplat.model.heads import AuxiliaryHeads, MatchedViews
from pansplat.model.pansplat import PanSplat
from pansplat.training.config import MemoryConfig
from pansplat.training.deferred import LossTerms, Problem, backpropagate, whole_loss
from pansplat.training.losses import LossWeights, Structure, auxiliary_loss, depth_loss, image_loss
from pansplat.training.network import matching_is_trainable
from pansplat.training.rendering import TargetRenderer

LOSS_TERMS: tuple[str, ...] = ("loss", "square", "perceptual", "depth", "auxiliary")
"""Names of the total loss and its terms."""


@dataclass(frozen=True)
class TrainingStep:
    """Loss of a batch, and its gradients.

    Attributes:
        auxiliary: heads for the auxiliary loss; None for no auxiliary loss.
        perceptual: None for no perceptual loss.
    """

    network: PanSplat
    auxiliary: AuxiliaryHeads | None
    perceptual: Lpips | Structure | None
    weights: LossWeights
    memory: MemoryConfig

    def __call__(self, batch: Batch) -> LossTerms:
        """Add the gradients of the loss to the parameters' gradients; returns the loss and its terms."""
        parameter = next(self.network.parameters())
        batch = batch.to(parameter.device, parameter.dtype)
        renderer = TargetRenderer(self.memory.style, self.memory.mixing, batch.images.shape[-2])

        def image_terms(images: Tensor) -> tuple[Tensor, LossTerms]:
            loss = image_loss(
                images.flatten(0, 1),
                batch.target_images.flatten(0, 1),
                self.perceptual,
                self.weights,
                pixel_weights=_target_weights(batch),
            )
            return loss.total, {"square": loss.square.item(), "perceptual": loss.perceptual.item()}

        def match_terms(matched: MatchedViews) -> tuple[Tensor | None, LossTerms]:
            terms: LossTerms = {}
            losses: list[Tensor] = []
            if (depth := self._depth_loss(batch, matched)) is not None:
                terms["depth"] = depth.item()
                losses.append(self.weights.depth * depth)
            if (auxiliary := self._auxiliary_loss(batch, matched, renderer)) is not None:
                terms["auxiliary"] = auxiliary.item()
                losses.append(auxiliary)
            return sum(losses[1:], losses[0]) if losses else None, terms

        problem = Problem(
            batch.images, batch.cam2world, batch.near, batch.far, batch.target_cam2world, image_terms, match_terms
        )
        options = {"tiles": self.memory.tiles, "matching_is_trainable": matching_is_trainable(self.network)}
        if self.memory.backpropagation == "plain":
            loss, terms = whole_loss(problem, self.network, renderer, **options)
            if loss.requires_grad:
                loss.backward()
        else:
            loss, terms = backpropagate(problem, self.network, renderer, **options)
        return {**dict.fromkeys(LOSS_TERMS, 0.0), **terms, "loss": loss.item()}

    def _depth_loss(self, batch: Batch, matched: MatchedViews) -> Tensor | None:
        if batch.depths is None or not self.weights.depth:
            return None
        return depth_loss(
            matched.depths.depth,
            batch.depths,
            batch.near,
            batch.far,
            form=self.weights.depth_form,
            decay=self.weights.decay,
            masks=None if bool(batch.masks.all()) else batch.masks,
        )

    def _auxiliary_loss(self, batch: Batch, matched: MatchedViews, renderer: TargetRenderer) -> Tensor | None:
        if self.auxiliary is None:
            return None
        images = [
            renderer.render_batch(scenes, batch.target_cam2world, batch.cam2world).flatten(0, 1)
            for scenes in self.auxiliary(matched)
        ]
        return auxiliary_loss(
            images,
            batch.target_images.flatten(0, 1),
            self.perceptual,
            self.weights,
            pixel_weights=_target_weights(batch),
        )


def _target_weights(batch: Batch) -> Tensor | None:
    """Weights of the target pixels; None when all have weight 1."""
    return None if bool(batch.target_masks.all()) else batch.target_masks.flatten(0, 1).to(batch.images)
