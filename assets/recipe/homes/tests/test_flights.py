"""Flights through generated homes as pairs with targets."""

from pathlib import Path

import numpy as np
import pytest

from pansplat.inputs.folders import load_sets
from pansplat_homes.flights import NAMES, write_flight

HEIGHT = 32


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, float]:
    """The folder of a flight to a neighbouring room, and its length."""
    folder = tmp_path_factory.mktemp("flights") / "one"
    return folder, write_flight(folder, (7, 1), HEIGHT, samples=1)


@pytest.mark.slow
def test_a_flight_is_a_pair_with_targets_at_equal_distances(flight: tuple[Path, float]) -> None:
    folder, length = flight
    (pair,) = load_sets(folder)
    context, targets = pair.load_context(HEIGHT), pair.load_targets(HEIGHT)
    start, end = context.cam2world[:, :3, 3]
    shares = (targets.cam2world[:, :3, 3] - start) @ (end - start) / length**2
    assert np.allclose(shares, (0.25, 0.5, 0.75), atol=1e-6)
    assert 1.5 <= length <= 4 and float((end - start).norm()) == pytest.approx(length)
    assert context.masks.all(), "nothing is fixed to the camera"


@pytest.mark.slow
def test_targets_have_depth_and_the_way_is_free(flight: tuple[Path, float]) -> None:
    folder, _ = flight
    (pair,) = load_sets(folder)
    depths = pair.load_targets(HEIGHT).depths
    assert depths is not None and depths.shape == (3, HEIGHT, 2 * HEIGHT)
    assert depths.min() > 0.2 and 0.5 < depths.median() < 10


@pytest.mark.slow
def test_a_complete_flight_is_kept_and_equal_seeds_are_equal(flight: tuple[Path, float], tmp_path: Path) -> None:
    folder, length = flight
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    again = write_flight(tmp_path / "again", (7, 1), HEIGHT, samples=1)
    assert again == length and len(before) == 2 * len(NAMES) + 2
    for name in NAMES:
        assert (tmp_path / "again" / f"{name}.png").read_bytes() == before[f"{name}.png"]
    (folder / "start.png").write_bytes(b"kept")
    assert write_flight(folder, (7, 1), HEIGHT, samples=1) == length
    assert (folder / "start.png").read_bytes() == b"kept"
