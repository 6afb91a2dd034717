"""The support `scgs` of SC-GS (Huang et al. 2024): sparse control nodes with learned radii, found in a space of
positions and learned hyper coordinates.

Until its nodes are placed the chain moves each Gaussian, by deltas of means alone: from these Gaussians the nodes are
chosen. After that a Gaussian follows the nodes that are nearest to it in position and hyper coordinates, with weights
that don't depend on time.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import embedding

from msdgs_serve.scene.quaternion import MIN_NORM
from msdgs_train.gaussians.attribute import Attribute
from msdgs_train.gaussians.scale_space import ScaleSpace
from msdgs_train.layers.arrays import to_array
from msdgs_train.layers.base import check_size
from msdgs_train.layers.chain import Deltas, MultiStepDeformation
from msdgs_train.layers.parameters import ParamGroup, constant
from msdgs_train.layers.placement import farthest_points
from msdgs_train.layers.quaternions import identity_like, rotation_matrices, unit
from msdgs_train.supports.base import CanonicalPoints, Support, SupportConfig
from msdgs_train.supports.nearest import nearest
from msdgs_train.supports.skinning import check_nodes

GAUSSIAN_HYPER, NODE_HYPER = -1e-2, 1e-2
"""Initial hyper coordinates of Gaussians and of nodes."""
INITIAL_RADIUS = 0.1
"""Of a node, in the range of the coordinates of the points that nodes are chosen from."""
MIN_RANGE = 1e-7
MIN_WEIGHT = 1e-7
"""Added to weights, so that a Gaussian far from all nodes follows the nearest alike."""
LOCAL_QUATS = "local_quats"
MOTION = 19
"""Numbers of a motion: matrix 9, offset 3, delta of scales 3, delta of quaternions 4."""


@dataclass(frozen=True)
class SCGSConfig(SupportConfig):
    """Settings of the support `scgs`."""

    kind: ClassVar[str] = "scgs"
    moves_nodes: ClassVar[bool] = True
    scale_spaces: ClassVar[tuple[ScaleSpace, ...]] = ("linear",)
    extra_heads: ClassVar[Mapping[str, int]] = MappingProxyType({LOCAL_QUATS: 4})
    num_nodes: int = 512
    """Control nodes."""
    k_nearest: int = 3
    """Nodes that a Gaussian follows, at most 8."""
    hyper_dim: int = 8
    """Learned coordinates besides the position, in which Gaussians and nodes are near or far."""
    lr_nodes: float = 8e-4
    """Learning rate of the nodes' hyper coordinates, radii and weights; constant."""
    lr_hyper: float = 2.5e-3
    """Learning rate of the Gaussians' hyper coordinates; constant."""

    def build(self) -> "SCGSSupport":
        return SCGSSupport(self)

    def check(self, field: str) -> None:
        check_nodes(field, self.num_nodes, self.k_nearest)
        check_size(f"{field}.hyper_dim", self.hyper_dim)

    @property
    def followed(self) -> int:
        """Nodes that each Gaussian follows."""
        return min(self.k_nearest, self.num_nodes)

    def attributes(self) -> dict[str, Attribute]:
        first = lambda n, columns, _: torch.full((n, columns), GAUSSIAN_HYPER)  # noqa: E731
        return {"hyper_coords": Attribute(self.hyper_dim, first, constant(self.lr_hyper))}


class NodeRows(NamedTuple):
    """What is stored per node."""

    nodes: Tensor  # [M, 3] canonical positions, which the layers read; not trained
    node_hypers: Tensor  # [M, H]
    log_radii: Tensor  # [M]
    node_logits: Tensor  # [M] of a factor of the weight


