"""Kinds of storage: each packs an array of float32 into integers and adds the nodes that unfold it."""

from collections.abc import Callable

import numpy as np
from onnx import TensorProto

from msdgs_export.layers.graph import GraphBuilder
from msdgs_train.gaussians.scale_space import LOG_SCALE_LIMIT

Pack = Callable[[GraphBuilder, str, np.ndarray], str]
"""Stores an array, [N, ...] with N > 0, and adds nodes that compute a value of this name from it; returns the name."""


def in_range(bits: int) -> Pack:
    """Equal steps from the lowest to the highest value of each column, which are values at one place in their rows."""

    def pack(graph: GraphBuilder, name: str, values: np.ndarray) -> str:
        exact, first = values.astype(np.float64), _lowest(bits)
        low, high = exact.min(axis=0), exact.max(axis=0)
        steps = ((high - low) / (2**bits - 1)).astype(np.float32)
        places = np.divide(exact - low, steps, out=np.zeros(values.shape), where=steps > 0)
        places = places.clip(0, 2**bits - 1)  # steps below 1e-38 have few digits
        start = (low - first * steps.astype(np.float64)).astype(np.float32)
        numbers = _numbers(graph, name, places + first, bits)
        scaled = graph.node("Mul", [numbers, graph.constant(f"{name}.steps", steps)], f"{name}.scaled")
        return graph.node("Add", [scaled, graph.constant(f"{name}.start", start)], name)

    return pack


def logarithms(bits: int) -> Pack:
    """Positive values by their logarithms, in equal steps."""

    def pack(graph: GraphBuilder, name: str, values: np.ndarray) -> str:
        logs = np.log(values.astype(np.float64)).clip(-LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)
        return graph.node("Exp", [in_range(bits)(graph, f"{name}.logarithms", logs)], name)

    return pack


def fractions(bits: int, most: float) -> Pack:
    """Equal steps from 0 to `most`, which no value exceeds, not by a rounding either."""

    def pack(graph: GraphBuilder, name: str, values: np.ndarray) -> str:
        levels = 2 ** min(bits, 15) - 1
        numbers = _numbers(graph, name, values.astype(np.float64).clip(0, most) * (levels / most), bits)
        return graph.node("Div", [numbers, graph.constant(f"{name}.one", np.array(levels / most, np.float32))], name)

    return pack


def directions(bits: int) -> Pack:
    """Unit quaternions, [N, 4], with all bits for the largest component of each; nodes normalize them."""

    def pack(graph: GraphBuilder, name: str, values: np.ndarray) -> str:
        largest = 2 ** (bits - 1) - 1
        exact = values / np.abs(values).max(axis=1, keepdims=True).astype(np.float64)
        middle = _lowest(bits) + largest + 1
        numbers = _numbers(graph, name, exact * largest + middle, bits)
        shift = graph.constant(f"{name}.middle", np.array(middle, np.float32))
        raw = graph.node("Sub", [numbers, shift], f"{name}.raw")
        ones = graph.constant(f"{name}.ones", np.ones((4, 4), np.float32))
        sums = graph.node("MatMul", [graph.node("Mul", [raw, raw], f"{name}.squares"), ones], f"{name}.sums")
        return graph.node("Div", [raw, graph.node("Sqrt", [sums], f"{name}.norms")], name)

    return pack


def low_rank(rank: int, fine: int = 8) -> Pack:
    """[n, C] as a product of the first singular vectors, `fine` of them in 16 bits: control points of splines over
    time, of which most move little or alike."""

    def pack(graph: GraphBuilder, name: str, values: np.ndarray) -> str:
        over_time, sizes, columns = np.linalg.svd(values.astype(np.float64), full_matrices=False)
        parts = []
        for bits, part in ((16, slice(0, min(fine, rank))), (8, slice(fine, rank))):
            if len(columns[part]):
                parts.append(in_range(bits)(graph, f"{name}.in{bits}", columns[part].T))
        factors = (over_time * sizes)[:, :rank].T.astype(np.float32)
        product = [graph.node("Concat", parts, f"{name}.columns", axis=1), graph.constant(f"{name}.times", factors)]
        first = graph.constant(f"{name}.axis", np.zeros(1, np.int64))  # files may turn arrays of three axes only
        product = graph.node("Unsqueeze", [graph.node("MatMul", product, f"{name}.product"), first], f"{name}.whole")
        turned = graph.node("Transpose", [product], f"{name}.turned", perm=[0, 2, 1])
        return graph.node("Squeeze", [turned, first], name)

    return pack


def _lowest(bits: int) -> int:
    """The lowest integer of these bits; 16 are signed, since graphs cast no uint16."""
    return 0 if bits == 8 else -(1 << 15)


def _numbers(graph: GraphBuilder, name: str, values: np.ndarray, bits: int) -> str:
    """Store numbers rounded to integers; returns the name of these in float32."""
    stored = graph.constant(f"{name}.stored", np.round(values).astype(np.uint8 if bits == 8 else np.int16))
    return graph.node("Cast", [stored], f"{name}.numbers", to=TensorProto.FLOAT)
