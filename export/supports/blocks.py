"""Gaussians on control nodes in blocks: neighbors in space follow nearly the same nodes, so that skinning a block is
one product of a small dense matrix of weights with the motions of a few nodes."""

from typing import NamedTuple

import numpy as np

from export.supports.base import Layout

BLOCK_SIZES = (64, 128, 256)
BLOCK_NODES = 8
"""Nodes of a block are padded to a multiple of this."""
GRID_BITS = 20
"""Of a coordinate in Morton order."""
WEIGHT_ONE = 32767
"""A skinning weight of 1 as it is stored, in 16 bits: one of 4 weights is off by 1.5e-5 at most."""


class Blocks(NamedTuple):
    """B blocks of S rows that follow U nodes each."""

    nodes: np.ndarray  # int64 [B, U]
    ids: np.ndarray  # int64 [B, F, S], indices into a row of `nodes`
    weights: np.ndarray  # int16 [B, F, S], fractions of `WEIGHT_ONE`

    @property
    def size(self) -> int:
        """Elements of all matrices of weights."""
        return self.nodes.size * self.ids.shape[2]


def morton_order(points: np.ndarray) -> np.ndarray:
    """[N] int64 indices of points, [N, 3], along a Z-order curve through their bounding box; a stable sort."""
    low, high = points.min(axis=0, initial=np.inf), points.max(axis=0, initial=-np.inf)
    cells = (points.astype(np.float64) - low) / np.maximum(high - low, np.finfo(np.float32).tiny)
    codes = np.zeros(len(points), np.uint64)
    for axis, values in enumerate((cells * (2**GRID_BITS - 1)).astype(np.uint64).T):
        for bit in range(GRID_BITS):
            codes |= (values >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(codes, kind="stable")


def block_layout(means: np.ndarray, node_ids: np.ndarray, skinning_weights: np.ndarray) -> Layout:
    """Rows along a Z-order curve, the last one repeated until the last block is full, and their blocks.

    Args:
        means: [N, 3] canonical, N > 0.
        node_ids: [N, F] nodes that each Gaussian follows.
        skinning_weights: [N, F]; rows sum to 1.
    """
    order = morton_order(means)
    stored = _stored_weights(skinning_weights)
    layouts = []
    for size in BLOCK_SIZES:
        size = min(size, len(order))
        rows = np.append(order, np.repeat(order[-1:], -len(order) % size))
        layouts.append((rows, _blocks(node_ids[rows], stored[rows], size)))
    rows, blocks = min(layouts, key=lambda layout: layout[1].size)
    return Layout(rows, blocks._asdict())


def _blocks(node_ids: np.ndarray, weights: np.ndarray, size: int) -> Blocks:
    members = node_ids.reshape(-1, size, node_ids.shape[1])
    distinct = [np.unique(block, return_inverse=True) for block in members]
    width = -(-max(len(nodes) for nodes, _ in distinct) // BLOCK_NODES) * BLOCK_NODES
    nodes = np.stack([np.pad(nodes, (0, width - len(nodes)), mode="edge") for nodes, _ in distinct])
    ids = np.stack([local.reshape(size, -1).T for _, local in distinct])
    return Blocks(nodes, ids, weights.reshape(members.shape).transpose(0, 2, 1))


def _stored_weights(weights: np.ndarray) -> np.ndarray:
    """int16 [N, F] whose rows sum to `WEIGHT_ONE`: the largest weight takes what rounding leaves."""
    stored = np.round(weights.astype(np.float64) * WEIGHT_ONE).astype(np.int64)
    largest = stored.argmax(axis=1)
    stored[np.arange(len(stored)), largest] += WEIGHT_ONE - stored.sum(axis=1)
    return stored.astype(np.int16)
