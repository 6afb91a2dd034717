"""Supports as parts of an ONNX graph, from a chain of layers on points to deltas of Gaussians; one module per kind.

A kind from outside this package registers itself with `SUPPORTS[kind] = export`, a `SupportExport`.
"""

from msdgs_export.layers.base import ModelNotExportable
from msdgs_export.supports.base import Layout, SupportExport, SupportInputs
from msdgs_export.supports.gaussians import GaussiansExport
from msdgs_export.supports.nodes import NodesExport
from msdgs_export.supports.scgs import SCGSExport
from msdgs_train.supports.base import Support

__all__ = ["SUPPORTS", "Layout", "SupportExport", "SupportInputs", "support_export_of"]

SUPPORTS: dict[str, SupportExport] = {"gaussians": GaussiansExport(), "nodes": NodesExport(), "scgs": SCGSExport()}
"""By the attribute `kind` of a support."""


def support_export_of(support: Support) -> SupportExport:
    """The export of this support. Raises `ModelNotExportable` for a kind that isn't registered."""
    if support.kind not in SUPPORTS:
        known = ", ".join(SUPPORTS)
        raise ModelNotExportable(f"support {support.kind!r} can't be exported; those that can: {known}")
    return SUPPORTS[support.kind]
