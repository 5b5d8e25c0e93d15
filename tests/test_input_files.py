"""Any file may be damaged, and any part of it anything: it is read, or the message names the file and the part."""

from __future__ import annotations

import copy
import os
import random
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from input_files import DOCUMENTS, FILES, IN_PART, InputFile

from pansplat.errors import InputError

pytestmark = pytest.mark.filterwarnings("ignore")
TOKENS = (b"0", b"-1", b"1e999", b"NaN", b"9" * 25, b"1e30", b"null", b"[", b"{", b'"', b"true", b"\xff", b"\\ud800")
VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 7, 0.5, 1e300, 10**400, float("nan"), "", "x", "../x", [], {}, [[1, 2], [3]], {"a": 1}, [None],
)  # fmt: skip
OF_WHOLE = "no Gaussians|one length|accessor|another file|spherical|another content|its pictures|frame .:|png'"
OF_WHOLE += "|its . cameras|must be|settings of a|needed the attribute"
OF_WHOLE += r"|(frame|pose|number) \d|pose.json: needed a|'.*\b[ab]\b"
"""Of messages about values that contradict each other or leave nothing, or about a picture, pose or accessor."""


def is_named(file: InputFile, message: str) -> bool:
    return file.path.name in message or (file.companion != "" and file.companion in message)


def attempt(file: InputFile, content: bytes) -> str | None:
    """Read other content; returns the message of the error or the notes, or None if all is read."""
    file.path.write_bytes(content)
    try:
        return file.read(file.path) or None
    except InputError as error:
        assert len(str(error)) < 4000 and is_named(file, str(error)), (content[:300], error)
        return str(error)


def flip(data: bytes, rng: random.Random) -> bytes:
    """The data with some bytes changed, cut, repeated, or replaced by a hostile token."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8))):
        at = rng.randrange(max(1, len(changed)))
        how = rng.randrange(6)
        if how < 2 and changed:
            changed[at] ^= 1 << rng.randrange(8)
        elif how == 2 and changed:
            changed[at] = rng.choice((0, 255, 127, 128))
        elif how == 3:
            changed[at : at + rng.randrange(1, 9)] = rng.choice(TOKENS)
        elif how == 4:
            del changed[at : at + rng.randrange(1, 65)]
        else:
            changed[at:at] = changed[at : at + rng.randrange(1, 65)]
    return bytes(changed)


@pytest.mark.parametrize("count", [15, pytest.param(2000, marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize("name", FILES)
def test_a_damaged_file_is_read_or_named(name: str, count: int, tmp_path: Path) -> None:
    file, rng = FILES[name](tmp_path), random.Random(name)
    content = file.path.read_bytes()
    assert attempt(file, content) is None
    refused = sum(attempt(file, flip(content, rng)) is not None for _ in range(count))
    assert refused or name == "scene comment", "a reader that accepts all damage reads nothing"


@pytest.mark.parametrize("name", FILES)
def test_a_file_that_is_cut_is_read_or_named_and_refused_where_its_length_is_known(name: str, tmp_path: Path) -> None:
    file = FILES[name](tmp_path)
    content = file.path.read_bytes()
    for end in (0, 1, 3, len(content) // 3, len(content) // 2 + 1, 2 * len(content) // 3, len(content) - file.idle - 1):
        assert attempt(file, content[:end]) is not None or file.has_cuts, end


OTHERS = [
    *(b"", b"[]", b"5", b'"a"', b"null", b"true", b"1e999", b"NaN", b"[" * 100_000, b"[" * 100 + b"]" * 100),
    *(b'{"a": ' * 30 + b"1" + b"}" * 30, b'{"\\ud800": 1}', b'{"a\\u0000.png": 1}', b'{"a.png": 1, "a.png": 2}'),
    *("{}".encode("utf-16"), bytes(range(256)), bytes(300), b"{"),
]


@pytest.mark.parametrize("name", FILES)
def test_a_file_of_other_content_is_named(name: str, tmp_path: Path) -> None:
    file = FILES[name](tmp_path)
    for content in OTHERS:
        message = attempt(file, content)
        assert is_named(file, message or "") or not file.is_recognised(), content[:30]


@pytest.mark.parametrize("name", [name for name in FILES if name.startswith("room")])
def test_a_file_that_is_too_large_is_named_and_not_read(name: str, tmp_path: Path) -> None:
    file = FILES[name](tmp_path)
    os.truncate(file.path, 1 << 32)  # without blocks on the disk
    try:
        message = file.read(file.path)
    except InputError as error:
        message = str(error)
    is_tour = file.path.name in ("tour.json", "data.js")  # as if it were none
    assert is_tour or re.search(rf"{file.path.name}.* of at most [\d,]+ bytes, got 4,294", message)


def list_parts(document: Any, keys: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The path of each value in nested lists and objects."""
    items = (
        document.items() if isinstance(document, dict) else enumerate(document) if isinstance(document, list) else ()
    )
    for key, value in items:
        yield (*keys, key)
        yield from list_parts(value, (*keys, key))


def change(document: Any, keys: tuple[Any, ...], value: Any) -> Any:
    """A copy with another value at a path."""
    changed = holder = copy.deepcopy({"": document})
    for key in ("", *keys)[:-1]:
        holder = holder[key]
    holder[("", *keys)[-1]] = value
    return changed[""]


def require_named(keys: tuple[Any, ...], message: str) -> None:
    names = [part.replace("_", " ") if isinstance(part, str) else f"[{part}]" for part in keys]
    assert any(name in message.replace("_", " ") for name in names) or re.search(OF_WHOLE, message), (keys, message)


@pytest.mark.parametrize("name", DOCUMENTS)
def test_any_other_value_is_read_or_its_field_is_named(name: str, tmp_path: Path) -> None:
    file, rng, refused = FILES[name](tmp_path), random.Random(name), 0
    parts = list(list_parts(file.document))
    for keys in rng.sample(parts, min(len(parts), 40)):
        for value in ({"odd": []}, "odd", *rng.sample(VALUES, 3)):
            message = attempt(file, file.pack(change(file.document, keys, value)))
            refused += message is not None
            if message is not None and not (message.startswith(IN_PART) and is_named(file, message)):
                require_named(keys, message)
    assert refused > 5
