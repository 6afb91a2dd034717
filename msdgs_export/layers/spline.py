"""A layer of kind `spline` as a graph."""

from typing import cast

import numpy as np

from msdgs_export.layers.base import HEADS, LayerInputs
from msdgs_export.layers.curves import curves_at
from msdgs_export.layers.graph import GraphBuilder, to_numpy
from msdgs_train.layers.base import DeformationLayer
from msdgs_train.layers.spline import SplineLayer


class SplineExport:
    """Exports `SplineLayer`."""

    removable_heads: frozenset[str] = frozenset()
    scale_columns = 6

    def deltas(self, graph: GraphBuilder, inputs: LayerInputs, used: list[str]) -> str:
        """[nodes, 13] translations, stretches, and quaternions minus the identity."""
        assert used == list(HEADS)  # all heads of nodes are used
        layer = cast(SplineLayer, inputs.layer)
        values = [to_numpy(curve) for curve in (layer.transls, layer.stretches, layer.rots)]
        curves = curves_at(graph, inputs.name, layer, values, inputs.time)
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
