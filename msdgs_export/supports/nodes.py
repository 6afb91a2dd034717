"""The support `nodes` as a graph: the chain at the nodes once a call, then linear blend skinning of all Gaussians.

Gaussians come in B blocks of S rows (`msdgs_export.supports.blocks`), R = B · S in all.
"""

from collections.abc import Mapping
from typing import cast

import numpy as np
from onnx import TensorProto

from msdgs_export.layers.base import HEADS
from msdgs_export.layers.chain import stored_constants, summed_deltas
from msdgs_export.layers.graph import GraphBuilder, to_numpy
from msdgs_export.layers.rotations import IDENTITY, rotation_columns, turned, unit_rows
from msdgs_export.supports.base import Layout, SupportExport, SupportInputs
from msdgs_export.supports.blocks import block_layout
from msdgs_export.supports.skinning import Blend, columns_of, reshaped, rows_of, skinned_deltas, skinned_poses
from msdgs_train.supports.base import Support
from msdgs_train.supports.nodes import NodesSupport


class NodesExport(SupportExport):
    """Exports `NodesSupport`."""

    heads_are_removable = False

    def bytes_per_gaussian(self, support: Support) -> int:
        """An index in 8 bits and, but for the last, a weight for each node that a Gaussian follows."""
        return 5 * cast(NodesSupport, support).config.followed - 4

    def layout(self, means: np.ndarray, attributes: Mapping[str, np.ndarray]) -> Layout:
        """Blocks of Gaussians that are near each other."""
        return block_layout(means, attributes["node_ids"], attributes["skinning_weights"])

    def deltas(self, graph: GraphBuilder, inputs: SupportInputs) -> dict[str, str]:
        """Motions of the nodes, blended for each Gaussian, minus its canonical pose."""
        blend, gains = _blend(graph, inputs)
        return skinned_deltas(graph, blend) | gains

    def poses(self, graph: GraphBuilder, inputs: SupportInputs, log_scales: str) -> dict[str, str]:
        """Motions of the nodes, blended for each Gaussian, applied to its canonical pose."""
        blend, gains = _blend(graph, inputs)
        return skinned_poses(graph, blend, log_scales) | gains


def _motions(graph: GraphBuilder, inputs: SupportInputs) -> tuple[str, dict[str, int]]:
    """`NodesSupport.motions`, [M, ·], but matrices column by column; and its parts' numbers of columns."""
    support = cast(NodesSupport, inputs.support)
    positions = to_numpy(support.nodes)
    nodes = graph.constant("nodes", positions)
    chain = inputs.layers, nodes, inputs.time, inputs.steps
    constants = stored_constants(graph, inputs.layers, positions)
    parts = summed_deltas(graph, *chain, list(HEADS), len(positions), constants)
    raw = graph.node("Add", [parts["quats"], graph.constant("nodes.identity", IDENTITY)], "nodes.raw_rots")
    rots = unit_rows(graph, "nodes.rots", raw)
    matrices = _stretching(graph, "nodes.matrices", rotation_columns(graph, "nodes.rotations", rots), parts["scales"])
    offsets = node_offsets(graph, nodes, parts["means"], matrices)
    columns = {"matrices": (matrices, 9), "offsets": (offsets, 3), "rots": (rots, 4)}
    columns |= {"gains": (parts["gains"], 3)} if "gains" in parts else {}
    motions = graph.node("Concat", [value for value, _ in columns.values()], "nodes.motions", axis=1)
    return motions, {name: width for name, (_, width) in columns.items()}


def node_offsets(graph: GraphBuilder, nodes: str, translations: str, matrices: str) -> str:
    """[M, 3] offsets of motions that take nodes, [M, 3], by these translations, of matrices column by column."""
    rotated = turned(graph, "nodes.rotated", matrices, nodes)
    return graph.node("Sub", [graph.node("Add", [nodes, translations], "nodes.moved"), rotated], "nodes.offsets")


