"""One step of deformation: a small MLP over encoded position and time, with its heads (paper, equations 7 and 10)."""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from msdgs_train.layers.heads import PAPER_HEADS, Heads

HIDDEN_BIAS, XYZ_GAIN, TIME_GAIN = -1.0, 2.0, 3.0
"""Of a new layer: bias of the hidden units, and what the first Linear's columns are multiplied by."""


class LayerStep(NamedTuple):
    """What one layer proposes for N Gaussians at one time; the deltas aren't yet multiplied by the weight."""

    delta_means: Tensor  # [N, 3] scene units
    delta_scales: Tensor  # [N, 3] of logarithms or of scales, as the model's `delta_space` says
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


def frequency_matrix(dimensions: int, frequencies: int) -> Tensor:
    """The matrix F, [D, frequencies · D], for which x @ F is 1x, 2x, 4x, … side by side, each of D columns.

    Powers of two times one coordinate: exact in float32, so every reader of a model sees the same phases.
    """
    return torch.cat([torch.eye(dimensions) * 2.0**k for k in range(frequencies)], dim=1)


class PositionalEncoding(torch.autograd.Function):
    """γ(x): [N, D] → [N, D + 2·F·D], ordered x, sin 1x, sin 2x, sin 4x …, cos 1x, cos 2x, cos 4x … (no π).

    The backward takes the forward's sines and cosines as derivatives instead of computing them again.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, frequency_matrix_: Tensor) -> Tensor:
        phases = x @ frequency_matrix_  # 12x faster than a broadcast product of shape [N, F, 3] on a CPU
        sines, cosines = phases.sin(), phases.cos_()
        ctx.save_for_backward(sines, cosines, frequency_matrix_)
        return torch.cat([x, sines, cosines], dim=-1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        sines, cosines, frequency_matrix_ = ctx.saved_tensors
        d, n = frequency_matrix_.shape
        grad_phases = (grad[..., d : d + n] * cosines).addcmul_(grad[..., d + n :], sines, value=-1)
        return torch.addmm(grad[..., :d], grad_phases, frequency_matrix_.t()), None


class MLPLayer(nn.Module):
    """D_k of equation 7: encoded means and time through `depth` Linear–ReLU, then one Linear for all heads.

    Time has its own small network whose output is the same for all Gaussians. It runs once a call, and its part of
    a Linear that reads it is a vector added to the bias. At the default sizes the layer has 235,561 parameters. With
    depth 8, `skip` 5 and no weight it is the network of DeformGS, 522,280 parameters.
    """

    kind = "mlp"
    xyz_frequency_matrix: Tensor
    time_frequency_matrix: Tensor

    def __init__(
        self,
        width: int = 256,
        depth: int = 4,
        xyz_frequencies: int = 10,
        time_frequencies: int = 6,
        time_width: int = 256,
        time_features: int = 30,
        skip: int = 0,
        outputs: Heads = PAPER_HEADS,
    ) -> None:
        """`skip`: after so many hidden layers the input is read once more, beside their output; 0: never."""
        super().__init__()
        self.outputs = outputs
        self.skip = skip
        self.register_buffer("xyz_frequency_matrix", frequency_matrix(3, xyz_frequencies), persistent=False)
        self.register_buffer("time_frequency_matrix", frequency_matrix(1, time_frequencies), persistent=False)
        self.xyz_features = 3 * (1 + 2 * xyz_frequencies)
        self.input_features = self.xyz_features + time_features
        self.time_hidden = nn.Linear(1 + 2 * time_frequencies, time_width)
        self.time_output = nn.Linear(time_width, time_features)
        self.first = nn.Linear(self.input_features, width)  # columns: encoded xyz, then time features
        trunk = [nn.Linear(width + (self.input_features if i == skip else 0), width) for i in range(1, depth)]
        self.trunk = nn.ModuleList(trunk)  # columns of the one after the skip: as `first`, then hidden units
        self.heads = nn.Linear(width, sum(outputs.sizes))
        self._initialize(trunk)

    @torch.no_grad()
    def _initialize(self, trunk: list[nn.Linear]) -> None:
        """He's initialisation with bias towards silence: a hidden unit answers to some places and times only.

        The paper names none. With torch's default the last features of a small layer (width 96, depth 2) have a cosine
        similarity of 0.98 for times 0.1 apart and 0.81 for places one unit apart: whatever one part of the scene
        learns moves all others at all times, and they push it back. Here it is 0.57 and 0.39.
        """
        for linear in (self.time_hidden, self.first, *trunk):
            nn.init.kaiming_normal_(linear.weight, nonlinearity="relu")
            nn.init.constant_(linear.bias, HIDDEN_BIAS)
        for linear in trunk[1:]:  # silence grows with depth: at depth 4 no last unit would answer anywhere
            nn.init.zeros_(linear.bias)
        nn.init.kaiming_normal_(self.time_output.weight, nonlinearity="linear")
        nn.init.zeros_(self.time_output.bias)
        self.first.weight[:, : self.xyz_features] *= XYZ_GAIN
        self.first.weight[:, self.xyz_features :] *= TIME_GAIN
        deltas = sum(self.outputs.sizes[:-1])
        self.heads.weight[:deltas] = 0  # a new layer moves nothing; its weight keeps a random direction to learn from
        self.heads.bias[:] = 0

    def forward(self, means: Tensor, t: Tensor) -> LayerStep:
        """The step of means, [N, 3], at time `t`, a scalar tensor of the same dtype and device."""
        encoded, code = PositionalEncoding.apply(means, self.xyz_frequency_matrix), self.time_code(t)
        hidden = self._read_input(self.first, encoded, code).relu_()
        for i, linear in enumerate(self.trunk, start=1):
            if i == self.skip:
                read = self._read_input(linear, encoded, code)
                weight = linear.get_parameter("weight")[:, self.input_features :]
                hidden = torch.addmm(read, hidden, weight.t()).relu_()
            else:
                hidden = linear(hidden).relu_()
        return LayerStep.of_columns(self.heads(hidden), self.outputs)

    def time_code(self, t: Tensor) -> Tensor:
        """[time_features] of time `t`, the same for all Gaussians."""
        encoded = PositionalEncoding.apply(t.reshape(1, 1), self.time_frequency_matrix)
        return self.time_output(self.time_hidden(encoded).relu_())[0]

    def _read_input(self, linear: nn.Module, encoded: Tensor, code: Tensor) -> Tensor:
        """[N, width] the part of a Linear that reads encoded means and time, its bias included."""
        weight, bias = linear.get_parameter("weight"), linear.get_parameter("bias")
        at_time = torch.addmv(bias, weight[:, self.xyz_features : self.input_features], code)
        return torch.addmm(at_time, encoded, weight[:, : self.xyz_features].t())

    def extra_repr(self) -> str:
        return f"{sum(p.numel() for p in self.parameters()):,} parameters"


def to_array(tensor: Tensor) -> np.ndarray:
    """As kernels take it."""
    return tensor.detach().cpu().contiguous().numpy()
