"""The JSON reader of the project: bounded size and depth, finite numbers, and values of the types of msgspec.

A file from elsewhere may be nested without end, repeat a key, or hold numbers that no type of the machine holds. All of
this is an error that names the file and the field, as is a value of another type or out of the range of its type.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from pansplat.errors import InputError
from pansplat.system.files import read_file

MAX_BYTES = 1 << 28  # bytes of the largest file that is read
MAX_DEPTH = 32  # deepest nesting of lists and objects
MAX_DIGITS = 18  # largest length of a whole number, which then fits 64 bits

_QUOTED = 60  # part of a wrong value that a message quotes
_TYPE_WORDS = {
    "int": "a whole number", "float": "a number", "str": "a text", "bool": "true or false", "array": "a list",
    "object": "an object {...}", "Tensor": "a tensor",
}  # fmt: skip


def read_json(path: Path, kind: Any = Any) -> Any:
    """The content of a JSON file in UTF-8 as a type of msgspec; an InputError as of `parse_json`, or if unreadable."""
    data = read_file(path, limit=MAX_BYTES)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: needed JSON text in UTF-8, got another encoding; save it as UTF-8.") from error
    return convert(parse_json(text, path), kind, path)


def parse_json(text: str, source: object) -> Any:
    """The content of a JSON text: at most `MAX_DEPTH` levels, no repeated key, finite numbers, valid Unicode.

    Args:
        source: the file that error messages name.
    """

    def as_object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        content = dict(pairs)
        if len(content) < len(pairs):
            seen: set[str] = set()
            key = next(key for key, _ in pairs if key in seen or seen.add(key))
            raise InputError(f"{source}: needed each key once, got {key!a:.{_QUOTED}} twice; remove one.")
        return content

    def as_whole(digits: str) -> float:
        return int(digits) if len(digits.lstrip("-")) <= MAX_DIGITS else math.inf

    try:
        value = json.loads(text, parse_int=as_whole, parse_constant=lambda _: math.nan, object_pairs_hook=as_object)
    except json.JSONDecodeError as error:
        raise InputError(
            f"{source}: needed JSON, got invalid text at line {error.lineno}, column {error.colno} "
            f"({error.msg}); correct it there."
        ) from error
    except RecursionError as error:
        raise InputError(f"{source}: needed JSON of at most {MAX_DEPTH} levels, got more; correct it.") from error
    _check(value, source)
    return value


def _check(value: Any, source: object) -> None:
    """Check depth, numbers and strings. Iterative: a recursion over a foreign value may overflow the stack."""
    pending: list[tuple[Any, str, int]] = [(value, "", 0)]  # value, name, depth of nesting
    while pending:
        value, name, depth = pending.pop()
        if depth >= MAX_DEPTH and isinstance(value, (dict, list)):
            raise InputError(f"{source}: needed JSON of at most {MAX_DEPTH} levels, got more; correct it.")
        if isinstance(value, dict):
            pending += [(item, f"{name}.{key}", depth + 1) for key, item in value.items()]
            value = "".join(value)
        elif isinstance(value, list) and not all(type(item) is float and math.isfinite(item) for item in value):
            pending += [(item, f"{name}[{index}]", depth + 1) for index, item in enumerate(value)]
        if isinstance(value, float) and not math.isfinite(value):
            needed = f"a finite number of at most {MAX_DIGITS} digits, got NaN or infinite numbers, or too many digits"
            raise InputError(f"{_locate(source, name)}: needed {needed}; correct it.")
        if isinstance(value, str) and value.encode(errors="replace").decode() != value:
            raise InputError(f"{_locate(source, name)}: needed valid Unicode, got {value!a:.{_QUOTED}}; correct it.")


def _locate(source: object, name: str) -> str:
    return f"{source}, {name.removeprefix('.')}" if name else str(source)


def convert(value: Any, kind: Any, source: object, *, strict: bool = True) -> Any:
    """A value of JSON, or of a command line, as a type of msgspec, such as a `Struct` with `Meta(ge=, le=)`.

    Args:
        source: the file or option that messages name.
        strict: whether a text is no number.
    """
    try:
        return msgspec.convert(value, kind, strict=strict, dec_hook=lambda kind, content: kind(content))  # a Path
    except UnicodeEncodeError as error:
        raise InputError(f"{source}: needed valid Unicode, got {error.object!a:.{_QUOTED}}; correct it.") from error
    except msgspec.ValidationError as error:
        found = re.fullmatch(r"(.*?)(?: - at (?:`key` in )?`\$(.*)`)?", str(error), re.DOTALL)
        problem, path = found[1], found[2] or ""
        for key, index in re.findall(r"\.([^.\[]+)|\[(\d+)\]", path):
            value = value[key or int(index)] if "[...]" not in path else value
        where = _locate(source, path)
        if field := re.match("Object (missing|contains unknown).*`(.*)`", problem):
            name, is_missing = repr(field[2]), field[1] == "missing"
            problem = f"the field {name}, got none; add" if is_missing else f"only known fields, got {name}; correct"
            raise InputError(f"{where}: needed {problem} it.") from error
        if not re.match("Expected|Invalid|Number out", problem):  # a message of our own, from a `__post_init__`
            raise InputError(f"{where}: {problem}; correct it.") from error
        problem = re.sub(r"`(.+?)`", lambda m: " or ".join(_TYPE_WORDS.get(w, w) for w in m[1].split(" | ")), problem)
        problem = re.sub(", got .*", "", problem).replace("Expected", "needed")
        problem = re.sub("^(Invalid|Number).*", "needed a known value", problem)
        raise InputError(f"{where}: {problem}, got {value!r:.{_QUOTED}}; correct it.") from error


def read_field(content: Mapping[str, Any], key: str, kind: Any, source: object, default: Any = None) -> Any:
    """A field of an object as a type of msgspec; the default if it is missing or null."""
    value = content.get(key)
    return default if value is None else convert(value, kind, f"{source}, {key}")
