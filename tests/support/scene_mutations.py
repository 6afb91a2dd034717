"""Random mutations of valid scene files: nodes, attributes, shapes, names, versions, metadata, and the encoding of
protobuf. The same seed gives the same file."""

import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message
from onnx import TensorProto, numpy_helper
from onnx.external_data_helper import uses_external_data

from tests.support.hostile_scenes import POISON, elsewhere
from tests.support.wire_mutations import changed_wire

Rng = np.random.Generator
Mutation = Callable[[onnx.ModelProto, Rng], object]

CANARY = Path("/tmp/msdgs-canary")
"""The file that external tensors refer to; it must never be opened."""

OPERATORS = (
    "Add", "Cast", "Clip", "Concat", "Cos", "DequantizeLinear", "Div", "Equal", "Exp", "Floor", "Gather", "Gemm",
    "Identity", "Less", "Log", "MatMul", "Max", "Min", "Mul", "Pow", "QuantizeLinear", "ReduceProd", "Relu", "Reshape",
    "ScatterND", "Sigmoid", "Sin", "Split", "Sqrt", "Squeeze", "Sub", "Unsqueeze", "Where",
    "Abs", "ArgMax", "Constant", "ConstantOfShape", "Conv", "Einsum", "Expand", "GridSample", "If", "Loop", "Mod",
    "NonZero", "OneHot", "Pad", "RandomNormal", "Range", "Resize", "Scan", "Shape", "Slice", "StringNormalizer", "Tile",
    "TopK", "Transpose", "", "add", "Bogus",
)  # fmt: skip
SAME_INPUTS = (
    ("Add", "Sub", "Mul", "Div", "Max", "Min", "Pow"),
    ("Cos", "Exp", "Floor", "Identity", "Log", "Relu", "Sigmoid", "Sin", "Sqrt"),
    ("Less", "Equal"),
)
"""Operators that take the same inputs."""

INTEGERS = (0, 1, -1, 2, 3, 7, 2**31 - 1, 2**31, -(2**31), 2**40, 2**62, 2**63 - 1, -(2**63))
REALS = (0.0, -0.0, 1e-45, -1.0, 1e30, 3.4e38, -3.4e38, float("nan"), float("inf"), float("-inf"))
ELEMENTS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 16, 17, 22, 99)
METADATA = (
    *(text for _, text in POISON.values()),
    *map(json.dumps, (None, True, -1, 0, 1e308, "", "x", [], {}, [[[[1e300]]]])),
)
VALUES: dict[str, tuple[Any, ...]] = {
    "NodeProto.op_type": OPERATORS,
    "NodeProto.domain": ("ai.onnx", "com.microsoft", "ai.onnx.ml", "x"),
    "AttributeProto.name": ("axis", "axes", "to", "transA", "transB", "alpha", "allowzero", "value", "body", ""),
    "TensorProto.data_type": ELEMENTS,
    "Tensor.elem_type": ELEMENTS,
    "ModelProto.ir_version": (*INTEGERS, 4, 8, 9, 10, 11),
    "OperatorSetIdProto.version": (*INTEGERS, 13, 17, 18, 19, 20, 21, 24),
    "OperatorSetIdProto.domain": ("", "ai.onnx", "com.microsoft", "local"),
    "StringStringEntryProto.key": ("", "plan", "a\r\nb", "contract"),
    "StringStringEntryProto.value": METADATA,
}
"""Values that fields are given, by message and field; others are given values of their type."""


def pick(rng: Rng, values: Iterable[Any]) -> Any:
    """Return one of the values."""
    values = list(values)
    return values[int(rng.integers(len(values)))]


def _names(model: onnx.ModelProto) -> list[str]:
    written = [name for node in model.graph.node for name in node.output]
    return [*written, *(c.name for c in model.graph.initializer), "t", "ids", "steps", "", "nothing", "a\nb", "ü" * 150]


def _messages(message: Message) -> Iterator[Message]:
    """Yield a message and all messages in it."""
    yield message
    for field, value in message.ListFields():
        if field.message_type is not None:
            for inner in value if field.is_repeated else (value,):
                yield from _messages(inner)


def _value(field: FieldDescriptor, model: onnx.ModelProto, rng: Rng) -> Any:
    """Return a value for a field that is not a message."""
    assert field.containing_type is not None
    name = f"{field.containing_type.name}.{field.name}"
    if name in VALUES:
        return pick(rng, VALUES[name])
    if field.enum_type is not None:
        return pick(rng, field.enum_type.values_by_number)
    if field.cpp_type == FieldDescriptor.CPPTYPE_STRING:
        text = pick(rng, _names(model))
        return text.encode() if field.type == FieldDescriptor.TYPE_BYTES else text
    real = field.cpp_type in (FieldDescriptor.CPPTYPE_FLOAT, FieldDescriptor.CPPTYPE_DOUBLE)
    return pick(rng, REALS if real else INTEGERS)


