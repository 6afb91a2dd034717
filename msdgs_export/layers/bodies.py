"""A layer of kind `bodies` as a graph: poses of all bodies once a call, and constant weights of the nodes."""

from typing import cast

import numpy as np

from msdgs_export.layers.base import HEADS, LayerInputs
from msdgs_export.layers.curves import CurveLayerExport, curves_at
from msdgs_export.layers.graph import GraphBuilder, to_numpy
from msdgs_export.layers.rotations import IDENTITY, turn_columns, turned, unit_rows
from msdgs_train.layers.bodies import BodiesLayer


class BodiesExport(CurveLayerExport):
    """Exports `BodiesLayer`."""

    def deltas(self, graph: GraphBuilder, inputs: LayerInputs, used: list[str]) -> str:
        """[nodes, 13] translations, stretches of 0, and quaternions minus the identity."""
        assert used == list(HEADS)  # all heads of nodes are used
        name, layer = inputs.name, cast(BodiesLayer, inputs.layer)
        weights = to_numpy(layer.weights())
        stored = graph.constant(f"{name}.body_weights", weights)
        moved = graph.node("MatMul", [stored, _motions(graph, name, layer, inputs.time)], f"{name}.moved_by")
        matrices, offsets, quats = graph.split(
            moved, [f"{name}.{part}" for part in ("turn", "offset", "quat")], [9, 3, 4]
        )
        shifts = graph.node("Add", [turned(graph, f"{name}.turned", matrices, inputs.means), offsets], f"{name}.shifts")
        zeros = graph.constant(f"{name}.stretches", np.zeros((len(weights), 6), np.float32))
        columns = graph.node("Concat", [shifts, zeros, quats], f"{name}.raw", axis=1)
        return graph.node("Mul", [columns, inputs.gate], f"{name}.gated")


def _motions(graph: GraphBuilder, name: str, layer: BodiesLayer, time: str) -> str:
    """[bodies, 16] `BodiesLayer.motions`, but matrices column by column."""
    curves = [to_numpy(layer.transls), to_numpy(layer.rots)]
    poses = curves_at(graph, name, layer, curves, time)
    transls, raw = graph.split(poses, [f"{name}.transls", f"{name}.raw_rots"], [3, 4])
    rots = unit_rows(graph, f"{name}.rots", raw)
    matrices = turn_columns(graph, f"{name}.matrices", rots)
    centers = turned(graph, f"{name}.arms", matrices, graph.constant(f"{name}.centers", to_numpy(layer.centers)))
    offsets = graph.node("Sub", [transls, centers], f"{name}.offsets")
    quats = graph.node("Sub", [rots, graph.constant(f"{name}.identity", IDENTITY)], f"{name}.from_identity")
    return graph.node("Concat", [matrices, offsets, quats], f"{name}.motions", axis=1)
