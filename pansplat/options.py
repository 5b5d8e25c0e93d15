"""Types of the numbers on command lines, and one check of all of them.

An option has a type such as `Height`, an integer with a range. The parser accepts any text for it; `check_numbers`
refuses what is no number or out of range, with one line that names the option, before anything is loaded.
"""

from __future__ import annotations

import dataclasses
import math
import typing
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated, Any

from tyro.constructors import PrimitiveConstructorSpec

from pansplat.errors import InputError

EYE_DISTANCE = 0.063  # metres, the mean of adults
MIN_HEIGHT, MAX_HEIGHT = 64, 8192  # pixels, of panoramas that are predicted from


@dataclass(frozen=True)
class Range:
    """The allowed values of an option: from `low` to `high`, inclusive.

    Attributes:
        unit: for messages, such as "pixels".
        above: whether `low` itself is refused.
        below: whether `high` itself is refused.
        multiple: the number must be a multiple of this one.
    """

    low: float
    high: float
    unit: str = ""
    above: bool = False
    below: bool = False
    multiple: int = 1

    def __contains__(self, value: float) -> bool:
        inside = self.low < value if self.above else self.low <= value
        inside = inside and (value < self.high if self.below else value <= self.high)
        return inside and (self.multiple == 1 or value % self.multiple == 0)

    def describe(self, *, whole: bool) -> str:
        """What is needed, for messages, such as "a whole number of 64 to 8192 pixels"."""
        kind = "a whole number" if whole else "a number"
        multiple = f", a multiple of {self.multiple}" if self.multiple > 1 else ""
        low = f"above {self.low:.10g}" if self.above else f"{self.low:.10g}"
        if self.high == math.inf:
            bounds = f" {low}" if self.above else f" of at least {low}"
        elif self.below or self.above:
            bounds = f" {low if self.above else 'from ' + low} {'below' if self.below else 'to'} {self.high:.10g}"
        else:
            bounds = f" of {low} to {self.high:.10g}"
        return f"{kind}{bounds}{' ' + self.unit if self.unit else ''}{multiple}"


class _Unreadable(str):
    """A text of the command line that is not a number."""


def _make_spec(convert: Callable[[str], float], metavar: str) -> PrimitiveConstructorSpec[Any]:
    """A parser of a number that never fails; `check_numbers` reports what is no number."""

    def parse(words: list[str]) -> float | _Unreadable:
        if words[0] == "None":
            raise ValueError("no number")  # an optional number is absent
        try:
            return convert(words[0])
        except (ValueError, OverflowError):
            return _Unreadable(words[0])

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=parse,
        is_instance=lambda value: isinstance(value, (int, float)) and not isinstance(value, bool),
        str_from_instance=lambda value: [str(value)],
    )


WHOLE, REAL = _make_spec(int, "INT"), _make_spec(float, "FLOAT")
"""How the parser of arguments reads a number."""

Height = Annotated[int, Range(MIN_HEIGHT, MAX_HEIGHT, "pixels"), WHOLE]
"""Height of panoramas to predict from."""
ImageHeight = Annotated[int, Range(2, MAX_HEIGHT, "pixels"), WHOLE]
"""Height of an image to draw."""
Count = Annotated[int, Range(1, 1e9), WHOLE]
CountOrNone = Annotated[int, Range(0, 1e9), WHOLE]
"""A number of things; 0 for none."""
Threads = Annotated[int, Range(1, 1024), WHOLE]
Seed = Annotated[int, Range(0, 2**32 - 1), WHOLE]
EyeDistance = Annotated[float, Range(0, 1, "metres", above=True), REAL]
Depth = Annotated[float, Range(1e-9, 1e9, "metres"), REAL]
Seconds = Annotated[float, Range(0, 1e6, "seconds"), REAL]
"""A time limit; 0 for none."""
Minutes = Annotated[float, Range(0, math.inf, "minutes"), REAL]
Fraction = Annotated[float, Range(0, 1, below=True), REAL]
Positive = Annotated[float, Range(0, 1e9, above=True), REAL]
Real = Annotated[float, Range(-1e12, 1e12), REAL]
Weight = Annotated[float, Range(0, 1e9), REAL]


def check_numbers(options: Any, *, prefixed: bool = False) -> None:
    """Check all numbers of a command's options.

    Args:
        options: a dataclass; its fields may be dataclasses.
        prefixed: whether an option of a nested dataclass has the name of its field as a prefix, as in
            `--optimizer.steps`.

    Raises:
        InputError: a number is missing its range; the message names the option.
    """
    for name, hint, value in _list_fields(options):
        option = name.replace("_", "-")
        if dataclasses.is_dataclass(value):
            try:
                check_numbers(value, prefixed=prefixed)
            except OptionError as error:
                raise OptionError(f"{option}.{error.option}" if prefixed else error.option, error.problem) from None
            continue
        found = _find_range(hint)
        for item in value if isinstance(value, tuple) else (value,):
            if found is not None and item is not None:
                _check_number(option, item, *found)


class OptionError(InputError):
    """An option of a command line with a value that cannot be used."""

    def __init__(self, option: str, problem: str) -> None:
        super().__init__(f"--{option} {problem}")
        self.option, self.problem = option, problem


def _list_fields(options: Any) -> Iterator[tuple[str, Any, Any]]:
    """Name, annotation and value of each field."""
    hints = typing.get_type_hints(type(options), include_extras=True)
    for field in dataclasses.fields(options):
        yield field.name, hints[field.name], getattr(options, field.name)


def _find_range(hint: Any) -> tuple[Range, bool] | None:
    """The range in an annotation, also of an optional or repeated number, and whether the number is whole."""
    metadata = getattr(hint, "__metadata__", ())
    for entry in metadata:
        if isinstance(entry, Range):
            return entry, WHOLE in metadata
    return next((found for inner in typing.get_args(hint) if (found := _find_range(inner))), None)


def _check_number(option: str, value: object, allowed: Range, whole: bool) -> None:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not is_number or (whole and not isinstance(value, int)) or value not in allowed:
        got = f"{value:.10g}" if isinstance(value, float) else f"{value!s:.40}"
        raise OptionError(option, f"must be {allowed.describe(whole=whole)}, got {got}")
