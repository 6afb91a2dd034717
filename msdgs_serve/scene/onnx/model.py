"""Parse the ONNX model of a scene file."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from msdgs_serve.scene.onnx import schema
from msdgs_serve.scene.onnx.wire import ModelInvalid, read_integers, read_message

FLOAT, UINT8, INT8, INT16, INT32, INT64, BOOL = 1, 2, 3, 5, 6, 7, 9
"""Element types in onnx.proto."""

DTYPES = {
    FLOAT: np.dtype("<f4"),
    UINT8: np.dtype("u1"),
    INT8: np.dtype("i1"),
    INT16: np.dtype("<i2"),
    INT32: np.dtype("<i4"),
    INT64: np.dtype("<i8"),
    BOOL: np.dtype("?"),
}
CONSTANT_ELEMENTS = (FLOAT, UINT8, INT8, INT16, INT32, INT64)

OPSETS = range(18, 21)
"""Versions of the operator set in which the operators of scene files are the same."""
IR_VERSIONS = range(8, 11)

INT_ATTRIBUTE, INTS_ATTRIBUTE = 2, 7
"""Attribute types in onnx.proto."""

Attribute = int | tuple[int, ...]


def element_name(element: int) -> str:
    """Return the name of an element type, such as `float32`."""
    return DTYPES[element].name if element in DTYPES else f"element type {element}"


@dataclass(frozen=True)
class Tensor:
    """A constant. `data` is a view of the file's bytes, unless it is stored as a list of integers."""

    name: str
    element: int
    shape: tuple[int, ...]
    data: memoryview

    def array(self) -> np.ndarray:
        """Return a view of the values, which may be unaligned; nobody writes to it."""
        return np.frombuffer(self.data, DTYPES[self.element]).reshape(self.shape)


@dataclass(frozen=True)
class Node:
    """A node with an operator of the default domain."""

    operator: str
    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: Mapping[str, Attribute]


@dataclass(frozen=True)
class Port:
    """An input or output of the graph. Dimensions are numbers, names or empty texts."""

    name: str
    element: int
    shape: tuple[int | str, ...] | None


@dataclass(frozen=True)
class Model:
    """A parsed model. Names are unique within each of `constants`, `inputs` and `outputs`; `infer` checks the graph."""

    opset: int
    nodes: tuple[Node, ...]
    constants: Mapping[str, Tensor]
    inputs: Mapping[str, Port]
    outputs: Mapping[str, Port]
    properties: Mapping[str, str]


def read_model(contents: bytes | memoryview) -> Model:
    """Parse a model; constants in bytes are views of `contents`. Raises `ModelInvalid` for what is not allowed."""
    fields = read_message(memoryview(contents), schema.MODEL, "the model")
    if fields.get("ir_version") not in IR_VERSIONS:
        raise _invalid(f"it is of IR version {fields.get('ir_version')}, not {_span(IR_VERSIONS)}")
    if "graph" not in fields:
        raise _invalid("it holds no graph")
    graph = read_message(fields["graph"], schema.GRAPH, "the graph")
    return Model(
        _opset(fields["opset_import"]),
        tuple(_node(part) for part in graph["node"]),
        _by_name(_tensors(graph["initializer"]), "constant"),
        _by_name([_port(part) for part in graph["input"]], "input"),
        _by_name([_port(part) for part in graph["output"]], "output"),
        _properties(fields["metadata_props"]),
    )


def _opset(parts: list[memoryview]) -> int:
    opsets = [read_message(part, schema.OPSET, "the opset") for part in parts]
    for opset in opsets:
        if opset.get("domain", ""):
            raise _invalid(f"it needs operators of the domain `{opset['domain']}`, not of ONNX alone")
    versions = [opset.get("version", 0) for opset in opsets]
    if len(versions) != 1 or versions[0] not in OPSETS:
        raise _invalid(f"it needs operator sets {versions}, not one of {_span(OPSETS)}")
    return versions[0]


def _properties(parts: list[memoryview]) -> dict[str, str]:
    properties: dict[str, str] = {}
    for part in parts:
        entry = read_message(part, schema.PROPERTY, "the metadata")
        key = entry.get("key", "")
        if key in properties:
            raise ModelInvalid(key, "is in the metadata twice")
        properties[key] = entry.get("value", "")
    return properties


def _node(part: memoryview) -> Node:
    fields = read_message(part, schema.NODE, "a node")
    operator = fields.get("op_type", "")
    outputs = tuple(fields["output"])
    name = fields.get("name") or (outputs[0] if outputs else operator)
    if fields.get("domain", "") or fields.get("overload", ""):
        raise ModelInvalid(name, f"is {operator} of another domain, not of ONNX")
    attributes: dict[str, Attribute] = {}
    for part in fields["attribute"]:
        key, value = _attribute(part, name)
        if key in attributes:
            raise ModelInvalid(name, f"has the attribute `{key}` more than once")
        attributes[key] = value
    return Node(operator, name, tuple(fields["input"]), outputs, attributes)


