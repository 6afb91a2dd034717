"""A layer of kind `spline` as a graph: four knots are read once per call."""

from typing import cast

import numpy as np
from onnx import TensorProto

from msdgs_export.layers.base import HEADS, LayerInputs
from msdgs_export.layers.graph import GraphBuilder, to_numpy
from msdgs_train.layers.base import DeformationLayer
from msdgs_train.layers.spline import SplineLayer

KNOTS = 4
"""Number of knots that determine the value at a time."""


class SplineExport:
    """Exports `SplineLayer`."""

    removable_heads: frozenset[str] = frozenset()
    scale_columns = 6

    def deltas(self, graph: GraphBuilder, inputs: LayerInputs, used: list[str]) -> str:
        """[nodes, 13] translations, stretches, and quaternions minus the identity."""
        assert used == list(HEADS)  # all heads of nodes are used
        curves = _spline(graph, inputs.name, cast(SplineLayer, inputs.layer), inputs.time)
        rest = np.zeros(13, np.float32)
        rest[9] = 1  # the identity quaternion's w
        raw = graph.node("Sub", [curves, graph.constant(f"{inputs.name}.rest", rest)], f"{inputs.name}.raw")
        return graph.node("Mul", [raw, inputs.gate], f"{inputs.name}.gated")

    def point_constants(self, layer: DeformationLayer, points: np.ndarray) -> dict[str, np.ndarray]:
        """None: a curve belongs to its node."""
        return {}

    def inert_heads(self, layer: DeformationLayer) -> frozenset[str]:
        """No heads, since a curve translates, stretches and rotates."""
        return frozenset()

    def without_heads(self, layer: DeformationLayer, names: frozenset[str]) -> DeformationLayer:
        """The layer as it is: it has no heads to remove."""
        return layer


def _spline(graph: GraphBuilder, name: str, layer: SplineLayer, time: str) -> str:
    """[nodes, 13] translations 3, stretches 6, quaternions 4 of any length, at `time`, [1, 1]."""
    knots, count = layer.config.num_knots, layer.transls.shape[1]

    def scalar(suffix: str, value: float) -> str:
        return graph.constant(f"{name}.{suffix}", np.array(value, np.float32))

    since = graph.node("Sub", [time, graph.constant(f"{name}.first_time", to_numpy(layer.first_time))], f"{name}.since")
    place = graph.node("Mul", [since, graph.constant(f"{name}.knots", to_numpy(layer.knots_per_time))], f"{name}.place")
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
    curves = [to_numpy(curve) for curve in (layer.transls, layer.stretches, layer.rots)]
    values = np.concatenate(curves, axis=2).reshape(knots + 3, -1)
    table = graph.node("Gather", [graph.constant(f"{name}.table", values), flat], f"{name}.read")
    mixed = graph.node("MatMul", [weights, table], f"{name}.mixed")
    shape = graph.constant(f"{name}.shape", np.array([count, values.shape[1] // count], np.int64))
    return graph.node("Reshape", [mixed, shape], f"{name}.curves")
