"""The JSON reader of the project: bounded size and depth, finite numbers, typed fields.

A file from elsewhere may be nested without end, repeat a key, or hold numbers that no type of the machine holds. All of
this is an error that names the file and the field. The functions that read single fields check type and range.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pansplat.errors import InputError
from pansplat.files import read_file

MAX_BYTES = 1 << 28
MAX_DEPTH = 32  # levels of lists and objects
MAX_DIGITS = 18  # of a whole number, which then fits 64 bits

_SHOWN = 60  # characters of a value in a message


def read_json(path: Path) -> Any:
    """The content of a JSON file in UTF-8.

    Raises:
        InputError: unreadable, not JSON (the message gives the line), or against a rule of `parse_json`.
    """
    data = read_file(path, limit=MAX_BYTES)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: needed JSON text in UTF-8, got another encoding; save it as UTF-8.") from error
    return parse_json(text, path)


def parse_json(text: str, source: object) -> Any:
    """The content of a JSON text: at most `MAX_DEPTH` levels, no repeated key, finite numbers, valid Unicode.

    Args:
        source: the file that error messages name.

    Raises:
        InputError: invalid text, or against one of these rules; the message names the field.
    """
    try:
        value = json.loads(
            text, parse_int=_parse_whole, parse_constant=lambda name: math.nan, object_pairs_hook=_Object.of
        )
    except json.JSONDecodeError as error:
        raise InputError(
            f"{source}: needed JSON, got invalid text at line {error.lineno}, column {error.colno} "
            f"({error.msg}); correct it there."
        ) from error
    except RecursionError as error:
        raise InputError(
            f"{source}: needed JSON of at most {MAX_DEPTH} levels, got deeper lists; correct it."
        ) from error
    _check(value, source)
    return value


class _Object(dict[str, Any]):
    """An object of a JSON text, with the first repeated key."""

    repeated: str | None = None

    @staticmethod
    def of(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        content = dict(pairs)
        if len(content) == len(pairs):
            return content
        content, seen = _Object(content), set()
        content.repeated = next(key for key, _ in pairs if key in seen or seen.add(key))
        return content


def _parse_whole(text: str) -> float:
    """A whole number; infinity if it has too many digits, so that the check reports it."""
    return int(text) if len(text.lstrip("-")) <= MAX_DIGITS else math.inf


def _check(value: Any, source: object) -> None:
    """Check depth, keys, numbers and strings. Iterative: a recursion over a foreign value may overflow the stack."""
    pending: list[tuple[Any, Any, int]] = [(value, None, 0)]  # value, (parent, key), depth
    while pending:
        value, path, depth = pending.pop()
        if depth >= MAX_DEPTH and isinstance(value, (dict, list)):
            raise InputError(f"{source}: needed JSON of at most {MAX_DEPTH} levels, got deeper lists; correct it.")
        if isinstance(value, dict):
            if isinstance(value, _Object):
                raise InputError(f"{source}: needed each key once, got {value.repeated!r:.{_SHOWN}} twice; remove one.")
            for key, item in value.items():
                _check_text(key, source, path)
                pending.append((item, (path, key), depth + 1))
        elif isinstance(value, list):
            if all(type(item) is float for item in value) and math.isfinite(math.fsum(map(_bounded, value))):
                continue
            pending += [(item, (path, index), depth + 1) for index, item in enumerate(value)]
        elif isinstance(value, float):
            if not math.isfinite(value):
                raise InputError(
                    f"{source}{_name(path)}: needed a finite number of at most {MAX_DIGITS} digits, got NaN or "
                    "infinite numbers, or too many digits; correct it."
                )
        elif isinstance(value, str):
            _check_text(value, source, path)


def _bounded(value: float) -> float:
    """0 for finite numbers, so that a sum shows whether all are finite."""
    return value - value


def _check_text(text: str, source: object, path: Any) -> None:
    if text.isascii():
        return
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise InputError(
            f"{source}{_name(path)}: needed valid Unicode text, got {text!a:.{_SHOWN}}; correct it."
        ) from error


def _name(path: Any) -> str:
    """The name of a field in messages, such as `, poses.left.jpg[0]`."""
    parts = []
    while path is not None:
        path, key = path
        parts.append(f"[{key}]" if isinstance(key, int) else f".{key}")
    name = "".join(reversed(parts)).removeprefix(".")
    return f", {name}" if name else ""


def require_object(value: Any, source: object) -> dict[str, Any]:
    """The value, which must be a JSON object, else an InputError."""
    if not isinstance(value, dict):
        raise InputError(f"{source}: needed a JSON object {{...}}, got {_shorten(value)}; correct it.")
    return value


def number_field(
    content: Mapping[str, Any],
    key: str,
    source: object,
    *,
    low: float = -math.inf,
    high: float = math.inf,
    whole: bool = False,
    needed: str = "a number",
) -> float | None:
    """An optional number of a JSON object; None if it is missing or null.

    Args:
        low, high: allowed range, inclusive.
        whole: whether it must be a whole number.
        needed: what was needed, for messages.

    Raises:
        InputError: the value is not a number, or out of range.
    """
    value = content.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or (whole and value != int(value)):
        raise InputError(f'{source}: needed {needed} as "{key}", got {_shorten(value)}; correct it.')
    if not low <= value <= high:
        raise InputError(f'{source}: needed {needed} of {low:g} to {high:g} as "{key}", got {value:g}; correct it.')
    return int(value) if whole else float(value)


def text_field(content: Mapping[str, Any], key: str, source: object) -> str | None:
    """An optional text of a JSON object; None if it is missing or null; an InputError for another type."""
    value = content.get(key)
    if value is not None and not isinstance(value, str):
        raise InputError(f'{source}: needed a text as "{key}", got {_shorten(value)}; correct it.')
    return value


def list_field(content: Mapping[str, Any], key: str, source: object) -> list[Any]:
    """A list of a JSON object; empty if it is missing or null; an InputError for another type."""
    value = content.get(key)
    if value is not None and not isinstance(value, list):
        raise InputError(f'{source}: needed a list as "{key}", got {_shorten(value)}; put [ ] around it.')
    return value or []


def _shorten(value: Any) -> str:
    return f"{value!r:.{_SHOWN}}"
