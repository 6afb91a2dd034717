"""Deformation layers as parts of an ONNX graph, one module a kind.

A kind from outside this package registers itself with `LAYERS[kind] = export`, a `LayerExport`.
"""

from torch import nn

from export.layers.base import HEAD_COLUMNS, HEADS, LayerExport, LayerInputs, ModelNotExportable
from export.layers.mlp import MLPExport
from export.layers.plane import PlaneExport
from export.layers.spline import SplineExport

__all__ = ["HEADS", "HEAD_COLUMNS", "LAYERS", "LayerExport", "LayerInputs", "ModelNotExportable", "export_of"]

LAYERS: dict[str, LayerExport] = {"mlp": MLPExport(), "plane": PlaneExport(), "bases": SplineExport()}
"""By the kind of the layer, its attribute `kind`."""


def export_of(layer: nn.Module) -> LayerExport:
    """How this layer is exported. Raises `ModelNotExportable` for a kind that isn't registered."""
    kind = getattr(layer, "kind", type(layer).__name__)
    if kind not in LAYERS:
        raise ModelNotExportable(f"layers of kind {kind!r} can't be exported; those that can: {', '.join(LAYERS)}")
    return LAYERS[kind]
