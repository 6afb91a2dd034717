"""The support `gaussians` as a graph: the chain runs on the canonical means."""

from msdgs_export.layers.chain import summed_deltas, used_heads
from msdgs_export.layers.graph import GraphBuilder
from msdgs_export.supports.base import SupportExport, SupportInputs


class GaussiansExport(SupportExport):
    """Exports `GaussiansSupport`."""

    def deltas(self, graph: GraphBuilder, inputs: SupportInputs) -> dict[str, str]:
        """The deltas of the chain itself."""
        used = used_heads(inputs.layers)
        return summed_deltas(graph, inputs.layers, inputs.means, inputs.time, inputs.steps, used)
