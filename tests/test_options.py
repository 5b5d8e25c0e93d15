"""All numbers of a command line are checked at once, and messages name the option."""

import math
from dataclasses import dataclass, field
from typing import Annotated

import pytest
import tyro

from pansplat.options import REAL, WHOLE, Depth, Height, Range, check_numbers


@dataclass(frozen=True)
class Inner:
    weight: Annotated[float, Range(0, 1, below=True), REAL] = 0.5


@dataclass(frozen=True)
class Options:
    height: Height = 512
    near: Depth | None = None
    heights: tuple[Annotated[int, Range(64, 256, multiple=32), WHOLE], ...] = (64,)
    inner: Inner = field(default_factory=Inner)
    name: str = "x"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--height 63", "--height must be a whole number of 64 to 8192 pixels, got 63"),
        ("--height x", "--height must be a whole number of 64 to 8192 pixels, got x"),
        ("--height -1e5", "--height must be a whole number of 64 to 8192 pixels, got -1e5"),
        ("--near inf", "--near must be a number of 1e-09 to 1000000000 metres, got inf"),
        ("--heights 64 70", "--heights must be a whole number of 64 to 256, a multiple of 32, got 70"),
        ("--inner.weight 1", "--inner.weight must be a number from 0 below 1, got 1"),
    ],
)
def test_a_number_out_of_range_is_refused(arguments: str, message: str) -> None:
    options = tyro.cli(Options, args=arguments.split())
    with pytest.raises(ValueError) as refused:
        check_numbers(options, prefixed=True)
    assert str(refused.value) == message


@pytest.mark.parametrize("arguments", ["", "--height 64", "--near None", "--near 1e-9", "--heights 64 96", "--name 7"])
def test_valid_numbers_are_accepted(arguments: str) -> None:
    check_numbers(tyro.cli(Options, args=arguments.split()), prefixed=True)


def test_ranges_are_described_by_their_ends() -> None:
    assert Range(0, math.inf, "minutes").describe(whole=False) == "a number of at least 0 minutes"
    assert Range(0, 240, above=True).describe(whole=False) == "a number above 0 to 240"
    assert math.nan not in Range(0, math.inf)
