"""The interface of the export of a kind of support."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from msdgs_export.layers.graph import GraphBuilder
from msdgs_train.layers.base import DeformationLayer
from msdgs_train.supports.base import Support


class Layout(NamedTuple):
    """The rows of a graph that poses all Gaussians in one order and then selects those that are asked for."""

    rows: np.ndarray  # [R] int64, the Gaussian of each row; every Gaussian has one at least
    attributes: Mapping[str, np.ndarray]  # values that the support stores per row


class SupportInputs(NamedTuple):
    """A support with its chain of layers, and the names of the graph's values that it may read."""

    support: Support
    layers: Sequence[DeformationLayer]
    means: str  # [R, 3] canonical, of the Gaussians asked for or of a layout's rows
    quats: str  # [R, 4] canonical, wxyz, unit
    time: str  # [1, 1]
    steps: str  # [1] how many layers are applied
    attributes: Mapping[str, np.ndarray]  # a layout's, or `Support.baked` of all moving Gaussians
    constants: Mapping[str, str] = MappingProxyType({})  # [R, …] by name, of `SupportExport.constants`


class SupportExport:
    """How supports of one kind are exported. Register one in `msdgs_export.supports.SUPPORTS` under the kind's name."""

    heads_are_removable = True
    """Whether a head that is 0 in all layers is 0 for the Gaussians too."""

    def bytes_per_gaussian(self, support: Support) -> int:
        """Bytes per moving Gaussian that the support stores in a scene file, in float32; by default an id."""
        return 8

    def layout(self, means: np.ndarray, attributes: Mapping[str, np.ndarray]) -> Layout | None:
        """The rows of a graph of all moving Gaussians, of canonical means [M, 3] and attributes `Support.baked`; None
        for a graph that poses the Gaussians asked for alone."""
        return None

    def constants(self, layers: Sequence[DeformationLayer], means: np.ndarray) -> dict[str, np.ndarray]:
        """Rows [M, …] by name that the graph reads of all moving Gaussians, of canonical means [M, 3], whatever the
        time: what `point_constants` gives layers whose points they are."""
        return {}

    def deltas(self, graph: GraphBuilder, inputs: SupportInputs) -> dict[str, str]:
        """Add the nodes of the chain and of the support. Returns the summed deltas of the rows by head, without heads
        that are always 0 (equations 7 to 9, before modulation), and `gains`, [R, 3], if colors change."""
        raise NotImplementedError

    def poses(self, graph: GraphBuilder, inputs: SupportInputs, log_scales: str) -> dict[str, str] | None:
        """Add the nodes of means, scales and quaternions of a layout's rows, deformed without modulation and with
        deltas of logarithms of scales, [R, 3], and of `gains`; None to have them computed from `deltas`."""
        return None
