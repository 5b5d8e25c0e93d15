"""Object literals of JavaScript as Python values. Nothing is run: what is no literal is refused or skipped.

Accepted beyond JSON, as in JSON5 (https://spec.json5.org): keys without quotes, quotes ' and `, comments, trailing
commas, numbers such as +1, .5 and 0xff, and `undefined`. A value of another kind, such as a function or a call, is
skipped and becomes None.
"""

from __future__ import annotations

import re
from typing import Any

from pansplat.errors import InputError
from pansplat.system.strict_json import MAX_DEPTH

_TEXT = "|".join(rf"{quote}[^{quote}\\]*(?:\\.[^{quote}\\]*)*{quote}" for quote in "'\"`")
_NUMBER = r"[+-]?(?:0[xX][0-9a-fA-F]{1,12}|(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d{1,3})?)(?![\w$.(])"
_TOKEN = re.compile(  # a token and the white space and comments before it
    r"(?:\s+|//[^\n]*|/\*.*?\*/)*"
    rf"(?:(?P<text>{_TEXT})|(?P<number>{_NUMBER})|(?P<name>[^\W\d][\w$]*|\$[\w$]*)|(?P<mark>[\w$]+|.)|(?P<end>\Z))",
    re.DOTALL,
)
_ESCAPE = re.compile(r"\\(?:u([0-9a-fA-F]{4})|u\{([0-9a-fA-F]{1,6})\}|x([0-9a-fA-F]{2})|(\r\n|.))", re.DOTALL)
_CONTROLS = dict(zip("ntrbfv0", "\n\t\r\b\f\v\0", strict=True)) | dict.fromkeys(("\n", "\r", "\r\n"), "")
_WORDS = {"true": True, "false": False, "null": None, "undefined": None}
_CLOSING = {"(": ")", "[": "]", "{": "}"}


def parse_literal(text: str, start: int, source: object) -> tuple[Any, int]:
    """The literal that begins at a position of a text, and the position of the token after it.

    Args:
        source: the file that error messages name.
    """
    parser = _Parser(text, start, source)
    return parser.read_value(0), parser.start


class _Parser:
    """Reads a token ahead: its kind, text, start and end."""

    def __init__(self, text: str, position: int, source: object) -> None:
        self._text, self._end, self._source = text, position, source
        self._advance()

    def _advance(self) -> None:
        found = _TOKEN.match(self._text, self._end)
        assert found is not None and found.lastgroup is not None
        self._kind, self._token = found.lastgroup, found[found.lastgroup]
        self.start, self._end = found.span(found.lastgroup)

    def read_value(self, depth: int) -> Any:
        if depth >= MAX_DEPTH:
            raise self._fail(f"at most {MAX_DEPTH} levels of lists and objects", "more")
        self._require_token()
        kind, token = self._kind, self._token
        if token == "{":
            return self._read_object(depth)
        if token == "[":
            return self._read_list(depth)
        if kind != "mark":
            self._advance()
            if self._kind == "end" or self._token in (",", ";", ")", "]", "}"):
                return (
                    _read_text(token) if kind == "text" else _number(token) if kind == "number" else _WORDS.get(token)
                )
        self._skip_expression()
        return None

    def _read_object(self, depth: int) -> dict[str, Any]:
        self._advance()
        content: dict[str, Any] = {}
        while self._token != "}":
            if self._token == ",":
                self._advance()
                continue
            self._require_token()
            if self._kind == "mark":
                raise self._fail("a key", repr(self._text[self.start : self.start + 10]))
            key = _read_text(self._token) if self._kind == "text" else self._token
            self._advance()
            if self._token == ":":
                self._advance()
                content[key] = self.read_value(depth + 1)
            else:  # this is a method, or the short form {name}
                self._skip_expression()
        self._advance()
        return content

    def _read_list(self, depth: int) -> list[Any]:
        self._advance()
        content: list[Any] = []
        while self._token != "]":
            if self._token == ",":
                self._advance()
            elif self._token in (")", "}"):
                raise self._fail("a value or ]", self._token)
            else:
                content.append(self.read_value(depth + 1))
        self._advance()
        return content

    def _skip_expression(self) -> None:
        """Go to the comma or bracket that ends the value."""
        closing: list[str] = []
        while closing or self._token not in (",", ")", "]", "}"):
            self._require_token()
            if closing and self._token == closing[-1]:
                closing.pop()
            elif self._token in _CLOSING:
                closing.append(_CLOSING[self._token])
            self._advance()

    def _require_token(self) -> None:
        if self._kind == "end":
            raise self._fail("the end of an object", "the end of the file")
        if self._kind == "mark" and (self._token in "'\"`" or self._text.startswith("/*", self.start)):
            raise self._fail(f"the end of a {'comment' if self._token == '/' else 'text'}", "none")

    def _fail(self, needed: str, got: str) -> InputError:
        line = self._text.count("\n", 0, self.start) + 1
        return InputError(f"{self._source}: needed {needed} at line {line}, got {got}; correct it there.")


def _number(text: str) -> float:
    value = float(int(text, 16)) if "x" in text.lower() else float(text)
    return int(value) if value.is_integer() and abs(value) < 1e15 else value


def _read_text(token: str) -> str:
    joined = _ESCAPE.sub(_unescape, token[1:-1])
    # Two escapes of UTF-16 may make one letter; a single one is replaced.
    return joined.encode("utf-16", "surrogatepass").decode("utf-16", "replace")


def _unescape(found: re.Match[str]) -> str:
    code = found[1] or found[2] or found[3]
    if code is None:
        return _CONTROLS.get(found[4], found[4])
    return chr(int(code, 16)) if int(code, 16) <= 0x10FFFF else "\ufffd"
