"""ONNX files of a few nodes, written without the package onnx, and sessions that are functions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

_FLOAT, _INT64 = 1, 7  # TensorProto.DataType
_OPSET = 13


class Node(NamedTuple):
    """An operator, with integer attributes."""

    operator: str
    inputs: Sequence[str]
    outputs: Sequence[str]
    attributes: Mapping[str, int | Sequence[int]] = {}


class FakeSession:
    """A session of onnxruntime that calls a function of the image (1, 3, h, w)."""

    def __init__(self, function: Callable | None, inputs: Sequence[tuple[str, str, Sequence]]) -> None:
        self.function = function
        self.inputs = [SimpleNamespace(name=name, type=kind, shape=list(shape)) for name, kind, shape in inputs]

    def get_inputs(self) -> Sequence[Any]:
        return self.inputs

    def run(self, output_names: None, input_feed: dict[str, np.ndarray]) -> Sequence[Any]:
        assert self.function is not None
        return self.function(input_feed[self.inputs[0].name])


def write_onnx(
    path: Path, shape: Sequence[int | str], nodes: Sequence[Node], constants: Mapping[str, np.ndarray] | None = None
) -> None:
    """A network from "image" of a shape to "depth"; the fields are those of onnx.proto3."""
    graph = b"".join(_field(1, _encode_node(node)) for node in nodes) + _field(2, b"graph")
    for name, array in (constants or {}).items():
        kind = _INT64 if array.dtype == np.int64 else _FLOAT
        sizes = b"".join(_field(1, size) for size in array.shape)
        graph += _field(5, sizes + _field(2, kind) + _field(8, name.encode()) + _field(9, array.tobytes()))
    sizes = b"".join(
        _field(1, _field(1, size) if isinstance(size, int) else _field(2, size.encode())) for size in shape
    )
    tensor = _field(1, _field(1, _FLOAT) + _field(2, sizes))
    graph += _field(11, _field(1, b"image") + _field(2, tensor))
    graph += _field(12, _field(1, b"depth") + _field(2, _field(1, _field(1, _FLOAT))))
    path.write_bytes(_field(1, 8) + _field(7, graph) + _field(8, _field(2, _OPSET)))


def _encode_node(node: Node) -> bytes:
    content = b"".join(_field(1, name.encode()) for name in node.inputs)
    content += b"".join(_field(2, name.encode()) for name in node.outputs) + _field(4, node.operator.encode())
    for name, value in node.attributes.items():
        numbers = _field(3, value) + _field(20, 2) if isinstance(value, int) else b""
        if not isinstance(value, int):
            numbers = b"".join(_field(8, number) for number in value) + _field(20, 7)
        content += _field(5, _field(1, name.encode()) + numbers)
    return content


def _field(number: int, value: int | bytes) -> bytes:
    """A field of a message: a number, or bytes with their length."""
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    return _varint(number << 3 | 2) + _varint(len(value)) + value


def _varint(value: int) -> bytes:
    content = b""
    while value >= 128:
        content += bytes((value & 127 | 128,))
        value >>= 7
    return content + bytes((value,))
