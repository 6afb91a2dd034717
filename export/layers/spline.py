"""A layer of kind `bases` as a graph: motion splines once per call, then linear blend skinning of each Gaussian."""

from collections.abc import Mapping
from typing import cast

import numpy as np
import torch
from onnx import TensorProto
from torch import Tensor, nn

from export.layers.base import LayerInputs
from export.layers.graph import GraphBuilder, to_numpy
from msdgs_serve.scene.quaternion import MIN_NORM
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.model import carried
from msdgs_train.supports.nodes import BasisLayer, SkinningInputs
from msdgs_train.supports.skinning_kernels import K_NEAREST, LEAST_STRETCH

KNOTS = 4
"""Knots that the value at a time depends on."""


class SplineExport:
    """Of `BasisLayer`."""

    removable_heads: frozenset[str] = frozenset()
    parameters = frozenset({"skinning_logits", "node_ids"})
    bytes_per_gaussian = K_NEAREST * (4 + 1)  # a weight in float32 and an id in 8 bits for each motion

    def attributes(self, gaussians: CanonicalGaussians) -> dict[str, np.ndarray]:
        """`skinning_weights`, [N, F], whose rows sum to 1, and `node_ids`, int64 [N, F]: the motions of a Gaussian."""
        inputs = carried(gaussians)
        assert inputs is not None  # the model's configuration has seen to it
        return {"skinning_weights": to_numpy(inputs.skinning_weights), "node_ids": inputs.node_ids.numpy()}

    def deltas(self, graph: GraphBuilder, inputs: LayerInputs, used: list[str]) -> str:
        """Motions once a call, then for each Gaussian the mean of its motions, applied to its canonical pose."""
        name, means, quats = inputs.name, inputs.canonical_means, inputs.canonical_quats
        motions = _motions(graph, f"{name}.motions", cast(BasisLayer, inputs.layer), inputs.time)
        blended = _blended(graph, name, inputs.attributes, motions)
        names = [f"{name}.{part}" for part in ("matrices", "offsets", "turns")]
        matrices, offsets, turns = graph.split(blended, names, [9, 3, 4])
        parts = {
            "means": lambda: _moved(graph, name, matrices, offsets, means),
            "scales": lambda: _stretched(graph, name, matrices, quats),
            "quats": lambda: _turned(graph, name, turns, quats),
        }
        columns = [parts[part]() for part in used]
        return graph.node("Mul", [graph.node("Concat", columns, f"{name}.raw", axis=1), inputs.gate], f"{name}.shared")

    def inert_heads(self, layer: nn.Module) -> frozenset[str]:
        """None: a motion moves, scales and rotates."""
        return frozenset()

    def without_heads(self, layer: nn.Module, names: frozenset[str]) -> nn.Module:
        """The layer as it is: it has no heads to remove."""
        return layer


def skinning_inputs(means: Tensor, quats: Tensor, attributes: Mapping[str, np.ndarray]) -> SkinningInputs | None:
    """What `BasisLayer` reads of canonical Gaussians, in the dtype of `means`; None without its attributes."""
    if "node_ids" not in attributes:
        return None
    weights = torch.from_numpy(attributes["skinning_weights"]).to(means.dtype)
    return SkinningInputs(means, quats, weights, torch.from_numpy(attributes["node_ids"]))


def _blended(graph: GraphBuilder, name: str, attributes: Mapping[str, np.ndarray], motions: str) -> str:
    """[M, 16] the mean of the motions [B, 16] that each Gaussian follows."""
    node_ids, skinning_weights = attributes["node_ids"], attributes["skinning_weights"]
    small = np.uint8 if node_ids.max(initial=0) < 256 else np.int64
    ids = graph.node("Gather", [graph.constant("node_ids", node_ids.astype(small)), "ids"], "ids.node_ids")
    ids = graph.node("Cast", [ids], f"{name}.followed", to=TensorProto.INT64)
    weights = graph.node(
        "Gather", [graph.constant("skinning_weights", skinning_weights), "ids"], "ids.skinning_weights"
    )
    axis = graph.constant(f"{name}.axis", np.array([1], np.int64))
    row = graph.node("Unsqueeze", [weights, axis], f"{name}.row")
    picked = graph.node("Gather", [motions, ids], f"{name}.picked")
    return graph.node("Squeeze", [graph.node("MatMul", [row, picked], f"{name}.mean"), axis], f"{name}.blended")


def _motions(graph: GraphBuilder, name: str, layer: BasisLayer, time: str) -> str:
    """[B, 16] `BasisLayer.motions` at `time`, [1, 1]."""
    shifts, turns, stretches = _spline(graph, name, layer, time)
    turns = _unit(graph, f"{name}.turns", turns)
    matrices = _stretching(graph, f"{name}.matrices", _matrices(graph, f"{name}.rotations", turns), stretches)
    pivots = to_numpy(layer.pivots)
    tiled = graph.constant(f"{name}.pivots.tiled", np.tile(pivots, 3))
    turned = _row_sums(graph, f"{name}.pivots.turned", graph.node("Mul", [matrices, tiled], f"{name}.pivots.products"))
    placed = graph.node("Add", [graph.constant(f"{name}.pivots", pivots), shifts], f"{name}.placed")
    offsets = graph.node("Sub", [placed, turned], f"{name}.offsets")
    return graph.node("Concat", [matrices, offsets, turns], name, axis=1)


