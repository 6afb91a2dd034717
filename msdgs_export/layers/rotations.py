"""Quaternions and rotation matrices of rows as parts of a graph. Matrices lie column by column."""

import numpy as np

from msdgs_export.layers.graph import GraphBuilder
from msdgs_serve.scene.quaternion import MIN_NORM, to_matrix

IDENTITY = np.array([1, 0, 0, 0], np.float32)


def rotation_columns(graph: GraphBuilder, name: str, quats: str) -> str:
    """[·, 9] rotation matrices of unit quaternions, [·, 4]."""
    ones = graph.constant(f"{name}.ones", np.eye(3, dtype=np.float32).reshape(9))
    return graph.node("Gemm", [*_terms(graph, name, quats), ones], name)


def turn_columns(graph: GraphBuilder, name: str, quats: str) -> str:
    """[·, 9] rotation matrices of unit quaternions, [·, 4], less the identity."""
    return graph.node("MatMul", [*_terms(graph, name, quats)], name)


def turned(graph: GraphBuilder, name: str, matrices: str, vectors: str) -> str:
    """[·, 3] products of matrices, [·, 9], and vectors, [·, 3]."""
    columns = graph.constant(f"{name}.columns", np.repeat(np.arange(3), 3))
    factors = graph.node("Gather", [vectors, columns], f"{name}.factors", axis=1)
    add_columns = graph.constant(f"{name}.add_columns", np.tile(np.eye(3, dtype=np.float32), (3, 1)))
    return graph.node("MatMul", [graph.node("Mul", [matrices, factors], f"{name}.products"), add_columns], name)


def _terms(graph: GraphBuilder, name: str, quats: str) -> tuple[str, str]:
    """Products of pairs of w, x, y, z, [·, 10], and a constant by which they sum up to matrices."""
    first, second, factors = quaternion_products()
    left, right = (
        graph.node("Gather", [quats, graph.constant(f"{name}.{letter}", ids)], f"{name}.{side}", axis=1)
        for letter, side, ids in (("i", "left", first), ("j", "right", second))
    )
    sums = graph.constant(f"{name}.sums", factors.transpose(0, 2, 1).reshape(10, 9))
    return graph.node("Mul", [left, right], f"{name}.products"), sums


def quaternion_products() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Indices, [10], of the factors of all products of two components, and what each adds to `to_matrix` beyond the
    identity, [10, 3, 3]."""
    first, second = np.triu_indices(4)
    alone = to_matrix(np.eye(4)) - np.eye(3)
    both = to_matrix(np.eye(4)[first] + np.eye(4)[second]) - np.eye(3) - alone[first] - alone[second]
    return first, second, np.where((first == second)[:, None, None], alone[first], both).astype(np.float32)


def unit_rows(graph: GraphBuilder, name: str, quats: str) -> str:
    """Normalize quaternions, [·, 4], as training does."""
    ones = graph.constant(f"{name}.four", np.ones((4, 4), np.float32))
    least = graph.constant(f"{name}.least", np.array(MIN_NORM, np.float32))
    sums = graph.node("MatMul", [graph.node("Mul", [quats, quats], f"{name}.squares"), ones], f"{name}.sums")
    norms = graph.node("Max", [graph.node("Sqrt", [sums], f"{name}.norms"), least], f"{name}.divisors")
    return graph.node("Div", [quats, norms], name)
