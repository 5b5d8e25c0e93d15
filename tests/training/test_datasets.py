"""The samples of a run are those of its settings."""

from __future__ import annotations

from pathlib import Path

import pytest

from pansplat.training.config import DataConfig
from pansplat.training.datasets import load_sources
from pansplat.training.sources import PairSource, TripletSource

pytestmark = pytest.mark.shared


def test_a_folder_of_triplets_is_read_as_triplets_and_as_pairs(shared: Path) -> None:
    root = shared / "data" / "bsp_demo"
    for source in load_sources(DataConfig("triplets", root), 64, 0):
        assert isinstance(source, TripletSource) and len(source) == 12
    for source in load_sources(DataConfig("pairs", root), 64, 0):
        assert isinstance(source, PairSource) and len(source) == 12
