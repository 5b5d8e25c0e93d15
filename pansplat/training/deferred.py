"""Two-step deferred backpropagation: the gradient of a whole 4K picture in the memory of a face and a tile.

A picture depends on the network by way of few numbers: the maps before the heads, the Gaussians, the pixels. Each of
these is a place to cut the graph. Forward, nothing is kept but the numbers at the cuts. Backward, one piece at a time
is computed again, with a graph, and gets the gradient that was left at the cut behind it:

    views -> match ->| maps ->| lift, tile by tile ->| Gaussians ->| draw, face by face ->| layers -> picture -> loss
                    cut 1                           cut 2                               cut 3

    plain     no cuts
    one-step  cuts 1 and 2: the heads, which are the largest, tile by tile; the picture in one graph
    two-step  cuts 1, 2 and 3: and the picture face by face

The gradients are those of the plain path: every piece is a function of the numbers at its cut alone.

Source: PanSplat, section 3.4 (deferred backpropagation); OFFICIAL.md, section 12.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from jaxtyping import Float, Integer
from torch import Tensor

from pansplat.gaussians.gaussians import Gaussians
from pansplat.model.heads import TileGaussians, whole
from pansplat.model.layers import Compat
from pansplat.model.network import Network
from pansplat.training.config import Backpropagation
from pansplat.training.drawing import Drawing

_T = TypeVar("_T")

PictureLoss = Callable[[Tensor], Tensor]
"""From pictures (batch target 3 height width) to a number."""
MapLoss = Callable[[Any], "Tensor | None"]
"""From what the network matched (depths and features) to a number; None where there is no such loss."""


@dataclass(frozen=True)
class Problem:
    """What the gradient is of.

    Attributes:
        images, cam2world, near, far: of the context, as the network takes them.
        targets: poses of the pictures.
        picture_loss, map_loss: the loss is their sum.
    """

    images: Float[Tensor, "batch view 3 height width"]
    cam2world: Float[Tensor, "batch view 4 4"]
    near: Float[Tensor, "batch view"]
    far: Float[Tensor, "batch view"]
    targets: Float[Tensor, "batch target 4 4"]
    picture_loss: PictureLoss
    map_loss: MapLoss


def backpropagate(
    problem: Problem,
    network: Network,
    drawing: Drawing,
    *,
    method: Backpropagation = "plain",
    tiles: int = 1,
    matching_learns: bool = True,
    share: float = 1.0,
) -> float:
    """Add `share` times the gradient of the loss to every parameter's; returns the loss.

    Args:
        tiles: tiles along each side of the panorama.
        matching_learns: whether anything before the heads has parameters that learn; else no graph is made for it.
    """
    with torch.set_grad_enabled(matching_learns):
        matched = network.match(problem.images, problem.cam2world, problem.near, problem.far)
    if method == "plain":
        scenes = whole(list(network.lift(matched, tiles=tiles)), network.compat)
        pictures = _draw(scenes, problem, drawing)
        loss = problem.picture_loss(pictures) + _number(problem.map_loss(matched))
        (share * loss).backward()
        return loss.item()

    maps = Cut.of(matched)
    with torch.no_grad():
        parts = list(network.lift(maps.copy, tiles=tiles))
        scenes = Cut.of(whole(parts, network.compat), everything=True)
    places = _places(parts, network.compat)
    del parts
    if method == "one-step":
        loss = problem.picture_loss(_draw(scenes.copy, problem, drawing))
        (share * loss).backward()
    else:
        loss = _draw_in_two_steps(scenes.copy, problem, drawing, share)
    map_loss = problem.map_loss(maps.copy)
    if map_loss is not None and map_loss.requires_grad:
        (share * map_loss).backward()
    for number, index in enumerate(places):
        (part,) = network.lift(maps.copy, tiles=tiles, only=[number]) if tiles > 1 else network.lift(maps.copy)
        _hand_back(part, scenes.copy, index)
    maps.backward()
    return loss.item() + _number(map_loss).item()


def _draw(scenes: list[Gaussians], problem: Problem, drawing: Drawing) -> Float[Tensor, "batch target 3 h w"]:
    items = zip(scenes, problem.targets, problem.cam2world, strict=True)
    return torch.stack(
        [torch.stack([drawing.draw(scene, pose, context) for pose in poses]) for scene, poses, context in items]
    )


def _draw_in_two_steps(scenes: list[Gaussians], problem: Problem, drawing: Drawing, share: float) -> Tensor:
    """Leave the gradient of the picture's loss at the Gaussians, one layer's graph at a time; returns the loss."""
    jobs = [
        (scene, pose, context, drawing.layers(len(context)))
        for scene, poses, context in zip(scenes, problem.targets, problem.cam2world, strict=True)
        for pose in poses
    ]
    with torch.no_grad():
        drawn = [[drawing.draw_layer(scene, pose, layer) for layer in layers] for scene, pose, _, layers in jobs]
    cuts = [[layer.requires_grad_() for layer in layers] for layers in drawn]
    pictures = [drawing.compose(cut, pose, context) for cut, (_, pose, context, _) in zip(cuts, jobs, strict=True)]
    loss = problem.picture_loss(torch.stack(pictures).unflatten(0, problem.targets.shape[:2]))
    (share * loss).backward()
    for cut, (scene, pose, _, layers) in zip(cuts, jobs, strict=True):
        for kept, layer in zip(cut, layers, strict=True):
            again = drawing.draw_layer(scene, pose, layer)
            if again.requires_grad:
                again.backward(kept.grad)
            kept.grad = None
    return loss.detach()


def _hand_back(part: TileGaussians, scenes: list[Gaussians], index: Integer[Tensor, "n"]) -> None:
    """Send the gradients left at a tile's Gaussians through the heads that made them again."""
    tensors, gradients = [], []
    for made, scene in zip(part.gaussians, scenes, strict=True):
        for name in _floating(made):
            left = getattr(scene, name).grad
            if left is not None and getattr(made, name).requires_grad:
                tensors.append(getattr(made, name))
                gradients.append(left[index])
    torch.autograd.backward(tensors, gradients)


