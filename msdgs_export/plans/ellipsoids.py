"""The unit form of quaternions of any length as ONNX nodes: `unit_form` of the trainer, step by step."""

import numpy as np
from onnx import TensorProto

from msdgs_export.layers.graph import GraphBuilder
from msdgs_train.gaussians.raw_quaternions import LARGE, LEAST, PAIRS, SWEEPS
from msdgs_train.gaussians.scale_space import MIN_SCALE

FIRST, SECOND = np.triu_indices(4)
"""Of the ten products of two of the numbers w, x, y, z."""

W, X, Y, Z = range(4)
MATRIX: tuple[dict[tuple[int, int], float], ...] = (
    {(Y, Y): -2, (Z, Z): -2}, {(X, Y): 2, (W, Z): 2}, {(X, Z): 2, (W, Y): -2},
    {(X, Y): 2, (W, Z): -2}, {(X, X): -2, (Z, Z): -2}, {(Y, Z): 2, (W, X): 2},
    {(X, Z): 2, (W, Y): 2}, {(Y, Z): 2, (W, X): -2}, {(X, X): -2, (Y, Y): -2},
)  # fmt: skip
"""Entries of the rotation matrix of a unit quaternion, less the identity, by columns."""

XX, YX, ZX, XY, YY, ZY, XZ, YZ, ZZ = range(9)
MULTIPLES: tuple[tuple[dict[int, float], ...], ...] = (
    ({XX: 1, YY: 1, ZZ: 1}, {ZY: 1, YZ: -1}, {XZ: 1, ZX: -1}, {YX: 1, XY: -1}),
    ({ZY: 1, YZ: -1}, {XX: 1, YY: -1, ZZ: -1}, {XY: 1, YX: 1}, {XZ: 1, ZX: 1}),
    ({XZ: 1, ZX: -1}, {XY: 1, YX: 1}, {XX: -1, YY: 1, ZZ: -1}, {YZ: 1, ZY: 1}),
    ({YX: 1, XY: -1}, {XZ: 1, ZX: 1}, {YZ: 1, ZY: 1}, {XX: -1, YY: -1, ZZ: 1}),
)
"""4 q_i q, less 1 in its place i, from those entries."""


def ellipsoids(graph: GraphBuilder, quats: str, scales: str, output: str) -> str:
    """Add the scales, [M, 3], as `output`, and return quaternions, [M, 4], whose norm isn't 0."""
    axes = _half_axes(graph, quats, scales)
    for sweep in range(SWEEPS):
        for i, j in PAIRS:
            axes[i], axes[j] = _turned(graph, axes[i], axes[j], f"sweep{sweep}.{i}{j}")
    ones, least = graph.constant("axes.ones", np.ones((3, 1), np.float32)), _number(graph, "axes.least", LEAST)
    lengths, units = [], []
    for i, axis in enumerate(axes):
        squares = graph.node("MatMul", [graph.node("Mul", [axis, axis], f"axes.{i}.squares"), ones], f"axes.{i}.sum")
        lengths.append(graph.node("Sqrt", [squares], f"axes.{i}.length"))
        divisor = graph.node("Max", [lengths[-1], least], f"axes.{i}.divisor")
        units.append(graph.node("Div", [axis, divisor], f"axes.{i}.unit"))
    every = graph.node("Concat", lengths, "axes.lengths", axis=1)
    graph.node("Max", [every, _number(graph, "axes.min_scale", MIN_SCALE)], output)
    return _quaternions(graph, graph.node("Concat", units, "axes.matrix", axis=1))


