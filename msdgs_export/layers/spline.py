"""A layer of kind `spline` as a graph."""

import copy
from typing import cast

import numpy as np

from msdgs_export.layers.base import GAINS, HEADS, LayerInputs
from msdgs_export.layers.curves import CurveLayerExport, curves_at
from msdgs_export.layers.graph import GraphBuilder, to_numpy
from msdgs_train.layers.base import DeformationLayer
from msdgs_train.layers.spline import SplineLayer


class SplineExport(CurveLayerExport):
    """Exports `SplineLayer`."""

    removable_heads = frozenset({GAINS})

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

    def without_heads(self, layer: DeformationLayer, names: frozenset[str]) -> DeformationLayer:
        """A copy of the layer that doesn't shade."""
        layer = copy.deepcopy(cast(SplineLayer, layer))
        layer.gains = None
        return layer

    def gains(self, graph: GraphBuilder, inputs: LayerInputs) -> str | None:
        """[nodes, 3] values of the curves of shading."""
        layer, name = cast(SplineLayer, inputs.layer), f"{inputs.name}.gains"
        if layer.gains is None:
            return None
        curves = curves_at(graph, name, layer, [to_numpy(layer.gains)], inputs.time)
        return graph.node("Mul", [curves, inputs.gate], f"{name}.gated")
