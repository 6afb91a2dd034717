"""The interface of a deformation layer, and what it proposes for each point."""

from collections.abc import Iterable
from typing import ClassVar, NamedTuple

from torch import Tensor, nn

from msdgs_train.layers.base import Heads
from msdgs_train.layers.parameters import ParamGroup


class LayerStep(NamedTuple):
    """What one layer proposes for N points at one time; the deltas aren't yet multiplied by the weight."""

    delta_means: Tensor  # [N, 3] scene units
    delta_scales: Tensor  # [N, 3] as the model's `scale_space` says; on nodes [N, 3] or [N, 6] of a stretch tensor
    delta_quats: Tensor  # [N, 4] wxyz
    weight: Tensor  # [N, 1] in (0, 1); 1 without the head
    delta_opacities: Tensor | None = None  # [N] of logits
    delta_sh: Tensor | None = None  # [N, (degree + 1)², 3]

    @classmethod
    def of_columns(cls, columns: Tensor, heads: Heads) -> "LayerStep":
        """From the heads' columns side by side, [N, sum of `heads.sizes`]."""
        means, scales, quats, opacity, sh, logit = columns.split(heads.sizes, dim=1)
        weight = logit.sigmoid() if heads.weight else columns.new_ones(len(columns), 1)
        opacities = opacity[:, 0] if heads.opacity else None
        return cls(means, scales, quats, weight, opacities, sh.unflatten(1, (heads.sh, 3)) if heads.sh else None)


class DeformationLayer(nn.Module):
    """D_k of equation 7. It knows positions and times, not whether they are of Gaussians or of control nodes."""

    kind: ClassVar[str]

    def forward(self, means: Tensor, t: Tensor) -> LayerStep:
        """The step of points at `means`, [N, 3], where the layers before have moved them; `t` is a scalar tensor of
        the same dtype and device."""
        raise NotImplementedError

    def parameter_groups(self) -> list[ParamGroup]:
        """All trainable parameters, each in one group, with their learning rates."""
        raise NotImplementedError

    def regularizers(self, t: Tensor, is_new_frame: bool) -> dict[str, Tensor]:
        """Weighted terms of the loss at time `t`, by name; `is_new_frame` if the image at `t` has just been admitted
        to the time window."""
        return {}

    def on_window(self, before: float, after: float) -> None:
        """Extrapolate when the time window, centered in the time range, widens: half widths, as parts of the range."""

    def new_frame_rows(self, times: Iterable[float]) -> list[tuple[nn.Parameter, Tensor]]:
        """Parameters, and a mask of their rows, whose steps are larger where newly admitted frames are at `times`."""
        return []

    def operations(self) -> int:
        """Floating-point operations a point: a product and a sum for each weight that it reads."""
        linears = [module for module in self.modules() if isinstance(module, nn.Linear)]
        return 2 * sum(linear.weight.numel() for linear in linears)

    def extra_repr(self) -> str:
        return f"{sum(p.numel() for p in self.parameters()):,} parameters"
