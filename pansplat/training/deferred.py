"""Two-step deferred backpropagation: the gradient of a whole 4K picture in the memory of a face and a tile.

A picture depends on the network by way of few numbers: the maps before the heads, the Gaussians, the pixels. Each of
these is a place to cut the graph. Forward, nothing is kept but the numbers at the cuts. Backward, one piece at a time
is computed again, with a graph, and gets the gradient that was left at the cut behind it:

    views -> match ->| maps ->| lift, tile by tile ->| Gaussians ->| draw, part by part ->| layers -> picture -> loss
                    cut 1                           cut 2                               cut 3

    plain     no cuts: `whole_loss`, and its backward()
    one-step  cuts 1 and 2: the heads, which are the largest, tile by tile and view by view; the picture in one graph
    two-step  cuts 1, 2 and 3: and the picture face by face, or strip by strip

The gradients are those of the plain path: every piece is a function of the numbers at its cut alone.

Source: PanSplat, section 3.4 (deferred backpropagation); OFFICIAL.md, section 12.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import torch
from jaxtyping import Float, Integer
from torch import Tensor

from pansplat.gaussians.scene import Gaussians
from pansplat.model.heads import TileGaussians, merge_tiles
from pansplat.model.network import Network
from pansplat.model.pansplat import PanSplat
from pansplat.training.rendering import ImagePart, TargetRenderer

_T = TypeVar("_T")
_ItemView = tuple[int, "int | None"]

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


def whole_loss(
    problem: Problem, network: Network, renderer: TargetRenderer, *, tiles: int = 1, matching_is_trainable: bool = True
) -> Float[Tensor, ""]:
    """The loss with the graph of everything it is made of.

    Args:
        tiles, matching_is_trainable: as in `backpropagate`.
    """
    matched = _match(problem, network, matching_is_trainable)
    scenes = merge_tiles(list(network.lift_gaussians(matched, tiles=tiles)), network.compat)
    loss = problem.picture_loss(_draw(scenes, problem, renderer))
    return loss + _number(problem.map_loss(matched))


def backpropagate(
    problem: Problem,
    network: Network,
    renderer: TargetRenderer,
    *,
    method: Literal["one-step", "two-step"],
    tiles: int = 1,
    matching_is_trainable: bool = True,
    share: float = 1.0,
) -> Float[Tensor, ""]:
    """Add `share` times the gradient of the loss to every parameter's; returns the loss, without a graph.

    Args:
        tiles: tiles along each side of the panorama.
        matching_is_trainable: whether anything before the heads is trainable; else it is computed without a graph.
    """
    maps = Cut.of(_match(problem, network, matching_is_trainable))
    with torch.no_grad():
        tiled = [Cut.of(part, everything=True).copy for part in network.lift_gaussians(maps.copy, tiles=tiles)]
    if method == "one-step":
        loss = problem.picture_loss(_draw(merge_tiles(tiled, network.compat), problem, renderer))
        (share * loss).backward()
    else:
        ordered = network.compat == "fixed"
        scenes = [Scattered(tiled, item, ordered=ordered) for item in range(len(problem.images))]
        loss = _draw_in_two_steps(scenes, problem, renderer, share)
    map_loss = problem.map_loss(maps.copy)
    if map_loss is not None and map_loss.requires_grad:
        (share * map_loss).backward()
    for number, kept in enumerate(tiled):
        for item, view in _lifted_at_a_time(network, problem.images):
            again = _lift_again(network, maps.copy, item, view, tiles, number)
            _hand_back(again, kept.gaussians[item], view)
        kept.gaussians.clear()  # their memory is wanted for the next
    maps.backward()
    return (loss + _number(map_loss)).detach()


def _match(problem: Problem, network: Network, matching_is_trainable: bool) -> Any:
    with torch.set_grad_enabled(matching_is_trainable):
        return network.match_views(problem.images, problem.cam2world, problem.near, problem.far)


def _draw(scenes: list[Gaussians], problem: Problem, renderer: TargetRenderer) -> Float[Tensor, "batch target 3 h w"]:
    items = zip(scenes, problem.targets, problem.cam2world, strict=True)
    return torch.stack(
        [torch.stack([renderer.render(scene, pose, context) for pose in poses]) for scene, poses, context in items]
    )


@dataclass(frozen=True)
class _Job:
    """A picture to draw layer by layer.

    Attributes:
        rows: for each layer, the Gaussians it is drawn of, tile by tile.
    """

    scene: Scattered
    pose: Float[Tensor, "4 4"]
    context: Float[Tensor, "view 4 4"]
    layers: list[ImagePart]
    rows: list[list[Integer[Tensor, "_"]]]


def _draw_in_two_steps(scenes: list[Scattered], problem: Problem, renderer: TargetRenderer, share: float) -> Tensor:
    """Leave the gradient of the picture's loss at the Gaussians, one layer's graph at a time; returns the loss."""
    jobs = []
    for scene, poses, context in zip(scenes, problem.targets, problem.cam2world, strict=True):
        layers = renderer.parts(len(context))
        jobs += [_Job(scene, pose, context, layers, scene.shown(renderer, pose, layers)) for pose in poses]
    cuts = []
    with torch.no_grad():
        for job in jobs:
            picked = (job.scene.picked(rows) for rows in job.rows)
            cuts.append([renderer.render_part(own, job.pose, at) for own, at in zip(picked, job.layers, strict=True)])
    for layer in (layer for cut in cuts for layer in cut):
        layer.requires_grad_()
    loss = _picture_loss(cuts, jobs, problem, renderer, share)
    for cut, job in zip(cuts, jobs, strict=True):
        for kept, layer, rows in zip(cut, job.layers, job.rows, strict=True):
            leaf = Cut.of(job.scene.picked(rows), everything=True).copy
            again = renderer.render_part(leaf, job.pose, layer)
            if again.requires_grad and kept.grad is not None:
                again.backward(kept.grad)
                job.scene.add_gradients(leaf, rows)
            kept.grad = None
    return loss


def _picture_loss(
    cuts: list[list[Tensor]], jobs: list[_Job], problem: Problem, renderer: TargetRenderer, share: float
) -> Float[Tensor, ""]:
    """The loss, its gradient left at the layers; its graph is gone when this returns."""
    pictures = [renderer.compose(cut, job.pose, job.context) for cut, job in zip(cuts, jobs, strict=True)]
    loss = problem.picture_loss(torch.stack(pictures).unflatten(0, problem.targets.shape[:2]))
    (share * loss).backward()
    return loss.detach()


class Scattered:
    """One item's Gaussians, tile by tile as they were made: never all in one place, which would take as much again.

    Args:
        tiled: leaves that gather gradients.
        item: of the batch.
        ordered: whether the order of all is the untiled one; else tile by tile, as in the original.
    """

    def __init__(self, tiled: list[TileGaussians], item: int, *, ordered: bool) -> None:
        self._tiles = [part.gaussians[item] for part in tiled]
        self._places = [part.index for part in tiled] if ordered and len(tiled) > 1 else None

    def shown(
        self, renderer: TargetRenderer, pose: Float[Tensor, "4 4"], layers: list[ImagePart]
    ) -> list[list[Tensor]]:
        """For each layer, the numbers of the Gaussians it is drawn of, tile by tile."""
        by_tile = [[mask.nonzero()[:, 0] for mask in renderer.visible(tile, pose, layers)] for tile in self._tiles]
        return [list(rows) for rows in zip(*by_tile, strict=True)]

    @torch.no_grad()
    def picked(self, rows: list[Integer[Tensor, "_"]]) -> Gaussians:
        """Those Gaussians, in the order of all."""
        picked = Gaussians.cat([tile.select(own) for tile, own in zip(self._tiles, rows, strict=True)])
        order = self._order(rows)
        return picked if order is None else picked.select(order)

    @torch.no_grad()
    def add_gradients(self, picked: Gaussians, rows: list[Integer[Tensor, "_"]]) -> None:
        """Add the gradients of what `picked` gave to the tiles' own."""
        order, counts = self._order(rows), [len(own) for own in rows]
        for name in _floating(picked):
            gradient = getattr(picked, name).grad
            if gradient is None:
                continue
            if order is not None:
                gradient = torch.empty_like(gradient).index_copy_(0, order, gradient)
            for tile, own, part in zip(self._tiles, rows, gradient.split(counts), strict=True):
                leaf = getattr(tile, name)
                if leaf.grad is None:
                    leaf.grad = torch.zeros_like(leaf)
                leaf.grad.index_add_(0, own, part)

    def _order(self, rows: list[Integer[Tensor, "_"]]) -> Integer[Tensor, "_"] | None:
        if self._places is None:
            return None
        places = [index.to(own.device)[own] for index, own in zip(self._places, rows, strict=True)]
        return torch.argsort(torch.cat(places))


