"""Sound scene files changed at random at the level of the format: nodes, attributes, shapes, names, versions, metadata,
and how protobuf writes them. The same seed gives the same file."""

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import AttributeProto, TensorProto, helper, numpy_helper

from tests.support.hostile_scenes import POISON, elsewhere
from tests.support.wire_mutations import changed_wire

Rng = np.random.Generator
Mutation = Callable[[onnx.ModelProto, Rng], object]

CANARY = Path("/tmp/msdgs-canary")
"""Where external tensors point to: it must never be opened."""

OPERATORS = (
    "Add", "Cast", "Clip", "Concat", "Cos", "DequantizeLinear", "Div", "Equal", "Exp", "Floor", "Gather", "Gemm",
    "Identity", "Less", "Log", "MatMul", "Max", "Min", "Mul", "Pow", "QuantizeLinear", "ReduceProd", "Relu", "Reshape",
    "ScatterND", "Sigmoid", "Sin", "Split", "Sqrt", "Squeeze", "Sub", "Unsqueeze", "Where",
    "Abs", "ArgMax", "Constant", "ConstantOfShape", "Conv", "Einsum", "Expand", "GridSample", "If", "Loop", "Mod",
    "NonZero", "OneHot", "Pad", "RandomNormal", "Range", "Resize", "Scan", "Shape", "Slice", "StringNormalizer", "Tile",
    "TopK", "Transpose", "", "add", "Bogus",
)  # fmt: skip
WHOLE = (0, 1, -1, 2, 3, 7, 2**31 - 1, 2**31, -(2**31), 2**40, 2**62, 2**63 - 1, -(2**63))
REAL = (0.0, -0.0, 1e-45, -1.0, 1e30, 3.4e38, -3.4e38, float("nan"), float("inf"), float("-inf"))
ELEMENTS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 16, 17, 22, 99)


def pick(rng: Rng, values: Iterable[Any]) -> Any:
    """One of them."""
    values = list(values)
    return values[int(rng.integers(len(values)))]


def _node(model: onnx.ModelProto, rng: Rng) -> onnx.NodeProto:
    if not model.graph.node:
        model.graph.node.append(helper.make_node("Identity", ["sh"], ["again"]))
    return pick(rng, model.graph.node)


def _constant(model: onnx.ModelProto, rng: Rng) -> onnx.TensorProto:
    return pick(rng, model.graph.initializer)


def _names(model: onnx.ModelProto) -> list[str]:
    written = [name for node in model.graph.node for name in node.output]
    return [*written, *(c.name for c in model.graph.initializer), "t", "ids", "steps", "", "nothing", "a\nb", "ü" * 150]


def drop_a_node(model: onnx.ModelProto, rng: Rng) -> None:
    model.graph.node.remove(_node(model, rng))


def repeat_a_node(model: onnx.ModelProto, rng: Rng) -> None:
    model.graph.node.append(_node(model, rng))


def swap_nodes(model: onnx.ModelProto, rng: Rng) -> None:
    first, second = _node(model, rng), _node(model, rng)
    kept = onnx.NodeProto.FromString(first.SerializeToString())
    first.CopyFrom(onnx.NodeProto.FromString(second.SerializeToString()))
    second.CopyFrom(kept)


def change_an_operator(model: onnx.ModelProto, rng: Rng) -> None:
    _node(model, rng).op_type = pick(rng, OPERATORS)


def swap_operator(model: onnx.ModelProto, rng: Rng) -> None:
    """For one that takes as much."""
    alike = (
        ("Add", "Sub", "Mul", "Div", "Max", "Min", "Pow"),
        ("Cos", "Exp", "Floor", "Identity", "Log", "Relu", "Sigmoid", "Sin", "Sqrt"),
        ("Less", "Equal"),
    )
    node = _node(model, rng)
    for operators in alike:
        if node.op_type in operators:
            node.op_type = pick(rng, operators)


def change_a_domain(model: onnx.ModelProto, rng: Rng) -> None:
    _node(model, rng).domain = pick(rng, ("ai.onnx", "com.microsoft", "ai.onnx.ml", "x"))


def rewire(model: onnx.ModelProto, rng: Rng) -> None:
    node = _node(model, rng)
    names = node.input if rng.random() < 0.7 or not node.output else node.output
    if names:
        names[int(rng.integers(len(names)))] = pick(rng, _names(model))


