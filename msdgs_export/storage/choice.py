"""The choice of a kind of storage for each group of arrays: the fewest bytes that an error allows, or the reverse."""

import re
from collections.abc import Callable, Iterator, Mapping
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np
import onnx
from onnx import TensorProto, numpy_helper

from msdgs_export.layers.graph import GraphBuilder
from msdgs_export.storage.kinds import Pack, directions, fractions, in_range, logarithms, low_rank

MIN_VALUES = 256
"""Arrays of fewer values stay float32: the nodes that unfold them would take as many bytes."""

MAX_VALUES = 1 << 26
"""Files with more float32 values stay as they are: readers limit the bytes of the values of all nodes, and unfolding
has up to six nodes per array."""


class Group(NamedTuple):
    """Arrays that are stored alike."""

    names: str  # regular expression of the names of their constants
    kinds: Mapping[str, Pack]  # from coarse to fine; the last resort is float32


def _bits(kind: Callable[[int], Pack], *bits: int) -> dict[str, Pack]:
    return {f"{n} bits": kind(n) for n in bits}


GROUPS = {
    "static means": Group(r"static_means", _bits(in_range, 16)),
    "means": Group(r"canonical_means|mean\.means", _bits(in_range, 16)),
    "static quats": Group(r"static_quats", _bits(directions, 8, 16)),
    "quats": Group(r"canonical_quats", _bits(directions, 8, 16)),
    "static scales": Group(r"static_scales", _bits(logarithms, 8, 16)),
    "scales": Group(r"canonical_log_scales", _bits(in_range, 8, 16)),
    "mean scales": Group(r"(mean|frames)\.scales", _bits(logarithms, 8, 16)),
    "mean quats": Group(r"mean\.quats", _bits(in_range, 8, 16)),
    "opacities": Group(r"(static_)?opacities", _bits(lambda bits: fractions(bits, 1.0), 8, 16)),
    "sh": Group(r"((static|canonical)_)?sh", _bits(in_range, 8, 16)),
    "modulation": Group(r"\w+_modulation", _bits(in_range, 8, 16)),
    "skinning weights": Group(r"skinning\.weight\d+", _bits(lambda bits: fractions(bits, 0.5), 8, 16)),
    "weights of bodies": Group(r"layer\d+\.body_weights", _bits(lambda bits: fractions(bits, 1.0), 8, 16)),
    "splines": Group(
        r"layer\d+\.table",
        {f"rank {rank}": low_rank(rank) for rank in (12, 16, 24, 32, 48)}
        | {"rank 64": low_rank(64, fine=24)}
        | _bits(in_range, 16),
    ),
    "shading": Group(
        r"layer\d+\.gains\.table", {f"rank {rank}": low_rank(rank) for rank in (8, 16, 32)} | _bits(in_range, 8, 16)
    ),
    "planes": Group(r"layer\d+\.grid\d+\.(space|time)", _bits(in_range, 8, 16)),
    "hash grids": Group(r"layer\d+\.now\.table", _bits(in_range, 8, 16)),
    "features of points": Group(r"layer\d+\.canonical", _bits(in_range, 8, 16)),
    "functions of time": Group(r"functions\.control", _bits(in_range, 8, 16)),
    "leading coefficients": Group(r"coefficients\d+\.leading", _bits(in_range, 8, 16)),
    "coefficients": Group(r"coefficients\d+\.rest", _bits(in_range, 8, 16)),
    "network": Group(r"layer\d+\..*weight.*", _bits(in_range, 8, 16)),
    "other": Group(r".*", _bits(in_range, 16)),
}
"""By name. A constant belongs to the first whose expression matches its whole name."""

COARSEST = {name: next(iter(group.kinds)) for name, group in GROUPS.items()}


class Stored(NamedTuple):
    """A scene file with packed arrays."""

    contents: onnx.ModelProto
    kinds: dict[str, str]  # by group, of those that are packed


def fewest_bytes(
    contents: onnx.ModelProto,
    estimate: Callable[[onnx.ModelProto], float],
    is_allowed: Callable[[onnx.ModelProto], bool],
    sample: onnx.ModelProto | None = None,
) -> Stored | None:
    """The smallest scene file that `is_allowed`, or None if only the given one is.

    All groups start with their coarsest kind, and the one with the largest squared error per byte, estimated with that
    group alone packed, becomes finer until the file is allowed: found by bisection. The estimates are of `sample`, the
    same file with fewer Gaussians, if it is given.
    """
    if not _members(contents):
        return None
    steps = [kinds for kinds in _Choice(contents if sample is None else sample, estimate).steps() if kinds]
    found, first, last = None, 0, len(steps)
    while first < last:
        middle = (first + last) // 2
        model = packed(contents, steps[middle])
        if is_allowed(model):
            found, last = Stored(model, steps[middle]), middle
        else:
            first = middle + 1
    return found