def _blend(graph: GraphBuilder, inputs: SupportInputs) -> tuple[Blend, dict[str, str]]:
    """Weighted means of the motions of the nodes that each Gaussian follows, and of their `gains`, if there are any."""
    (matrices, offsets, rots, *gains), count = blended_parts(graph, inputs.attributes, *_motions(graph, inputs))
    axes = rotation_columns(graph, "skinning.axes", inputs.quats)  # constant: computed when the file is opened
    sizes = ((inputs.means, 3), (inputs.quats, 4), (axes, 9))
    means, quats, axes = (columns_of(graph, value, width, count) for value, width in sizes)
    blend = Blend(matrices, offsets, rots, means, quats, axes, count)
    return blend, rows_of(graph, {"gains": gains[0]}, count) if gains else {}


def blended_parts(
    graph: GraphBuilder, blocks: Mapping[str, np.ndarray], motions: str, parts: Mapping[str, int]
) -> tuple[list[str], int]:
    """Weighted means of motions, [M, C], of the nodes that each of R rows of blocks follows: parts of so many columns,
    [·, R] each, and R."""
    nodes, ids, weights = (blocks[name] for name in ("nodes", "ids", "weights"))
    count, width = ids.shape[0] * ids.shape[1], sum(parts.values())
    followed = [motions, _stored_ids(graph, "skinning.nodes", nodes)]
    followed = graph.node("Gather", followed, "skinning.followed")  # [B, U, C]
    # [B, S, 16], and transposed: 2.1 ms for 106,500 Gaussians; [B, 16, S], where the larger matrix is on the right, 3.0
    blended = graph.node("MatMul", [_weights(graph, ids, weights, nodes.shape[1]), followed], "skinning.blended")
    names = [f"skinning.{name}" for name in parts]
    return graph.split(columns_of(graph, blended, width, count), names, list(parts.values()), axis=0), count


def _weights(graph: GraphBuilder, ids: np.ndarray, weights: np.ndarray, width: int) -> str:
    """[B, S, U] skinning weights of all nodes of a block. Constant: onnxruntime computes them when it opens the file.

    The last weight of a Gaussian isn't stored: it is one minus the others.
    """
    own = graph.constant("skinning.own", np.arange(width))
    left, total = graph.constant("skinning.one", np.ones(1, np.float32)), ""
    for f in range(ids.shape[2]):
        name, weight = f"skinning.node{f}", left
        if f + 1 < ids.shape[2]:
            weight = graph.constant(f"skinning.weight{f}", weights[..., f, None])
            left = graph.node("Sub", [left, weight], f"{name}.left")
        followed = graph.node("Equal", [_stored_ids(graph, name, ids[..., f, None]), own], f"{name}.equal")
        place = graph.node("Cast", [followed], f"{name}.place", to=TensorProto.FLOAT)
        term = graph.node("Mul", [place, weight], f"{name}.matrix")
        total = graph.node("Add", [total, term], f"{name}.sum") if total else term
    return total


def _stored_ids(graph: GraphBuilder, name: str, ids: np.ndarray) -> str:
    """Indices in as few bits as they need."""
    small = np.uint8 if ids.max() < 1 << 8 else np.int16 if ids.max() < 1 << 15 else np.int32
    stored = graph.constant(f"{name}.stored", ids.astype(small))
    return graph.node("Cast", [stored], f"{name}.ids", to=TensorProto.INT64)


def _stretching(graph: GraphBuilder, name: str, rotations: str, stretches: str) -> str:
    """[M, 9] matrices, column by column, that stretch by the identity and xx, yy, zz, xy, xz, yz, [M, 6], and then
    rotate by matrices column by column, [M, 9]."""
    place = np.zeros((6, 9), np.float32)
    for k, entries in enumerate(((0,), (4,), (8,), (1, 3), (2, 6), (5, 7))):
        place[k, list(entries)] = 1
    one = graph.constant(f"{name}.one", np.eye(3, dtype=np.float32).reshape(9))
    full = graph.node("Gemm", [stretches, graph.constant(f"{name}.place", place), one], f"{name}.stretch")
    transposed = [reshaped(graph, m, (-1, 3, 3), f"{name}.{k}") for k, m in (("left", full), ("right", rotations))]
    return reshaped(graph, graph.node("MatMul", transposed, f"{name}.product"), (-1, 9), name)
