"""A coarse step of deformation: a few rigid bodies, which the control nodes follow softly.

A body has one pose over time for all nodes that follow it, so what is seen of any of them moves all. The layers after
it add what is left. Bodies are placed among the nodes when the deformation starts; how much a node follows each of them
is learned and constant in time.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn.functional import one_hot

from msdgs_train.layers.base import Heads, LayerStep, SceneBounds, check_size
from msdgs_train.layers.curves import CurveConfig, CurveLayer
from msdgs_train.layers.parameters import LearningRate, ParamGroup
from msdgs_train.layers.placement import spread_centers
from msdgs_train.layers.quaternions import identity_like, rotation_matrices, unit

INITIAL_SPREAD = 0.5
"""Standard deviation of the initial weights of a node, in sizes of the nearest body."""
MIN_INITIAL_LOGIT = -12.0
"""Lower bound of initial logits: weights near 0 keep a gradient."""
MIN_SIZE = 0.5
"""Of a body, as a fraction of the mean: few nodes don't tell its size."""
MIN_MEAN_SIZE = 1e-3  # scene units


@dataclass(frozen=True)
class BodiesConfig(CurveConfig):
    """Sizes and learning rates of a layer of rigid bodies."""

    kind: ClassVar[str] = "bodies"
    num_bodies: int = 32
    """Bodies; at most one per control node."""
    lr_init: float = 5e-4
    """Learning rate of poses until all times take part: scene units by which a translation, or a rotation at the border
    of its body, moves nodes."""
    lr_final: float = 5e-5
    """Learning rate of poses at the last step, to which it decays exponentially."""
    logits_lr_init: float = 2e-2
    """Learning rate of the weights' logits until all times take part."""
    logits_lr_final: float = 2e-3
    """Learning rate of the weights' logits at the last step."""
    body_smoothness_weight: float = 0.05
    """Weight of the mean size of second differences of poses along time, scene units."""

    def build(self, bounds: SceneBounds, heads: Heads, num_points: int | None) -> "BodiesLayer":
        assert num_points is not None  # `check` refuses Gaussians
        return BodiesLayer(self.with_knots(), num_points, bounds.time_range)

    def check(self, field: str, moves_nodes: bool) -> None:
        super().check(field, moves_nodes)
        check_size(f"{field}.num_bodies", self.num_bodies)


class BodiesLayer(CurveLayer):
    """B bodies, each with a rotation about its center and a translation, and M nodes. A node's delta is the weighted
    mean of what the bodies do there; step weights are 1.

    Quaternions are as long as their body is large: a change of one has about the effect of an equal translation, and
    one learning rate fits bodies of any size.
    """

    kind = "bodies"
    centers: Tensor
    sizes: Tensor

    def __init__(self, config: BodiesConfig, num_points: int, time_range: tuple[float, float]) -> None:
        count = min(config.num_bodies, num_points)
        super().__init__(config.num_knots, count, time_range)
        self.config = config
        self.logits = nn.Parameter(torch.zeros(num_points, count))
        self.register_buffer("centers", torch.zeros(count, 3))  # scene units
        self.register_buffer("sizes", torch.ones(count))  # scene units

    @torch.no_grad()
    def on_deform_start(self, points: Tensor) -> None:
        """Place bodies by k-means of the nodes, each of which follows near bodies most."""
        self.centers.copy_(spread_centers(points, len(self.centers)))
        distances = torch.cdist(points, self.centers)
        to_nearest, nearest = distances.min(dim=1)
        mean = (2 * to_nearest.mean()).clamp_min(MIN_MEAN_SIZE)
        members = one_hot(nearest, len(self.sizes)).to(points.dtype)
        own = 2 * to_nearest @ members / members.sum(dim=0).clamp_min(1)
        self.sizes.copy_(own.clamp_min(MIN_SIZE * mean))
        self.rots.copy_(self.rot_lengths * identity_like(self.rots))
        logits = -0.5 * (distances / (INITIAL_SPREAD * self.sizes[nearest][:, None])).square()
        self.logits.copy_((logits - logits.amax(dim=1, keepdim=True)).clamp_min(MIN_INITIAL_LOGIT))

    @property
    def rot_lengths(self) -> Tensor:
        return self.sizes[:, None]

    def forward(self, means: Tensor, t: Tensor) -> LayerStep:
        maps, turns = self.motions(t)
        moved = self.weights() @ torch.cat([maps, turns], dim=1)
        matrices, offsets, quats = moved.split((9, 3, 4), dim=1)
        shifts = torch.einsum("mij,mj->mi", matrices.unflatten(1, (3, 3)), means) + offsets
        return LayerStep(shifts, means.new_zeros(len(means), 3), quats, means.new_ones(len(means), 1))

    def motions(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """What bodies do to points, less the identity: [B, 12] matrices row by row and offsets, scene units, and
        [B, 4] quaternions. All are 0 for a body at rest."""
        transls, rots = self.values_at(t, self.transls, self.rots)
        quats = unit(rots)
        matrices = rotation_matrices(quats) - torch.eye(3, dtype=quats.dtype, device=quats.device)
        offsets = transls - torch.einsum("bij,bj->bi", matrices, self.centers)
        return torch.cat([matrices.flatten(1), offsets], dim=1), quats - identity_like(quats)

    def weights(self) -> Tensor:
        """[M, B] how much each node follows each body; rows sum to 1."""
        return self.logits.softmax(dim=1)

    def parameter_groups(self) -> list[ParamGroup]:
        c = self.config
        poses = LearningRate(c.lr_init, c.lr_final, holds=True)
        logits = LearningRate(c.logits_lr_init, c.logits_lr_final, holds=True)
        return [ParamGroup("poses", [self.transls, self.rots], poses), ParamGroup("logits", [self.logits], logits)]

    def regularizers(self, points: Tensor, t: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
        transls, rots = self.unsteadiness(t, self.transls, self.rots)
        return {"body_smoothness": self.config.body_smoothness_weight * (transls + rots)}

    def operations(self) -> int:
        """A product and a sum per weight and number of a motion, and those of a map."""
        return 2 * (16 * len(self.centers) + 9)
