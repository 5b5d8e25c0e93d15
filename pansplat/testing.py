"""Run-time checks of annotated shapes and types, enabled in tests/conftest.py."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from beartype import BeartypeConf, beartype

_F = TypeVar("_F", bound=Callable[..., Any])


def check_types(function: _F) -> _F:
    """Check arguments and result of a function against its annotations; an int is accepted as a float."""
    return beartype(conf=BeartypeConf(is_pep484_tower=True))(function)
