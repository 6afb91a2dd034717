"""The interface of a deformation layer, and its outputs."""

from typing import ClassVar, NamedTuple

from torch import Tensor, nn

from msdgs_train.layers.base import Heads
from msdgs_train.layers.parameters import ParamGroup


class LayerStep(NamedTuple):
    """Outputs of one layer for N points at one time; the deltas are not yet multiplied by the weight."""

    delta_means: Tensor  # [N, 3] scene units
    delta_scales: Tensor  # [N, 3] as the model's `scale_space` says; on nodes [N, 3] or [N, 6] of a stretch tensor
    delta_quats: Tensor  # [N, 4] wxyz
    weight: Tensor  # [N, 1] in (0, 1); 1 without the head
    delta_opacities: Tensor | None = None  # [N] of logits
    delta_sh: Tensor | None = None  # [N, (degree + 1)², 3]

    @classmethod
    def of_columns(cls, columns: Tensor, heads: Heads) -> "LayerStep":
        """Split the concatenated outputs of all heads, [N, sum of `heads.sizes`]."""
        means, scales, quats, opacity, sh, logit = columns.split(heads.sizes, dim=1)
        weight = logit.sigmoid() if heads.weight else columns.new_ones(len(columns), 1)
        opacities = opacity[:, 0] if heads.opacity else None
        return cls(means, scales, quats, weight, opacities, sh.unflatten(1, (heads.sh, 3)) if heads.sh else None)


class DeformationLayer(nn.Module):
    """D_k of equation 7: a function of positions and time, of Gaussians or of control nodes."""

    kind: ClassVar[str]

    def forward(self, means: Tensor, t: Tensor) -> LayerStep:
        """Deltas of points at `means`, [N, 3], as moved by the layers before; `t` is a scalar tensor of the same dtype
        and device."""
        raise NotImplementedError

    def parameter_groups(self) -> list[ParamGroup]:
        """All trainable parameters, each in one group, with their learning rates."""
        raise NotImplementedError

    def regularizers(self, t: Tensor) -> dict[str, Tensor]:
        """Weighted terms of the loss at time `t`, by name."""
        return {}

    def on_window(self, before: float, after: float) -> None:
        """Extrapolate when the time window widens; half widths, as fractions of the time range."""

    def operations(self) -> int:
        """Floating-point operations per point; by default a product and a sum per weight of a Linear."""
        linears = [module for module in self.modules() if isinstance(module, nn.Linear)]
        return 2 * sum(linear.weight.numel() for linear in linears)
