"""Deformation layers as parts of an ONNX graph, one module a kind.

A kind from outside this package registers itself with `LAYERS[kind] = export`, a `LayerExport`.
"""

from export.layers.base import HEAD_COLUMNS, HEADS, LayerExport, LayerInputs, ModelNotExportable
from export.layers.mlp import MLPExport
from export.layers.plane import PlaneExport
from export.layers.spline import SplineExport
from msdgs_train.layers.deformation import DeformationLayer

__all__ = ["HEADS", "HEAD_COLUMNS", "LAYERS", "LayerExport", "LayerInputs", "ModelNotExportable", "export_of"]

LAYERS: dict[str, LayerExport] = {"mlp": MLPExport(), "plane": PlaneExport(), "spline": SplineExport()}
"""By the kind of the layer, its attribute `kind`."""


def export_of(layer: DeformationLayer) -> LayerExport:
    """How this layer is exported. Raises `ModelNotExportable` for a kind that isn't registered."""
    kind = layer.kind
    if kind not in LAYERS:
        raise ModelNotExportable(f"layers of kind {kind!r} can't be exported; those that can: {', '.join(LAYERS)}")
    return LAYERS[kind]
