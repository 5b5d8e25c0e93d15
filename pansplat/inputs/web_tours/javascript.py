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

_SPACE = re.compile(r"(?:\s+|//[^\n]*|/\*.*?\*/)*", re.DOTALL)
_NAME = re.compile(r"[^\W\d][\w$]*|\$[\w$]*")
_NUMBER = re.compile(r"[+-]?(?:0[xX][0-9a-fA-F]{1,12}|(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d{1,3})?)(?![\w$.(])")
_ESCAPE = re.compile(r"\\(?:u([0-9a-fA-F]{4})|u\{([0-9a-fA-F]{1,6})\}|x([0-9a-fA-F]{2})|(\r\n|.))", re.DOTALL)
_CONTROLS = dict(zip("ntrbfv0", "\n\t\r\b\f\v\0", strict=True)) | dict.fromkeys(("\n", "\r", "\r\n"), "")
_WORDS = {"true": True, "false": False, "null": None, "undefined": None}
_CLOSING = {"(": ")", "[": "]", "{": "}"}


def parse_literal(text: str, start: int, source: object) -> tuple[Any, int]:
    """The literal that begins at a position of a text, and the position after it.

    Args:
        source: the file that error messages name.
    """
    parser = _Parser(text, start, source)
    return parser.read_value(0), parser.position


def skip_space(text: str, position: int) -> int:
    """The position after white space and comments."""
    found = _SPACE.match(text, position)
    assert found is not None
    return found.end()


class _Parser:
    def __init__(self, text: str, position: int, source: object) -> None:
        self._text, self.position, self._source = text, position, source

    def read_value(self, depth: int) -> Any:
        if depth >= MAX_DEPTH:
            raise self._fail(f"at most {MAX_DEPTH} levels of lists and objects", "more")
        letter = self._peek()
        if letter == "{":
            return self._read_object(depth)
        if letter == "[":
            return self._read_list(depth)
        if letter in "'\"`":
            begin, value = self.position, self._read_string()
            return value if self._ends_value() else self._skip_expression(begin)
        for pattern in (_NUMBER, _NAME):
            found = pattern.match(self._text, self.position)
            if found is not None:
                begin, self.position = self.position, found.end()
                if self._ends_value() and pattern is _NUMBER:
                    return _number(found.group())
                if self._ends_value() and found.group() in _WORDS:
                    return _WORDS[found.group()]
                return self._skip_expression(begin)
        return self._skip_expression(self.position)

    def _read_object(self, depth: int) -> dict[str, Any]:
        self.position += 1
        content: dict[str, Any] = {}
        while (letter := self._peek()) != "}":
            if letter == ",":
                self.position += 1
                continue
            key = self._read_key(letter)
            if self._peek() == ":":
                self.position += 1
                content[key] = self.read_value(depth + 1)
            else:  # this is a method, or the short form {name}
                self._skip_expression(self.position)
        self.position += 1
        return content

    def _read_key(self, letter: str) -> str:
        if letter in "'\"":
            return self._read_string()
        found = _NUMBER.match(self._text, self.position) or _NAME.match(self._text, self.position)
        if found is None:
            raise self._fail("a key", repr(self._text[self.position : self.position + 10]))
        self.position = found.end()
        return found.group()

    def _read_list(self, depth: int) -> list[Any]:
        self.position += 1
        content: list[Any] = []
        while (letter := self._peek()) != "]":
            if letter == ",":
                self.position += 1
            elif letter in ")}":
                raise self._fail("a value or ]", letter)
            else:
                content.append(self.read_value(depth + 1))
        self.position += 1
        return content

    def _read_string(self) -> str:
        begin, quote = self.position, self._text[self.position]
        position = begin + 1
        while position < len(self._text) and self._text[position] != quote:
            position += 2 if self._text[position] == "\\" else 1
        if position >= len(self._text):
            raise self._fail("the end of a text", "none")
        self.position = position + 1
        joined = _ESCAPE.sub(_unescape, self._text[begin + 1 : position])
        # Two escapes of UTF-16 may make one letter; a single one is replaced.
        return joined.encode("utf-16", "surrogatepass").decode("utf-16", "replace")

    def _skip_expression(self, begin: int) -> None:
        """Go to the comma or bracket that ends the value."""
        self.position = begin
        closing: list[str] = []
        while True:
            letter = self._peek()
            if letter in "'\"`":
                self._read_string()
                continue
            if letter in ",)]}" and not closing:
                return
            if closing and letter == closing[-1]:
                closing.pop()
            elif letter in _CLOSING:
                closing.append(_CLOSING[letter])
            self.position += 1

    def _ends_value(self) -> bool:
        position = skip_space(self._text, self.position)
        return position >= len(self._text) or self._text[position] in ",;)]}"

    def _peek(self) -> str:
        self.position = skip_space(self._text, self.position)
        if self.position >= len(self._text):
            raise self._fail("the end of an object", "the end of the file")
        if self._text.startswith("/*", self.position):
            raise self._fail("the end of a comment", "none")
        return self._text[self.position]

    def _fail(self, needed: str, got: str) -> InputError:
        line = self._text.count("\n", 0, self.position) + 1
        return InputError(f"{self._source}: needed {needed} at line {line}, got {got}; correct it there.")


def _number(text: str) -> float:
    value = float(int(text, 16)) if "x" in text.lower() else float(text)
    return int(value) if value.is_integer() and abs(value) < 1e15 else value


def _unescape(found: re.Match[str]) -> str:
    code = found[1] or found[2] or found[3]
    if code is None:
        return _CONTROLS.get(found[4], found[4])
    return chr(int(code, 16)) if int(code, 16) <= 0x10FFFF else "\ufffd"
