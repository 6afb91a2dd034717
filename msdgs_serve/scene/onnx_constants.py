"""The constants in an ONNX file, read from its bytes without the onnx package.

onnxruntime doesn't show a graph's constants, and the serving side has nothing else to read them with. This walks the
protobuf wire format (https://protobuf.dev/programming-guides/encoding) with the field numbers of onnx.proto.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

_FLOAT, _FLOAT16, _DOUBLE = 1, 10, 11
_FLOATING = {_FLOAT: np.dtype("<f4"), _FLOAT16: np.dtype("<f2"), _DOUBLE: np.dtype("<f8")}
_EXTERNAL = 1
_LENGTHS = {1: 8, 5: 4}  # bytes of a value by wire type

Fields = Iterator[tuple[int, int, int | memoryview]]


class Malformed(ValueError):
    """The bytes aren't a whole ONNX model."""


@dataclass(frozen=True)
class Constant:
    """One tensor stored in a model."""

    name: str
    shape: tuple[int, ...]
    external: bool  # its values lie in another file
    values: np.ndarray | None  # flat; None for anything but floating-point numbers

    @property
    def bad_values(self) -> int:
        """How many are NaN or infinite."""
        return 0 if self.values is None else int(np.count_nonzero(~np.isfinite(self.values)))


def read_constants(model: bytes) -> list[Constant]:
    """Every constant of a serialized ModelProto: initializers and attributes, in subgraphs too. Raises `Malformed`."""
    graphs = [value for number, _, value in _fields(memoryview(model)) if number == 7]  # ModelProto.graph
    if len(graphs) != 1:
        raise Malformed("it holds no graph")
    return list(_graph_constants(_bytes(graphs[0])))


def _graph_constants(graph: memoryview) -> Iterator[Constant]:
    for number, _, value in _fields(graph):
        if number == 5:  # GraphProto.initializer
            yield _tensor(_bytes(value))
        elif number == 1:  # GraphProto.node
            yield from _node_constants(_bytes(value))
        elif number == 15:  # GraphProto.sparse_initializer
            raise Malformed("it holds sparse constants")


def _node_constants(node: memoryview) -> Iterator[Constant]:
    for number, _, attribute in _fields(node):
        if number != 5:  # NodeProto.attribute
            continue
        for part, kind, value in _fields(_bytes(attribute)):
            if part in (5, 10):  # AttributeProto.t, .tensors
                yield _tensor(_bytes(value))
            elif part in (6, 11):  # AttributeProto.g, .graphs
                yield from _graph_constants(_bytes(value))
            elif part in (2, 7) and kind in (2, 5):  # AttributeProto.f, .floats
                values = np.frombuffer(_bytes(value), "<f4")
                yield Constant("attribute", values.shape, False, values)


def _tensor(tensor: memoryview) -> Constant:
    shape: list[int] = []
    name, data_type, location, raw = "", 0, 0, None
    numbers: list[memoryview] = []
    for number, _, value in _fields(tensor):
        if number == 1:  # dims
            shape += list(_varints(value)) if isinstance(value, memoryview) else [value]
        elif number == 2:
            data_type = value
        elif number in (4, 10):  # float_data, double_data
            numbers.append(_bytes(value))
        elif number == 8:
            name = bytes(_bytes(value)).decode("utf-8", "replace")
        elif number == 9:  # raw_data
            raw = _bytes(value)
        elif number == 14:  # data_location
            location = value
    external = location == _EXTERNAL
    dtype = _FLOATING.get(data_type) if isinstance(data_type, int) else None
    if dtype is None or external:
        return Constant(name, tuple(shape), external, None)
    values = np.frombuffer(raw if raw is not None else b"".join(numbers), dtype)
    if values.size != math.prod(shape):
        raise Malformed(f"its constant `{name}` of shape {shape} has {values.size} values")
    return Constant(name, tuple(shape), external, values)


def _fields(message: memoryview) -> Fields:
    """(field number, wire type, value) of each field; a value is an int or, with a length, bytes."""
    position = 0
    while position < len(message):
        key, position = _varint(message, position)
        number, kind = key >> 3, key & 7
        if kind == 0:
            value, position = _varint(message, position)
            yield number, kind, value
            continue
        if kind == 2:
            length, position = _varint(message, position)
        elif kind in _LENGTHS:
            length = _LENGTHS[kind]
        else:
            raise Malformed(f"it has a field of unknown kind {kind}")
        if position + length > len(message):
            raise Malformed("it is cut off")
        yield number, kind, message[position : position + length]
        position += length


def _varint(message: memoryview, position: int) -> tuple[int, int]:
    result = 0
    for shift in range(0, 70, 7):
        if position >= len(message):
            raise Malformed("it is cut off")
        byte = message[position]
        position += 1
        result |= (byte & 0x7F) << shift
        if byte < 0x80:
            return result, position
    raise Malformed("it has a number of more than 64 bits")


def _varints(packed: memoryview) -> Iterator[int]:
    position = 0
    while position < len(packed):
        value, position = _varint(packed, position)
        yield value


def _bytes(value: int | memoryview) -> memoryview:
    if isinstance(value, int):
        raise Malformed("it has a number where a message belongs")
    return value
