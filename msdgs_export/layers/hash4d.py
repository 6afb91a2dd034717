"""A layer of kind `hash4d` as a graph.

Features over space are constants of each point. The grids over time become planes once a call, between two nodes of
time of each level; points then read four nodes of each plane.
"""

import copy
from typing import NamedTuple, cast

import numpy as np
import torch
from onnx import TensorProto

from msdgs_export.layers.base import HEAD_COLUMNS, FieldLayerExport, LayerInputs, ModelNotExportable, heads_of, zero
from msdgs_export.layers.graph import GraphBuilder, affine, to_numpy
from msdgs_train.layers.base import DeformationLayer
from msdgs_train.layers.hash4d import AXES, MIN_SQUARED_NORM, TIME_MARGIN, TURN, Hash4DLayer
from msdgs_train.layers.hash_grid import HashGrid
from msdgs_train.layers.hash_kernels import Levels, row_of

CANONICAL = "canonical"
"""Name of a point's features over space."""

MAX_ROWS = 1 << 24
"""Nodes of all grids over time, hashed ones too: a graph has no hashes, so it stores each node."""


class Hash4DExport(FieldLayerExport):
    """Exports `Hash4DLayer`."""

    def outputs(self, graph: GraphBuilder, inputs: LayerInputs, rows: np.ndarray) -> str:
        """Features over time, a hidden layer times the factors of features over space, then a product for all heads."""
        name, layer = inputs.name, cast(Hash4DLayer, inputs.layer)
        features = _temporal_features(graph, name, layer, inputs)
        hidden = affine(graph, f"{name}.temporal", features, layer.from_temporal.weight, layer.from_temporal.bias)
        hidden = graph.node("Relu", [hidden], f"{name}.temporal.relu")
        hidden = graph.node("Mul", [hidden, _factors(graph, name, layer, inputs)], f"{name}.product")
        for i, linear in enumerate(layer.hidden):
            weights = (linear.get_parameter(kind) for kind in ("weight", "bias"))
            hidden = graph.node(
                "Relu", [affine(graph, f"{name}.hidden{i}", hidden, *weights)], f"{name}.hidden{i}.relu"
            )
        moves = rows[:1].tolist() == [0]  # the first three are shifts of means
        used = np.concatenate([np.arange(TURN if moves else 0), TURN + rows])
        columns = affine(graph, f"{name}.heads", hidden, layer.heads.weight[used], layer.heads.bias[used])
        if not moves:
            return columns
        sizes, parts = [1, TURN - 1, 3, len(rows) - 3], [f"{name}.{part}" for part in ("w", "axis", "shift", "rest")]
        w, axis, shift, rest = graph.split(columns, parts, sizes)
        turned = _displacements(graph, f"{name}.turn", w, axis, inputs.means)
        return graph.node(
            "Concat", [graph.node("Add", [shift, turned], f"{name}.shifted"), rest], f"{name}.outputs", axis=1
        )

    def point_constants(self, layer: DeformationLayer, points: np.ndarray) -> dict[str, np.ndarray]:
        """Features over space, [N, L · C]."""
        layer = cast(Hash4DLayer, layer)
        with torch.no_grad():
            places = layer.places(torch.from_numpy(points), layer.first_time)
            return {CANONICAL: to_numpy(layer.canonical(places[:, :3]))}

    def inert_heads(self, layer: DeformationLayer) -> frozenset[str]:
        """Heads whose rows of the last Linear are all 0."""
        heads, columns = cast(Hash4DLayer, layer).heads, heads_of(layer).columns
        rows = {name: _rows_of(name, part) for name, part in columns.items()}
        return frozenset(n for n, part in rows.items() if not (heads.weight[part].any() or heads.bias[part].any()))

    def without_heads(self, layer: DeformationLayer, names: frozenset[str]) -> DeformationLayer:
        """Set these rows of the last Linear to 0."""
        layer = copy.deepcopy(cast(Hash4DLayer, layer))
        for name in names:
            part = _rows_of(name, HEAD_COLUMNS[name])
            zero(layer.heads.weight[part], layer.heads.bias[part])
        return layer


def _rows_of(head: str, columns: slice) -> slice:
    """Rows of the last Linear; the quaternion of a turn is part of the head of means."""
    return slice(0 if head == "means" else TURN + columns.start, TURN + columns.stop)


