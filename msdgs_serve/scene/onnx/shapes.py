"""Shapes that are known before a graph runs: dimensions are fixed or proportional to the number of ids of a call."""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from msdgs_serve.scene.onnx.schema import MAX_OPERANDS


class ShapeInvalid(ValueError):
    """Shapes don't fit; the caller adds the name of the node."""


class Dim(NamedTuple):
    """`fixed + per_id · M`, where M is the number of ids of a call."""

    fixed: int
    per_id: int = 0

    def at(self, ids: int) -> int:
        """Return the length for a number of ids."""
        return self.fixed + self.per_id * ids

    def __str__(self) -> str:
        if not self.per_id:
            return str(self.fixed)
        per_id = "M" if self.per_id == 1 else f"{self.per_id} M"
        return f"{per_id} + {self.fixed}" if self.fixed else per_id


ONE = Dim(1)
IDS = Dim(0, 1)
Shape = tuple[Dim, ...]


def fixed(shape: Iterable[int]) -> Shape:
    """Return a shape of fixed lengths."""
    return tuple(Dim(length) for length in shape)


def text(shape: Shape) -> str:
    """Return a shape as text, such as `[M, 3]`."""
    return f"[{', '.join(str(dim) for dim in shape)}]"


def count(shape: Shape, ids: int) -> int:
    """Return the number of elements for a number of ids."""
    return math.prod(dim.at(ids) for dim in shape)


def broadcast(*shapes: Shape) -> Shape:
    """Return the broadcast shape, as in NumPy; M counts as different from any number."""
    rank = max(len(shape) for shape in shapes)
    result = [ONE] * rank
    for shape in shapes:
        for i, dim in enumerate(shape, start=rank - len(shape)):
            if result[i] == ONE:
                result[i] = dim
            elif dim not in (ONE, result[i]):
                raise ShapeInvalid(f"can't broadcast {' and '.join(text(each) for each in shapes)}")
    return tuple(result)


def axis_of(axis: int, rank: int) -> int:
    """Return a non-negative axis."""
    if not -rank <= axis < rank:
        raise ShapeInvalid(f"has no axis {axis} among {rank}")
    return axis % rank


def numbers(values: np.ndarray, name: str) -> list[int]:
    """Return a list of lengths or axes; `name` is for messages."""
    if values.ndim != 1 or len(values) > MAX_OPERANDS:
        raise ShapeInvalid(f"has {name} of shape {values.shape}, not a short list")
    return values.tolist()


def axes_of(axes: Sequence[int], rank: int) -> set[int]:
    """Return non-negative axes, which must be different."""
    found = {axis_of(axis, rank) for axis in axes}
    if len(found) != len(axes):
        raise ShapeInvalid(f"has duplicate axes {axes}")
    return found


def reshaped(shape: Shape, target: Sequence[int]) -> Shape:
    """Return `shape` reshaped to `target`, in which one length may be −1 for the remaining elements."""
    if any(length < 1 and length != -1 for length in target) or list(target).count(-1) > 1:
        raise ShapeInvalid(f"reshapes to {list(target)}; lengths must be above 0, and one may be −1")
    total = _linear(shape)
    known = math.prod(length for length in target if length != -1)
    if -1 not in target:
        if total != Dim(known):
            raise ShapeInvalid(f"can't reshape {text(shape)} to {list(target)}")
        return fixed(target)
    if total.fixed % known or total.per_id % known:
        raise ShapeInvalid(f"can't reshape {text(shape)} to {list(target)}")
    rest = Dim(total.fixed // known, total.per_id // known)
    return tuple(rest if length == -1 else Dim(length) for length in target)


def added(dims: Iterable[Dim]) -> Dim:
    """Return the sum of lengths."""
    dims = list(dims)
    return Dim(sum(dim.fixed for dim in dims), sum(dim.per_id for dim in dims))


def _linear(shape: Shape) -> Dim:
    """Return the number of elements; at most one dimension may depend on the ids."""
    varying = [dim for dim in shape if dim.per_id]
    if len(varying) > 1:
        raise ShapeInvalid(f"reshapes {text(shape)}, in which several lengths depend on the ids")
    scale = math.prod(dim.fixed for dim in shape if not dim.per_id)
    dim = varying[0] if varying else ONE
    return Dim(dim.fixed * scale, dim.per_id * scale)
