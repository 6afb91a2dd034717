"""The support `scgs` as a graph: the chain at the nodes once a call, then weighted means of their motions.

Weights don't depend on time. Gaussians come in blocks as those of the support `nodes`.
"""

from collections.abc import Mapping
from typing import cast

import numpy as np

from msdgs_export.layers.base import HEADS, ModelNotExportable
from msdgs_export.layers.chain import stored_constants, summed_deltas
from msdgs_export.layers.graph import GraphBuilder, to_numpy
from msdgs_export.layers.rotations import IDENTITY, rotation_columns, unit_rows
from msdgs_export.supports.base import Layout, SupportExport, SupportInputs
from msdgs_export.supports.blocks import block_layout
from msdgs_export.supports.nodes import blended_parts, node_offsets
from msdgs_export.supports.skinning import Affine, columns_of, moved_means, rows_of
from msdgs_train.supports.base import Support
from msdgs_train.supports.scgs import LOCAL_QUATS, SCGSSupport

PARTS = {"matrices": 9, "offsets": 3, "scales": 3, "quats": 4}


class SCGSExport(SupportExport):
    """Exports `SCGSSupport` once its nodes are placed."""

    heads_are_removable = False

    def bytes_per_gaussian(self, support: Support) -> int:
        """An index in 8 bits and, but for the last, a weight for each node that a Gaussian follows; a factor."""
        return 5 * cast(SCGSSupport, support).config.followed

    def layout(self, means: np.ndarray, attributes: Mapping[str, np.ndarray]) -> Layout:
        """Blocks of Gaussians that are near each other."""
        layout = block_layout(means, attributes["node_ids"], attributes["skinning_weights"])
        factors = {"quat_factors": attributes["quat_factors"][layout.rows]}
        return layout._replace(attributes={**layout.attributes, **factors})

    def deltas(self, graph: GraphBuilder, inputs: SupportInputs) -> dict[str, str]:
        """Affine maps of the means; deltas of scales and of quaternions."""
        motions = _motions(graph, inputs)
        (matrices, offsets, scales, quats), count = blended_parts(graph, inputs.attributes, motions, PARTS)
        means = columns_of(graph, inputs.means, 3, count)
        moved = moved_means(graph, Affine(matrices, offsets, means, count))
        factors = graph.constant("skinning.quat_factors", inputs.attributes["quat_factors"].T)
        columns = {
            "means": graph.node("Sub", [moved, means], "skinning.means.delta"),
            "scales": scales,
            "quats": graph.node("Mul", [quats, factors], "skinning.quats.delta"),
        }
        return rows_of(graph, columns, count)


def _motions(graph: GraphBuilder, inputs: SupportInputs) -> str:
    """[M, 19] `SCGSSupport.motions`, but matrices column by column."""
    support = cast(SCGSSupport, inputs.support)
    if not support.has_nodes:
        raise ModelNotExportable("the control nodes of this model aren't placed: train it past its first stage")
    positions, used = to_numpy(support.nodes), [*HEADS, LOCAL_QUATS]
    nodes, constants = graph.constant("nodes", positions), stored_constants(graph, inputs.layers, positions)
    parts = summed_deltas(graph, inputs.layers, nodes, inputs.time, inputs.steps, used, constants=constants)
    raw = graph.node("Add", [parts[LOCAL_QUATS], graph.constant("nodes.identity", IDENTITY)], "nodes.raw_rots")
    matrices = rotation_columns(graph, "nodes.rotations", unit_rows(graph, "nodes.rots", raw))
    offsets = node_offsets(graph, nodes, parts["means"], matrices)
    return graph.node("Concat", [matrices, offsets, parts["scales"], parts["quats"]], "nodes.motions", axis=1)
