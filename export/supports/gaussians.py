"""The support `gaussians` as a graph: the chain runs on the canonical means."""

from collections.abc import Mapping

import numpy as np

from export.layers.chain import summed_deltas, used_heads
from export.layers.graph import GraphBuilder
from export.supports.base import Layout, SupportInputs
from msdgs_train.supports.base import Support


class GaussiansExport:
    """Of `GaussiansSupport`."""

    heads_are_removable = True

    def bytes_per_gaussian(self, support: Support) -> int:
        """Nothing."""
        return 0

    def layout(self, means: np.ndarray, attributes: Mapping[str, np.ndarray]) -> Layout | None:
        """None: layers run on the Gaussians asked for."""
        return None

    def deltas(self, graph: GraphBuilder, inputs: SupportInputs) -> dict[str, str]:
        """Of the chain itself."""
        used = used_heads(inputs.layers)
        return summed_deltas(graph, inputs.layers, inputs.means, inputs.time, inputs.steps, used)
