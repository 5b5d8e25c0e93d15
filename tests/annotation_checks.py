"""Run-time checks of annotated shapes and types, enabled in conftest.py."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable
from typing import Any, TypeVar

from beartype import BeartypeConf, beartype

_F = TypeVar("_F", bound=Callable[..., Any])
_CHECKED_CALLS = 10  # of each function in each test; checks of thousands of small tiles take longer than the tests

_calls: Counter[Callable[..., Any]] = Counter()


def check_types(function: _F) -> _F:
    """Check arguments and result of a function's first calls against its annotations; an int is accepted as a float."""

    @functools.cache
    def checked() -> _F:  # made at the first call: most functions are not called by a worker's tests
        return beartype(conf=BeartypeConf(is_pep484_tower=True))(function)

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        _calls[function] += 1
        return (checked() if _calls[function] <= _CHECKED_CALLS else function)(*args, **kwargs)

    return call  # pyright: ignore[reportReturnType]


def restart_checks() -> None:
    """Check the next calls of every function again."""
    _calls.clear()
