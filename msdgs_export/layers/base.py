"""The interface of the export of a kind of deformation layer."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple, Protocol, cast

import numpy as np
import torch

from msdgs_export.layers.graph import GraphBuilder
from msdgs_serve.scene.errors import MsdgsError
from msdgs_train.layers.base import HEAD_COLUMNS, PAPER_HEADS, DeformationLayer, Heads

HEADS = tuple(HEAD_COLUMNS)
"""The heads of poses. Others, of opacities and SH, are named as the outputs of a scene file."""

GAINS = "gains"
"""The head of gains of colors, of layers that shade."""


class ModelNotExportable(MsdgsError):
    """A model has values or parts that a scene file can't hold."""


class LayerInputs(NamedTuple):
    """One layer, and the names of the graph's values that it may read."""

    name: str  # prefix of the layer's nodes and constants
    layer: DeformationLayer
    means: str  # [P, 3] points, Gaussians or control nodes, as moved by the layers before it
    time: str  # [1, 1]
    gate: str  # [1] fraction of the layer that the input `steps` applies, in [0, 1]
    constants: Mapping[str, str] = MappingProxyType({})  # [P, …] by name: what `point_constants` gives the points


class LayerExport(Protocol):
    """How layers of one kind are exported. Register one in `msdgs_export.layers.LAYERS` under the kind's name."""

    removable_heads: frozenset[str]
    """The heads that `without_heads` can remove."""
    scale_columns: int
    """Columns of a delta of scales: 3, or 6 of a stretch tensor on control nodes."""

    def deltas(self, graph: GraphBuilder, inputs: LayerInputs, used: list[str]) -> str:
        """Add the nodes of one layer. Returns the deltas of the heads `used`, side by side, times weight and gate."""
        ...

    def point_constants(self, layer: DeformationLayer, points: np.ndarray) -> dict[str, np.ndarray]:
        """Rows [P, …] by name that the layer reads of canonical points, [P, 3], whatever the time; float32. Only the
        first layer of a chain, whose points are canonical, may have any."""
        ...

    def gains(self, graph: GraphBuilder, inputs: LayerInputs) -> str | None:
        """Add the nodes of the layer's gains of colors, [P, 3], times the gate; None if it has none."""
        ...

    def inert_heads(self, layer: DeformationLayer) -> frozenset[str]:
        """The heads whose deltas are always 0."""
        ...

    def without_heads(self, layer: DeformationLayer, names: frozenset[str]) -> DeformationLayer:
        """A copy of the layer in which the heads `names` give 0. The layer itself isn't changed."""
        ...


class FieldLayerExport:
    """Base of kinds whose layers evaluate a field at the means and have one output per head column."""

    removable_heads = frozenset(HEADS)
    scale_columns = 3

    def deltas(self, graph: GraphBuilder, inputs: LayerInputs, used: list[str]) -> str:
        """The outputs of the heads `used`, times the step weight, if the layer predicts one, and the gate."""
        heads = heads_of(inputs.layer)
        rows = output_rows(used, heads)
        return weighted(graph, inputs, self.outputs(graph, inputs, rows), len(rows), heads.weight)

    def point_constants(self, layer: DeformationLayer, points: np.ndarray) -> dict[str, np.ndarray]:
        """None: the field is evaluated in the graph."""
        return {}

    def gains(self, graph: GraphBuilder, inputs: LayerInputs) -> str | None:
        """None: colors change by the head of SH."""
        return None

    def outputs(self, graph: GraphBuilder, inputs: LayerInputs, rows: np.ndarray) -> str:
        """Add the nodes of the field. Returns these output columns, [P, len(rows)]; the logit of the weight is last, if
        there is one."""
        raise NotImplementedError


def heads_of(layer: DeformationLayer) -> Heads:
    """The heads of a layer; those of poses if it doesn't name them."""
    return cast(Heads, getattr(layer, "outputs", PAPER_HEADS))


def output_rows(used: list[str], heads: Heads) -> np.ndarray:
    """Indices of the outputs of the heads `used`, then of the weight."""
    columns = np.arange(sum(heads.sizes))
    deltas = [columns[heads.columns[head]] for head in used]
    return np.concatenate([*deltas, columns[-1:]] if heads.weight else deltas)


def weighted(graph: GraphBuilder, inputs: LayerInputs, outputs: str, columns: int, has_weight: bool) -> str:
    """Deltas times the layer's weight, if it predicts one as the last of `columns` outputs, and its gate."""
    name = inputs.name
    if not has_weight:
        return graph.node("Mul", [outputs, inputs.gate], f"{name}.shared")
    deltas, logit = graph.split(outputs, [f"{name}.unweighted", f"{name}.logit"], [columns - 1, 1])
    weight = graph.node("Sigmoid", [logit], f"{name}.weight")
    return graph.node("Mul", [graph.node("Mul", [weight, inputs.gate], f"{name}.shared"), deltas], f"{name}.weighted")


def zero(*parameters: torch.Tensor) -> None:
    """Set views of parameters to 0 in place."""
    with torch.no_grad():
        for parameter in parameters:
            parameter.zero_()