def change_a_field(model: onnx.ModelProto, rng: Rng) -> None:
    """Change a field of a message of any kind, mostly one that is set."""
    kinds: dict[str, list[Message]] = defaultdict(list)
    for message in _messages(model):
        kinds[message.DESCRIPTOR.name].append(message)
    message = pick(rng, kinds[pick(rng, sorted(kinds))])
    fields = [field for field, _ in message.ListFields()] if rng.random() < 0.8 else []
    field: FieldDescriptor = pick(rng, fields or message.DESCRIPTOR.fields)
    if field.is_repeated:
        _change_elements(getattr(message, field.name), field, model, rng)
    elif rng.random() < 0.2:
        message.ClearField(field.name)
    elif field.message_type is not None:
        getattr(message, field.name).SetInParent()
    else:
        setattr(message, field.name, _value(field, model, rng))


def _change_elements(elements: Any, field: FieldDescriptor, model: onnx.ModelProto, rng: Rng) -> None:
    """Remove, repeat, replace or move an element of a repeated field, or add one."""
    how = pick(rng, ("remove", "repeat", "replace", "move", "add")) if elements else "add"
    index = int(rng.integers(len(elements))) if elements else 0
    if how == "remove" or (how == "replace" and field.message_type is not None):
        elements.pop(index)
    elif how == "repeat":
        elements.append(elements[index])
    elif how == "replace":
        elements[index] = _value(field, model, rng)
    elif how == "move":
        elements.append(elements.pop(index))
    elif field.message_type is not None:
        elements.add()
    else:
        elements.append(_value(field, model, rng))


def swap_operator(model: onnx.ModelProto, rng: Rng) -> None:
    """Replace an operator by one that takes the same inputs."""
    node = pick(rng, model.graph.node)
    for operators in SAME_INPUTS:
        if node.op_type in operators:
            node.op_type = pick(rng, operators)


def rewire(model: onnx.ModelProto, rng: Rng) -> None:
    """Give a node another input or output."""
    node = pick(rng, model.graph.node)
    names = node.input if rng.random() < 0.7 else node.output
    names[int(rng.integers(len(names)))] = pick(rng, _names(model))


def _changed_constant(model: onnx.ModelProto, rng: Rng, change: Callable[[np.ndarray], np.ndarray]) -> None:
    constant = pick(rng, [each for each in model.graph.initializer if not uses_external_data(each)])
    values = change(numpy_helper.to_array(constant).copy())
    constant.CopyFrom(numpy_helper.from_array(np.ascontiguousarray(values), constant.name))


def change_values(model: onnx.ModelProto, rng: Rng) -> None:
    """Set one value of a constant, or all, to an extreme."""

    def change(values: np.ndarray) -> np.ndarray:
        extreme = np.array([pick(rng, REALS if values.dtype.kind == "f" else INTEGERS)])
        places = slice(None) if rng.random() < 0.2 else int(rng.integers(values.size))
        with np.errstate(over="ignore"):
            values.reshape(-1)[places] = extreme.astype(values.dtype)[0]
        return values

    _changed_constant(model, rng, change)


def resize_a_constant(model: onnx.ModelProto, rng: Rng) -> None:
    """Repeat each row or column of a constant up to 29 times, or not at all."""
    _changed_constant(
        model, rng, lambda values: values.repeat(int(rng.integers(30)), axis=int(rng.integers(values.ndim)))
    )


def transpose_a_constant(model: onnx.ModelProto, rng: Rng) -> None:
    """Exchange the axes of a constant."""
    _changed_constant(model, rng, np.transpose)


def move_a_constant_elsewhere(model: onnx.ModelProto, rng: Rng) -> None:
    """Add a constant of a name that is in use, whose values lie in another file."""
    location = pick(rng, (0, 1, 2, 2**32 + 1, 2**63 + 1))
    tensor = elsewhere(pick(rng, model.graph.initializer).name, CANARY, location)
    model.graph.initializer.append(TensorProto.FromString(tensor))


def change_metadata(model: onnx.ModelProto, rng: Rng) -> None:
    """Change or cut off an entry of the metadata."""
    entry = pick(rng, model.metadata_props)
    entry.value = pick(rng, METADATA) if rng.random() < 0.8 else entry.value[: int(rng.integers(len(entry.value)))]


MUTATIONS: tuple[Mutation, ...] = (
    *[change_a_field] * 6, resize_a_constant, transpose_a_constant, move_a_constant_elsewhere, change_metadata,
)  # fmt: skip
SUBTLE: tuple[Mutation, ...] = (change_values, change_values, rewire, swap_operator, transpose_a_constant)
"""Half of the changes: more of these files are valid and reach onnxruntime."""

WIRE = 0.3
"""Fraction of the files whose encoding is changed."""


def mutated(sound: bytes, rng: Rng) -> bytes:
    """Return a valid file with one to three changes."""
    model = onnx.load_from_string(sound)
    only_wire = rng.random() < WIRE / 2
    for _ in range(0 if only_wire else int(rng.choice([1, 2, 3], p=[0.7, 0.2, 0.1]))):
        try:
            pick(rng, SUBTLE if rng.random() < 0.5 else MUTATIONS)(model, rng)
        except (ValueError, TypeError):
            continue  # nothing to change, or the field can't hold the value
    contents = model.SerializeToString()
    return changed_wire(contents, rng) if only_wire or rng.random() < WIRE / 2 else contents
