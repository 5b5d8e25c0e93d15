"""Two-step deferred backpropagation: gradients of a 4K panorama in the memory of one image part and one tile.

The image depends on the network through small intermediate results: the maps before the heads, the Gaussians, and the
pixels. The graph is cut at each of them. The forward pass keeps only the values at the cuts. The backward pass
recomputes one piece at a time with a graph, and backpropagates the gradient of its result through it:

    views -> match ->| maps ->| lift, by tile ->| Gaussians ->| render, by part ->| image parts -> image -> loss
                   cut 1                      cut 2                             cut 3

    plain     no cuts: `whole_loss` and its backward()
    two-step  all cuts: the heads, which need most memory, by tile and view; the image by cube face or strip

The gradients equal those of the plain method, because a piece depends only on the values at its cut.

Source: PanSplat, section 3.4 (deferred backpropagation); docs/official.md, section 12.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Integer
from torch import Tensor

from pansplat.gaussians.scene import Gaussians
from pansplat.model.heads import MatchedViews, TileGaussians, merge_tiles
from pansplat.model.pansplat import PanSplat
from pansplat.training.rendering import ImagePart, TargetRenderer

LossTerms = dict[str, float]
"""Values of the terms of a loss, by name, before their weights."""
ImageLoss = Callable[[Tensor], tuple[Tensor, LossTerms]]
"""From images (batch target 3 height width) to a loss and its terms."""
MatchLoss = Callable[[MatchedViews], tuple["Tensor | None", LossTerms]]
"""From the matching results of the network (depths and features) to a loss, None if there is none, and its terms."""


@dataclass(frozen=True)
class Problem:
    """Inputs and losses of a batch.

    Attributes:
        images, cam2world, near, far: context views, as the network takes them.
        targets: poses of the images to render.
        image_loss, match_loss: the loss is their sum.
    """

    images: Float[Tensor, "batch view 3 height width"]
    cam2world: Float[Tensor, "batch view 4 4"]
    near: Float[Tensor, "batch view"]
    far: Float[Tensor, "batch view"]
    targets: Float[Tensor, "batch target 4 4"]
    image_loss: ImageLoss
    match_loss: MatchLoss


def whole_loss(
    problem: Problem, network: PanSplat, renderer: TargetRenderer, *, tiles: int = 1, matching_is_trainable: bool = True
) -> tuple[Float[Tensor, ""], LossTerms]:
    """The loss with its whole graph, and its terms.

    Args:
        tiles, matching_is_trainable: see `backpropagate`.
    """
    matched = _match(problem, network, matching_is_trainable)
    scenes = merge_tiles(list(network.lift_gaussians(matched, tiles=tiles)), network.compat)
    loss, terms = problem.image_loss(renderer.render_batch(scenes, problem.targets, problem.cam2world))
    match_loss, match_terms = problem.match_loss(matched)
    return loss + _zero_if_none(match_loss), terms | match_terms


def backpropagate(
    problem: Problem,
    network: PanSplat,
    renderer: TargetRenderer,
    *,
    tiles: int = 1,
    matching_is_trainable: bool = True,
) -> tuple[Float[Tensor, ""], LossTerms]:
    """Add the gradient of the loss to the parameters' gradients.

    Args:
        tiles: number of tiles along each side of the panorama.
        matching_is_trainable: whether anything before the heads is trainable; else it is computed without a graph.

    Returns:
        The loss, without a graph, and its terms.
    """
    maps = Cut(_match(problem, network, matching_is_trainable))
    with torch.no_grad():
        tiled = [Cut(part, everything=True).leaves for part in network.lift_gaussians(maps.leaves, tiles=tiles)]
    ordered = network.compat == "fixed"
    scenes = [TiledGaussians(tiled, item, ordered=ordered) for item in range(len(problem.images))]
    loss, terms = _backpropagate_parts(scenes, problem, renderer)
    match_loss, match_terms = problem.match_loss(maps.leaves)
    if match_loss is not None and match_loss.requires_grad:
        match_loss.backward()
    for number, tile in enumerate(tiled):
        for item, view in itertools.product(*map(range, problem.images.shape[:2])):
            gaussians = _lift_tile(network, maps.leaves, item, view, tiles, number)
            _backpropagate_gaussians(gaussians, tile.gaussians[item], view)
        tile.gaussians.clear()
    maps.backward()
    return (loss + _zero_if_none(match_loss)).detach(), terms | match_terms


def _match(problem: Problem, network: PanSplat, matching_is_trainable: bool) -> MatchedViews:
    with torch.set_grad_enabled(matching_is_trainable):
        return network.match_views(problem.images, problem.cam2world, problem.near, problem.far)


@dataclass(frozen=True)
class _PartwiseImage:
    """A target image that is rendered part by part.

    Attributes:
        rows: for each part, the indices of its visible Gaussians in each tile.
    """

    scene: TiledGaussians
    pose: Float[Tensor, "4 4"]
    context: Float[Tensor, "view 4 4"]
    parts: list[ImagePart]
    rows: list[list[Integer[Tensor, "_"]]]


def _backpropagate_parts(
    scenes: list[TiledGaussians], problem: Problem, renderer: TargetRenderer
) -> tuple[Tensor, LossTerms]:
    """Add the image loss's gradient to the Gaussians' gradients, with the graph of one part at a time."""
    images = []
    for scene, poses, context in zip(scenes, problem.targets, problem.cam2world, strict=True):
        parts = renderer.list_parts(len(context))
        images += [
            _PartwiseImage(scene, pose, context, parts, scene.find_visible(renderer, pose, parts)) for pose in poses
        ]
    rendered = []
    with torch.no_grad():
        for image in images:
            selected = (image.scene.select(rows) for rows in image.rows)
            rendered.append(
                [renderer.render_part(g, image.pose, part) for g, part in zip(selected, image.parts, strict=True)]
            )
    for part in (part for parts in rendered for part in parts):
        part.requires_grad_()
    loss, terms = _backpropagate_image_loss(rendered, images, problem, renderer)
    for parts, image in zip(rendered, images, strict=True):
        for leaf, part, rows in zip(parts, image.parts, image.rows, strict=True):
            gaussians = Cut(image.scene.select(rows), everything=True).leaves
            recomputed = renderer.render_part(gaussians, image.pose, part)
            if recomputed.requires_grad and leaf.grad is not None:
                recomputed.backward(leaf.grad)
                image.scene.add_gradients(gaussians, rows)
            leaf.grad = None
    return loss, terms


def _backpropagate_image_loss(
    rendered: list[list[Tensor]],
    images: list[_PartwiseImage],
    problem: Problem,
    renderer: TargetRenderer,
) -> tuple[Float[Tensor, ""], LossTerms]:
    """Backpropagate the image loss to the rendered parts. The graph is freed on return."""
    composed = [
        renderer.compose(parts, image.pose, image.context) for parts, image in zip(rendered, images, strict=True)
    ]
    loss, terms = problem.image_loss(torch.stack(composed).unflatten(0, problem.targets.shape[:2]))
    loss.backward()
    return loss.detach(), terms


class TiledGaussians:
    """The Gaussians of one item, stored by tile; a concatenated copy would double their memory.

    Args:
        tiled: leaves that accumulate gradients.
        item: index in the batch.
        ordered: whether selections have the order without tiles; else that of the tiles, as in the official code.
    """

    def __init__(self, tiled: list[TileGaussians], item: int, *, ordered: bool) -> None:
        self._tiles = [tile.gaussians[item] for tile in tiled]
        self._places = [tile.index for tile in tiled] if ordered and len(tiled) > 1 else None

    def find_visible(
        self, renderer: TargetRenderer, pose: Float[Tensor, "4 4"], parts: list[ImagePart]
    ) -> list[list[Tensor]]:
        """For each part, the indices of its visible Gaussians in each tile."""
        by_tile = [[mask.nonzero()[:, 0] for mask in renderer.find_visible(tile, pose, parts)] for tile in self._tiles]
        return [list(rows) for rows in zip(*by_tile, strict=True)]

    @torch.no_grad()
    def select(self, rows: list[Integer[Tensor, "_"]]) -> Gaussians:
        """The Gaussians at the given indices in each tile."""
        selected = Gaussians.cat([tile.select(index) for tile, index in zip(self._tiles, rows, strict=True)])
        order = self._order(rows)
        return selected if order is None else selected.select(order)

    @torch.no_grad()
    def add_gradients(self, selected: Gaussians, rows: list[Integer[Tensor, "_"]]) -> None:
        """Add the gradients of `selected`, the result of `select(rows)`, to those of the tiles."""
        order, counts = self._order(rows), [len(index) for index in rows]
        for name in _float_fields(selected):
            gradient = getattr(selected, name).grad
            if gradient is None:
                continue
            if order is not None:
                gradient = torch.empty_like(gradient).index_copy_(0, order, gradient)
            for tile, index, part in zip(self._tiles, rows, gradient.split(counts), strict=True):
                leaf = getattr(tile, name)
                if leaf.grad is None:
                    leaf.grad = torch.zeros_like(leaf)
                leaf.grad.index_add_(0, index, part)

    def _order(self, rows: list[Integer[Tensor, "_"]]) -> Integer[Tensor, "_"] | None:
        if self._places is None:
            return None
        places = [place.to(index.device)[index] for place, index in zip(self._places, rows, strict=True)]
        return torch.argsort(torch.cat(places))


def _lift_tile(network: PanSplat, matched: MatchedViews, item: int, view: int, tiles: int, number: int) -> Gaussians:
    """The Gaussians of one item, view and tile, with a graph; in the same order as in the whole tile."""
    maps = _map_tensors(matched, lambda tensor: tensor[item : item + 1, view : view + 1])
    (tile,) = network.lift_gaussians(maps, tiles=tiles, only=[number] if tiles > 1 else None)
    return tile.gaussians[0]


def _backpropagate_gaussians(gaussians: Gaussians, leaves: Gaussians, view: int) -> None:
    """Backpropagate the gradients of a tile's leaves through the graph of its recomputed Gaussians."""
    rows = leaves.views == view
    tensors, gradients = [], []
    for name in _float_fields(gaussians):
        gradient = getattr(leaves, name).grad
        if gradient is not None and getattr(gaussians, name).requires_grad:
            tensors.append(getattr(gaussians, name))
            gradients.append(gradient[rows])
    torch.autograd.backward(tensors, gradients)