def more_or_fewer_operands(model: onnx.ModelProto, rng: Rng) -> None:
    node = _node(model, rng)
    names = node.input if rng.random() < 0.5 else node.output
    if rng.random() < 0.5 or not names:
        names.append(pick(rng, _names(model)))
    else:
        names.pop()


def change_an_attribute(model: onnx.ModelProto, rng: Rng) -> None:
    with_attributes = [node for node in model.graph.node if node.attribute]
    if with_attributes:
        attribute = pick(rng, pick(rng, with_attributes).attribute)
        if rng.random() < 0.7:
            attribute.i = pick(rng, WHOLE)
        else:
            attribute.name = pick(rng, ("axis", "axes", "to", "transA", "transB", "alpha", "saturate", ""))


def add_an_attribute(model: onnx.ModelProto, rng: Rng) -> None:
    values = (1, -1, 2**40, 1.5, "text", [1, 2], [1.0], ["a"], numpy_helper.from_array(np.ones(3)), onnx.GraphProto())
    name = pick(rng, ("axis", "keepdims", "transA", "allowzero", "to", "value", "body", "block_size", "x"))
    _node(model, rng).attribute.append(helper.make_attribute(name, pick(rng, values)))


def attribute_of_another_type(model: onnx.ModelProto, rng: Rng) -> None:
    with_attributes = [node for node in model.graph.node if node.attribute]
    if with_attributes:
        attribute = pick(rng, pick(rng, with_attributes).attribute)
        attribute.type = pick(rng, AttributeProto.AttributeType.values())


def change_dims(model: onnx.ModelProto, rng: Rng) -> None:
    constant = _constant(model, rng)
    if not constant.dims or rng.random() < 0.2:
        constant.dims.append(pick(rng, WHOLE))
    elif rng.random() < 0.5:
        constant.dims[int(rng.integers(len(constant.dims)))] = pick(rng, WHOLE)
    else:
        constant.dims[:] = [constant.dims[i] for i in rng.permutation(len(constant.dims))]


def change_an_element_type(model: onnx.ModelProto, rng: Rng) -> None:
    _constant(model, rng).data_type = pick(rng, ELEMENTS)


def change_values(model: onnx.ModelProto, rng: Rng) -> None:
    constant = _constant(model, rng)
    values = numpy_helper.to_array(constant).copy()
    if values.size:
        extremes = REAL if values.dtype.kind == "f" else WHOLE
        places = slice(None) if rng.random() < 0.2 else int(rng.integers(values.size))
        with np.errstate(over="ignore"):
            values.reshape(-1)[places] = np.array([pick(rng, extremes)]).astype(values.dtype)[0]
        constant.CopyFrom(numpy_helper.from_array(values, constant.name))


def grow_a_constant(model: onnx.ModelProto, rng: Rng) -> None:
    constant = _constant(model, rng)
    values = numpy_helper.to_array(constant)
    if values.ndim and 0 < values.size < 10_000:
        values = np.repeat(values, int(rng.integers(0, 30)), axis=int(rng.integers(values.ndim)))
        constant.CopyFrom(numpy_helper.from_array(values, constant.name))


def transpose_a_constant(model: onnx.ModelProto, rng: Rng) -> None:
    constant = _constant(model, rng)
    values = np.ascontiguousarray(numpy_helper.to_array(constant).T)
    constant.CopyFrom(numpy_helper.from_array(values, constant.name))


def drop_a_constant(model: onnx.ModelProto, rng: Rng) -> None:
    model.graph.initializer.remove(_constant(model, rng))


def repeat_a_constant(model: onnx.ModelProto, rng: Rng) -> None:
    model.graph.initializer.append(_constant(model, rng))


def move_a_constant_elsewhere(model: onnx.ModelProto, rng: Rng) -> None:
    name = _constant(model, rng).name
    location = pick(rng, (0, 1, 2, 2**32 + 1, 2**63 + 1))
    model.graph.initializer.append(TensorProto.FromString(elsewhere(name, CANARY, location)))


def rename(model: onnx.ModelProto, rng: Rng) -> None:
    part = pick(rng, [*model.graph.initializer, *model.graph.input, *model.graph.output])
    part.name = pick(rng, _names(model))


