"""All numbers of a command line are checked at once, and messages name the option (see test_command_numbers.py)."""

from dataclasses import dataclass, field
from typing import Annotated

import pytest
import tyro
from msgspec import Meta

from pansplat.system.options import Depth, Height, check_numbers


@dataclass(frozen=True)
class Inner:
    weight: Annotated[float, Meta(ge=0, lt=1)] = 0.5


@dataclass(frozen=True)
class Options:
    height: Height = 512
    near: Depth | None = None
    heights: tuple[Annotated[int, Meta(ge=64, le=256, multiple_of=32)], ...] = (64,)
    inner: Inner = field(default_factory=Inner)
    name: str = "x"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--height 63", "--height: needed a whole number >= 64, got 63; correct it."),
        ("--near inf", "--near: needed a number <= 1000000000.0, got inf; correct it."),
        ("--heights 64 70", "--heights, [1]: needed a whole number that's a multiple of 32, got 70; correct it."),
        ("--inner.weight 1", "--inner.weight: needed a number < 1.0, got 1.0; correct it."),
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