class _Planes(NamedTuple):
    """P planes over two axes of space at one time: all levels of the first grid, of the second and of the third."""

    levels: np.ndarray  # [P]
    axes: np.ndarray  # [P, 2]
    sizes: np.ndarray  # [P] nodes at one time
    starts: np.ndarray  # [P] first row of its nodes in a table of all planes' at one time
    table: np.ndarray  # [rows, C] nodes at all times of the first plane, then of the next
    first_rows: np.ndarray  # [P] in that table

    @classmethod
    def of(cls, grids: list[HashGrid]) -> "_Planes":
        """Raises `ModelNotExportable` if there are too many nodes."""
        levels, numbers = grids[0].levels, np.arange(len(grids[0].levels.nodes))
        total = len(grids) * int(np.prod(levels.nodes, axis=1).sum())
        if total > MAX_ROWS:
            problem = f"its hash grids have {total:,} nodes over time, of which a scene file holds up to {MAX_ROWS:,}"
            raise ModelNotExportable(problem)
        tables = [to_numpy(grid.table)[_rows_of_nodes(levels, int(k))] for grid in grids for k in numbers]
        sizes = np.tile(np.prod(levels.nodes[:, :2], axis=1), len(grids))
        return cls(
            np.tile(numbers, len(grids)),
            np.repeat(np.array(AXES), len(numbers), axis=0),
            sizes,
            np.cumsum(sizes) - sizes,
            np.concatenate(tables),
            np.cumsum([0, *map(len, tables[:-1])]),
        )


def _rows_of_nodes(levels: Levels, level: int) -> np.ndarray:
    """Rows of the table of all nodes of a level, by time, then by the second and by the first axis."""
    z, y, x = (index.reshape(-1) for index in np.indices(tuple(levels.nodes[level, ::-1].tolist())))
    return row_of(levels, level, x, y, z)


def _temporal_features(graph: GraphBuilder, name: str, layer: Hash4DLayer, inputs: LayerInputs) -> str:
    """[M, 3 · L · C] features of the grids over time."""
    grids = [cast(HashGrid, grid) for grid in layer.temporal]
    levels, planes = grids[0].levels, _Planes.of(grids)
    half = graph.constant(f"{name}.half_sizes", to_numpy(layer.half_sizes))
    sides = graph.constant(f"{name}.sides", 2 * to_numpy(layer.half_sizes))
    space = graph.node("Div", [graph.node("Add", [inputs.means, half], f"{name}.from_corner"), sides], f"{name}.space")
    time = _time(graph, name, layer, inputs.time)
    table, inside = _at_time(graph, f"{name}.now", planes, levels, time), _inside(graph, name, planes, space, time)
    cells, shares = [], []
    for axis in (0, 1):
        columns = graph.constant(f"{name}.axes{axis}", planes.axes[:, axis])
        places = graph.node("Gather", [space, columns], f"{name}.places{axis}", axis=1)
        sizes = levels.scales[planes.levels, axis], levels.nodes[planes.levels, axis]
        cell, share = _cells(graph, f"{name}.cells{axis}", places, *sizes)
        cells.append(cell)
        shares.append(_unsqueezed(graph, f"{name}.share{axis}", share, 2))
    widths = levels.nodes[planes.levels, 0]
    lines = graph.node("Mul", [cells[1], graph.constant(f"{name}.widths", widths)], f"{name}.lines")
    first = graph.node("Add", [cells[0], graph.constant(f"{name}.starts", planes.starts)], f"{name}.columns")
    first, corners = graph.node("Add", [first, lines], f"{name}.rows"), list[str]()
    for k, step in enumerate((0 * widths, 0 * widths + 1, widths, widths + 1)):
        rows = graph.node("Add", [first, graph.constant(f"{name}.step{k}", step)], f"{name}.rows{k}")
        corners.append(graph.node("Gather", [table, rows], f"{name}.corner{k}"))
    low, high = (_between(graph, f"{name}.line{k}", corners[2 * k], corners[2 * k + 1], shares[0]) for k in (0, 1))
    read = _between(graph, f"{name}.read", low, high, shares[1])
    masked = graph.node("Mul", [read, _unsqueezed(graph, f"{name}.mask", inside, 2)], f"{name}.masked")
    shape = graph.constant(f"{name}.shape", np.array([-1, layer.from_temporal.in_features]))
    return graph.node("Reshape", [masked, shape], f"{name}.features")


