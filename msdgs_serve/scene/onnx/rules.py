"""Shape and cost rules of the operators."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from msdgs_serve.scene.onnx.model import Attribute
from msdgs_serve.scene.onnx.shapes import (
    ONE,
    Dim,
    Shape,
    ShapeInvalid,
    added,
    axes_of,
    axis_of,
    broadcast,
    numbers,
    reshaped,
    text,
)


@dataclass(frozen=True)
class Call:
    """A node: shapes of its inputs, values of constant inputs, attributes and number of outputs."""

    shapes: Sequence[Shape]
    constants: Sequence[np.ndarray | None]
    attributes: Mapping[str, Attribute]
    outputs: int

    def constant(self, index: int) -> np.ndarray:
        """Return the values of an input that must be a constant by the table of operators."""
        values = self.constants[index]
        assert values is not None  # `infer` has checked this
        return values

    def attribute(self, name: str, default: int) -> int:
        """Return an integer attribute."""
        value = self.attributes.get(name, default)
        assert isinstance(value, int)  # `infer` has checked this
        return value


@dataclass(frozen=True)
class Result:
    """Shapes of the outputs; `inner` is the shape that is reduced for each element of the first output, and `products`
    the shape of a stack of matrix products."""

    shapes: Sequence[Shape]
    inner: Shape = ()
    products: Shape = ()


def elementwise(call: Call) -> Result:
    """Return the broadcast shape of all inputs."""
    return Result([broadcast(*call.shapes)])


def alike(call: Call) -> Result:
    """Return the shape of the first input."""
    return Result([call.shapes[0]])


def clip(call: Call) -> Result:
    """Return the shape of the first input; limits must be single numbers."""
    if not {call.shapes[1], call.shapes[2]} <= {(), (ONE,)}:
        raise ShapeInvalid(f"clips to limits of shapes {text(call.shapes[1])} and {text(call.shapes[2])}, not [1]")
    return alike(call)


def quantize(call: Call) -> Result:
    """Return the shape of the first input; scales and zero points are single numbers or one per index of an axis."""
    shape, scale, zero = call.shapes
    if scale != zero or (scale and scale != (shape[axis_of(call.attribute("axis", 1), len(shape))],)):
        raise ShapeInvalid(f"quantizes {text(shape)} with scales {text(scale)} and zero points {text(zero)}")
    return alike(call)


def gather(call: Call) -> Result:
    """Return the shape of elements along an axis by index."""
    data, indices = call.shapes
    axis = axis_of(call.attribute("axis", 0), len(data))
    return Result([(*data[:axis], *indices, *data[axis + 1 :])])


def scatter(call: Call) -> Result:
    """Return the shape of an array with replaced rows; their indices [k, 1] must be constant and valid."""
    data, indices, updates = call.shapes
    rows = call.constant(1)
    if len(indices) != 2 or indices[1] != ONE or not data or updates != (indices[0], *data[1:]) or data[0].per_id:
        raise ShapeInvalid(f"replaces rows {text(indices)} of {text(data)} by {text(updates)}")
    if rows.size > data[0].fixed:
        raise ShapeInvalid(f"replaces {rows.size} rows of {data[0]}")
    if rows.size and not (rows.min() >= 0 and rows.max() < data[0].fixed):
        raise ShapeInvalid(f"replaces rows {rows.min()} to {rows.max()} of {data[0]}")
    return Result([data])


def concat(call: Call) -> Result:
    """Return the shape of arrays concatenated along an axis."""
    first = call.shapes[0]
    axis = axis_of(call.attribute("axis", 0), len(first))
    if any(len(s) != len(first) or s[:axis] + s[axis + 1 :] != first[:axis] + first[axis + 1 :] for s in call.shapes):
        raise ShapeInvalid(f"can't concatenate {' and '.join(text(shape) for shape in call.shapes)}")
    return Result([(*first[:axis], added(shape[axis] for shape in call.shapes), *first[axis + 1 :])])


def split(call: Call) -> Result:
    """Return the shapes of parts of constant lengths along an axis."""
    shape, parts = call.shapes[0], numbers(call.constant(1), "lengths")
    axis = axis_of(call.attribute("axis", 0), len(shape))
    if len(parts) != call.outputs or min(parts, default=-1) < 0 or shape[axis] != Dim(sum(parts)):
        raise ShapeInvalid(f"splits {text(shape)} into {call.outputs} parts of {parts}")
    return Result([(*shape[:axis], Dim(part), *shape[axis + 1 :]) for part in parts])


def transpose(call: Call) -> Result:
    """Return the shape with its axes in another order."""
    shape, order = call.shapes[0], call.attributes["perm"]
    assert isinstance(order, tuple)
    if len(order) != len(shape):
        raise ShapeInvalid(f"orders {len(order)} axes of {text(shape)}")
    return Result([tuple(shape[axis] for axis in order)])


def reshape(call: Call) -> Result:
    """Return a constant shape, with the same number of elements."""
    return Result([reshaped(call.shapes[0], numbers(call.constant(1), "lengths"))])


def unsqueeze(call: Call) -> Result:
    """Return the shape with new axes of length 1."""
    rest, axes = list(call.shapes[0]), numbers(call.constant(1), "axes")
    rank = len(rest) + len(axes)
    new = axes_of(axes, rank)
    return Result([tuple(ONE if i in new else rest.pop(0) for i in range(rank))])


def squeeze(call: Call) -> Result:
    """Return the shape without some axes of length 1."""
    shape = call.shapes[0]
    gone = axes_of(numbers(call.constant(1), "axes"), len(shape))
    if not gone or any(shape[axis] != ONE for axis in gone):  # no axes would mean all of length 1
        raise ShapeInvalid(f"squeezes axes {sorted(gone)} of {text(shape)}")
    return Result([tuple(dim for i, dim in enumerate(shape) if i not in gone)])


def reduce(call: Call) -> Result:
    """Return the shape of a reduction along some axes."""
    shape, keep = call.shapes[0], call.attribute("keepdims", 1)
    gone = axes_of(numbers(call.constant(1), "axes"), len(shape))
    if not gone:
        raise ShapeInvalid(f"reduces no axes of {text(shape)}")  # which would mean all
    left = tuple(ONE if i in gone else dim for i, dim in enumerate(shape) if keep or i not in gone)
    return Result([left], inner=tuple(shape[axis] for axis in gone))


def matmul(call: Call) -> Result:
    """Return the shape of a product of matrices or of stacks of matrices."""
    left, right = call.shapes
    if len(left) < 2 or len(right) < 2 or left[-1] != right[-2]:
        raise ShapeInvalid(f"can't multiply {text(left)} by {text(right)}")
    stack = broadcast(left[:-2], right[:-2]) if len(left) > 2 or len(right) > 2 else ()
    return Result([(*stack, left[-2], right[-1])], inner=left[-1:], products=stack)


def gemm(call: Call) -> Result:
    """Return the shape of a product of two matrices plus a summand."""
    left, right, summand = call.shapes
    right = right[::-1] if call.attribute("transB", 0) else right
    if len(left) != 2 or len(right) != 2 or left[1] != right[0]:
        raise ShapeInvalid(f"can't multiply {text(left)} by {text(right)}")
    product = (left[0], right[1])
    if broadcast(product, summand) != product:
        raise ShapeInvalid(f"can't add {text(summand)} to {text(product)}")
    return Result([product], inner=left[1:])
