"""Gaussians on control nodes in blocks: neighbors in space follow nearly the same nodes, so that skinning a block is
one product of a small dense matrix of weights with the motions of a few nodes."""

from typing import NamedTuple

import numpy as np

from msdgs_export.spatial_order import morton_order
from msdgs_export.supports.base import Layout

BLOCK_SIZES = (64, 128, 256)
BLOCK_NODES = 8
"""Nodes of a block are padded to a multiple of this."""
BLOCK_COST = 1250
"""Elements of a matrix of weights whose products take as long as a block adds: 64 rows per block take 1.1 times as long
as 128."""
SORTING_GAIN = 0.9
"""Rows are sorted if this makes the cost smaller than this times that of the order given, which needs no index from
Gaussians to rows."""


class Blocks(NamedTuple):
    """B blocks of S rows that follow U nodes each."""

    nodes: np.ndarray  # int64 [B, U]
    ids: np.ndarray  # int64 [B, S, F], indices into a row of `nodes`
    weights: np.ndarray  # float32 [B, S, F]; the largest of a Gaussian is the last, so that others are 0.5 at most

    @property
    def cost(self) -> int:
        """Time of skinning, in elements of a matrix of weights."""
        return self.nodes.size * self.ids.shape[1] + BLOCK_COST * len(self.nodes)


def block_layout(means: np.ndarray, node_ids: np.ndarray, skinning_weights: np.ndarray) -> Layout:
    """Rows in the order given, if neighbors in it are neighbors in space, or along a Z-order curve; the last row is
    repeated until the last block is full.

    Args:
        means: [N, 3] canonical, N > 0.
        node_ids: [N, F] nodes that each Gaussian follows.
        skinning_weights: [N, F]; rows sum to 1.
    """
    ascending = np.argsort(skinning_weights, axis=1, kind="stable")
    node_ids = np.take_along_axis(node_ids, ascending, axis=1)
    weights = np.take_along_axis(skinning_weights, ascending, axis=1).astype(np.float32)
    given, sorted_ = (_cheapest(order, node_ids, weights) for order in (np.arange(len(means)), morton_order(means)))
    rows, blocks = sorted_ if sorted_[1].cost < SORTING_GAIN * given[1].cost else given
    return Layout(rows, blocks._asdict())


def _cheapest(order: np.ndarray, node_ids: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, Blocks]:
    """Padded rows and blocks of the size that costs least."""
    layouts = []
    for size in sorted({min(size, len(order)) for size in BLOCK_SIZES}):
        rows = np.append(order, np.repeat(order[-1:], -len(order) % size))
        layouts.append((rows, _blocks(node_ids[rows], weights[rows], size)))
    return min(layouts, key=lambda layout: layout[1].cost)


def _blocks(node_ids: np.ndarray, weights: np.ndarray, size: int) -> Blocks:
    members = node_ids.reshape(-1, size, node_ids.shape[1])
    distinct = [np.unique(block, return_inverse=True) for block in members]
    width = -(-max(len(nodes) for nodes, _ in distinct) // BLOCK_NODES) * BLOCK_NODES
    nodes = np.stack([np.pad(nodes, (0, width - len(nodes)), mode="edge") for nodes, _ in distinct])
    ids = np.stack([local.reshape(size, -1) for _, local in distinct])
    return Blocks(nodes, ids, weights.reshape(members.shape))
