"""A layer of kind `plane` as a graph of gathers and interpolations, which are faster than GridSample on a CPU."""

import copy
from typing import cast

import numpy as np
import torch
from onnx import TensorProto

from msdgs_export.layers.base import HEADS, FieldLayerExport, LayerInputs, heads_of, zero
from msdgs_export.layers.graph import GraphBuilder, affine, to_numpy
from msdgs_train.layers.base import DeformationLayer
from msdgs_train.layers.plane import PlaneGrid, PlaneLayer

FIRST_AXES = np.array([0, 0, 1], np.int64)  # of the planes xy, xz, yz
SECOND_AXES = np.array([1, 2, 2], np.int64)


class PlaneExport(FieldLayerExport):
    """Exports `PlaneLayer`."""

    def outputs(self, graph: GraphBuilder, inputs: LayerInputs, rows: np.ndarray) -> str:
        """Features of the planes, then a hidden layer and a product for each head."""
        name, layer = inputs.name, cast(PlaneLayer, inputs.layer)
        grids = enumerate(layer.plane_grids())
        read = [_features(graph, f"{name}.grid{i}", grid, inputs.means, inputs.time) for i, grid in grids]
        features = graph.node("Concat", read, f"{name}.features", axis=1) if len(read) > 1 else read[0]
        hidden = affine(graph, f"{name}.features.linear", features, layer.features.weight, layer.features.bias)
        hidden = graph.node("Relu", [hidden], f"{name}.features.relu")
        weights, biases = (torch.cat([each.get_parameter(n) for each in layer.hidden]) for n in ("weight", "bias"))
        hidden = graph.node("Relu", [affine(graph, f"{name}.hidden", hidden, weights, biases)], f"{name}.hidden.relu")
        # each head reads its own hidden units
        heads = torch.block_diag(*(head.get_parameter("weight") for head in layer.heads))
        bias = torch.cat([head.get_parameter("bias") for head in layer.heads])
        return affine(graph, f"{name}.heads", hidden, heads[rows], bias[rows])

    def inert_heads(self, layer: DeformationLayer) -> frozenset[str]:
        """Heads whose Linear is all 0."""
        heads = zip(heads_of(layer).columns, cast(PlaneLayer, layer).heads, strict=False)  # the weight's comes last
        return frozenset(name for name, head in heads if not any(p.any() for p in head.parameters()))

    def without_heads(self, layer: DeformationLayer, names: frozenset[str]) -> DeformationLayer:
        """Set the Linears of these heads to 0."""
        layer = copy.deepcopy(cast(PlaneLayer, layer))
        for name in names:
            zero(*layer.heads[HEADS.index(name)].parameters())
        return layer


def _features(graph: GraphBuilder, name: str, grid: PlaneGrid, means: str, time: str) -> str:
    """[M, C] the features of one grid at the means [M, 3]."""
    size, channels = grid.space.shape[1], grid.space.shape[3]
    scaled = graph.node("Mul", [means, graph.constant(f"{name}.cells", to_numpy(grid.cells))], f"{name}.scaled")
    origin = graph.constant(f"{name}.origin", to_numpy(grid.origin))
    positions = graph.node("Add", [scaled, origin], f"{name}.positions")
    cells, parts = _cells(graph, f"{name}.xyz", positions, size)
    lines = _lines(graph, name, grid, time)
    over_time = _interpolated_lines(graph, name, lines, cells, parts, size)
    table = graph.constant(f"{name}.space", to_numpy(grid.space).reshape(-1, channels))
    over_space = _interpolated_planes(graph, name, table, cells, parts, size)
    return graph.node("Mul", [over_space, over_time], f"{name}.features")


def _cells(graph: GraphBuilder, name: str, positions: str, nodes: int) -> tuple[str, str]:
    """Index of the node below, int64, and the fraction of the way to the next, both of the shape of `positions`."""
    zero = graph.constant(f"{name}.zero", np.array(0, np.float32))
    last, last_cell = (
        graph.constant(f"{name}.{n}", np.array(v, np.float32))
        for n, v in (("last", nodes - 1), ("last_cell", nodes - 2))
    )
    inside = graph.node("Clip", [positions, zero, last], f"{name}.inside")
    below = graph.node("Min", [graph.node("Floor", [inside], f"{name}.floor"), last_cell], f"{name}.below")
    parts = graph.node("Sub", [inside, below], f"{name}.parts")
    return graph.node("Cast", [below], f"{name}.cell", to=TensorProto.INT64), parts


