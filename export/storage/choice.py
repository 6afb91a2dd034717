"""The choice of a kind of storage for each group of arrays: the fewest bytes that an error allows."""

import re
from collections.abc import Callable, Mapping
from functools import cache
from typing import NamedTuple

import numpy as np
import onnx
from onnx import TensorProto, numpy_helper

from export.layers.graph import GraphBuilder
from export.storage.kinds import Pack, directions, fractions, in_range, logarithms

MIN_VALUES = 256
"""Arrays of fewer values stay float32: the nodes that unfold them would take as many bytes."""

MAX_VALUES = 1 << 27
"""Files with more float32 values stay as they are: readers limit the bytes of the values of all nodes, and unfolding
has up to five nodes per array."""


class Group(NamedTuple):
    """Arrays that are stored alike."""

    names: str  # regular expression of the names of their constants
    kinds: Mapping[str, Pack]  # from coarse to fine; the last resort is float32


def _bits(kind: Callable[[int], Pack], *bits: int) -> dict[str, Pack]:
    return {f"{n} bits": kind(n) for n in bits}


GROUPS = {
    "static means": Group(r"static_means", _bits(in_range, 16)),
    "means": Group(r"canonical_means", _bits(in_range, 16)),
    "static quats": Group(r"static_quats", _bits(directions, 8, 16)),
    "quats": Group(r"canonical_quats", _bits(directions, 8, 16)),
    "static scales": Group(r"static_scales", _bits(logarithms, 8, 16)),
    "scales": Group(r"canonical_log_scales", _bits(in_range, 8, 16)),
    "opacities": Group(r"opacities", _bits(lambda bits: fractions(bits, 1.0), 8, 16)),
    "sh": Group(r"sh", _bits(in_range, 8, 16)),
    "modulation": Group(r"\w+_modulation", _bits(in_range, 8, 16)),
    "skinning weights": Group(r"skinning\.weight\d+", _bits(lambda bits: fractions(bits, 0.5), 8, 16)),
    "curves and planes": Group(r"layer\d+\.(table|space|time)", _bits(in_range, 8, 16)),
    "network": Group(r"layer\d+\..*weight.*", _bits(in_range, 8, 16)),
    "other": Group(r".*", _bits(in_range, 16)),
}
"""By name. A constant belongs to the first whose expression matches its whole name."""


class Stored(NamedTuple):
    """A scene file with packed arrays."""

    contents: onnx.ModelProto
    kinds: dict[str, str]  # by group, of those that are packed


def fewest_bytes(
    contents: onnx.ModelProto,
    estimate: Callable[[onnx.ModelProto], float],
    is_allowed: Callable[[onnx.ModelProto], bool],
    allowed: float,
) -> Stored | None:
    """The smallest scene file that `is_allowed`, or None if only the given one is.

    Groups are packed one at a time to `estimate` their squared errors, which add up. All groups start with their
    coarsest kind; while the sum is above `allowed`, the group with the largest error per byte gets its next kind.
    """
    present = {name: [*GROUPS[name].kinds, None] for name in _members(contents)}

    @cache
    def alone(name: str, level: int) -> tuple[float, int]:
        kind = present[name][level]
        model = contents if kind is None else packed(contents, {name: kind})
        return max(0.0, estimate(model) - before) if kind else 0.0, model.ByteSize()

    def gain(name: str) -> float:
        level = levels[name]
        finer = alone(name, level + 1) if level + 1 < len(present[name]) else None
        return alone(name, level)[0] / max(finer[1] - alone(name, level)[1], 1) if finer else -1.0

    before, levels = estimate(contents), dict.fromkeys(present, 0)
    while True:
        while (total := sum(alone(name, level)[0] for name, level in levels.items())) > allowed:
            levels[max(levels, key=gain)] += 1
        kinds = {name: kind for name, level in levels.items() if (kind := present[name][level]) is not None}
        if not kinds:
            return None
        model = packed(contents, kinds)
        if is_allowed(model):
            return Stored(model, kinds)
        if not total:
            return None
        allowed = total / 2


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
