"""For tests: the run-time check of annotated shapes and types, switched on in tests/conftest.py."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from beartype import BeartypeConf, beartype

_F = TypeVar("_F", bound=Callable[..., Any])


def check_types(function: _F) -> _F:
    """Check a function's arguments and result against its annotations; an int will do where a float is named."""
    return beartype(conf=BeartypeConf(is_pep484_tower=True))(function)
