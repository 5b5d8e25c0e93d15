"""Connected components."""

import numpy as np
import pytest
import scipy

from pansplat.system.components import label_components


@pytest.mark.parametrize("count", [0, 1, 40])
@pytest.mark.parametrize("seed", range(5))
def test_the_labels_are_those_of_scipy(count: int, seed: int) -> None:
    edges = np.random.default_rng(seed).integers(0, max(count, 1), (count // 2 + seed, 2))[: count * count]
    graph = scipy.sparse.coo_array((np.ones(len(edges)), edges.T), shape=(count, count))
    labels = scipy.sparse.csgraph.connected_components(graph, directed=False)[1].tolist() if count else []
    numbers = {label: number for number, label in enumerate(dict.fromkeys(labels))}
    assert label_components(count, edges.tolist()) == [numbers[label] for label in labels]