def _lifted_at_a_time(network: Network, images: Float[Tensor, "batch view 3 height width"]) -> list[_ItemView]:
    """The heads see each view by itself; in the baseline an item's views see each other (None for all of them)."""
    views = range(images.shape[1]) if isinstance(network, PanSplat) else [None]
    return [(item, view) for item in range(len(images)) for view in views]


def _lift_again(network: Network, matched: Any, item: int, view: int | None, tiles: int, number: int) -> Gaussians:
    """A tile's Gaussians of one item and view, in the order that they have among the tile's."""
    views = slice(None) if view is None else slice(view, view + 1)
    own = _mapped(matched, lambda maps: maps[item : item + 1, views])
    (part,) = network.lift_gaussians(own, tiles=tiles, only=[number] if tiles > 1 else None)
    return part.gaussians[0]


def _hand_back(again: Gaussians, kept: Gaussians, view: int | None) -> None:
    """Send the gradients left at a tile's Gaussians through the heads that made them again."""
    rows = slice(None) if view is None else kept.views == view
    tensors, gradients = [], []
    for name in _floating(again):
        left = getattr(kept, name).grad
        if left is not None and getattr(again, name).requires_grad:
            tensors.append(getattr(again, name))
            gradients.append(left[rows])
    torch.autograd.backward(tensors, gradients)


def _floating(gaussians: Gaussians) -> list[str]:
    return [f.name for f in dataclasses.fields(gaussians) if getattr(gaussians, f.name).is_floating_point()]


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