def _spline(graph: GraphBuilder, name: str, layer: BasisLayer, time: str) -> list[str]:
    """Shifts [B, 3], turns [B, 4] before they are made unit, and stretches [B, 6]."""
    knots, count = layer.shifts.shape[0] - 3, layer.shifts.shape[1]

    def scalar(what: str, value: float) -> str:
        return graph.constant(f"{name}.{what}", np.array(value, np.float32))

    since = graph.node("Sub", [time, graph.constant(f"{name}.first_time", to_numpy(layer.first_time))], f"{name}.since")
    place = graph.node("Mul", [since, graph.constant(f"{name}.knots", to_numpy(layer.time_knots))], f"{name}.place")
    place = graph.node("Clip", [place, scalar("zero", 0), scalar("last", knots)], f"{name}.inside")
    first = graph.node(
        "Min", [graph.node("Floor", [place], f"{name}.floor"), scalar("last_first", knots - 1)], f"{name}.first"
    )
    part = graph.node("Sub", [place, first], f"{name}.part")
    # [1, u, u², u³] times the matrix of a uniform cubic B-spline
    square = graph.node("Mul", [part, part], f"{name}.square")
    ones = graph.constant(f"{name}.one", np.ones((1, 1), np.float32))
    powers = [ones, part, square, graph.node("Mul", [square, part], f"{name}.cube")]
    matrix = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]], np.float32) / 6
    weights = graph.node(
        "MatMul",
        [graph.node("Concat", powers, f"{name}.powers", axis=1), graph.constant(f"{name}.cubic", matrix)],
        f"{name}.weights",
    )
    row = graph.node("Cast", [first], f"{name}.row", to=TensorProto.INT64)
    around = graph.constant(f"{name}.around", np.arange(KNOTS, dtype=np.int64)[None])
    rows = graph.node("Add", [row, around], f"{name}.rows")
    flat = graph.node("Reshape", [rows, graph.constant(f"{name}.flat", np.array([KNOTS], np.int64))], f"{name}.ids")
    curves = [to_numpy(curve) for curve in (layer.shifts, layer.turns, layer.stretches)]
    values = np.concatenate(curves, axis=2).reshape(knots + 3, -1)
    table = graph.node("Gather", [graph.constant(f"{name}.table", values), flat], f"{name}.read")
    mixed = graph.node("MatMul", [weights, table], f"{name}.mixed")
    sizes = [curve.shape[2] for curve in curves]
    shape = graph.constant(f"{name}.shape", np.array([count, sum(sizes)], np.int64))
    names = [f"{name}.{part}" for part in ("shifts", "raw_turns", "stretches")]
    return graph.split(graph.node("Reshape", [mixed, shape], f"{name}.curves"), names, sizes)


def _stretching(graph: GraphBuilder, name: str, rotations: str, stretches: str) -> str:
    """[B, 9] matrices that stretch by the identity and xx, yy, zz, xy, xz, yz, [B, 6], and then rotate."""
    place = np.zeros((6, 9), np.float32)
    for k, entries in enumerate(((0,), (4,), (8,), (1, 3), (2, 6), (5, 7))):
        place[k, list(entries)] = 1
    one = graph.constant(f"{name}.one", np.eye(3, dtype=np.float32).reshape(9))
    full = graph.node("Gemm", [stretches, graph.constant(f"{name}.place", place), one], f"{name}.stretch")
    return _products(graph, name, rotations, full)


def _products(graph: GraphBuilder, name: str, left: str, right: str) -> str:
    """[·, 9] products of 3 × 3 matrices, [·, 9] each."""
    square, flat = (
        graph.constant(f"{name}.{word}", np.array(shape, np.int64))
        for word, shape in (("square", (-1, 3, 3)), ("flat", (-1, 9)))
    )
    squares = [graph.node("Reshape", [m, square], f"{name}.{k}") for k, m in (("left", left), ("right", right))]
    return graph.node("Reshape", [graph.node("MatMul", squares, f"{name}.product"), flat], name)