def _half_axes(graph: GraphBuilder, quats: str, scales: str) -> list[str]:
    """The columns of R(q) S, [M, 3] each."""
    factors = [
        graph.node("Gather", [quats, graph.constant(f"axes.{name}_ids", ids.astype(np.int64))], f"axes.{name}", axis=1)
        for name, ids in (("first", FIRST), ("second", SECOND))
    ]
    products = graph.node("Mul", factors, "axes.products")
    place = {(int(i), int(j)): n for n, (i, j) in enumerate(zip(FIRST, SECOND, strict=True))}
    weights = np.zeros((10, 9), np.float32)
    for column, terms in enumerate(MATRIX):
        for pair, factor in terms.items():
            weights[place[pair], column] = factor
    constants = [
        graph.constant("axes.weights", weights),
        graph.constant("axes.eye", np.eye(3, dtype=np.float32).ravel()),
    ]
    matrix = graph.node("Gemm", [products, *constants], "axes.rotation")
    thrice = graph.constant("axes.thrice", np.repeat(np.arange(3), 3))
    sizes = graph.node("Gather", [scales, thrice], "axes.sizes", axis=1)
    halves = graph.node("Mul", [matrix, sizes], "axes.halves")
    return graph.split(halves, ["axes.0", "axes.1", "axes.2"], [3, 3, 3])


def _turned(graph: GraphBuilder, a: str, b: str, name: str) -> tuple[str, str]:
    """`raw_quaternions._turned`."""

    def node(operator: str, inputs: list[str], output: str) -> str:
        return graph.node(operator, inputs, f"{name}.{output}")

    twos = graph.constant("axes.twos", np.full((3, 1), 2, np.float32))
    ones, one = graph.constant("axes.ones", np.ones((3, 1), np.float32)), _number(graph, "axes.one", 1)
    product = node("MatMul", [node("Mul", [a, b], "ab"), twos], "product")
    squares = node("Sub", [node("Mul", [b, b], "bb"), node("Mul", [a, a], "aa")], "squares")
    difference = node("MatMul", [squares, ones], "difference")
    is_less = graph.node(
        "Cast", [node("Less", [difference, _number(graph, "axes.zero", 0)], "less")], f"{name}.is_less",
        to=TensorProto.FLOAT,
    )  # fmt: skip
    sign = node("Sub", [one, node("Mul", [is_less, _number(graph, "axes.two", 2)], "twice")], "sign")
    sums = node("Add", [node("Mul", [difference, difference], "dd"), node("Mul", [product, product], "pp")], "sums")
    size = node("Add", [node("Mul", [sign, difference], "size"), node("Sqrt", [sums], "hypot")], "above")
    divisor = node("Add", [size, _number(graph, "axes.least", LEAST)], "divisor")
    tangent = node("Div", [node("Mul", [sign, product], "signed"), divisor], "tangent")
    secant = node("Sqrt", [node("Add", [node("Mul", [tangent, tangent], "tt"), one], "one_tt")], "secant")
    cosine = node("Div", [one, secant], "cosine")
    sine = node("Mul", [tangent, cosine], "sine")
    first = node("Sub", [node("Mul", [a, cosine], "ca"), node("Mul", [b, sine], "sb")], "first")
    second = node("Add", [node("Mul", [a, sine], "sa"), node("Mul", [b, cosine], "cb")], "second")
    return first, second


def _quaternions(graph: GraphBuilder, matrix: str) -> str:
    """`raw_quaternions._quaternions` of [M, 9] matrices, by columns."""
    large, found = _number(graph, "axes.large", LARGE), ""
    for i in (3, 2, 1, 0):
        weights = np.zeros((9, 4), np.float32)
        for column, terms in enumerate(MULTIPLES[i]):
            for entry, factor in terms.items():
                weights[entry, column] = factor
        constants = [
            graph.constant(f"multiple.{i}.weights", weights),
            graph.constant(f"multiple.{i}.one", np.eye(4, dtype=np.float32)[i]),
        ]
        multiple = graph.node("Gemm", [matrix, *constants], f"multiple.{i}")
        if found:
            column = graph.constant(f"multiple.{i}.column", np.array([i]))
            square = graph.node("Gather", [multiple, column], f"multiple.{i}.square", axis=1)
            is_small = graph.node("Less", [square, large], f"multiple.{i}.is_small")
            found = graph.node("Where", [is_small, found, multiple], f"multiple.{i}.found")
        else:
            found = multiple
    return found


def _number(graph: GraphBuilder, name: str, value: float) -> str:
    return graph.constant(name, np.array(value, np.float32))