def smallest_error(contents: onnx.ModelProto, estimate: Callable[[onnx.ModelProto], float], max_bytes: int) -> Stored:
    """The scene file with the smallest sum of squared errors in `max_bytes`, or the smallest of all if none fits."""
    kinds = _Choice(contents, estimate).within_bytes(max_bytes)
    return Stored(packed(contents, kinds), kinds)


class _Choice:
    """Kinds of all groups by one estimate of their squared errors."""

    def __init__(self, contents: onnx.ModelProto, estimate: Callable[[onnx.ModelProto], float]) -> None:
        self._contents, self._estimate = contents, estimate
        self._kinds: dict[str, list[str | None]] = {name: [*GROUPS[name].kinds, None] for name in _members(contents)}
        self._alone = cache(self._packed_alone)

    def steps(self) -> list[dict[str, str]]:
        """Kinds without groups in float32, from the coarsest to none."""
        return [self._chosen(levels) for levels in self._refined()]

    def within_bytes(self, max_bytes: int) -> dict[str, str]:
        """The finest of these kinds of a file of `max_bytes`."""
        smallest = packed(self._contents, self._chosen(dict.fromkeys(self._kinds, 0)))
        *_, levels = self._refined(max_bytes - smallest.ByteSize())
        return self._chosen(levels)

    def _refined(self, free: float | None = None) -> Iterator[dict[str, int]]:
        """Levels of all groups. They start with their coarsest kind; the one with the largest error per byte that its
        next kind adds gets it, until all are float32, or until no group with an error has a kind that adds no more than
        the `free` bytes."""
        levels = dict.fromkeys(self._kinds, 0)
        while True:
            yield levels
            left = {name: level for name, level in levels.items() if self._kinds[name][level] is not None}
            if free is not None:
                left = {n: k for n, k in left.items() if self._alone(n, k)[0] and self._added_bytes(n, k) <= free}
            if not left:
                return
            name = max(left, key=lambda name: self._gain(name, left[name]))
            free = None if free is None else free - self._added_bytes(name, levels[name])
            levels = levels | {name: levels[name] + 1}

    def _chosen(self, levels: Mapping[str, int]) -> dict[str, str]:
        kinds = {name: self._kinds[name][level] for name, level in levels.items()}
        return {name: kind for name, kind in kinds.items() if kind is not None}

    def _gain(self, name: str, level: int) -> float:
        return self._alone(name, level)[0] / max(self._added_bytes(name, level), 1)

    def _added_bytes(self, name: str, level: int) -> int:
        """How much larger a file is in which this group has its next kind."""
        return self._alone(name, level + 1)[1] - self._alone(name, level)[1]

    def _packed_alone(self, name: str, level: int) -> tuple[float, int]:
        """Squared error and bytes of a file in which only this group is packed."""
        kind = self._kinds[name][level]
        if kind is None:
            return 0.0, self._contents.ByteSize()
        model = packed(self._contents, {name: kind})
        return max(0.0, self._estimate(model) - self._before), model.ByteSize()

    @cached_property
    def _before(self) -> float:
        return self._estimate(self._contents)


def packed(contents: onnx.ModelProto, kinds: Mapping[str, str]) -> onnx.ModelProto:
    """A copy of a scene file in which some groups are stored by these kinds."""
    members, graph = _members(contents), GraphBuilder()
    for name, kind in kinds.items():
        for constant in members.get(name, ()):
            GROUPS[name].kinds[kind](graph, constant.name, numpy_helper.to_array(constant))
    replaced = {constant.name for name in kinds for constant in members.get(name, ())}
    model = onnx.ModelProto()
    model.CopyFrom(contents)
    del model.graph.initializer[:], model.graph.node[:]
    model.graph.initializer.extend(each for each in contents.graph.initializer if each.name not in replaced)
    model.graph.initializer.extend(graph.constants.values())
    model.graph.node.extend([*graph.nodes, *contents.graph.node])
    return model


def _members(contents: onnx.ModelProto) -> dict[str, list[onnx.TensorProto]]:
    """The constants of a scene file that can be packed, by group."""
    quantizers = {"QuantizeLinear", "DequantizeLinear"}  # whose factors must be constants of the file
    taken = {name for node in contents.graph.node if node.op_type in quantizers for name in node.input}
    taken |= {each.name for each in contents.graph.input}
    floats = [each for each in contents.graph.initializer if each.data_type == TensorProto.FLOAT]
    if sum(int(np.prod(each.dims)) for each in floats) > MAX_VALUES:
        return {}
    members: dict[str, list[onnx.TensorProto]] = {}
    for each in floats:
        if each.name not in taken and np.prod(each.dims) >= MIN_VALUES:
            name = next(name for name, group in GROUPS.items() if re.fullmatch(group.names, each.name))
            members.setdefault(name, []).append(each)
    return members
