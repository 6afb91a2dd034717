"""The support `nodes` as a graph: the chain at the nodes once a call, then linear blend skinning of all Gaussians.

Gaussians come in B blocks of S rows (`export.supports.blocks`). Values of a block lie in columns, [B, C, S], so that
operations on them are on long contiguous rows.
"""

from collections.abc import Mapping, Sequence
from typing import cast

import numpy as np
from onnx import TensorProto

from export.layers.base import HEADS
from export.layers.chain import summed_deltas
from export.layers.graph import GraphBuilder, to_numpy
from export.supports.base import Layout, SupportExport, SupportInputs
from export.supports.blocks import WEIGHT_ONE, block_layout
from msdgs_serve.scene.quaternion import MIN_NORM
from msdgs_train.supports.base import Support
from msdgs_train.supports.nodes import NodesSupport
from msdgs_train.supports.skinning_kernels import MIN_STRETCH

WIDTHS = {"means": 3, "scales": 3, "quats": 4}
IDENTITY = np.array([1, 0, 0, 0], np.float32)


class NodesExport(SupportExport):
    """Exports `NodesSupport`."""

    heads_are_removable = False

    def bytes_per_gaussian(self, support: Support) -> int:
        """A weight in 16 bits and an index in 8 bits for each node that a Gaussian follows."""
        return 3 * cast(NodesSupport, support).config.followed

    def layout(self, means: np.ndarray, attributes: Mapping[str, np.ndarray]) -> Layout:
        """Blocks of Gaussians that are near each other."""
        return block_layout(means, attributes["node_ids"], attributes["skinning_weights"])

    def deltas(self, graph: GraphBuilder, inputs: SupportInputs) -> dict[str, str]:
        """Motions of the nodes, blended for each Gaussian, applied to its canonical pose."""
        blended = _blended(graph, inputs.attributes, _motions(graph, inputs))
        names = ["skinning.x", "skinning.y", "skinning.z", "skinning.offsets", "skinning.rots"]
        *columns, offsets, rots = graph.split(blended, names, [3, 3, 3, 3, 4])
        blocks, _, rows = inputs.attributes["weights"].shape
        means, quats = _columns(graph, inputs.means, blocks, rows, 3), _columns(graph, inputs.quats, blocks, rows, 4)
        axes = _matrices(graph, "skinning.axes", inputs.quats)  # constant: computed when the file is opened
        parts = {
            "means": _moved(graph, columns, offsets, means),
            "scales": _stretched(graph, columns, _columns(graph, axes, blocks, rows, 9)),
            "quats": _rotated(graph, rots, quats),
        }
        return {part: _rows(graph, value, WIDTHS[part]) for part, value in parts.items()}


def _motions(graph: GraphBuilder, inputs: SupportInputs) -> str:
    """[M, 16] `NodesSupport.motions`, but matrices column by column."""
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
    by_columns = graph.constant("nodes.by_columns", np.arange(9).reshape(3, 3).T.reshape(9))
    matrices = graph.node("Gather", [matrices, by_columns], "nodes.columns", axis=1)
    return graph.node("Concat", [matrices, offsets, rots], "nodes.motions", axis=1)


def _blended(graph: GraphBuilder, attributes: Mapping[str, np.ndarray], motions: str) -> str:
    """[B, 16, S] weighted means of the motions, [M, 16], of the nodes that each Gaussian follows."""
    nodes, ids, weights = (attributes[name] for name in ("nodes", "ids", "weights"))
    picked = graph.node("Gather", [motions, _stored_ids(graph, "skinning.nodes", nodes)], "skinning.picked")
    picked = graph.node("Transpose", [picked], "skinning.motions", perm=[0, 2, 1])
    own = graph.constant("skinning.own", np.arange(nodes.shape[1])[:, None])
    one = graph.constant("skinning.one", np.array([1 / WEIGHT_ONE], np.float32))
    matrix = ""
    for f in range(ids.shape[1]):  # constant: onnxruntime computes the matrices when it opens the file
        name = f"skinning.node{f}"
        followed = graph.node("Equal", [_stored_ids(graph, name, ids[:, f, None]), own], f"{name}.equal")
        stored = graph.constant(f"{name}.stored_weight", weights[:, f, None])
        weight = graph.node("Cast", [stored], f"{name}.number", to=TensorProto.FLOAT)
        weight = graph.node("Mul", [weight, one], f"{name}.weight")
        place = graph.node("Cast", [followed], f"{name}.place", to=TensorProto.FLOAT)
        term = graph.node("Mul", [place, weight], f"{name}.matrix")
        matrix = graph.node("Add", [matrix, term], f"{name}.sum") if matrix else term
    return graph.node("MatMul", [picked, matrix], "skinning.blended")


def _stored_ids(graph: GraphBuilder, name: str, ids: np.ndarray) -> str:
    """Indices in as few bits as they need."""
    small = np.uint8 if ids.max() < 1 << 8 else np.int16 if ids.max() < 1 << 15 else np.int32
    stored = graph.constant(f"{name}.stored", ids.astype(small))
    return graph.node("Cast", [stored], f"{name}.ids", to=TensorProto.INT64)


def _columns(graph: GraphBuilder, rows: str, blocks: int, size: int, width: int) -> str:
    """[B, C, S] of [B · S, C]."""
    shape = graph.constant(f"{rows}.block_shape", np.array([blocks, size, width], np.int64))
    block = graph.node("Reshape", [rows, shape], f"{rows}.blocks")
    return graph.node("Transpose", [block], f"{rows}.columns", perm=[0, 2, 1])


