"""Types of the numbers on command lines, and one check of all of them.

An option has a type such as `Height`, an integer with a range. `check_numbers` refuses a number out of range, with one
line that names the option, before anything is loaded.
"""

from __future__ import annotations

import contextlib
import dataclasses
import typing
from typing import Annotated, Any

from msgspec import Meta
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from pansplat.system.strict_json import convert

CAMERA_HEIGHT = 1.5  # metres over the floor, if it is not known; tripods of tours stand at 1.3 to 1.6 m
EYE_DISTANCE = 0.063  # metres between the eyes, the mean of adults
MIN_HEIGHT, MAX_HEIGHT = 64, 8192  # rows of panoramas that are predicted from

Height = Annotated[int, Meta(ge=MIN_HEIGHT, le=MAX_HEIGHT)]
"""Height of panoramas to predict from, pixels."""
ImageHeight = Annotated[int, Meta(ge=2, le=MAX_HEIGHT)]
"""Height of an image to draw, pixels."""
Count = Annotated[int, Meta(ge=1, le=10**9)]
CountOrNone = Annotated[int, Meta(ge=0, le=10**9)]
"""A number of things; 0 for none."""
Threads = Annotated[int, Meta(ge=1, le=1024)]
Seed = Annotated[int, Meta(ge=0, le=2**32 - 1)]
EyeDistance = Annotated[float, Meta(gt=0, le=1)]
"""Distance of the eyes, metres."""
Depth = Annotated[float, Meta(ge=1e-9, le=1e9)]
"""A distance, metres."""
Minutes = Annotated[float, Meta(ge=0)]
Fraction = Annotated[float, Meta(ge=0, lt=1)]
Positive = Annotated[float, Meta(gt=0, le=1e9)]
Real = Annotated[float, Meta(ge=-1e12, le=1e12)]
Weight = Annotated[float, Meta(ge=0, le=1e9)]


def check_numbers(options: Any, *, prefixed: bool = False, prefix: str = "--") -> None:
    """Check all numbers of a command's options.

    Args:
        options: a dataclass; its fields may be dataclasses.
        prefixed: whether an option of a nested dataclass has the name of its field as a prefix, as in
            `--optimizer.steps`.
        prefix: the start of the names of the options.
    """
    hints = typing.get_type_hints(type(options), include_extras=True)
    for name, hint in hints.items():
        named = (getattr(mark, "name", None) for mark in getattr(hint, "__metadata__", ()))
        value, option = getattr(options, name), prefix + next(filter(None, named), name).replace("_", "-")
        if dataclasses.is_dataclass(value):
            check_numbers(value, prefixed=prefixed, prefix=f"{option}." if prefixed else prefix)
        elif "Meta(" in str(hint):
            convert(value, hint, option)


NUMBERS = ConstructorRegistry()
"""How numbers of command lines are parsed; a text that is no number stays a text, which `check_numbers` refuses."""


@NUMBERS.primitive_rule
def _parse_number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    def parse(words: list[str]) -> Any:
        if words[0] == "None":
            raise ValueError("no number")  # None, for an optional number that is not given
        for kind in (info.type, float):
            with contextlib.suppress(ValueError):
                return kind(words[0])
        return words[0]

    if info.type not in (int, float):
        return None
    return PrimitiveConstructorSpec(1, info.type.__name__.upper(), parse, _is_number, lambda value: [str(value)])


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)
