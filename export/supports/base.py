"""The interface of the export of a kind of support."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from export.layers.graph import GraphBuilder
from msdgs_train.layers.deformation import DeformationLayer
from msdgs_train.supports.base import Support


class SupportInputs(NamedTuple):
    """A support with its chain of layers, and the names of the graph's values that it may read."""

    support: Support
    layers: Sequence[DeformationLayer]
    means: str  # [M, 3] canonical
    quats: str  # [M, 4] canonical, wxyz, unit
    time: str  # [1, 1]
    steps: str  # [1] how many layers are applied
    attributes: Mapping[str, np.ndarray]  # `Support.baked`, of all moving Gaussians


class SupportExport(Protocol):
    """How supports of one kind are exported. Register one in `export.supports.SUPPORTS` under the kind's name."""

    heads_are_removable: bool
    """Whether a head that is 0 in all layers is 0 for the Gaussians too."""
    bytes_per_gaussian: int
    """Size of `Support.baked` in a scene file."""

    def deltas(self, graph: GraphBuilder, inputs: SupportInputs) -> dict[str, str]:
        """Add the nodes of the chain and of the support. Returns the summed deltas of Gaussians by head, without heads
        that are always 0 (equations 7 to 9, before modulation)."""
        ...