def _attribute(part: memoryview, node: str) -> tuple[str, Attribute]:
    values = read_message(part, schema.ATTRIBUTE, f"an attribute of node `{node}`")
    key, kind, single, several = values.get("name", ""), values.get("type"), values.get("i"), tuple(values["ints"])
    if kind == INT_ATTRIBUTE and single is not None and not several:
        return key, single
    if kind == INTS_ATTRIBUTE and single is None and several:
        return key, several
    raise ModelInvalid(node, f"has the attribute `{key}` that isn't an integer or a list of integers")


def _tensors(parts: list[memoryview]) -> list[Tensor]:
    found = [read_message(part, schema.TENSOR, "a constant") for part in parts]
    if sum(len(fields.get("int32_data", b"")) for fields in found) > schema.MAX_LISTED:
        raise _invalid(f"its lists of integers have more than {schema.MAX_LISTED:,} bytes")
    return [_tensor(fields) for fields in found]


def _tensor(fields: dict[str, Any]) -> Tensor:
    name, element, shape = fields.get("name", ""), fields.get("data_type", 0), tuple(fields["dims"])
    if fields.get("data_location", 0):
        raise ModelInvalid(name, "is stored in another file")
    if element not in CONSTANT_ELEMENTS:
        known = ", ".join(element_name(each) for each in CONSTANT_ELEMENTS)
        raise ModelInvalid(name, f"is a constant of {element_name(element)}, not of {known}")
    data, size = _contents(fields, element, name), DTYPES[element].itemsize
    if min(shape, default=0) < 0 or math.prod(max(length, 1) for length in shape) > schema.MAX_ELEMENTS:
        raise ModelInvalid(name, f"has the impossible shape {shape}")
    if len(data) != math.prod(shape) * size:
        raise ModelInvalid(name, f"of shape {shape} has {len(data):,} bytes")
    return Tensor(name, element, shape, data)


def _contents(fields: dict[str, Any], element: int, name: str) -> memoryview:
    """Bytes of a constant, which is stored as bytes or, as onnxruntime's quantizer does, as a list of numbers."""
    stored = [key for key in ("raw_data", "float_data", "int32_data") if key in fields]
    if len(stored) > 1:
        raise ModelInvalid(name, f"is stored more than once: as {' and '.join(stored)}")
    if ("float_data" in stored and element != FLOAT) or ("int32_data" in stored and element in (FLOAT, INT64)):
        raise ModelInvalid(name, f"of {element_name(element)} is stored as {stored[0]}")
    if "int32_data" not in stored:
        return fields[stored[0]] if stored else memoryview(b"")  # packed floats are their bytes
    numbers = np.array(read_integers(fields["int32_data"]), np.int64)
    values = numbers.astype(DTYPES[element])
    if (values != numbers).any():
        raise ModelInvalid(name, f"has a number beyond {element_name(element)}")
    return memoryview(values.tobytes())


def _port(part: memoryview) -> Port:
    fields = read_message(part, schema.PORT, "an input or output")
    kind = read_message(fields.get("type", memoryview(b"")), schema.TYPE, "a type")
    tensor = read_message(kind.get("tensor_type", memoryview(b"")), schema.TENSOR_TYPE, "a type")
    shape: tuple[int | str, ...] | None = None
    if "shape" in tensor:
        dims = read_message(tensor["shape"], schema.TENSOR_SHAPE, "a shape")["dim"]
        shape = tuple(_dimension(read_message(dim, schema.DIMENSION, "a dimension")) for dim in dims)
    return Port(fields.get("name", ""), tensor.get("elem_type", 0), shape)


def _dimension(fields: dict[str, Any]) -> int | str:
    if "dim_value" in fields and "dim_param" in fields:
        raise _invalid("a dimension is both a number and a name")
    return fields.get("dim_value", fields.get("dim_param", ""))


def _by_name(parts: list[Any], kind: str) -> dict[str, Any]:
    named: dict[str, Any] = {}
    for part in parts:
        if not part.name:
            raise _invalid(f"it has a nameless {kind}")
        if part.name in named:
            raise ModelInvalid(part.name, f"names more than one {kind}")
        named[part.name] = part
    return named


def _span(versions: range) -> str:
    return f"{versions[0]} to {versions[-1]}"


def _invalid(problem: str) -> ModelInvalid:
    return ModelInvalid("file", f"can't be read as a scene: {problem}")