def _time(graph: GraphBuilder, name: str, layer: Hash4DLayer, time: str) -> str:
    """[1, 1] the place of a time in the grids' cube."""
    first, duration = (graph.constant(f"{name}.{n}", to_numpy(getattr(layer, n))) for n in ("first_time", "duration"))
    margin, middle = (
        graph.constant(f"{name}.{n}", np.array(v, np.float32))
        for n, v in (("margin", TIME_MARGIN), ("middle", 1 - 2 * TIME_MARGIN))
    )
    part = graph.node("Div", [graph.node("Sub", [time, first], f"{name}.since"), duration], f"{name}.part")
    return graph.node("Add", [graph.node("Mul", [part, middle], f"{name}.spread"), margin], f"{name}.time")


def _at_time(graph: GraphBuilder, name: str, planes: _Planes, levels: Levels, time: str) -> str:
    """[nodes, C] all planes at one time, a step between those of two nodes of time."""
    cell, share = _cells(graph, f"{name}.cell", time, levels.scales[:, 2], levels.nodes[:, 2])
    flat = graph.constant(f"{name}.flat", np.array([-1], np.int64))
    cell, share = (graph.node("Reshape", [v, flat], f"{name}.{n}") for n, v in (("cells", cell), ("shares", share)))
    strides = np.prod(levels.nodes[:, :2], axis=1)
    level_of = graph.constant(f"{name}.level_of", np.repeat(planes.levels, planes.sizes).astype(np.uint8))
    level_of = graph.node("Cast", [level_of], f"{name}.levels", to=TensorProto.INT64)
    own = np.concatenate([first + np.arange(n) for first, n in zip(planes.first_rows, planes.sizes, strict=True)])
    own = graph.node(
        "Cast", [graph.constant(f"{name}.own", own.astype(np.int32))], f"{name}.first", to=TensorProto.INT64
    )
    table, read = graph.constant(f"{name}.table", planes.table), list[str]()
    for k in (0, 1):
        node = graph.node("Add", [cell, graph.constant(f"{name}.step{k}", np.array(k, np.int64))], f"{name}.node{k}")
        skipped = graph.node("Mul", [node, graph.constant(f"{name}.strides", strides)], f"{name}.skipped{k}")
        skipped = graph.node("Gather", [skipped, level_of], f"{name}.to{k}")
        rows = graph.node("Add", [own, skipped], f"{name}.rows{k}")
        read.append(graph.node("Gather", [table, rows], f"{name}.at{k}"))
    share = _unsqueezed(graph, f"{name}.share", graph.node("Gather", [share, level_of], f"{name}.of_each"), 1)
    return _between(graph, f"{name}.planes", read[0], read[1], share)


def _cells(graph: GraphBuilder, name: str, places: str, scales: np.ndarray, nodes: np.ndarray) -> tuple[str, str]:
    """The node below and the share of the next one, of the shape of places in [0, 1], which are clamped."""
    zero, one, two, three = (graph.constant(f"{name}.{v}", np.array(v, np.float32)) for v in (0, 1, 2, 3))
    inside = graph.node("Clip", [places, zero, one], f"{name}.inside")
    inside = graph.node("Mul", [inside, graph.constant(f"{name}.scales", scales)], f"{name}.scaled")
    last = graph.constant(f"{name}.last", (nodes - 2).astype(np.float32))
    below = graph.node("Min", [graph.node("Floor", [inside], f"{name}.floor"), last], f"{name}.below")
    part = graph.node("Sub", [inside, below], f"{name}.part")
    slope = graph.node("Sub", [three, graph.node("Mul", [two, part], f"{name}.twice")], f"{name}.slope")
    share = graph.node("Mul", [graph.node("Mul", [part, part], f"{name}.square"), slope], f"{name}.share")
    return graph.node("Cast", [below], f"{name}.index", to=TensorProto.INT64), share