def _float_fields(gaussians: Gaussians) -> list[str]:
    return [f.name for f in dataclasses.fields(gaussians) if getattr(gaussians, f.name).is_floating_point()]


def _zero_if_none(loss: Tensor | None) -> Tensor:
    return torch.zeros(()) if loss is None else loss


class Cut:
    """A cut of the graph: tensors of nested dataclasses and lists are copied as leaves, which accumulate gradients.

    Args:
        structure: tensors, possibly with a graph.
        everything: whether floating-point tensors without a graph become leaves with gradients too.

    Attributes:
        leaves: the same structure with the leaves.
    """

    def __init__(self, structure: Any, *, everything: bool = False) -> None:
        self._pairs: dict[int, tuple[Tensor, Tensor]] = {}

        def cut(tensor: Tensor) -> Tensor:
            if not (tensor.is_floating_point() and (tensor.requires_grad or everything)):
                return tensor
            if id(tensor) not in self._pairs:
                self._pairs[id(tensor)] = (tensor, tensor.detach().requires_grad_())
            return self._pairs[id(tensor)][1]

        self.leaves = _map_tensors(structure, cut)

    def backward(self) -> None:
        """Backpropagate the leaves' gradients through the graph before the cut."""
        pairs = [(tensor, leaf.grad) for tensor, leaf in self._pairs.values() if tensor.requires_grad]
        pairs = [(tensor, gradient) for tensor, gradient in pairs if gradient is not None]
        if pairs:
            torch.autograd.backward(*map(list, zip(*pairs, strict=True)))


def _map_tensors(structure: Any, function: Callable[[Tensor], Tensor]) -> Any:
    """Apply a function to every tensor of nested dataclasses and lists."""
    if isinstance(structure, Tensor):
        return function(structure)
    if isinstance(structure, (list, tuple)):
        return type(structure)(_map_tensors(part, function) for part in structure)
    if dataclasses.is_dataclass(structure) and not isinstance(structure, type):
        values = {f.name: getattr(structure, f.name) for f in dataclasses.fields(structure)}
        return type(structure)(**{name: _map_tensors(value, function) for name, value in values.items()})
    return structure
