"""Any number of any command may be anything: it is in its range, or the message names the option."""

from __future__ import annotations

import dataclasses
import math
import typing
from collections.abc import Iterator
from importlib import import_module
from typing import Any

import pytest

from pansplat.cli import _COMMANDS
from pansplat.errors import InputError
from pansplat.system.options import check_numbers
from pansplat.training.config import TrainConfig
from pansplat_viewer.app import Options

NUMBERS = (-1, 0, 0.5, 1, 64.0, 10**9, 10**30, 1e300, math.nan, math.inf, True)
COMMANDS = [getattr(import_module(f"pansplat.cli.{name}"), name.title()) for name in _COMMANDS]


def list_kinds(hint: Any) -> list[type]:
    """The dataclasses in an annotation."""
    inner = [kind for part in typing.get_args(hint) for kind in list_kinds(part)]
    return [hint] if isinstance(hint, type) and dataclasses.is_dataclass(hint) else inner


def make_default(kind: type) -> Any:
    """An instance of a command with its default values; options that are needed are None."""
    options, hints = object.__new__(kind), typing.get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        kinds, default = list_kinds(hints[field.name]), field.default_factory
        value = None if field.default is dataclasses.MISSING else field.default
        value = value if default is dataclasses.MISSING else default()
        object.__setattr__(options, field.name, make_default(kinds[0]) if kinds else value)
    return options


def list_numbers(options: Any, prefix: str, prefixed: bool) -> Iterator[tuple[Any, str, str, Any]]:
    """The options that are numbers: their dataclass, field, name and type."""
    for name, hint in typing.get_type_hints(type(options), include_extras=True).items():
        named = [mark.name for mark in getattr(hint, "__metadata__", ()) if getattr(mark, "name", None)]
        option, value = prefix + [name, *named][-1].replace("_", "-"), getattr(options, name)
        if dataclasses.is_dataclass(value):
            yield from list_numbers(value, f"{option}." if prefixed else prefix, prefixed)
        elif "Meta(" in str(hint):
            yield options, name, option, hint
        else:
            assert hint not in (int, float, int | None, float | None), option  # each number has a range


def fill(hint: Any, value: Any) -> Any:
    """A value of an option; of several numbers all are the same."""
    kinds = typing.get_args(hint)
    if typing.get_origin(hint) is tuple:
        return (value,) * (1 if ... in kinds else len(kinds))
    return fill(kinds[0], value) if type(None) in kinds else value


SUITES = list_kinds(typing.get_type_hints(COMMANDS[_COMMANDS.index("bench")], include_extras=True)["what"])


@pytest.mark.parametrize("kind", [*COMMANDS, *SUITES, TrainConfig, Options], ids=lambda kind: kind.__name__)
def test_a_number_of_a_command_is_in_its_range_or_the_message_names_the_option(kind: type) -> None:
    options = make_default(kind)
    for holder, name, option, hint in list(list_numbers(options, "--", kind is TrainConfig)):
        default = getattr(holder, name)
        for value in NUMBERS:
            object.__setattr__(holder, name, fill(hint, value))
            is_number = not isinstance(value, bool) and not math.isnan(value)
            try:
                check_numbers(options, prefixed=kind is TrainConfig)
                assert is_number and (abs(value) < 1e13 or option in ("--optimizer.clip", "--checkpoint.minutes"))
            except InputError as error:
                assert str(error).startswith(option)
        object.__setattr__(holder, name, default)