def _lines(graph: GraphBuilder, name: str, grid: PlaneGrid, time: str) -> str:
    """[3 S, C] the planes over time at `time`, [1, 1]: one lookup per call, for any number of ids."""
    nodes, channels = grid.time.shape[1], grid.time.shape[3]
    first = graph.constant(f"{name}.first_time", to_numpy(grid.first_time))
    rate = graph.constant(f"{name}.time_cells", to_numpy(grid.time_cells))
    since = graph.node("Sub", [time, first], f"{name}.since")
    cell, part = _cells(graph, f"{name}.t", graph.node("Mul", [since, rate], f"{name}.t.position"), nodes)
    rows = to_numpy(grid.time).transpose(1, 0, 2, 3).reshape(nodes, -1)
    table = graph.constant(f"{name}.time", rows)
    one = graph.constant(f"{name}.t.one", np.array(1, np.int64))
    flat = graph.constant(f"{name}.t.flat", np.array([1], np.int64))
    cell = graph.node("Reshape", [cell, flat], f"{name}.t.row")
    low = graph.node("Gather", [table, cell], f"{name}.t.low")
    high = graph.node("Gather", [table, graph.node("Add", [cell, one], f"{name}.t.next")], f"{name}.t.high")
    line = _between(graph, f"{name}.lines", low, high, part)
    return graph.node(
        "Reshape", [line, graph.constant(f"{name}.lines.shape", np.array([-1, channels]))], f"{name}.table"
    )


def _interpolated_lines(graph: GraphBuilder, name: str, lines: str, cells: str, parts: str, size: int) -> str:
    """[M, C] the product of the three lines' values."""
    offsets = graph.constant(f"{name}.lines.offsets", np.arange(3, dtype=np.int64) * size)
    rows = graph.node("Add", [cells, offsets], f"{name}.lines.rows")
    low, high = _gathered(graph, f"{name}.lines", lines, rows, (0, 1))
    share = _with_channels(graph, f"{name}.lines.parts", parts)
    return _product(graph, f"{name}.over_time", _between(graph, f"{name}.lines.at", low, high, share))


def _interpolated_planes(graph: GraphBuilder, name: str, table: str, cells: str, parts: str, size: int) -> str:
    """[M, C] the product of the three planes' values, from a table of [3 S², C]."""
    sides = (("first", FIRST_AXES), ("second", SECOND_AXES))

    def along(value: str, which: str, axes: np.ndarray, what: str) -> str:
        axis = graph.constant(f"{name}.planes.{which}", axes)
        return graph.node("Gather", [value, axis], f"{name}.planes.{which}.{what}", axis=1)

    first, second = (along(cells, *side, "cells") for side in sides)
    a, b = (_with_channels(graph, f"{name}.planes.{side[0]}.parts", along(parts, *side, "part")) for side in sides)
    width = graph.constant(f"{name}.planes.width", np.array(size, np.int64))
    offsets = graph.constant(f"{name}.planes.offsets", np.arange(3, dtype=np.int64) * size * size)
    rows = graph.node("Mul", [first, width], f"{name}.planes.lines")
    rows = graph.node(
        "Add", [graph.node("Add", [rows, second], f"{name}.planes.nodes"), offsets], f"{name}.planes.rows"
    )
    v00, v01, v10, v11 = _gathered(graph, f"{name}.planes", table, rows, (0, 1, size, size + 1))
    low = _between(graph, f"{name}.planes.low", v00, v01, b)
    high = _between(graph, f"{name}.planes.high", v10, v11, b)
    return _product(graph, f"{name}.over_space", _between(graph, f"{name}.planes.at", low, high, a))


def _gathered(graph: GraphBuilder, name: str, table: str, rows: str, steps: tuple[int, ...]) -> list[str]:
    """[M, 3, C] rows of a table, once for each offset of `steps`."""
    values = []
    for step in steps:
        offset = graph.constant(f"{name}.step{step}", np.array(step, np.int64))
        moved = graph.node("Add", [rows, offset], f"{name}.rows{step}") if step else rows
        values.append(graph.node("Gather", [table, moved], f"{name}.values{step}"))
    return values


def _with_channels(graph: GraphBuilder, name: str, parts: str) -> str:
    return graph.node("Unsqueeze", [parts, graph.constant(f"{name}.axis", np.array([2], np.int64))], name)


def _between(graph: GraphBuilder, name: str, low: str, high: str, part: str) -> str:
    """low + part · (high − low)."""
    step = graph.node("Mul", [part, graph.node("Sub", [high, low], f"{name}.span")], f"{name}.step")
    return graph.node("Add", [low, step], name)


def _product(graph: GraphBuilder, name: str, values: str) -> str:
    """[M, 3, C] → [M, C]."""
    axis = graph.constant(f"{name}.axis", np.array([1], np.int64))
    return graph.node("ReduceProd", [values, axis], name, keepdims=0)