def _matrices(graph: GraphBuilder, name: str, quats: str) -> str:
    """[B, 9] rotation matrices, row by row: products of pairs of w, x, y, z, summed by a constant."""
    pairs = [(i, j) for i in range(4) for j in range(i, 4)]
    first, second = (
        graph.constant(f"{name}.{n}", np.array(ids, np.int64))
        for n, ids in zip(("i", "j"), zip(*pairs, strict=True), strict=True)
    )
    left, right = (
        graph.node("Gather", [quats, ids], f"{name}.{side}", axis=1)
        for side, ids in (("left", first), ("right", second))
    )
    w, x, y, z = range(4)
    entries = [
        {(): 1, (y, y): -2, (z, z): -2}, {(x, y): 2, (w, z): -2}, {(x, z): 2, (w, y): 2},
        {(x, y): 2, (w, z): 2}, {(): 1, (x, x): -2, (z, z): -2}, {(y, z): 2, (w, x): -2},
        {(x, z): 2, (w, y): -2}, {(y, z): 2, (w, x): 2}, {(): 1, (x, x): -2, (y, y): -2},
    ]  # fmt: skip
    sums = np.array([[entry.get(pair, 0) for entry in entries] for pair in pairs], np.float32)
    ones = np.array([entry.get((), 0) for entry in entries], np.float32)
    products = graph.node("Mul", [left, right], f"{name}.products")
    return graph.node(
        "Gemm", [products, graph.constant(f"{name}.sums", sums), graph.constant(f"{name}.ones", ones)], name
    )


def _moved(graph: GraphBuilder, name: str, matrices: str, offsets: str, means: str) -> str:
    """[M, 3] by how much means move."""
    three = graph.node("Concat", [means, means, means], f"{name}.means.tiled", axis=1)
    turned = _row_sums(graph, f"{name}.means.turned", graph.node("Mul", [matrices, three], f"{name}.means.products"))
    return graph.node(
        "Sub", [graph.node("Add", [turned, offsets], f"{name}.means.moved"), means], f"{name}.means.delta"
    )


def _stretched(graph: GraphBuilder, name: str, matrices: str, quats: str) -> str:
    """[M, 3] logarithms of how much longer a Gaussian's axes are, columns of its rotation, times its matrix."""
    axes = _products(graph, f"{name}.axes", matrices, _matrices(graph, f"{name}.axes.canonical", quats))
    columns = graph.constant(f"{name}.axes.columns", np.tile(np.eye(3, dtype=np.float32), (3, 1)))
    squares = graph.node("Mul", [axes, axes], f"{name}.axes.squares")
    lengths = graph.node(
        "Sqrt", [graph.node("MatMul", [squares, columns], f"{name}.axes.sums")], f"{name}.axes.lengths"
    )
    least = graph.constant(f"{name}.axes.least", np.array(LEAST_STRETCH, np.float32))
    return graph.node("Log", [graph.node("Max", [lengths, least], f"{name}.axes.kept")], f"{name}.scales.delta")


def _row_sums(graph: GraphBuilder, name: str, products: str) -> str:
    """[·, 9] → [·, 3]: of three at a time."""
    threes = graph.constant(f"{name}.threes", np.kron(np.eye(3), np.ones((3, 1))).astype(np.float32))
    return graph.node("MatMul", [products, threes], name)


def _turned(graph: GraphBuilder, name: str, turns: str, quats: str) -> str:
    """[M, 4] by how much quaternions change where unit `turns` turn them."""
    turns = _unit(graph, f"{name}.turns.unit", turns)
    left = graph.constant(f"{name}.left", np.repeat(np.arange(4), 4))
    right = graph.constant(f"{name}.right", np.tile(np.arange(4), 4))
    a = graph.node("Gather", [turns, left], f"{name}.quats.left", axis=1)
    b = graph.node("Gather", [quats, right], f"{name}.quats.right", axis=1)
    hamilton = np.zeros((4, 4, 4), np.float32)
    for i, row in enumerate((((0, 1), (1, 1), (2, 1), (3, 1)), ((1, 1), (0, -1), (3, 1), (2, -1)),
                             ((2, 1), (3, -1), (0, -1), (1, 1)), ((3, 1), (2, 1), (1, -1), (0, -1)))):  # fmt: skip
        for j, (k, sign) in enumerate(row):
            hamilton[i, j, k] = sign
    products = graph.node("Mul", [a, b], f"{name}.quats.products")
    turned = graph.node(
        "MatMul", [products, graph.constant(f"{name}.hamilton", hamilton.reshape(16, 4))], f"{name}.quats.turned"
    )
    return graph.node("Sub", [turned, quats], f"{name}.quats.delta")


def _unit(graph: GraphBuilder, name: str, quats: str) -> str:
    """Quaternions [·, 4] of unit length, as `BasisLayer` makes them."""
    ones = graph.constant(f"{name}.four", np.ones((4, 4), np.float32))
    least = graph.constant(f"{name}.least", np.array(MIN_NORM, np.float32))
    sums = graph.node("MatMul", [graph.node("Mul", [quats, quats], f"{name}.squares"), ones], f"{name}.sums")
    norms = graph.node("Max", [graph.node("Sqrt", [sums], f"{name}.norms"), least], f"{name}.divisors")
    return graph.node("Div", [quats, norms], name)
