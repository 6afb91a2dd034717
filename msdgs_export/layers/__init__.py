"""Deformation layers as parts of an ONNX graph, one module per kind.

A kind from outside this package registers itself with `LAYERS[kind] = export`, a `LayerExport`.
"""

from msdgs_export.layers.base import GAINS, HEAD_COLUMNS, HEADS, LayerExport, LayerInputs, ModelNotExportable
from msdgs_export.layers.bodies import BodiesExport
from msdgs_export.layers.hash4d import Hash4DExport
from msdgs_export.layers.mlp import MLPExport
from msdgs_export.layers.plane import PlaneExport
from msdgs_export.layers.spline import SplineExport
from msdgs_train.layers.base import DeformationLayer

__all__ = ["GAINS", "HEADS", "HEAD_COLUMNS", "LAYERS", "LayerExport", "LayerInputs", "ModelNotExportable", "export_of"]

LAYERS: dict[str, LayerExport] = {
    "mlp": MLPExport(),
    "plane": PlaneExport(),
    "spline": SplineExport(),
    "hash4d": Hash4DExport(),
    "bodies": BodiesExport(),
}
"""By the attribute `kind` of a layer."""


def export_of(layer: DeformationLayer) -> LayerExport:
    """The export of this layer. Raises `ModelNotExportable` for a kind that isn't registered."""
    kind = layer.kind
    if kind not in LAYERS:
        raise ModelNotExportable(f"layers of kind {kind!r} can't be exported; those that can: {', '.join(LAYERS)}")
    return LAYERS[kind]
