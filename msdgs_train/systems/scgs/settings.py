"""Settings of the stages and losses of SC-GS."""

from dataclasses import dataclass
from typing import Annotated

from msdgs_train.settings import SystemConfig, optional


@dataclass(frozen=True)
class SCGSSettings(SystemConfig):
    """SC-GS. Its first stage trains few Gaussians of one size, each moved by the network, from which control nodes are
    chosen. The second trains the scene; fractions in other groups are of this stage."""

    node_stage_fraction: float = 10_000 / 90_000
    """Fraction of the run that the first stage takes."""
    node_choice_fraction: float = 7_500 / 10_000
    """Fraction of the first stage after which nodes are chosen, and its density control ends."""
    node_warm_up_fraction: float = 2_000 / 10_000
    """First fraction of the first stage, in which the network isn't trained."""
    node_refine_every_fraction: float = 100 / 10_000
    """Fraction of the first stage between rounds of density control."""
    node_reset_every_fraction: float = 3_000 / 10_000
    """Fraction of the first stage between resets of opacities."""
    gaussians_per_node: Annotated[int | None, optional("INT")] = None
    """Upper bound of the Gaussians of the first stage, per node; if not given 16 with sparse points of the dataset, and
    --max-gaussians without."""
    warm_up_fraction: float = 3_000 / 80_000
    """First fraction of the second stage, in which motion isn't trained."""
    densify_nodes_fraction: float = 10_000 / 80_000
    """Fraction of the second stage after which nodes are added and removed, once."""
    network_until_fraction: float = 40_000 / 80_000
    """Fraction of the second stage after which the network's rate has reached its last value; both stages begin with
    the first one."""
    elastic_weight: float = 1e-3
    """Weight of the relative variance of distances between neighboring nodes, in the first stage."""
    acceleration_weight: float = 1e-5
    """Weight of the relative second difference of the nodes' positions, in the first stage."""
    node_rigidity_weight: float = 1e-2
    """Weight of as-rigid-as-possible, a sum over the nodes' edges, in the first stage."""
    rigidity_weight_init: float = 1e-4
    """The same in the second stage until 1/16 of it."""
    rigidity_weight_final: float = 1e-5
    """The same from 1/8 of the second stage until 1/4 of it, and 0 after that; logarithmic in between."""

    def __post_init__(self) -> None:
        self.require_fractions(*(name for name in self.names() if name.endswith("_fraction")))
        self.require_weights("elastic_weight", "acceleration_weight", "node_rigidity_weight")
        self.require_positive("rigidity_weight_init", "rigidity_weight_final", "node_stage_fraction")
        self.require_positive("node_choice_fraction", "network_until_fraction")
        if self.gaussians_per_node is not None:
            self.require_counts("gaussians_per_node")
        self.require(("node_stage_fraction",), "above 0 and below 1", lambda value: value < 1)

    def rigidity_weight(self, part: float) -> float:
        """Of the second stage, of which a part has passed, in [0, 1]."""
        if part > 1 / 4:
            return 0.0
        ratio = min(max(16 * part - 1, 0.0), 1.0)
        return self.rigidity_weight_init ** (1 - ratio) * self.rigidity_weight_final**ratio