class SCGSSupport(Support):
    """The points are the Gaussians until the nodes are placed, then the nodes."""

    kind = "scgs"
    nodes: nn.Parameter
    node_hypers: nn.Parameter
    log_radii: nn.Parameter
    node_logits: nn.Parameter
    is_placed: Tensor

    def __init__(self, config: SCGSConfig) -> None:
        super().__init__()
        self.config = config
        m = config.num_nodes
        self.set_rows(NodeRows(torch.zeros(m, 3), torch.zeros(m, config.hyper_dim), torch.zeros(m), torch.zeros(m)))
        self.register_buffer("is_placed", torch.tensor(False))
        self.has_nodes = False  # as `is_placed`, but read without waiting for a device
        self.register_load_state_dict_post_hook(_read_is_placed)

    def set_placed(self, is_placed: bool) -> None:
        """Whether the nodes are placed, and Gaussians follow them."""
        self.is_placed.fill_(is_placed)
        self.has_nodes = is_placed

    def set_rows(self, rows: NodeRows) -> None:
        """Replace all nodes; their number may change."""
        for name, values in rows._asdict().items():
            setattr(self, name, nn.Parameter(values, requires_grad=name != "nodes"))
        self.num_points = len(rows.nodes)

    def rows(self) -> NodeRows:
        """What is stored per node, without gradients."""
        return NodeRows(*(self.get_parameter(name).detach() for name in NodeRows._fields))

    def parameter_groups(self) -> list[ParamGroup]:
        trained = [self.get_parameter(name) for name in NodeRows._fields[1:]]
        return [ParamGroup("nodes", trained, constant(self.config.lr_nodes))]

    @torch.no_grad()
    def place(self, means: Tensor, trajectories: Tensor, first: int) -> Tensor:
        """Make Gaussians nodes, `num_nodes` that are far from each other or all if they are fewer; returns their ids.

        Args:
            means: [N, 3] canonical.
            trajectories: [N, ·] positions over time, between which distances are measured.
            first: the id of the first one.
        """
        count = min(self.config.num_nodes, len(means))
        chosen, _ = farthest_points(trajectories, count, first)
        radius = INITIAL_RADIUS * float(means.max() - means.min()) + MIN_RANGE
        hypers = means.new_full((count, self.config.hyper_dim), NODE_HYPER)
        log_radii = means.new_full((count,), math.log(radius))
        self.set_rows(NodeRows(means[chosen].clone(), hypers, log_radii, torch.zeros_like(log_radii)))
        return chosen

    def motions(
        self, chain: MultiStepDeformation, means: Tensor, t: Tensor, num_layers: int | None = None
    ) -> Tensor | Deltas:
        deltas = chain(self.points(means), t, num_layers)
        return self.transforms(deltas) if self.has_nodes else deltas

    def points(self, means: Tensor) -> Tensor:
        return self.nodes if self.has_nodes else means.detach()

    def transforms(self, deltas: Deltas) -> Tensor:
        """[M, 19] matrices, offsets, deltas of scales and of quaternions of the nodes: x → matrix x + offset, which is
        R(x − p) + p + d of a node at p."""
        matrices = rotation_matrices(unit(_local_quats(deltas)))
        offsets = self.nodes + deltas.means - torch.einsum("bij,bj->bi", matrices, self.nodes)
        return torch.cat([matrices.flatten(1), offsets, deltas.scales, deltas.quats], dim=1)

    def follow(self, gaussians: CanonicalPoints, motions: Tensor | Deltas) -> Deltas:
        """Deltas of the Gaussians; they have gradients only if the motions have."""
        if isinstance(motions, Deltas):  # the nodes aren't placed
            still = torch.zeros_like(motions.means)
            return Deltas(motions.means, still, torch.zeros_like(motions.quats))
        with torch.set_grad_enabled(torch.is_grad_enabled() and motions.requires_grad):
            means, lengths = gaussians.means.detach(), gaussians.raw_quats.norm(dim=1, keepdim=True)
            weights, ids = self.weights(means, gaussians.attributes["hyper_coords"])
            blended = torch.einsum("nf,nfc->nc", weights, embedding(ids, motions))
            matrices, offsets, scales, quats = blended.split((9, 3, 3, 4), dim=1)
            moved = torch.einsum("nij,nj->ni", matrices.view(-1, 3, 3), means) + offsets
            # q + Δq of a quaternion of any norm is normalized, as unit(q) + Δq / |q| is
            return Deltas(moved - means, scales, quats / lengths.clamp_min(MIN_NORM))

    def weights(self, means: Tensor, hypers: Tensor, count: int | None = None) -> tuple[Tensor, Tensor]:
        """Weights, rows of which sum to 1, and ids, [N, F], of the nodes that Gaussians follow, or of the nearest
        `count`; from the nearest to the farthest. Means, [N, 3], have no gradients, hyper coordinates, [N, H], have."""
        places, own = torch.cat([self.nodes, self.node_hypers], dim=1), torch.cat([means.detach(), hypers], dim=1)
        # in float32 whatever the model's precision, so that equally near nodes are the same ones in all
        ids = nearest(own.float(), places.float(), self.config.followed if count is None else count)
        spread = 0.5 * torch.exp(-2 * self.log_radii)[:, None]
        near = embedding(ids, torch.cat([places, spread, self.node_logits.sigmoid()[:, None]], dim=1))
        squares = (own[:, None] - near[..., :-2]).square().sum(dim=2)
        weights = torch.exp(-squares * near[..., -2]) * near[..., -1] + MIN_WEIGHT
        return weights / weights.sum(dim=1, keepdim=True), ids

    @torch.no_grad()
    def densified(self, gaussians: CanonicalPoints, gradients: Tensor, least: float) -> tuple[Tensor, NodeRows]:
        """Ids of the nodes to keep, those that a Gaussian follows, and nodes to add: one where the Gaussians of a node
        of a mean gradient above `least` are, weighted by their gradients, of the node's radius and weight.

        Args:
            gradients: [N] mean norms of gradients of the Gaussians' projected means.
        """
        weights, ids = self.weights(gaussians.means, gaussians.attributes["hyper_coords"])
        own = torch.cat([gaussians.means, gaussians.attributes["hyper_coords"]], dim=1)
        parts = weights * gradients[:, None]
        values = torch.cat([weights[..., None], parts[..., None], parts[..., None] * own[:, None]], dim=2).flatten(0, 1)
        sums = values.new_zeros(self.num_points or 0, values.shape[1]).index_add_(0, ids.flatten(), values)
        followed, total = sums[:, 0], sums[:, 1]
        chosen = torch.nonzero((total / (followed + MIN_WEIGHT) > least) & (total > 0))[:, 0]
        places, rows = sums[chosen, 2:] / total[chosen, None], self.rows()
        added = NodeRows(places[:, :3], places[:, 3:], rows.log_radii[chosen], rows.node_logits[chosen])
        return torch.nonzero(followed > 0)[:, 0], added

    def baked(self, gaussians: CanonicalPoints) -> dict[str, Any]:
        """`skinning_weights`, [N, F], whose rows sum to 1; `node_ids`, int64 [N, F]; and `quat_factors`, [N, 1], of
        deltas of quaternions."""
        weights, ids = self.weights(gaussians.means, gaussians.attributes["hyper_coords"])
        lengths = gaussians.raw_quats.norm(dim=1, keepdim=True).clamp_min(MIN_NORM)
        return {name: to_array(v) for name, v in
                (("skinning_weights", weights), ("node_ids", ids), ("quat_factors", 1 / lengths))}  # fmt: skip

    def spread(self, values: Tensor, gaussians: CanonicalPoints) -> Tensor:
        weights, ids = self.weights(gaussians.means, gaussians.attributes["hyper_coords"])
        return (weights * values[ids]).sum(dim=1)

    def mean_error_bounds(self, errors: Tensor, deltas: Deltas, gaussians: CanonicalPoints) -> Tensor:
        of_means, *_, of_local_quats = errors.unbind(dim=1)
        angles = 2 * of_local_quats / _local_quats(deltas).norm(dim=1).clamp_min(MIN_NORM)
        weights, ids = self.weights(gaussians.means, gaussians.attributes["hyper_coords"])
        lever_arms = (gaussians.means[:, None] - self.nodes[ids]).norm(dim=2)
        return (weights * (of_means[ids] + lever_arms * angles[ids])).sum(dim=1)

    def operations(self) -> int:
        return 2 * MOTION * self.config.followed


def _local_quats(deltas: Deltas) -> Tensor:
    """[M, 4] rotations about the nodes, not normalized."""
    return deltas.extra[LOCAL_QUATS] + identity_like(deltas.means)


def _read_is_placed(support: nn.Module, _: object) -> None:
    """After its state is loaded."""
    assert isinstance(support, SCGSSupport)
    support.has_nodes = bool(support.is_placed)
