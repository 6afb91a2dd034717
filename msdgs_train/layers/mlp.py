"""One step of deformation: a small MLP over encoded position and time, with its heads (paper, equations 7 and 10)."""

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.layers import arrays
from msdgs_train.layers.base import (
    PAPER_HEADS,
    DeformationLayer,
    Heads,
    LayerConfig,
    LayerStep,
    SceneBounds,
    check_size,
)
from msdgs_train.layers.parameters import LearningRate, ParamGroup
from msdgs_train.layers.precision import chosen_precision, matrix_products

HIDDEN_BIAS, XYZ_GAIN, TIME_GAIN = -1.0, 2.0, 3.0
"""Initialization: bias of the hidden units, and factors of the first Linear's columns."""


def frequency_matrix(dimensions: int, frequencies: int) -> Tensor:
    """The matrix F, [D, frequencies · D], for which x @ F is 1x, 2x, 4x, … side by side, each of D columns.

    Powers of two times one coordinate: exact in float32, so every reader of a model sees the same phases.
    """
    return torch.cat([torch.eye(dimensions) * 2.0**k for k in range(frequencies)], dim=1)


def positional_encoding(x: Tensor, frequencies: Tensor) -> Tensor:
    """γ(x): [N, D] → [N, D + 2·F·D], ordered x, sin 1x, sin 2x, sin 4x …, cos 1x, cos 2x, cos 4x … (no π)."""
    if arrays.has_kernels(x):
        phases = x @ frequencies  # 12x faster than a broadcast product of shape [N, F, 3] on a CPU
    else:  # a product of matrices isn't exact in TF32
        phases = x.repeat(1, frequencies.shape[1] // frequencies.shape[0]) * frequencies.sum(dim=0)
    return torch.cat([x, phases.sin(), phases.cos()], dim=-1)


@dataclass(frozen=True)
class MLPConfig(LayerConfig):
    """Sizes and learning rates of an MLP layer; the sizes are the paper's."""

    kind: ClassVar[str] = "mlp"
    width: int = 256
    """Hidden units of the trunk."""
    depth: int = 4
    """Hidden layers of the trunk."""
    xyz_frequencies: int = 10
    """Octaves of the positional encoding of a mean."""
    time_frequencies: int = 6
    """Octaves of the encoding of a time."""
    time_width: int = 256
    """Hidden units of the network of time."""
    time_features: int = 30
    """Outputs of the network of time."""
    time_network: bool = True
    """Off: layers read the encoded time itself, as in Deformable-3D-Gaussians for real scenes; `time_width` and
    `time_features` are then ignored."""
    skip: int = 0
    """Skip connection: the input is concatenated after so many hidden layers, fewer than `depth`; 0: none."""
    initialization: str = "local"
    """`local`: zero deltas, and hidden units that are active at some positions and times only; `torch`: its default."""
    lr_init: float = 2e-3
    """Learning rate until all times take part."""
    lr_final: float = 2e-5
    """Learning rate at the last step, to which it decays exponentially."""

    def build(self, bounds: SceneBounds, heads: Heads, num_points: int | None) -> "MLPLayer":
        return MLPLayer(self, heads)

    def check(self, field: str, moves_nodes: bool) -> None:
        for name in ("width", "depth", "xyz_frequencies", "time_frequencies", "time_width", "time_features"):
            check_size(f"{field}.{name}", getattr(self, name))
        check_size(f"{field}.skip", self.skip, least=0)
        if not isinstance(self.time_network, bool):
            raise InvalidInput(f"{field}.time_network", "True or False", self.time_network)
        if self.initialization not in ("local", "torch"):
            raise InvalidInput(f"{field}.initialization", "local or torch", self.initialization)
        if self.skip >= self.depth:
            raise InvalidInput(f"{field}.skip", f"fewer than the {self.depth} hidden layers of `depth`", self.skip)

    def check_stored(self, num_tensors: int) -> None:
        if self.depth > num_tensors:
            raise InvalidInput("depth", f"at most {num_tensors}, the number of tensors that are stored", self.depth)


class MLPLayer(DeformationLayer):
    """D_k of equation 7: encoded means and time through `depth` Linear–ReLU, then one Linear for all heads.

    Time has its own small network whose output is the same for all points. It runs once a call, and its part of a
    Linear that reads it is a vector added to the bias. At the default sizes the layer has 235,561 parameters. With
    depth 8, `skip` 5 and no weight it is the network of DeformGS, 522,280 parameters.
    """

    kind = "mlp"
    xyz_frequency_matrix: Tensor
    time_frequency_matrix: Tensor

    def __init__(self, config: MLPConfig = MLPConfig(), outputs: Heads = PAPER_HEADS) -> None:
        super().__init__()
        c, encoded_time = config, 1 + 2 * config.time_frequencies
        width, time_width, time_features = c.width, c.time_width, c.time_features
        if not c.time_network:
            time_width, time_features = 2 * encoded_time, encoded_time
        self.config, self.outputs, self.skip = config, outputs, c.skip
        self.register_buffer("xyz_frequency_matrix", frequency_matrix(3, c.xyz_frequencies), persistent=False)
        self.register_buffer("time_frequency_matrix", frequency_matrix(1, c.time_frequencies), persistent=False)
        self.xyz_features = 3 * (1 + 2 * c.xyz_frequencies)
        self.input_features = self.xyz_features + time_features
        self.time_hidden = nn.Linear(encoded_time, time_width)
        self.time_output = nn.Linear(time_width, time_features)
        self.first = nn.Linear(self.input_features, width)  # columns: encoded xyz, then time features
        trunk = [nn.Linear(width + (self.input_features if i == c.skip else 0), width) for i in range(1, c.depth)]
        self.trunk = nn.ModuleList(trunk)  # columns of the one after the skip: as `first`, then hidden units
        self.heads = nn.Linear(width, sum(outputs.sizes))
        if c.initialization == "local":
            self._initialize(trunk)
        if not c.time_network:
            self._fix_time()

    @torch.no_grad()
    def _fix_time(self) -> None:
        """Make the network of time the identity, as relu(x) - relu(-x), for good."""
        eye = torch.eye(self.time_hidden.in_features)
        for linear, weight in (
            (self.time_hidden, torch.cat([eye, -eye])),
            (self.time_output, torch.cat([eye, -eye], 1)),
        ):
            linear.weight.copy_(weight)
            linear.bias.zero_()
            linear.requires_grad_(requires_grad=False)

    @torch.no_grad()
    def _initialize(self, trunk: list[nn.Linear]) -> None:
        """He's initialization with a negative bias: a hidden unit is active at some positions and times only.

        The paper doesn't specify any. With torch's default the last features of a small layer (width 96, depth 2) have
        a cosine similarity of 0.98 for times 0.1 apart and 0.81 for positions one unit apart, so that a gradient of one
        part of the scene moves all others at all times. Here it is 0.57 and 0.39.
        """
        for linear in (self.time_hidden, self.first, *trunk):
            nn.init.kaiming_normal_(linear.weight, nonlinearity="relu")
            nn.init.constant_(linear.bias, HIDDEN_BIAS)
        # negative biases add up over the depth: at 4 no unit of the last layer would be active
        for linear in trunk[1:]:
            nn.init.zeros_(linear.bias)
        nn.init.kaiming_normal_(self.time_output.weight, nonlinearity="linear")
        nn.init.zeros_(self.time_output.bias)
        self.first.weight[:, : self.xyz_features] *= XYZ_GAIN
        self.first.weight[:, self.xyz_features :] *= TIME_GAIN
        deltas = sum(self.outputs.sizes[:-1])
        self.heads.weight[:deltas] = 0  # zero deltas at first; the step weight keeps random parameters
        self.heads.bias[:] = 0

    def forward(self, means: Tensor, t: Tensor) -> LayerStep:
        linears = [self.time_hidden, self.time_output, self.first, *self.trunk, self.heads]
        tensors = [linear.get_parameter(name) for linear in linears for name in ("weight", "bias")]
        frequencies = self.xyz_frequency_matrix, self.time_frequency_matrix
        return LayerStep.of_columns(_Network.apply(means, t, *frequencies, self.skip, *tensors), self.outputs)

    def parameter_groups(self) -> list[ParamGroup]:
        lr = LearningRate(self.config.lr_init, self.config.lr_final, holds=True)
        trained = [parameter for parameter in self.parameters() if parameter.requires_grad]
        return [ParamGroup("network", trained, lr, is_clipped=True)]


def _encode_backward(grad: Tensor, encoded: Tensor, frequencies: Tensor) -> Tensor:
    """The gradient in x; sines and cosines are each other's derivatives."""
    d, n = frequencies.shape
    sines, cosines = encoded[..., d : d + n], encoded[..., d + n :]
    grad_phases = (grad[..., d : d + n] * cosines).addcmul_(grad[..., d + n :], sines, value=-1)
    if arrays.has_kernels(grad):
        return torch.addmm(grad[..., :d], grad_phases, frequencies.t())
    return grad[..., :d] + (grad_phases * frequencies.sum(dim=0)).unflatten(-1, (-1, d)).sum(dim=-2)


def _add_product(total: Tensor, a: Tensor, b: Tensor) -> None:
    if a.dtype == total.dtype:
        total.addmm_(a, b)
    else:
        total.add_(a @ b)


class _Network(torch.autograd.Function):
    """All outputs of an `MLPLayer`, [N, sum of `heads.sizes`], with a backward of its own: for the 512 rows of control
    nodes, matrix products take less time than the operations that torch records between them.

    The large products of the trunk, and those of their gradients, are in `chosen_precision()`.
    """

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        t: Tensor,
        xyz_frequencies: Tensor,
        time_frequencies: Tensor,
        skip: int,
        *params: Tensor,
    ) -> Tensor:
        time_weight, time_bias, code_weight, code_bias, *trunk, heads_weight, heads_bias = params
        ctx.precision = precision = chosen_precision()
        encoded = positional_encoding(means, xyz_frequencies)
        narrow = torch.bfloat16 if precision == "bf16" else encoded.dtype
        encoded_time = positional_encoding(t.reshape(1, 1), time_frequencies)[0]
        time_hidden = torch.addmv(time_bias, time_weight, encoded_time).relu_()
        code = torch.addmv(code_bias, code_weight, time_hidden)
        split = encoded.shape[1], encoded.shape[1] + len(code)
        hidden, read_by_trunk = [], encoded.to(narrow)
        with matrix_products(precision):
            for index, (weight, bias) in enumerate(zip(trunk[::2], trunk[1::2], strict=True)):
                if index in (0, skip):
                    bias = torch.addmv(bias, weight[:, split[0] : split[1]], code)
                    weight, bias = weight.to(narrow), bias.to(narrow)
                    read = torch.addmm(bias, read_by_trunk, weight[:, : split[0]].t())
                    read = torch.addmm(read, hidden[-1], weight[:, split[1] :].t()) if index else read
                else:
                    read = torch.addmm(bias.to(narrow), hidden[-1], weight.to(narrow).t())
                hidden.append(read.relu_())
        ctx.skip, ctx.split, ctx.time_shape = skip, split, t.shape
        saved = (xyz_frequencies, time_frequencies, encoded, encoded_time, time_hidden, code)
        ctx.save_for_backward(*saved, *params, *hidden)
        ctx.num_params = len(params)
        return torch.addmm(heads_bias, hidden[-1].to(encoded.dtype), heads_weight.t())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        xyz_frequencies, time_frequencies, encoded, encoded_time, time_hidden, code, *rest = ctx.saved_tensors
        params, hidden = rest[: ctx.num_params], rest[ctx.num_params :]
        (time_weight, _, code_weight, _), trunk, heads_weight = params[:4], params[4:-2], params[-2]
        begin, end = ctx.split
        wide, narrow = encoded.dtype, hidden[-1].dtype
        grads: list[Tensor] = [grad.t() @ hidden[-1].to(wide), grad.sum(dim=0)]
        grad_hidden = (grad @ heads_weight).to(narrow)
        wants_means, wants_t = ctx.needs_input_grad[:2]
        grad_encoded, grad_code, read_by_trunk = torch.zeros_like(encoded), torch.zeros_like(code), encoded.to(narrow)
        with matrix_products(ctx.precision):
            for index in reversed(range(len(hidden))):
                weight, below = trunk[2 * index], hidden[index - 1] if index else None
                grad_read = torch.ops.aten.threshold_backward(grad_hidden, hidden[index], 0)
                grad_bias = grad_read.sum(dim=0, dtype=wide)
                if index in (0, ctx.skip):
                    if wants_means:
                        _add_product(grad_encoded, grad_read, weight[:, :begin].to(narrow))
                    grad_code.addmv_(weight[:, begin:end].t(), grad_bias)
                    parts = [(grad_read.t() @ read_by_trunk).to(wide), torch.outer(grad_bias, code)]
                    parts += [] if below is None else [(grad_read.t() @ below).to(wide)]
                    grad_weight, weight = torch.cat(parts, dim=1), weight[:, end:]
                else:
                    grad_weight = (grad_read.t() @ hidden[index - 1]).to(wide)
                grads = [grad_weight, grad_bias, *grads]
                grad_hidden = grad_read @ weight.to(narrow) if index else grad_read
        grad_time_hidden = torch.ops.aten.threshold_backward(code_weight.t() @ grad_code, time_hidden, 0)
        grads = [torch.outer(grad_time_hidden, encoded_time), grad_time_hidden,
                 torch.outer(grad_code, time_hidden), grad_code, *grads]  # fmt: skip
        grad_means = _encode_backward(grad_encoded, encoded, xyz_frequencies) if wants_means else None
        grad_t = None
        if wants_t:
            grad_encoded_time = (time_weight.t() @ grad_time_hidden)[None]
            grad_t = _encode_backward(grad_encoded_time, encoded_time[None], time_frequencies).reshape(ctx.time_shape)
        return grad_means, grad_t, None, None, None, *grads