def _floating(gaussians: Gaussians) -> list[str]:
    return [f.name for f in dataclasses.fields(gaussians) if getattr(gaussians, f.name).is_floating_point()]


def _places(parts: list[TileGaussians], compat: Compat) -> list[Integer[Tensor, "n"]]:
    """Where each tile's Gaussians stand in what `whole` makes of all tiles."""
    if len(parts) > 1 and compat == "official":
        counts = [len(part.gaussians[0]) for part in parts]
        return list(torch.arange(sum(counts)).split(counts))
    return [part.index for part in parts] if len(parts) > 1 else [torch.arange(len(parts[0].gaussians[0]))]


def _number(loss: Tensor | None) -> Tensor:
    return torch.zeros(()) if loss is None else loss


class Cut:
    """Tensors of nested dataclasses and lists, copied as leaves that gather the gradients of what comes after them.

    Attributes:
        copy: the same structure with the leaves.
    """

    def __init__(self, copy: Any, pairs: list[tuple[Tensor, Tensor]]) -> None:
        self.copy = copy
        self._pairs = pairs

    @staticmethod
    def of(structure: _T, *, everything: bool = False) -> Cut:
        """Cut the graph behind a structure.

        Args:
            everything: whether numbers without a graph gather gradients too.
        """
        leaves: dict[int, tuple[Tensor, Tensor]] = {}

        def leaf(tensor: Tensor) -> Tensor:
            wanted = tensor.is_floating_point() and (tensor.requires_grad or everything)
            if not wanted:
                return tensor
            if id(tensor) not in leaves:
                leaves[id(tensor)] = (tensor, tensor.detach().requires_grad_())
            return leaves[id(tensor)][1]

        return Cut(_mapped(structure, leaf), list(leaves.values()))

    def backward(self) -> None:
        """Send what was gathered at the leaves on through the graph before the cut."""
        sent = [(before, leaf.grad) for before, leaf in self._pairs if leaf.grad is not None and before.requires_grad]
        if sent:
            torch.autograd.backward(*map(list, zip(*sent, strict=True)))


def _mapped(structure: Any, change: Callable[[Tensor], Tensor]) -> Any:
    if isinstance(structure, Tensor):
        return change(structure)
    if isinstance(structure, (list, tuple)):
        return type(structure)(_mapped(part, change) for part in structure)
    if dataclasses.is_dataclass(structure) and not isinstance(structure, type):
        fields: Iterator[tuple[str, Any]] = (
            (f.name, getattr(structure, f.name)) for f in dataclasses.fields(structure)
        )
        return type(structure)(**{name: _mapped(value, change) for name, value in fields})
    return structure
