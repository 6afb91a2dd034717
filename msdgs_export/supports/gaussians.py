"""The support `gaussians` as a graph: the chain runs on the canonical means."""

from collections.abc import Sequence

import numpy as np

from msdgs_export.layers.chain import point_constants, summed_deltas, used_heads
from msdgs_export.layers.graph import GraphBuilder
from msdgs_export.supports.base import SupportExport, SupportInputs
from msdgs_train.layers.base import DeformationLayer


class GaussiansExport(SupportExport):
    """Exports `GaussiansSupport`."""

    def constants(self, layers: Sequence[DeformationLayer], means: np.ndarray) -> dict[str, np.ndarray]:
        """Those of the chain: its points are the Gaussians."""
        return point_constants(layers, means)

    def deltas(self, graph: GraphBuilder, inputs: SupportInputs) -> dict[str, str]:
        """The deltas of the chain itself."""
        used, chain = used_heads(inputs.layers), (inputs.layers, inputs.means, inputs.time, inputs.steps)
        return summed_deltas(graph, *chain, used, constants=inputs.constants)
