"""The support `nodes` as a graph: the chain at the nodes once a call, then linear blend skinning of each Gaussian."""

from collections.abc import Mapping
from typing import cast

import numpy as np
from onnx import TensorProto

from export.layers.base import HEADS
from export.layers.chain import summed_deltas
from export.layers.graph import GraphBuilder, to_numpy
from export.supports.base import SupportInputs
from msdgs_serve.scene.quaternion import MIN_NORM
from msdgs_train.supports.nodes import NodesSupport
from msdgs_train.supports.skinning_kernels import MAX_NEAREST, MIN_STRETCH

IDENTITY = np.array([1, 0, 0, 0], np.float32)


class NodesExport:
    """Exports `NodesSupport`."""

    heads_are_removable = False
    bytes_per_gaussian = MAX_NEAREST * (4 + 1)  # a weight in float32 and an id in 8 bits for each node

    def deltas(self, graph: GraphBuilder, inputs: SupportInputs) -> dict[str, str]:
        """Motions of the nodes, blended for each Gaussian, applied to its canonical pose."""
        motions = _motions(graph, inputs)
        blended = _blended(graph, inputs.attributes, motions)
        names = [f"skinning.{part}" for part in ("matrices", "offsets", "rots")]
        matrices, offsets, rots = graph.split(blended, names, [9, 3, 4])
        return {
            "means": _moved(graph, matrices, offsets, inputs.means),
            "scales": _stretched(graph, matrices, inputs.quats),
            "quats": _rotated(graph, rots, inputs.quats),
        }


def _motions(graph: GraphBuilder, inputs: SupportInputs) -> str:
    """[nodes, 16] the motions of the nodes, as `NodesSupport.motions` computes them."""
    support = cast(NodesSupport, inputs.support)
    positions = to_numpy(support.nodes)
    nodes = graph.constant("nodes", positions)
    parts = summed_deltas(graph, inputs.layers, nodes, inputs.time, inputs.steps, list(HEADS), len(positions))
    raw = graph.node("Add", [parts["quats"], graph.constant("nodes.identity", IDENTITY)], "nodes.raw_rots")
    rots = _unit(graph, "nodes.rots", raw)
    matrices = _stretching(graph, "nodes.matrices", _matrices(graph, "nodes.rotations", rots), parts["scales"])
    tiled = graph.constant("nodes.tiled", np.tile(positions, 3))
    rotated = _row_sums(graph, "nodes.rotated", graph.node("Mul", [matrices, tiled], "nodes.products"))
    offsets = graph.node("Sub", [graph.node("Add", [nodes, parts["means"]], "nodes.moved"), rotated], "nodes.offsets")
    return graph.node("Concat", [matrices, offsets, rots], "nodes.motions", axis=1)


def _blended(graph: GraphBuilder, attributes: Mapping[str, np.ndarray], motions: str) -> str:
    """[M, 16] the weighted mean of the motions, [nodes, 16], of the nodes that each Gaussian follows."""
    node_ids, skinning_weights = attributes["node_ids"], attributes["skinning_weights"]
    small = np.uint8 if node_ids.max(initial=0) < 256 else np.int64
    ids = graph.node("Gather", [graph.constant("node_ids", node_ids.astype(small)), "ids"], "ids.node_ids")
    ids = graph.node("Cast", [ids], "skinning.ids", to=TensorProto.INT64)
    weights = graph.node(
        "Gather", [graph.constant("skinning_weights", skinning_weights), "ids"], "ids.skinning_weights"
    )
    axis = graph.constant("skinning.axis", np.array([1], np.int64))
    row = graph.node("Unsqueeze", [weights, axis], "skinning.row")
    picked = graph.node("Gather", [motions, ids], "skinning.picked")
    return graph.node("Squeeze", [graph.node("MatMul", [row, picked], "skinning.mean"), axis], "skinning.blended")


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


def _moved(graph: GraphBuilder, matrices: str, offsets: str, means: str) -> str:
    """[M, 3] deltas of means."""
    three = graph.node("Concat", [means, means, means], "skinning.means.tiled", axis=1)
    rotated = _row_sums(
        graph, "skinning.means.rotated", graph.node("Mul", [matrices, three], "skinning.means.products")
    )
    return graph.node(
        "Sub", [graph.node("Add", [rotated, offsets], "skinning.means.moved"), means], "skinning.means.delta"
    )


def _stretched(graph: GraphBuilder, matrices: str, quats: str) -> str:
    """[M, 3] deltas of log-scales: logarithms of the lengths of a Gaussian's unit axes after its matrix is applied."""
    axes = _products(graph, "skinning.axes", matrices, _matrices(graph, "skinning.axes.canonical", quats))
    columns = graph.constant("skinning.axes.columns", np.tile(np.eye(3, dtype=np.float32), (3, 1)))
    squares = graph.node("Mul", [axes, axes], "skinning.axes.squares")
    lengths = graph.node(
        "Sqrt", [graph.node("MatMul", [squares, columns], "skinning.axes.sums")], "skinning.axes.lengths"
    )
    least = graph.constant("skinning.axes.least", np.array(MIN_STRETCH, np.float32))
    return graph.node("Log", [graph.node("Max", [lengths, least], "skinning.axes.kept")], "skinning.scales.delta")


def _row_sums(graph: GraphBuilder, name: str, products: str) -> str:
    """[·, 9] → [·, 3]: sums of three columns at a time."""
    threes = graph.constant(f"{name}.threes", np.kron(np.eye(3), np.ones((3, 1))).astype(np.float32))
    return graph.node("MatMul", [products, threes], name)


def _rotated(graph: GraphBuilder, rots: str, quats: str) -> str:
    """[M, 4] deltas of quaternions that are rotated by `rots`, normalized first."""
    rots = _unit(graph, "skinning.rots.unit", rots)
    left = graph.constant("skinning.left", np.repeat(np.arange(4), 4))
    right = graph.constant("skinning.right", np.tile(np.arange(4), 4))
    a = graph.node("Gather", [rots, left], "skinning.quats.left", axis=1)
    b = graph.node("Gather", [quats, right], "skinning.quats.right", axis=1)
    hamilton = np.zeros((4, 4, 4), np.float32)
    for i, row in enumerate((((0, 1), (1, 1), (2, 1), (3, 1)), ((1, 1), (0, -1), (3, 1), (2, -1)),
                             ((2, 1), (3, -1), (0, -1), (1, 1)), ((3, 1), (2, 1), (1, -1), (0, -1)))):  # fmt: skip
        for j, (k, sign) in enumerate(row):
            hamilton[i, j, k] = sign
    products = graph.node("Mul", [a, b], "skinning.quats.products")
    rotated = graph.node(
        "MatMul", [products, graph.constant("skinning.hamilton", hamilton.reshape(16, 4))], "skinning.quats.rotated"
    )
    return graph.node("Sub", [rotated, quats], "skinning.quats.delta")


def _unit(graph: GraphBuilder, name: str, quats: str) -> str:
    """Normalize quaternions, [·, 4], as training does."""
    ones = graph.constant(f"{name}.four", np.ones((4, 4), np.float32))
    least = graph.constant(f"{name}.least", np.array(MIN_NORM, np.float32))
    sums = graph.node("MatMul", [graph.node("Mul", [quats, quats], f"{name}.squares"), ones], f"{name}.sums")
    norms = graph.node("Max", [graph.node("Sqrt", [sums], f"{name}.norms"), least], f"{name}.divisors")
    return graph.node("Div", [quats, norms], name)