def _rows(graph: GraphBuilder, columns: str, width: int) -> str:
    """[B · S, C] of [B, C, S]."""
    flat = graph.constant(f"{columns}.flat_shape", np.array([-1, width], np.int64))
    block = graph.node("Transpose", [columns], f"{columns}.blocks", perm=[0, 2, 1])
    return graph.node("Reshape", [block, flat], f"{columns}.rows")


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
    """[·, 9] rotation matrices, row by row: products of pairs of w, x, y, z, summed by a constant."""
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


def _row_sums(graph: GraphBuilder, name: str, products: str) -> str:
    """[·, 9] → [·, 3]: sums of three columns at a time."""
    threes = graph.constant(f"{name}.threes", np.kron(np.eye(3), np.ones((3, 1))).astype(np.float32))
    return graph.node("MatMul", [products, threes], name)


def _linear(graph: GraphBuilder, name: str, factors: Sequence[str], vectors: Sequence[str]) -> str:
    """[B, C, S] sum of vectors [B, C, S] times factors, [B, 1, S] each, or the other way round."""
    terms = [graph.node("Mul", [f, v], f"{name}.{i}") for i, (f, v) in enumerate(zip(factors, vectors, strict=True))]
    total = terms[0]
    for i, term in enumerate(terms[1:], start=1):
        total = graph.node("Add", [total, term], f"{name}.sum{i}")
    return total


def _moved(graph: GraphBuilder, columns: list[str], offsets: str, means: str) -> str:
    """[B, 3, S] by how much means move."""
    coordinates = graph.split(means, [f"{means}.{axis}" for axis in "xyz"], [1, 1, 1])
    rotated = _linear(graph, "skinning.means", coordinates, columns)
    moved = graph.node("Add", [rotated, offsets], "skinning.means.moved")
    return graph.node("Sub", [moved, means], "skinning.means.delta")


def _stretched(graph: GraphBuilder, columns: list[str], axes: str) -> str:
    """[B, 3, S] logarithms of how much longer a Gaussian's axes, columns of its rotation [B, 9, S], become by its
    matrix."""
    ones, lengths = graph.constant("skinning.three_ones", np.ones((1, 3), np.float32)), list[str]()
    entries = graph.split(axes, [f"{axes}.{k}" for k in range(9)], [1] * 9)
    for axis in range(3):
        name = f"skinning.axis{axis}"
        moved = _linear(graph, name, entries[axis::3], columns)
        lengths.append(
            graph.node("MatMul", [ones, graph.node("Mul", [moved, moved], f"{name}.squares")], f"{name}.square")
        )
    squares = graph.node("Concat", lengths, "skinning.squares", axis=1)
    least = graph.constant("skinning.least", np.array([MIN_STRETCH**2], np.float32))
    half = graph.constant("skinning.half", np.array([0.5], np.float32))
    logs = graph.node("Log", [graph.node("Max", [squares, least], "skinning.kept")], "skinning.logs")
    return graph.node("Mul", [logs, half], "skinning.scales.delta")


def _rotated(graph: GraphBuilder, rots: str, quats: str) -> str:
    """[B, 4, S] by how much quaternions change when `rots`, made unit, rotate them."""
    rows = (((0, 1), (1, 1), (2, 1), (3, 1)), ((1, -1), (0, 1), (3, -1), (2, 1)),
            ((2, -1), (3, 1), (0, 1), (1, -1)), ((3, -1), (2, -1), (1, 1), (0, 1)))  # fmt: skip
    ones = graph.constant("skinning.quats.ones", np.ones((1, 4), np.float32))
    factors = graph.split(rots, [f"{rots}.{axis}" for axis in "wxyz"], [1, 1, 1, 1])
    products = []
    for axis, row in zip("wxyz", rows, strict=True):  # row i of the left factor's matrix: unit i times the quaternion
        matrix = np.zeros((4, 4), np.float32)
        for k, (source, sign) in enumerate(row):
            matrix[k, source] = sign
        name = f"skinning.quats.{axis}"
        products.append(graph.node("MatMul", [graph.constant(f"{name}.unit", matrix), quats], f"{name}.product"))
    rotated = _linear(graph, "skinning.quats", factors, products)
    squares = graph.node("Mul", [rots, rots], "skinning.rots.squares")
    norm = graph.node("Sqrt", [graph.node("MatMul", [ones, squares], "skinning.rots.sum")], "skinning.rots.norm")
    least = graph.constant("skinning.rots.least", np.array([MIN_NORM], np.float32))
    unit = graph.node(
        "Div", [rotated, graph.node("Max", [norm, least], "skinning.rots.divisor")], "skinning.quats.unit"
    )
    return graph.node("Sub", [unit, quats], "skinning.quats.delta")


def _unit(graph: GraphBuilder, name: str, quats: str) -> str:
    """Normalize quaternions, [·, 4], as training does."""
    ones = graph.constant(f"{name}.four", np.ones((4, 4), np.float32))
    least = graph.constant(f"{name}.least", np.array(MIN_NORM, np.float32))
    sums = graph.node("MatMul", [graph.node("Mul", [quats, quats], f"{name}.squares"), ones], f"{name}.sums")
    norms = graph.node("Max", [graph.node("Sqrt", [sums], f"{name}.norms"), least], f"{name}.divisors")
    return graph.node("Div", [quats, norms], name)
