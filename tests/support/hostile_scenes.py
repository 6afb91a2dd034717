"""Scene files that were made to do harm, each from a sound one: what they do is in their names."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

Attack = Callable[[onnx.ModelProto, Path], bytes]

SECRET_BYTES = 24


def varint(value: int) -> bytes:
    """As short as it can be."""
    digits = bytearray()
    while value >= 0x80:
        digits.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*digits, value])


def field(number: int, content: bytes | int) -> bytes:
    """A field of protobuf's wire format: a number or what has a length."""
    if isinstance(content, int):
        return varint(number << 3) + varint(content)
    return varint(number << 3 | 2) + varint(len(content)) + content


def with_graph(model: onnx.ModelProto, graph: bytes) -> bytes:
    """The model with another graph, given as bytes."""
    rest = onnx.ModelProto()
    rest.CopyFrom(model)
    rest.ClearField("graph")
    return rest.SerializeToString() + field(7, graph)


def elsewhere(name: str, secret: Path, location: int) -> bytes:
    """A tensor [8, 3] whose values are the first bytes of a file; `location` is what says so."""
    tensor = onnx.TensorProto(name=name, data_type=TensorProto.UINT8, dims=[SECRET_BYTES // 3, 3])
    for key, value in {"location": str(secret), "offset": "0", "length": str(SECRET_BYTES)}.items():
        tensor.external_data.add(key=key, value=value)
    return tensor.SerializeToString() + field(14, location)


def without_constant(model: onnx.ModelProto, name: str) -> onnx.GraphProto:
    """Its graph."""
    graph = onnx.GraphProto()
    graph.CopyFrom(model.graph)
    graph.initializer.remove(next(each for each in graph.initializer if each.name == name))
    return graph


def file_read_by_a_truncated_location(model: onnx.ModelProto, secret: Path) -> bytes:
    """2³² + 1 in 32 bits is 1: EXTERNAL."""
    graph = without_constant(model, "base")
    graph.node.insert(0, helper.make_node("Cast", ["bytes"], ["base"], to=TensorProto.FLOAT))
    return with_graph(model, graph.SerializeToString() + field(5, elsewhere("bytes", secret, 2**32 + 1)))


def location_of_33_bits(model: onnx.ModelProto, secret: Path) -> bytes:
    """The same number where nothing else is wrong."""
    graph, sound = without_constant(model, "base"), next(c for c in model.graph.initializer if c.name == "base")
    return with_graph(model, graph.SerializeToString() + field(5, sound.SerializeToString() + field(14, 2**32 + 1)))


def file_read_inside_a_function(model: onnx.ModelProto, secret: Path) -> bytes:
    """The constant lies in a function of the model."""
    value = onnx.TensorProto.FromString(elsewhere("value", secret, 1))
    nodes = [
        helper.make_node("Constant", [], ["bytes"], value=value),
        helper.make_node("Cast", ["bytes"], ["heights"], to=TensorProto.FLOAT),
    ]
    opsets = [helper.make_opsetid("", 20)]
    model.functions.append(helper.make_function("local", "Heights", [], ["heights"], nodes, opsets))
    model.opset_import.append(helper.make_opsetid("local", 1))
    model.graph.initializer.remove(next(each for each in model.graph.initializer if each.name == "base"))
    model.graph.node.insert(0, helper.make_node("Heights", [], ["base"], domain="local"))
    return model.SerializeToString()


def constant_node_in_another_file(model: onnx.ModelProto, secret: Path) -> bytes:
    """A `Constant` of the graph itself."""
    value = onnx.TensorProto.FromString(elsewhere("value", secret, 1))
    model.graph.initializer.remove(next(each for each in model.graph.initializer if each.name == "base"))
    model.graph.node.insert(0, helper.make_node("Cast", ["bytes"], ["base"], to=TensorProto.FLOAT))
    model.graph.node.insert(0, helper.make_node("Constant", [], ["bytes"], value=value))
    return model.SerializeToString()


def loop_that_never_ends_in_the_middle(model: onnx.ModelProto, secret: Path) -> bytes:
    """Around t = 0.5 it runs 10¹⁵ times, at both ends of the scene's time not at all."""
    add(model, "eight", np.array([8], np.float32))
    add(model, "huge", np.array([1e15], np.float32))
    add(model, "none", np.array([], np.int64))
    add(model, "go", np.array(True))
    body = helper.make_graph(
        [helper.make_node("Identity", ["on"], ["on_out"]), helper.make_node("Identity", ["state"], ["state_out"])],
        "body",
        [
            helper.make_tensor_value_info("number", TensorProto.INT64, []),
            helper.make_tensor_value_info("on", TensorProto.BOOL, []),
            helper.make_tensor_value_info("state", TensorProto.FLOAT, [1]),
        ],
        [
            helper.make_tensor_value_info("on_out", TensorProto.BOOL, []),
            helper.make_tensor_value_info("state_out", TensorProto.FLOAT, [1]),
        ],
    )
    model.graph.node.insert(0, helper.make_node("Loop", ["trips", "go", "one"], ["applied_once"], body=body))
    model.graph.node.insert(0, helper.make_node("Reshape", ["many", "none"], ["trips"]))
    model.graph.node.insert(0, helper.make_node("Cast", ["times"], ["many"], to=TensorProto.INT64))
    model.graph.node.insert(0, helper.make_node("Mul", ["bump", "huge"], ["times"]))
    model.graph.node.insert(0, helper.make_node("Floor", ["raised"], ["bump"]))
    model.graph.node.insert(0, helper.make_node("Mul", ["product", "eight"], ["raised"]))
    model.graph.node.insert(0, helper.make_node("Mul", ["t", "rest"], ["product"]))
    model.graph.node.insert(0, helper.make_node("Sub", ["one", "t"], ["rest"]))
    scaled = next(node for node in model.graph.node if node.output[0] == "applied")
    scaled.input[:] = ["t", "applied_once"]
    return model.SerializeToString()


def blown_up(operator: str) -> Attack:
    """An array of 6 GB beside the scene, made by an operator whose output is as large as numbers say."""

    def attack(model: onnx.ModelProto, secret: Path) -> bytes:
        count = 1_500_000_000
        add(model, "size", np.array([count], np.int64))
        add(model, "ends", np.array(count, np.int64))
        add(model, "zero", np.array(0, np.int64))
        add(model, "step", np.array(1, np.int64))
        add(model, "corner", np.array([1], np.int64))
        inputs = {
            "Expand": ["one", "size"],
            "Tile": ["one", "size"],
            "ConstantOfShape": ["size"],
            "Range": ["zero", "ends", "step"],
            "Resize": ["one", "", "", "size"],
        }[operator]
        last = "corner" if operator != "Range" else "step"
        nodes = [helper.make_node(operator, inputs, ["vast"]), helper.make_node("Slice", ["vast", "0", last], ["few"])]
        add(model, "0", np.array([0], np.int64))
        nodes += [helper.make_node("Cast", ["few"], ["floats"], to=TensorProto.FLOAT)]
        nodes += [helper.make_node("ReduceMax", ["floats"], ["largest"], keepdims=0)]
        return with_sum_of(model, nodes, "largest")

    attack.__name__ = f"six_gigabytes_by_{operator.lower()}"
    return attack


def six_gigabytes_by_broadcasting(model: onnx.ModelProto, secret: Path) -> bytes:
    """All operators are those of sound files."""
    add(model, "row", np.ones((1, 40_000), np.float32))
    add(model, "column", np.ones((40_000, 1), np.float32))
    add(model, "first", np.zeros(1, np.int64))
    nodes = [
        helper.make_node("Mul", ["row", "t"], ["row_now"]),
        helper.make_node("Add", ["row_now", "column"], ["vast"]),
        helper.make_node("Gather", ["vast", "first"], ["few"]),
        helper.make_node("Gather", ["few", "first"], ["largest"], axis=1),
    ]
    return with_sum_of(model, nodes, "largest")


def a_quadrillion_operations(model: onnx.ModelProto, secret: Path) -> bytes:
    """Products of large matrices in little memory, one after the other."""
    add(model, "square", np.eye(2000, dtype=np.float32)[:, :2000])
    add(model, "first", np.zeros(1, np.int64))
    nodes = [helper.make_node("Mul", ["square", "t"], ["m0"])]
    nodes += [helper.make_node("MatMul", [f"m{i}", "square"], [f"m{i + 1}"]) for i in range(60)]
    nodes += [
        helper.make_node("Gather", ["m60", "first"], ["few"]),
        helper.make_node("Gather", ["few", "first"], ["largest"], axis=1),
    ]
    return with_sum_of(model, nodes, "largest")


def whole_numbers_divided_by_zero(model: onnx.ModelProto, secret: Path) -> bytes:
    """At t0 alone: processors raise a signal."""
    nodes = [
        helper.make_node("Cast", ["t"], ["whole"], to=TensorProto.INT64),
        helper.make_node("Div", ["whole", "whole"], ["quotient"]),
        helper.make_node("Cast", ["quotient"], ["largest"], to=TensorProto.FLOAT),
    ]
    return with_sum_of(model, nodes, "largest")


def a_shape_that_depends_on_time(model: onnx.ModelProto, secret: Path) -> bytes:
    """An operator of the table, whose output is as large as t says."""
    nodes = [
        helper.make_node("Cast", ["t"], ["whole"], to=TensorProto.INT64),
        helper.make_node("Reshape", ["one", "whole"], ["largest"]),
    ]
    return with_sum_of(model, nodes, "largest")


def another_domain(model: onnx.ModelProto, secret: Path) -> bytes:
    """onnxruntime's own operators."""
    model.opset_import.append(helper.make_opsetid("com.microsoft", 1))
    return with_sum_of(model, [helper.make_node("Gelu", ["t"], ["largest"], domain="com.microsoft")], "largest")


def with_sum_of(model: onnx.ModelProto, nodes: list[onnx.NodeProto], value: str) -> bytes:
    """The scene with nodes that compute a value, which is added to the factor of its motion times 0."""
    add(model, "nothing", np.zeros(1, np.float32))
    nodes = [
        *nodes,
        helper.make_node("Mul", [value, "nothing"], ["unseen"]),
        helper.make_node("Add", ["one", "unseen"], ["one_and"]),
    ]
    for node in reversed(nodes):
        model.graph.node.insert(0, node)
    next(node for node in model.graph.node if node.output[0] == "applied").input[:] = ["t", "one_and"]
    return model.SerializeToString()


def add(model: onnx.ModelProto, name: str, values: np.ndarray) -> None:
    """A constant."""
    model.graph.initializer.append(numpy_helper.from_array(values, name))


ATTACKS: dict[str, Attack] = {
    attack.__name__: attack
    for attack in (
        file_read_by_a_truncated_location,
        location_of_33_bits,
        file_read_inside_a_function,
        constant_node_in_another_file,
        loop_that_never_ends_in_the_middle,
        *(blown_up(operator) for operator in ("Expand", "Tile", "ConstantOfShape", "Range", "Resize")),
        six_gigabytes_by_broadcasting,
        a_quadrillion_operations,
        whole_numbers_divided_by_zero,
        a_shape_that_depends_on_time,
        another_domain,
    )
}

POISON: dict[str, tuple[str, str]] = {
    "a time of 400 digits": ("time_range", f"[0, 1{'0' * 400}]"),
    "100,000 lists in each other": ("left_out", "[" * 100_000 + "]" * 100_000),
    "an error of 400 digits": ("measured_error", f'{{"rendered": {{"psnr_worst": 1{"0" * 400}}}}}'),
    "an infinite error": ("measured_error", '{"rendered": {"psnr_worst": 1e999}}'),
    "a header in the plan": ("plan", '"network\\r\\nSet-Cookie: a=b"'),
    "a lone surrogate": ("plan", '"\\ud800"'),
    "a plan of 300,000 letters": ("plan", f'"{"x" * 300_000}"'),
    "a key twice": ("measured_error", '{"psnr": 1, "psnr": 2}'),
    "300,000 quotation marks": ("left_out", '"\\"' * 100_000),
    "texts for numbers": ("time_range", '["0", "1"]'),
    "not a number": ("bounds", "[[0, 0, NaN], [1, 1, 1]]"),
}
"""Metadata by what is wrong: the field and its text."""


def poisoned(model: onnx.ModelProto, what: str) -> bytes:
    """The scene with one of `POISON`."""
    name, text = POISON[what]
    properties = {entry.key: entry.value for entry in model.metadata_props} | {name: text}
    del model.metadata_props[:]
    helper.set_model_props(model, properties)
    return model.SerializeToString()
