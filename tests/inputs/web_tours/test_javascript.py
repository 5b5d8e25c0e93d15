"""Object literals are read as JavaScript reads them; nothing is run, and damaged text gives an error with its line."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import expect_error

from pansplat.inputs.web_tours.javascript import parse_literal

_JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**9), 10**9) | st.floats(-1e9, 1e9) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=10,
)


def parse(text: str) -> object:
    return parse_literal(text, 0, "tour.html")[0]


@given(_JSON, st.sampled_from((None, 2)))
def test_json_is_read_as_json(value: object, indent: int | None) -> None:
    assert parse(json.dumps(value, indent=indent) + ";") == value


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("{a: 1, $b_2: 'x', \"c\": `y`,}", {"a": 1, "$b_2": "x", "c": "y"}),
        ("[1, .5, +2, -3e2, 0x1F, 4.]", [1, 0.5, 2, -300, 31, 4]),
        ("{/* a: 2 } */ a: 1 // b: 2,\n, c: 3}", {"a": 1, "c": 3}),
        (r"""{a: 'it\'s \u00e9\x41\u{1F600}\
!'}""", {"a": "it's \u00e9A\U0001f600!"}),
        ("{a: true, b: false, c: null, d: undefined}", {"a": True, "b": False, "c": None, "d": None}),
        ("{12: 'x', 'y z': []}", {"12": "x", "y z": []}),
    ],
)  # fmt: skip
def test_literals_beyond_json_are_read(text: str, value: object) -> None:
    assert parse(text) == value


@pytest.mark.parametrize(
    "code",
    [
        "function () { return {a: '}'} }",
        "(e) => { alert(1, '\\'', \"}\") }",
        "run(1, [2, {b: 3}])",
        "'a' + b",
        "-x",
        "new Date()",
        "1 + 2",
        "cond ? {x: 1} : [2]",
    ],
)
def test_code_is_skipped(code: str) -> None:
    assert parse(f"{{a: {code}, b: 2, c() {{ return 1 }}, d}}") == {"a": None, "b": 2}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{a: 1,\n b: ", "the end of an object at line 2"),
        ("{a: 'x", "the end of a text at line 1"),
        ("{\n\n: 1}", "a key at line 3, got ': 1}'"),
        ("{a: [1, 2}", "a value or ] at line 1, got }"),
        ("{a: 1]", "a key at line 1, got ']'"),
        ("{a: /* x", "the end of a comment at line 1"),
        ("[" * 5000, "at most 32 levels"),
        ("{a: f(" + "(" * 5000, "the end of an object"),
    ],
)
def test_damaged_text_is_refused(text: str, message: str) -> None:
    expect_error(f"tour.html: needed {message}", parse, text)
