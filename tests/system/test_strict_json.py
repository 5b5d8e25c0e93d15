"""The JSON reader refuses what breaks its rules and names the field."""

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import expect_error

from pansplat.system.strict_json import MAX_DEPTH, parse_json, read_json

_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**17), 10**17) | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(exclude_categories=["Cs"])),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(st.characters(exclude_categories=["Cs"])), inner),
    max_leaves=20,
)  # fmt: skip


@given(_VALUES)
def test_valid_values_are_read_as_written(value: Any) -> None:
    assert parse_json(json.dumps(value), "file") == value


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"a": {"b": [1, NaN]}}', r"file, a\.b\[1\]"),
        ('{"a": 1e999}', "file, a:"),
        ("1" * 19, "file:"),
        ('{"a": 1, "a": 2}', "'a' twice"),
        ('["\\ud800"]', r"file, \[0\]"),
        ('{"\\udfff": 1}', "needed valid Unicode"),
        ("[" * (MAX_DEPTH + 1) + "]" * (MAX_DEPTH + 1), f"at most {MAX_DEPTH} levels"),
        ("[" * 1_000_000, "at most"),
        ("{", "line 1, column 2"),
    ],
)
def test_other_texts_are_refused(text: str, message: str) -> None:
    expect_error(message, parse_json, text, "file")


def test_the_deepest_allowed_list_is_read() -> None:
    assert parse_json("[" * MAX_DEPTH + "]" * MAX_DEPTH, "file")


def test_files_have_a_largest_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pansplat.system.strict_json.MAX_BYTES", 10)
    (tmp_path / "a.json").write_text("[1, 2, 3, 4, 5]")
    expect_error(r"a\.json: needed .* of at most 10 bytes, got 15", read_json, tmp_path / "a.json")