def change_a_port(model: onnx.ModelProto, rng: Rng) -> None:
    port = pick(rng, [*model.graph.input, *model.graph.output])
    if rng.random() < 0.5:
        port.type.tensor_type.elem_type = pick(rng, ELEMENTS)
    else:
        port.type.tensor_type.shape.dim.add(dim_value=pick(rng, WHOLE))


def drop_a_port(model: onnx.ModelProto, rng: Rng) -> None:
    ports = model.graph.input if rng.random() < 0.5 else model.graph.output
    if ports:
        ports.pop(int(rng.integers(len(ports))))


def add_a_port(model: onnx.ModelProto, rng: Rng) -> None:
    ports = model.graph.input if rng.random() < 0.5 else model.graph.output
    ports.append(helper.make_tensor_value_info(pick(rng, _names(model)), TensorProto.FLOAT, ["N", 3]))


def change_versions(model: onnx.ModelProto, rng: Rng) -> None:
    if rng.random() < 0.4:
        model.ir_version = pick(rng, (*WHOLE, 4, 8, 9, 10, 11))
    elif rng.random() < 0.5 and model.opset_import:
        model.opset_import[0].version = pick(rng, (*WHOLE, 13, 17, 18, 19, 20, 21, 24))
    else:
        domain = pick(rng, ("", "ai.onnx", "com.microsoft", "local"))
        model.opset_import.append(helper.make_opsetid(domain, 18))


def change_metadata(model: onnx.ModelProto, rng: Rng) -> None:
    if not model.metadata_props:
        return
    entry = pick(rng, model.metadata_props)
    deep = [[[[1e300]]]]
    values = (
        *(text for _, text in POISON.values()),
        *map(json.dumps, (None, True, -1, 0, 1e308, "", "x", [], {}, deep)),
    )
    choice = rng.random()
    if choice < 0.7:
        entry.value = pick(rng, values)
    elif choice < 0.8:
        entry.key = pick(rng, ("", "plan", "a\r\nb", "contract"))
    elif choice < 0.9:
        entry.value = entry.value[: int(rng.integers(len(entry.value) + 1))]
    else:
        model.metadata_props.remove(entry)


def what_scenes_have_not(model: onnx.ModelProto, rng: Rng) -> None:
    choice = int(rng.integers(4))
    if choice == 0:
        node = helper.make_node("Identity", ["a"], ["b"])
        model.functions.append(helper.make_function("", "Add", ["a"], ["b"], [node], [helper.make_opsetid("", 18)]))
    elif choice == 1:
        model.training_info.add()
    elif choice == 2:
        model.graph.sparse_initializer.add().values.name = "x"
    else:
        model.graph.quantization_annotation.add().tensor_name = "x"


MUTATIONS: tuple[Mutation, ...] = (
    drop_a_node, repeat_a_node, swap_nodes, change_an_operator, change_a_domain, rewire, more_or_fewer_operands,
    change_an_attribute, add_an_attribute, attribute_of_another_type, change_dims, change_an_element_type,
    grow_a_constant, transpose_a_constant, drop_a_constant, repeat_a_constant, move_a_constant_elsewhere, rename,
    change_a_port, drop_a_port, add_a_port, change_versions, change_metadata, change_metadata, what_scenes_have_not,
)  # fmt: skip
SUBTLE: tuple[Mutation, ...] = (change_values, change_values, rewire, swap_operator, transpose_a_constant)
"""Half of the changes: those that leave more files that onnxruntime sees."""

WIRE = 0.3
"""Of the files, those that are changed in how they are written."""


def mutated(sound: bytes, rng: Rng) -> bytes:
    """One to three changes of a sound file."""
    model = onnx.load_from_string(sound)
    only_wire = rng.random() < WIRE / 2
    for _ in range(0 if only_wire else int(rng.choice([1, 2, 3], p=[0.7, 0.2, 0.1]))):
        try:
            pick(rng, SUBTLE if rng.random() < 0.5 else MUTATIONS)(model, rng)
        except (ValueError, TypeError):
            continue  # an earlier change left nothing that this one could change
    contents = model.SerializeToString()
    return changed_wire(contents, rng) if only_wire or rng.random() < WIRE / 2 else contents
