"""The interface of a deformation layer, one step of a chain that moves Gaussians or control nodes (paper, equation 7):
its outputs, its module and its settings.

A new kind is one file: a frozen dataclass that derives from `LayerConfig`, a module that derives from
`DeformationLayer`, and a line that registers the first in `layers.registry`.
"""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.layers.parameters import ParamGroup

HEAD_COLUMNS = {"means": slice(0, 3), "scales": slice(3, 6), "quats": slice(6, 10)}
"""Columns of a layer's deltas, in the order of `Heads.sizes`; the logit of the step weight, if any, is the last."""

NO_EXTRA: Mapping[str, Tensor] = MappingProxyType({})


class Heads(NamedTuple):
    """Outputs of a layer besides deltas of means, scales and quaternions."""

    weight: bool = True  # False: all step weights are 1
    opacity: bool = False
    sh: int = 0  # coefficients (degree + 1)² per channel; 0: none
    extra: tuple[tuple[str, int], ...] = ()  # names and columns, as `SupportConfig.extra_heads`

    @property
    def sizes(self) -> tuple[int, ...]:
        """Columns of means, scales, quats, opacity, SH, extra heads, and the logit of the weight; 0 for an absent
        output."""
        extra = (columns for _, columns in self.extra)
        return (3, 3, 4, int(self.opacity), 3 * self.sh, *extra, int(self.weight))

    @property
    def columns(self) -> dict[str, slice]:
        """Columns of the deltas of each head that is there, by name."""
        ends = list(itertools.accumulate(self.sizes, initial=0))
        names = (*HEAD_COLUMNS, "opacities", "sh", *(name for name, _ in self.extra))
        spans = zip(names, ends, ends[1:], strict=False)
        return {name: slice(start, stop) for name, start, stop in spans if stop > start}


PAPER_HEADS = Heads()


class SceneBounds(NamedTuple):
    """The extent of a scene in space and time, which grids span. Stored with the weights."""

    scene_half_size: float = 1.0  # of a cube around the origin, scene units
    time_range: tuple[float, float] = (0.0, 1.0)


class LayerStep(NamedTuple):
    """Outputs of one layer for N points at one time; the deltas are not yet multiplied by the weight."""

    delta_means: Tensor  # [N, 3] scene units
    delta_scales: Tensor  # [N, 3] as the model's `scale_space` says; on nodes [N, 3] or [N, 6] of a stretch tensor
    delta_quats: Tensor  # [N, 4] wxyz
    weight: Tensor  # [N, 1] in (0, 1); 1 without the head
    delta_opacities: Tensor | None = None  # [N] of logits
    delta_sh: Tensor | None = None  # [N, (degree + 1)², 3]
    extra: Mapping[str, Tensor] = NO_EXTRA  # [N, ·] outputs of extra heads, by name
    gains: Tensor | None = None  # [N, 3] of red, green and blue, by whose 1 + gain colors are multiplied

    @classmethod
    def of_columns(cls, columns: Tensor, heads: Heads) -> "LayerStep":
        """Split the concatenated outputs of all heads, [N, sum of `heads.sizes`]."""
        means, scales, quats, opacity, sh, *values, logit = columns.split(heads.sizes, dim=1)
        weight = logit.sigmoid() if heads.weight else columns.new_ones(len(columns), 1)
        opacities = opacity[:, 0] if heads.opacity else None
        coefficients = sh.unflatten(1, (heads.sh, 3)) if heads.sh else None
        extra = {name: value for (name, _), value in zip(heads.extra, values, strict=True)}
        return cls(means, scales, quats, weight, opacities, coefficients, extra)


class DeformationLayer(nn.Module):
    """D_k of equation 7: a function of positions and time, of Gaussians or of control nodes."""

    kind: ClassVar[str]

    @property
    def shades(self) -> bool:
        """Whether it changes colors, by gains."""
        return False

    def forward(self, means: Tensor, t: Tensor) -> LayerStep:
        """Deltas of points at `means`, [N, 3], as moved by the layers before; `t` is a scalar tensor of the same dtype
        and device."""
        raise NotImplementedError

    def parameter_groups(self) -> list[ParamGroup]:
        """All trainable parameters, each in one group, with their learning rates."""
        raise NotImplementedError

    def regularizers(self, points: Tensor, t: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
        """Weighted terms of the loss at time `t`, by name; `points`, [N, 3], are the canonical positions of what the
        chain moves, and all randomness is the generator's, which is on the CPU."""
        return {}

    def on_deform_start(self, points: Tensor) -> None:
        """Called before the first step with deformation; `points`, [N, 3], are canonical positions of what moves."""

    def on_window(self, before: float, after: float) -> None:
        """Extrapolate when the time window widens; half widths, as fractions of the time range."""

    def operations(self) -> int:
        """Floating-point operations per point; by default a product and a sum per weight of a Linear."""
        linears = [module for module in self.modules() if isinstance(module, nn.Linear)]
        return 2 * sum(linear.weight.numel() for linear in linears)


@dataclass(frozen=True)
class LayerConfig:
    """Sizes and learning rates of one layer; each layer of a model has its own."""

    kind: ClassVar[str]
    """The name of this kind of layer in configurations and files."""
    has_extra_heads: ClassVar[bool] = True
    """Whether a layer predicts the heads that a support asks for (`SupportConfig.extra_heads`)."""

    def build(self, bounds: SceneBounds, heads: Heads, num_points: int | None) -> DeformationLayer:
        """A new layer, with zero deltas; `num_points` is the number of control nodes, None if it moves Gaussians."""
        raise NotImplementedError

    def for_rig(self, num_times: int) -> "LayerConfig":
        """These settings for a scene of fixed cameras, each of which has captured about `num_times` times."""
        return self

    def check(self, field: str, moves_nodes: bool) -> None:
        """Raise `InvalidInput` naming `field.SETTING` if a size is out of range, or the layer can't move such points,
        control nodes or Gaussians."""

    def check_stored(self, num_tensors: int) -> None:
        """Raise `InvalidInput` if a model file with `num_tensors` tensors can't hold this layer.

        Called before the layer is built, so that a damaged configuration doesn't allocate millions of tensors.
        """


def check_size(field: str, value: object, least: int = 1) -> None:
    """Raise `InvalidInput` unless `value` is an integer of `least` or more."""
    if type(value) is not int or value < least:
        raise InvalidInput(field, f"an integer of {least} or more", value)
