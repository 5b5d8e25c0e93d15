"""Game maps that are reserved for evaluation are never training data."""

from __future__ import annotations

from pathlib import Path

import pytest

from pansplat.training.config import DataConfig
from pansplat.training.datasets import RESERVED, is_reserved, load_sources
from pansplat.training.sources import PairSource, TripletSource

_FAMILIES = (
    *("oa_minia", "oa_koth1", "mictf1beta", "hydronex2", "sleekgrinder", "pul1duel-oa", "oacmpdm1", "oa_shouse"),
    *("strength", "bleach"),
)


def write_triplets(folder: Path, *names: str) -> Path:
    """Files with the names of triplets; their content is not read."""
    for name in names:
        (folder / f"{name}.json").write_text("{}")
        (folder / f"{name}_0.png").write_bytes(b"")
    return folder


def test_reserved_maps_are_skipped_with_a_warning(tmp_path: Path) -> None:
    write_triplets(tmp_path, *(f"{family}_{number}" for family in _FAMILIES for number in ("000", "001")), "oa_dm3_000")
    with pytest.warns(UserWarning, match="20 of 21 triplets belong to maps that are reserved"):
        both = load_sources(DataConfig("triplets", tmp_path), 64, 0)
    for source in both:
        assert isinstance(source, TripletSource)
        assert [path.stem for path in source.triplets.sources] == ["oa_dm3_000"]


def test_similar_names_are_not_reserved() -> None:
    free = ("oacmpdm10_000", "oa_koth2_003", "pul1ctf_001", "strengthened_000", "oa_minias", "desertfactory_002")
    assert not any(map(is_reserved, free))
    assert all(is_reserved(f"{name}_012") and is_reserved(name.upper()) for name in RESERVED)
    assert set(_FAMILIES) <= RESERVED


def test_reserved_demo_maps_are_skipped(shared: Path) -> None:
    root = shared / "data" / "bsp_demo"
    with pytest.warns(UserWarning, match="6 of 12 triplets"):
        training, _ = load_sources(DataConfig("triplets", root), 64, 0)
    assert isinstance(training, TripletSource)
    assert {path.stem[:-4] for path in training.triplets.sources} == {"desertfactory", "oa_dm3"}
    with pytest.warns(UserWarning, match="6 of 12 triplets"):
        pairs, validation = load_sources(DataConfig("pairs", root), 64, 0)
    for source in (pairs, validation):
        assert isinstance(source, PairSource)
        assert {pair.name.rsplit("_", 1)[0] for pair in source.pairs} == {"desertfactory", "oa_dm3"}
