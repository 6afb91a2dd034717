"""Write the part of a model that some outputs need, in a canonical encoding."""

from collections.abc import Iterable, Mapping, Sequence

from msdgs_serve.scene.onnx.infer import Value
from msdgs_serve.scene.onnx.model import INT_ATTRIBUTE, INTS_ATTRIBUTE, Attribute, Model, Node, Tensor
from msdgs_serve.scene.onnx.shapes import IDS

IR_VERSION = 9
_VARINT, _LENGTH = 0, 2

Parts = list[bytes | memoryview]


def write_model(
    model: Model, outputs: Sequence[str], inputs: Mapping[str, Value], values: Mapping[str, Value]
) -> bytes:
    """Return a model that computes `outputs` from `inputs`, without defaults. Large constants are copied once."""
    nodes, names = _needed(model, outputs)
    graph = _Message()
    for node in nodes:
        graph.message(1, _node(node))
    graph.text(2, "msdgs")
    for name in model.constants:
        if name in names and name not in inputs:
            graph.message(5, _tensor(model.constants[name]))
    for name, value in inputs.items():
        graph.message(11, _port(name, value))
    for name in outputs:
        graph.message(12, _port(name, values[name]))
    opset = _Message()
    opset.number(2, model.opset)
    whole = _Message()
    whole.number(1, IR_VERSION)
    whole.message(7, graph)
    whole.message(8, opset)
    return b"".join(whole.parts)


def names_needed(model: Model, outputs: Sequence[str]) -> set[str]:
    """Return the names of all values that the outputs depend on, and their own."""
    return _needed(model, outputs)[1]


def _needed(model: Model, outputs: Sequence[str]) -> tuple[list[Node], set[str]]:
    """Return the nodes, in order, and the names of values that the outputs depend on."""
    names, nodes = set(outputs), []
    for node in reversed(model.nodes):
        if names.intersection(node.outputs):
            nodes.append(node)
            names.update(node.inputs)
    return nodes[::-1], names


class _Message:
    """A Protobuf message in construction."""

    def __init__(self) -> None:
        self.parts: Parts = []
        self.length = 0

    def number(self, field: int, value: int) -> None:
        self._add(_varint(field << 3 | _VARINT), _varint(value % (1 << 64)))

    def data(self, field: int, value: bytes | memoryview) -> None:
        self._add(_varint(field << 3 | _LENGTH), _varint(len(value)), value)

    def text(self, field: int, value: str) -> None:
        self.data(field, value.encode())

    def message(self, field: int, value: "_Message") -> None:
        self._add(_varint(field << 3 | _LENGTH), _varint(value.length), *value.parts)

    def _add(self, *parts: bytes | memoryview) -> None:
        self.parts += parts
        self.length += sum(len(part) for part in parts)


def _node(node: Node) -> _Message:
    message = _Message()
    _texts(message, 1, node.inputs)
    _texts(message, 2, node.outputs)
    message.text(3, node.name)
    message.text(4, node.operator)
    for name, value in node.attributes.items():
        message.message(5, _attribute(name, value))
    return message


def _attribute(name: str, value: Attribute) -> _Message:
    message = _Message()
    message.text(1, name)
    if isinstance(value, int):
        message.number(3, value)
        message.number(20, INT_ATTRIBUTE)
    else:
        for number in value:
            message.number(8, number)
        message.number(20, INTS_ATTRIBUTE)
    return message


def _texts(message: _Message, field: int, values: Iterable[str]) -> None:
    for value in values:
        message.text(field, value)


def _tensor(tensor: Tensor) -> _Message:
    message = _Message()
    for length in tensor.shape:
        message.number(1, length)
    message.number(2, tensor.element)
    message.text(8, tensor.name)
    message.data(9, tensor.data)
    return message


def _port(name: str, value: Value) -> _Message:
    shape = _Message()
    for dim in value.shape:
        dimension = _Message()
        if dim == IDS:
            dimension.text(2, "M")
        elif not dim.per_id:
            dimension.number(1, dim.fixed)
        shape.message(1, dimension)
    tensor = _Message()
    tensor.number(1, value.element)
    tensor.message(2, shape)
    kind = _Message()
    kind.message(1, tensor)
    port = _Message()
    port.text(1, name)
    port.message(2, kind)
    return port


def _varint(value: int) -> bytes:
    digits = bytearray()
    while value >= 0x80:
        digits.append(value & 0x7F | 0x80)
        value >>= 7
    digits.append(value)
    return bytes(digits)
