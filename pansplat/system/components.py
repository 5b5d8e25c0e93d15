"""Connected components of small graphs."""

from collections.abc import Iterable


def label_components(count: int, edges: Iterable[tuple[int, int]]) -> list[int]:
    """The component of each node of an undirected graph, numbered in the order of their first nodes.

    Not by scipy, whose import takes a sixth of the time in which a window opens.

    Args:
        count: number of nodes.
        edges: pairs of nodes, 0 to count - 1.
    """
    parents = list(range(count))  # the root of a component is its first node

    def find_root(node: int) -> int:
        while parents[node] != node:
            parents[node] = node = parents[parents[node]]
        return node

    for a, b in edges:
        first, second = sorted((find_root(a), find_root(b)))
        parents[second] = first
    roots = [find_root(node) for node in range(count)]
    numbers = {root: number for number, root in enumerate(dict.fromkeys(roots))}
    return [numbers[root] for root in roots]
