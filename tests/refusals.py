"""A call that must be refused."""

from collections.abc import Callable
from typing import Any

import pytest

from pansplat.errors import InputError


def expect_error(match: str, call: Callable[..., Any], *arguments: Any, **options: Any) -> None:
    """The call must raise an InputError in whose message the pattern is found."""
    with pytest.raises(InputError, match=match):
        call(*arguments, **options)
