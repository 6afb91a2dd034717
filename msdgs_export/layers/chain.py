"""A chain of layers as part of a graph (equations 7 to 9)."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from msdgs_export.layers import export_of
from msdgs_export.layers.base import HEADS, LayerInputs, ModelNotExportable, heads_of
from msdgs_export.layers.graph import GraphBuilder
from msdgs_train.layers.base import DeformationLayer

STRETCH_COLUMNS = 6
"""Columns of a symmetric matrix, in which control nodes sum stretches; the first three are its diagonal."""


def used_heads(layers: Sequence[DeformationLayer]) -> list[str]:
    """Heads that change anything in any of the layers; at least one."""
    inert = [export_of(layer).inert_heads(layer) for layer in layers]
    return [head for head in heads_of(layers[0]).columns if any(head not in heads for heads in inert)] or ["means"]


def point_constants(layers: Sequence[DeformationLayer], points: np.ndarray) -> dict[str, np.ndarray]:
    """What layers read of canonical points, [P, 3], whatever the time: rows [P, …] by names of a graph.

    Raises `ModelNotExportable` if another than the first layer does.
    """
    found: dict[str, np.ndarray] = {}
    for k, layer in enumerate(layers, start=1):
        own = export_of(layer).point_constants(layer, points)
        if own and k > 1:
            raise ModelNotExportable(f"layer {k} is of kind {layer.kind!r}, which can only be exported as the first")
        found |= {f"layer{k}.{name}": values for name, values in own.items()}
    return found


def stored_constants(graph: GraphBuilder, layers: Sequence[DeformationLayer], points: np.ndarray) -> dict[str, str]:
    """`point_constants` in a graph that poses all of these points."""
    return {name: graph.constant(name, rows) for name, rows in point_constants(layers, points).items()}


def summed_deltas(
    graph: GraphBuilder,
    layers: Sequence[DeformationLayer],
    points: str,
    time: str,
    steps: str,
    used: list[str],
    num_nodes: int | None = None,
    constants: Mapping[str, str] = MappingProxyType({}),
) -> dict[str, str]:
    """Deltas of points, [P, 3], by head, and `gains` if layers have any; on control nodes scales have six columns.
    `constants` are the graph's values of `point_constants`."""
    widths = {name: columns.stop - columns.start for name, columns in heads_of(layers[0]).columns.items()}
    widths |= {} if num_nodes is None else {"scales": STRETCH_COLUMNS}
    total, gains, moved, parts = "", "", points, dict[str, str]()
    for k, layer in enumerate(layers, start=1):
        name, export = f"layer{k}", export_of(layer)
        own = {n.removeprefix(f"{name}."): value for n, value in constants.items() if n.startswith(f"{name}.")}
        inputs = LayerInputs(name, layer, moved, time, _gate(graph, name, steps, k), own)
        step = export.deltas(graph, inputs, used)
        if num_nodes is not None and export.scale_columns != STRETCH_COLUMNS:
            step = _padded(graph, name, step, num_nodes)
        total = graph.node("Add", [total, step], f"{name}.deltas") if total else step
        sizes = [widths[head] for head in used]
        parts = dict(zip(used, graph.split(total, [f"{name}.{head}" for head in used], sizes), strict=True))
        if k < len(layers) and "means" in parts:
            moved = graph.node("Add", [points, parts["means"]], f"{name}.moved")
        if more := export.gains(graph, inputs):
            gains = graph.node("Add", [gains, more], f"{name}.all_gains") if gains else more
    return parts | ({"gains": gains} if gains else {})


def _padded(graph: GraphBuilder, name: str, step: str, num_nodes: int) -> str:
    """Deltas of all heads, [P, 10], with zeros for the off-diagonal columns of scales, [P, 13]."""
    parts = graph.split(step, [f"{name}.raw.{head}" for head in HEADS], [3, 3, 4])
    zeros = graph.constant(f"{name}.off_diagonal", np.zeros((num_nodes, 3), np.float32))
    return graph.node("Concat", [parts[0], parts[1], zeros, parts[2]], f"{name}.padded", axis=1)


def _gate(graph: GraphBuilder, name: str, steps: str, k: int) -> str:
    """[1] fraction of layer k that is applied if `steps` layers are, in [0, 1]."""
    before = graph.constant(f"{name}.before", np.array([k - 1], np.float32))
    limits = [graph.constant(f"{name}.gate.{n}", np.array(v, np.float32)) for n, v in (("min", 0), ("max", 1))]
    return graph.node("Clip", [graph.node("Sub", [steps, before], f"{name}.steps"), *limits], f"{name}.gate")