def _inside(graph: GraphBuilder, name: str, planes: _Planes, space: str, time: str) -> str:
    """[M, P] 1 where the axes of a plane and the time are in [0, 1], else 0."""
    zero, one = (graph.constant(f"{name}.edges.{v}", np.array(v, np.float32)) for v in (0, 1))

    def outside(place: str, value: str) -> str:
        both = [
            graph.node("Less", sides, f"{name}.{place}.{n}")
            for n, sides in (("below", [value, zero]), ("above", [one, value]))
        ]
        return graph.node(
            "Add",
            [graph.node("Cast", [each], f"{each}.number", to=TensorProto.FLOAT) for each in both],
            f"{name}.{place}",
        )

    axes = outside("outside", space)
    parts = [
        graph.node("Gather", [axes, graph.constant(f"{name}.axes{k}", planes.axes[:, k])], f"{name}.outside{k}", axis=1)
        for k in (0, 1)
    ]
    count = graph.node("Add", parts, f"{name}.outsides")
    count = graph.node(
        "Min", [graph.node("Add", [count, outside("late", time)], f"{name}.all_outsides"), one], f"{name}.is_outside"
    )
    return graph.node("Sub", [one, count], f"{name}.is_inside")


def _factors(graph: GraphBuilder, name: str, layer: Hash4DLayer, inputs: LayerInputs) -> str:
    """[M, width] 2 σ(·) − 1 of features over space."""
    linear = layer.from_canonical
    value = affine(graph, f"{name}.from_canonical", inputs.constants[CANONICAL], linear.weight, linear.bias)
    one, two = (graph.constant(f"{name}.factors.{v}", np.array(v, np.float32)) for v in (1, 2))
    twice = graph.node("Mul", [two, graph.node("Sigmoid", [value], f"{name}.sigmoid")], f"{name}.twice")
    return graph.node("Sub", [twice, one], f"{name}.factors")


def _displacements(graph: GraphBuilder, name: str, w: str, axis: str, means: str) -> str:
    """[M, 3] as `layers.hash4d.displacements`, of quaternions minus the identity."""
    one, two, least = (
        graph.constant(f"{name}.{n}", np.array(v, np.float32))
        for n, v in (("one", 1), ("two", 2), ("least", MIN_SQUARED_NORM))
    )
    w = graph.node("Add", [w, one], f"{name}.w")
    cross = _cross(graph, f"{name}.cross", axis, means)
    sums = graph.constant(f"{name}.ones", np.ones((3, 1), np.float32))
    squared = graph.node("MatMul", [graph.node("Mul", [axis, axis], f"{name}.squares"), sums], f"{name}.sums")
    squared = graph.node("Add", [squared, graph.node("Mul", [w, w], f"{name}.w2")], f"{name}.norms")
    factor = graph.node("Div", [two, graph.node("Max", [squared, least], f"{name}.divisors")], f"{name}.factor")
    parts = [graph.node("Mul", [w, cross], f"{name}.first"), _cross(graph, f"{name}.second", axis, cross)]
    return graph.node("Mul", [factor, graph.node("Add", parts, f"{name}.sum")], f"{name}.displaced")


def _cross(graph: GraphBuilder, name: str, left: str, right: str) -> str:
    """[M, 3] cross products."""
    orders = [graph.constant(f"{name}.{n}", np.array(v)) for n, v in (("next", [1, 2, 0]), ("last", [2, 0, 1]))]
    products = []
    for k, pair in enumerate((orders, orders[::-1])):
        factors = (
            graph.node("Gather", [value, order], f"{name}.{k}.{side}", axis=1)
            for side, value, order in zip(("left", "right"), (left, right), pair, strict=True)
        )
        products.append(graph.node("Mul", list(factors), f"{name}.{k}"))
    return graph.node("Sub", products, name)


def _between(graph: GraphBuilder, name: str, low: str, high: str, share: str) -> str:
    """low + share · (high − low)."""
    step = graph.node("Mul", [share, graph.node("Sub", [high, low], f"{name}.span")], f"{name}.step")
    return graph.node("Add", [low, step], name)


def _unsqueezed(graph: GraphBuilder, name: str, value: str, axis: int) -> str:
    return graph.node("Unsqueeze", [value, graph.constant(f"{name}.axis", np.array([axis], np.int64))], name)
