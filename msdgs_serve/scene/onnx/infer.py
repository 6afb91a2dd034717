"""Infer types, shapes and cost of a graph before it runs, by the table of operators."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from msdgs_serve.scene.onnx.cost import PRODUCT, CallCost, GraphLimits
from msdgs_serve.scene.onnx.model import DTYPES, Model, Node, Tensor, element_name
from msdgs_serve.scene.onnx.operators import OPERATORS, Operator
from msdgs_serve.scene.onnx.rules import Call, Result
from msdgs_serve.scene.onnx.schema import MAX_ELEMENTS, MAX_RANK
from msdgs_serve.scene.onnx.shapes import Shape, ShapeInvalid, count, fixed, text
from msdgs_serve.scene.onnx.wire import ModelInvalid


@dataclass(frozen=True)
class Value:
    """The properties of an array that are known before the graph runs."""

    element: int
    shape: Shape
    varies: bool  # whether it depends on an input of the graph
    constant: Tensor | None = None  # if it is stored in the file


def infer(
    model: Model, inputs: Mapping[str, Value], limits: GraphLimits, ids: int, calls: int, returned: int
) -> tuple[dict[str, Value], CallCost]:
    """Return all values by name and the cost of one call.

    A frame makes `calls` calls of at most `ids` ids each, which return `returned` bytes in all. Raises `ModelInvalid`
    naming a node whose operator, attributes, types, shapes or cost are not allowed.
    """
    values = dict(inputs)
    for name, tensor in model.constants.items():
        values.setdefault(name, Value(tensor.element, fixed(tensor.shape), False, tensor))
    cost = CallCost(returned)
    for node in model.nodes:
        operator = OPERATORS.get(node.operator)
        if operator is None:
            raise ModelInvalid(node.name, f"is the operator {node.operator}, which scene files may not contain")
        operands = _operands(node, operator, values)
        _check_attributes(node, operator)
        try:
            result = operator.rule(_call(node, operands))
        except ShapeInvalid as error:
            raise ModelInvalid(node.name, f"({node.operator}) {error}") from None
        varies = any(operand.varies for operand in operands)
        element = _element(node, operator, operands)
        for name, shape in zip(node.outputs, result.shapes, strict=True):
            if not name or name in values:
                raise ModelInvalid(node.name, f"writes `{name}`, which has no name or exists already")
            if len(shape) > MAX_RANK or math.prod(max(dim.at(ids), 1) for dim in shape) > MAX_ELEMENTS:
                raise ModelInvalid(node.name, f"makes an array of shape {text(shape)}, which is too large")
            values[name] = Value(element, shape, varies)
        cost = cost.plus(*_cost(operator, result, element, ids))
        if problem := cost.problem(limits, calls):
            raise ModelInvalid(node.name, f"({node.operator}) {problem}")
    return values, cost


def _operands(node: Node, operator: Operator, values: Mapping[str, Value]) -> list[Value]:
    expected = list(operator.operands)
    if operator.repeated:
        expected += [expected[-1]] * (len(node.inputs) - len(expected))
    if len(node.inputs) != len(expected):
        raise ModelInvalid(node.name, f"({node.operator}) has {len(node.inputs)} inputs, not {len(expected)}")
    found = []
    for name, operand in zip(node.inputs, expected, strict=True):
        value = values.get(name)
        if value is None:
            raise ModelInvalid(node.name, f"({node.operator}) reads `{name}`, which nothing before it writes")
        if value.element not in operand.elements:
            known = " or ".join(element_name(each) for each in operand.elements)
            raise ModelInvalid(node.name, f"({node.operator}) reads {element_name(value.element)}, not {known}")
        if operand.constant and value.constant is None:
            raise ModelInvalid(node.name, f"({node.operator}) reads `{name}`, which must be a constant of the file")
        found.append(value)
    return found


def _element(node: Node, operator: Operator, operands: list[Value]) -> int:
    if operator.result is None:
        return operands[operator.like].element
    element = node.attributes[operator.result] if isinstance(operator.result, str) else operator.result
    assert isinstance(element, int)  # `_check_attributes` has checked this
    return element


def _check_attributes(node: Node, operator: Operator) -> None:
    for name, value in node.attributes.items():
        if name not in operator.attributes:
            raise ModelInvalid(node.name, f"({node.operator}) has the unknown attribute `{name}`")
        if value not in operator.attributes[name]:
            raise ModelInvalid(node.name, f"({node.operator}) has {name} = {value}, not {operator.attributes[name]}")
    for name in operator.needed:
        if name not in node.attributes:
            raise ModelInvalid(node.name, f"({node.operator}) lacks the attribute `{name}`")


def _call(node: Node, operands: list[Value]) -> Call:
    constants: list[np.ndarray | None] = [None if v.constant is None else v.constant.array() for v in operands]
    if node.operator != "Split" and len(node.outputs) != 1:
        raise ModelInvalid(node.name, f"({node.operator}) has {len(node.outputs)} outputs, not 1")
    return Call([operand.shape for operand in operands], constants, node.attributes, len(node.outputs))


def _cost(operator: Operator, result: Result, element: int, ids: int) -> tuple[int, int]:
    """Return bytes and operations of a node."""
    elements = sum(count(shape, ids) for shape in result.shapes)
    each = 2 * count(result.inner, ids) if result.inner else operator.work
    products = PRODUCT * count(result.products, ids) if result.products else 0
    return elements * DTYPES[element].itemsize, elements * each + products
