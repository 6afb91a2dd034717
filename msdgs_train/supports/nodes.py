"""The support `nodes`: the chain moves control nodes, and the Gaussians follow by linear blend skinning.

At one time a node has a translation, a rotation and a stretch about its position. Each Gaussian follows nodes that are
the nearest when the deformation starts, with weights that don't depend on time. The cost of the chain is independent of
the number of Gaussians.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.quaternion import MIN_NORM
from msdgs_train.gaussians.attribute import Attribute
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.scale_space import ScaleSpace
from msdgs_train.gaussians.surgery import RowSurgery
from msdgs_train.layers.arrays import to_array
from msdgs_train.layers.chain import Deltas, MultiStepDeformation
from msdgs_train.layers.parameters import LearningRate
from msdgs_train.layers.placement import farthest_points
from msdgs_train.layers.quaternions import identity_like, rotation_matrices, stretch_matrices, unit
from msdgs_train.supports.base import CanonicalPoints, Support, SupportConfig
from msdgs_train.supports.skinning import check_nodes, skin
from msdgs_train.supports.skinning_kernels import MAX_NEAREST, MOTION
from msdgs_train.supports.torch_skinning import blend

NODE_MIN_OPACITY = 0.3
"""Gaussians of a larger opacity are candidates for nodes."""
NODE_RADIUS = 0.5
"""Standard deviation of the initial skinning weights, in distances between nodes."""
MIN_NODE_RADIUS = 1e-3  # scene units
MIN_INITIAL_LOGIT = -12.0
"""Lower bound of initial logits: weights near 0 keep a gradient."""
ARAP_NEIGHBORS = 4
MIN_DISTANCE = 0.01
"""Scene units, added to distances between nodes in local rigidity."""


@dataclass(frozen=True)
class NodesConfig(SupportConfig):
    """Settings of the support `nodes`."""

    kind: ClassVar[str] = "nodes"
    moves_nodes: ClassVar[bool] = True
    scale_spaces: ClassVar[tuple[ScaleSpace, ...]] = ("log",)  # deltas of scales are stretch tensors
    num_nodes: int = 256
    """Control nodes."""
    k_nearest: int = MAX_NEAREST
    """Nodes that a Gaussian follows, at most 8: the nearest when the deformation starts."""
    skinning_lr_init: float = 2e-2
    """Learning rate of the skinning logits until all times take part."""
    skinning_lr_final: float = 2e-3
    """Learning rate of the skinning logits at the last step, to which it decays exponentially."""
    arap_weight: float = 0.1
    """Weight of local rigidity between neighboring nodes (as rigid as possible)."""

    def build(self) -> "NodesSupport":
        return NodesSupport(self)

    def check(self, field: str) -> None:
        check_nodes(field, self.num_nodes, self.k_nearest)

    @property
    def followed(self) -> int:
        """Nodes that each Gaussian follows."""
        return min(self.k_nearest, self.num_nodes)

    def attributes(self) -> dict[str, Attribute]:
        lr = LearningRate(self.skinning_lr_init, self.skinning_lr_final, holds=True)
        return {
            "skinning_logits": Attribute(self.followed, lambda n, columns, _: torch.zeros(n, columns), lr),
            "node_ids": Attribute(self.followed, _first_nodes, lr),
        }


class NodesSupport(Support):
    """The points are control nodes; their canonical positions are not trained."""

    kind = "nodes"
    nodes: Tensor
    neighbors: Tensor

    def __init__(self, config: NodesConfig) -> None:
        super().__init__()
        self.config, self.num_points = config, config.num_nodes
        self.register_buffer("nodes", torch.zeros(config.num_nodes, 3))
        neighbors = min(ARAP_NEIGHBORS, config.num_nodes - 1)
        self.register_buffer("neighbors", torch.zeros(config.num_nodes, neighbors, dtype=torch.int64))

    def check_attributes(self, attributes: dict[str, Tensor]) -> None:
        ids = attributes.get("node_ids", torch.zeros(0, dtype=torch.int64))
        if ids.dtype != torch.int64 or not bool(((ids >= 0) & (ids < self.config.num_nodes)).all()):
            raise InvalidInput("node_ids", f"integers in [0, {self.config.num_nodes})", "others")

    def follow(self, gaussians: CanonicalPoints, motions: Tensor) -> Deltas:
        weights, ids = skinning_weights(gaussians.attributes["skinning_logits"]), gaussians.attributes["node_ids"]
        motions, gains = motions.split((MOTION, motions.shape[1] - MOTION), dim=1)
        deltas = Deltas(*skin(gaussians.means, gaussians.quats, weights, ids, motions))
        return deltas._replace(gains=blend(weights, ids, gains)) if gains.shape[1] else deltas

    def points(self, means: Tensor) -> Tensor:
        return self.nodes

    def motions(self, chain: MultiStepDeformation, means: Tensor, t: Tensor, num_layers: int | None = None) -> Tensor:
        return self.transforms(chain(self.nodes, t, num_layers))

    def transforms(self, deltas: Deltas) -> Tensor:
        """[M, 16] matrices, offsets and quaternions of the nodes: x → matrix x + offset; with gains [M, 19]."""
        rots = unit(_quaternions(deltas))
        matrices = rotation_matrices(rots) @ stretch_matrices(deltas.scales)
        offsets = self.nodes + deltas.means - (matrices * self.nodes[:, None]).sum(dim=2)
        gains = [] if deltas.gains is None else [deltas.gains]
        return torch.cat([matrices.flatten(1), offsets, rots, *gains], dim=1)

    @torch.no_grad()
    def on_deform_start(self, gaussians: CanonicalGaussians, surgery: RowSurgery) -> None:
        """Place the nodes among opaque Gaussians and initialize the skinning weights."""
        logits, ids = self.initialize_nodes(gaussians.means.detach(), gaussians.raw_opacities.detach().sigmoid())
        surgery.replace_values("skinning_logits", logits)
        surgery.replace_values("node_ids", ids)

    @torch.no_grad()
    def initialize_nodes(self, means: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
        """Farthest-point sampling of the opaque Gaussians, or of all if few are; returns initial skinning logits and
        node ids, [N, F].

        Args:
            means: [N, 3].
            opacities: [N] in (0, 1).
        """
        opaque = means[opacities > NODE_MIN_OPACITY]
        if len(opaque) < 2 * len(self.nodes):  # too few to choose from
            opaque = means
        first = int((opaque - opaque.mean(dim=0)).norm(dim=1).argmin())
        chosen, distances = farthest_points(opaque, len(self.nodes), first)
        self.nodes.copy_(opaque[chosen])
        near = torch.cdist(self.nodes, self.nodes).topk(self.neighbors.shape[1] + 1, largest=False)
        self.neighbors.copy_(near.indices[:, 1:])
        radius = max(NODE_RADIUS * float(distances.max()), MIN_NODE_RADIUS)
        logits = -0.5 * (torch.cdist(means, self.nodes) / radius).square()
        nearest = logits.topk(self.config.followed, dim=1)
        return (nearest.values - nearest.values[:, :1]).clamp_min(MIN_INITIAL_LOGIT), nearest.indices

    def regularizers(
        self, motions: Tensor, gaussians: CanonicalPoints, t: Tensor, generator: torch.Generator
    ) -> dict[str, Tensor]:
        return {"arap": self.config.arap_weight * self.local_rigidity(motions)}

    def local_rigidity(self, motions: Tensor) -> Tensor:
        """Mean over pairs of neighbors: distance between one as moved by itself and as moved by the other, relative to
        their canonical distance."""
        matrices, offsets = motions[:, :9], motions[:, 9:12]
        near = self.neighbors
        if not near.numel():  # one node
            return motions.new_zeros(())
        points = torch.cat([self.nodes[:, None], self.nodes[near]], dim=1)  # a node, then its neighbors
        moved = torch.baddbmm(offsets[:, None], points, matrices.unflatten(1, (3, 3)).transpose(1, 2))
        apart = moved[:, 1:] - moved[:, 0][near]
        lengths = torch.linalg.vector_norm(points[:, 1:] - points[:, :1], dim=2)
        return (torch.linalg.vector_norm(apart, dim=2) / (lengths + MIN_DISTANCE)).mean()

    def baked(self, gaussians: CanonicalPoints) -> dict[str, Any]:
        """`skinning_weights`, [N, F], whose rows sum to 1, and `node_ids`, int64 [N, F]."""
        weights = skinning_weights(gaussians.attributes["skinning_logits"])
        return {"skinning_weights": to_array(weights), "node_ids": to_array(gaussians.attributes["node_ids"])}

    def spread(self, values: Tensor, gaussians: CanonicalPoints) -> Tensor:
        weights = skinning_weights(gaussians.attributes["skinning_logits"])
        return (weights * values[gaussians.attributes["node_ids"]]).sum(dim=1)

    def mean_error_bounds(self, errors: Tensor, deltas: Deltas, gaussians: CanonicalPoints) -> Tensor:
        of_means, of_scales, of_quats = errors.unbind(dim=1)
        angles = 2 * of_quats / torch.linalg.vector_norm(_quaternions(deltas), dim=1).clamp_min(MIN_NORM)
        identity = torch.eye(3, dtype=angles.dtype)
        stretches = 1 + torch.linalg.matrix_norm(stretch_matrices(deltas.scales) - identity)
        of_matrices = angles * stretches + of_scales
        ids = gaussians.attributes["node_ids"]
        lever_arms = torch.linalg.vector_norm(gaussians.means[:, None] - self.nodes[ids], dim=2)
        weights = skinning_weights(gaussians.attributes["skinning_logits"])
        return (weights * (of_means[ids] + lever_arms * of_matrices[ids])).sum(dim=1)

    def operations(self) -> int:
        return 2 * MOTION * self.config.followed


def _first_nodes(n: int, columns: int, _: torch.Generator) -> Tensor:
    """[N, F] placeholders until nodes are initialized."""
    return torch.arange(columns).repeat(n, 1)


def _quaternions(deltas: Deltas) -> Tensor:
    """[M, 4] rotations of the nodes, not normalized."""
    return deltas.quats + identity_like(deltas.quats)


def skinning_weights(logits: Tensor) -> Tensor:
    """Softmax of rows, [N, F]."""
    return logits.T.contiguous().softmax(dim=0).T  # of 18,000 rows of 8: a seventh of the time that `dim=1` takes
