"""Game maps that nothing is ever trained on or chosen by: figures of quality are measured on them.

Maps are split by family, since the maps of one share rooms; of hydronex2 the elder hydronex is left out too.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

from pansplat.errors import InputError

_T = TypeVar("_T")

RESERVED = frozenset(
    {
        *("oa_minia", "oa_koth1", "mictf1beta", "hydronex", "hydronex2", "sleekgrinder", "pul1duel-oa", "oacmpdm1"),
        *("oa_shouse", "strength", "bleach"),
    }
)
"""Names of maps; their triplets are called NAME_NUMBER."""

_NUMBER = re.compile(r"(_\d+)+$")


def is_reserved(name: str) -> bool:
    """Whether a triplet of that name is of a reserved map."""
    return name.lower() in RESERVED or _NUMBER.sub("", name.lower()) in RESERVED


def without_reserved(items: Iterable[_T], name_of: Callable[[_T], str], folder: Path) -> list[_T]:
    """What may be trained on; a warning tells how many were left out.

    Raises:
        InputError: nothing is left.
    """
    given = list(items)
    kept = [item for item in given if not is_reserved(name_of(item))]
    if given and not kept:
        raise InputError(
            f"{folder}: needed something to train on, got {len(given)} triplets of reserved maps only "
            f"({', '.join(sorted(RESERVED))}), which are for evaluation; take other maps."
        )
    if len(kept) < len(given):
        warnings.warn(
            f"{folder}: {len(given) - len(kept)} of {len(given)} triplets are of maps reserved for evaluation, and "
            "are left out.",
            stacklevel=3,
        )
    return kept
