"""Write the part of a model that some outputs need, in a canonical encoding."""

from collections.abc import Mapping, Sequence

from msdgs_serve.scene.onnx.infer import Value
from msdgs_serve.scene.onnx.model import INT_ATTRIBUTE, INTS_ATTRIBUTE, Attribute, Model, Node, Tensor
from msdgs_serve.scene.onnx.shapes import IDS

IR_VERSION = 9
_VARINT, _LENGTH = 0, 2


def write_model(
    model: Model, outputs: Sequence[str], inputs: Mapping[str, Value], values: Mapping[str, Value]
) -> bytes:
    """Return a model that computes `outputs` from `inputs`, without defaults. Large constants are copied once."""
    nodes, names = needed(model, outputs)
    stored = [tensor for name, tensor in model.constants.items() if name in names and name not in inputs]
    graph = Message(
        *((1, _node(node)) for node in nodes),
        (2, "msdgs"),
        *((5, _tensor(tensor)) for tensor in stored),
        *((11, _port(name, value)) for name, value in inputs.items()),
        *((12, _port(name, values[name])) for name in outputs),
    )
    return b"".join(Message((1, IR_VERSION), (7, graph), (8, Message((2, model.opset)))).parts)


def needed(model: Model, outputs: Sequence[str]) -> tuple[list[Node], set[str]]:
    """Return the nodes, in order, and the names of values that the outputs depend on, their own included."""
    names, nodes = set(outputs), []
    for node in reversed(model.nodes):
        if names.intersection(node.outputs):
            nodes.append(node)
            names.update(node.inputs)
    return nodes[::-1], names


class Message:
    """A Protobuf message of fields: their numbers and values. `parts` are its bytes, large ones by reference."""

    def __init__(self, *fields: "tuple[int, int | str | memoryview | Message]") -> None:
        self.parts: list[bytes | memoryview] = []
        for number, value in fields:
            if isinstance(value, int):
                self.parts += [_varint(number << 3 | _VARINT), _varint(value % (1 << 64))]
                continue
            data = value.encode() if isinstance(value, str) else value
            parts = data.parts if isinstance(data, Message) else [data]
            self.parts += [_varint(number << 3 | _LENGTH), _varint(sum(map(len, parts))), *parts]


def _node(node: Node) -> Message:
    operands = [(field, name) for field, names in ((1, node.inputs), (2, node.outputs)) for name in names]
    attributes = [(5, _attribute(*each)) for each in node.attributes.items()]
    return Message(*operands, (3, node.name), (4, node.operator), *attributes)


def _attribute(name: str, value: Attribute) -> Message:
    if isinstance(value, int):
        return Message((1, name), (3, value), (20, INT_ATTRIBUTE))
    return Message((1, name), *((8, number) for number in value), (20, INTS_ATTRIBUTE))


def _tensor(tensor: Tensor) -> Message:
    return Message(*((1, length) for length in tensor.shape), (2, tensor.element), (8, tensor.name), (9, tensor.data))


def _port(name: str, value: Value) -> Message:
    lengths = ([(2, "M")] if dim == IDS else [] if dim.per_id else [(1, dim.fixed)] for dim in value.shape)
    shape = Message(*((1, Message(*length)) for length in lengths))
    return Message((1, name), (2, Message((1, Message((1, value.element), (2, shape))))))


def _varint(value: int) -> bytes:
    digits = bytearray()
    while value >= 0x80:
        digits.append(value & 0x7F | 0x80)
        value >>= 7
    digits.append(value)
    return bytes(digits)
