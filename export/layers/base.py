"""What an export needs to know of a kind of deformation layer."""

from collections.abc import Mapping
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import nn

from export.layers.graph import GraphBuilder
from msdgs_serve.scene.errors import MsdgsError
from msdgs_train.gaussians.canonical import CanonicalGaussians

HEAD_COLUMNS = {"means": slice(0, 3), "scales": slice(3, 6), "quats": slice(6, 10)}
"""Columns of a layer's deltas, in the order of `Heads.sizes`; that of the step weight, if any, is the last one."""

HEADS = tuple(HEAD_COLUMNS)


class ModelNotExportable(MsdgsError):
    """A model has values or parts that a scene file can't hold."""


class LayerInputs(NamedTuple):
    """One layer, and the names of the graph's values that it may read."""

    name: str  # prefix of the layer's nodes and constants
    layer: nn.Module
    means: str  # [M, 3] as moved by the layers before it
    canonical_means: str  # [M, 3]
    canonical_quats: str  # [M, 4] wxyz, unit
    time: str  # [1, 1]
    gate: str  # [1] how much of the layer the input `steps` applies, in [0, 1]
    attributes: Mapping[str, np.ndarray]  # what `LayerExport.attributes` gave, of all moving Gaussians


class LayerExport(Protocol):
    """How layers of one kind are exported. Register one in `export.layers.LAYERS` under the kind's name."""

    removable_heads: frozenset[str]
    """Those of `HEADS` that `without_heads` can remove."""
    parameters: frozenset[str]
    """Parameters of `CanonicalGaussians` that only layers of this kind read."""
    bytes_per_gaussian: int
    """What `attributes` take in a scene file."""

    def attributes(self, gaussians: CanonicalGaussians) -> dict[str, np.ndarray]:
        """Arrays of N rows that the graph of a layer stores per Gaussian, by name."""
        ...

    def deltas(self, graph: GraphBuilder, inputs: LayerInputs, used: list[str]) -> str:
        """Add the nodes of one layer. Returns the deltas of the heads `used`, side by side, times weight and gate."""
        ...

    def inert_heads(self, layer: nn.Module) -> frozenset[str]:
        """Those of `HEADS` whose deltas are always 0."""
        ...

    def without_heads(self, layer: nn.Module, names: frozenset[str]) -> nn.Module:
        """A copy of the layer in which the heads `names` give 0. The layer itself isn't changed."""
        ...


class FieldLayerExport:
    """Base of kinds whose layers evaluate a field at the means and have one output per head column."""

    removable_heads = frozenset(HEADS)
    parameters: frozenset[str] = frozenset()
    bytes_per_gaussian = 0

    def attributes(self, gaussians: CanonicalGaussians) -> dict[str, np.ndarray]:
        """None."""
        return {}


def output_rows(used: list[str], has_weight: bool) -> np.ndarray:
    """Indices of the outputs that are computed: those of the heads `used`, then the weight's."""
    columns = np.arange(HEAD_COLUMNS[HEADS[-1]].stop + 1)
    deltas = [columns[HEAD_COLUMNS[head]] for head in used]
    return np.concatenate([*deltas, columns[-1:]] if has_weight else deltas)


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
