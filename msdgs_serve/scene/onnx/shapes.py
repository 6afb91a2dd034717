"""Shapes that are known before a graph runs: each dimension is a fixed number, or some for each id asked for."""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from msdgs_serve.scene.onnx.schema import MAX_OPERANDS


class ShapeInvalid(ValueError):
    """Shapes that don't fit; whoever knows the node adds its name."""


class Dim(NamedTuple):
    """`fixed + per_id · M`, where M is the number of ids of a call."""

    fixed: int
    per_id: int = 0

    def at(self, ids: int) -> int:
        """For so many ids."""
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
    """A shape without ids."""
    return tuple(Dim(length) for length in shape)


def text(shape: Shape) -> str:
    """As in `[M, 3]`."""
    return f"[{', '.join(str(dim) for dim in shape)}]"


def count(shape: Shape, ids: int) -> int:
    """Elements for so many ids."""
    return math.prod(dim.at(ids) for dim in shape)


def broadcast(*shapes: Shape) -> Shape:
    """The shape of what is computed element by element, as NumPy has it; M is taken to differ from any number."""
    rank = max(len(shape) for shape in shapes)
    result = [ONE] * rank
    for shape in shapes:
        for i, dim in enumerate(shape, start=rank - len(shape)):
            if result[i] == ONE:
                result[i] = dim
            elif dim not in (ONE, result[i]):
                raise ShapeInvalid(f"can't join {' and '.join(text(each) for each in shapes)}")
    return tuple(result)


def axis_of(axis: int, rank: int) -> int:
    """Counted from the front."""
    if not -rank <= axis < rank:
        raise ShapeInvalid(f"has no axis {axis} among {rank}")
    return axis % rank


def numbers(values: np.ndarray, what: str) -> list[int]:
    """A list of lengths or axes, as short as shapes are."""
    if values.ndim != 1 or len(values) > MAX_OPERANDS:
        raise ShapeInvalid(f"has {what} of shape {values.shape}, not a short list")
    return values.tolist()


def axes_of(axes: Sequence[int], rank: int) -> set[int]:
    """Several that differ."""
    found = {axis_of(axis, rank) for axis in axes}
    if len(found) != len(axes):
        raise ShapeInvalid(f"has axes {axes} that aren't different ones")
    return found


def reshaped(shape: Shape, target: Sequence[int]) -> Shape:
    """`shape` as `target`, of whose numbers one may be −1: what is left."""
    if any(length < 1 and length != -1 for length in target) or list(target).count(-1) > 1:
        raise ShapeInvalid(f"reshapes to {list(target)}; lengths above 0 and one −1 are known here")
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
    """Lengths side by side."""
    dims = list(dims)
    return Dim(sum(dim.fixed for dim in dims), sum(dim.per_id for dim in dims))


def _linear(shape: Shape) -> Dim:
    """The number of elements, where at most one dimension depends on the ids."""
    varying = [dim for dim in shape if dim.per_id]
    if len(varying) > 1:
        raise ShapeInvalid(f"reshapes {text(shape)}, in which several lengths depend on the ids")
    scale = math.prod(dim.fixed for dim in shape if not dim.per_id)
    dim = varying[0] if varying else ONE
    return Dim(dim.fixed * scale, dim.per_id * scale)
