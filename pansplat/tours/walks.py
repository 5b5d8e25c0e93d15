"""Walks through a tour: the cheapest ways along edges and zooms, and one that visits all panoramas."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from functools import lru_cache, partial

import numpy as np
import scipy
from jaxtyping import Float, Int

from pansplat.tours.graph import TourGraph

_MAX_STARTS = 10_000  # starts of a walk that are compared, times the number of nodes
_LINKED_ZOOM = 0.5  # cost of a zoom along a link, as a fraction of far
_UNLINKED_ZOOM = 2.5  # cost of another zoom, as a factor, so that two zooms along links cost less


def find_walk(tour: TourGraph, start: int, end: int) -> list[int]:
    """The nodes of the cheapest way along edges and zooms, both ends included.

    It stays in the part of both ends, if they are of one part.
    """
    _, previous = _find_shortest(tour)
    walk = [end]
    while walk[-1] != start:
        walk.append(int(previous[start, walk[-1]]))
    return walk[::-1]


def find_way(tour: TourGraph, position: Float[np.ndarray, "3"], node: int, part: int | None = None) -> list[int]:
    """The nodes on the way from a position to a node: from that end of the nearest edge which makes it better.

    The better way has fewer zooms. Of those with as many, it is the shorter one.

    Args:
        position: of the camera.
        node: the last one.
        part: of the camera, if it is known.
    """
    nearest, _ = tour.find_nearest_edge(position, part)

    def measure(walk: list[int]) -> tuple[int, float]:
        zooms = [tour.is_zoom(a, b) for a, b in itertools.pairwise(walk)]
        steps = np.linalg.norm(np.diff([position, *tour.positions[walk]], axis=0), axis=1)
        return sum(zooms), float(steps[~np.array([False, *zooms])].sum())

    ends: Sequence[int] = nearest
    if nearest in tour.poor:  # no camera flies to its other end
        ends = [tour.find_nearest(position, nearest)]
    return min((find_walk(tour, end, node) for end in ends), key=measure)


def find_next_nodes(tour: TourGraph) -> list[list[int]]:
    """The next node on the cheapest way from a node (row) to another one (column)."""
    following = _find_shortest(tour)[1].T.copy()  # the costs are symmetric: the node before the end of the way back
    np.fill_diagonal(following, range(len(tour)))
    return following.tolist()


def plan_walk(tour: TourGraph, start: int | None = None) -> list[int]:
    """Nodes of a short walk along edges and zooms that visits all nodes; some of them more than once.

    Nearest neighbours first, improved by exchanging parts of the order (2-opt).

    Args:
        start: its first node. None starts at the first node if that has a start view, or in a tour of parts with
            links: its author has chosen so. Else it chooses the start of the shortest walk, of some starts for more
            than 100 nodes; in a tour of parts one in the largest part.
    """
    costs, _ = _find_shortest(tour)
    starts = np.arange(len(tour)) if start is None else np.array([start])
    has_parts = max(tour.parts) > 0
    if start is None and (tour.panoramas[0].start is not None or (has_parts and tour.links)):
        starts = starts[:1]
    elif start is None and has_parts:
        starts = np.flatnonzero(np.array(tour.parts) == np.bincount(tour.parts).argmax())
    starts = starts[:: math.ceil(len(starts) * len(tour) / _MAX_STARTS)].tolist()
    orders = [_improve_order(_order_by_distance(costs, first), costs) for first in starts]
    order = min(orders, key=lambda order: float(costs[order[:-1], order[1:]].sum()))
    first, *others = order.tolist()
    walk = [first]
    for node in others:
        walk += find_walk(tour, walk[-1], node)[1:]
    return walk


def _order_by_distance(costs: Float[np.ndarray, "node node"], start: int) -> Int[np.ndarray, "node"]:
    """All nodes; the one after a node is its nearest one of those that are left."""
    order, left = [start], np.arange(len(costs)) != start
    while left.any():
        order.append(int(np.where(left, costs[order[-1]], np.inf).argmin()))
        left[order[-1]] = False
    return np.array(order)


def _improve_order(order: Int[np.ndarray, "node"], costs: Float[np.ndarray, "node node"]) -> Int[np.ndarray, "node"]:
    """Reverse parts of the order, except its start, as long as it gets shorter."""
    order, improved = order.copy(), True
    while improved:
        improved = False
        for first in range(1, len(order)):
            last = first + 1
            while last < len(order):
                # The change of the length if the part from `first` to each of `ends` is reversed.
                before, here, ends = order[first - 1], order[first], order[last:]
                change = costs[before, ends] - costs[before, here]
                change[:-1] += costs[here, ends[1:]] - costs[ends[:-1], ends[1:]]
                shorter = np.flatnonzero(change < -1e-9)
                if not len(shorter):
                    break
                last += int(shorter[0]) + 1
                order[first:last] = order[first:last][::-1].copy()
                improved = True
    return order


@lru_cache(maxsize=8)
def _find_shortest(tour: TourGraph) -> tuple[Float[np.ndarray, "node node"], Int[np.ndarray, "node node"]]:
    """Cost of the cheapest way between all nodes, and the node before its end."""
    find_ways = partial(scipy.sparse.csgraph.shortest_path, method="FW", directed=False, return_predecessors=True)
    costs = np.full((len(tour), len(tour)), np.inf)
    for (a, b), overlap in tour.overlaps.items():
        # With little overlap a way around looks better.
        doubt = 1.0 if (a, b) in tour.poor else max(1 - overlap / 0.25, 0.0)
        costs[a, b] = costs[b, a] = max(tour.length((a, b)), 1e-3) * (1 + 3 * doubt)
    ways, previous = find_ways(costs)
    is_near = np.isfinite(ways)
    if not is_near.all():
        # Two zooms cost more than each way within a part, so that a way between nodes of a part stays in it.
        longest = ways[is_near].max()
        zoom = 0.5 * longest + _LINKED_ZOOM * tour.far
        costs[~is_near] = _UNLINKED_ZOOM * zoom + longest
        for a, b in (*tour.links, *tour.walls):
            if tour.parts[a] != tour.parts[b]:
                costs[a, b] = costs[b, a] = zoom
        ways, previous = find_ways(costs)
    return ways, previous
