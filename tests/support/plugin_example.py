"""A plugin: a layer kind, a support, a system that trains with the layers, and the export of layers and support."""

import copy
import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.datasets import Frame
from msdgs_train.engine.config import TrainConfig
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.layers.base import (
    HEAD_COLUMNS,
    DeformationLayer,
    Heads,
    LayerConfig,
    LayerStep,
    SceneBounds,
    check_size,
)
from msdgs_train.layers.chain import Deltas
from msdgs_train.layers.parameters import LearningRate, ParamGroup
from msdgs_train.layers.registry import register_layer
from msdgs_train.settings import SystemConfig
from msdgs_train.supports.base import CanonicalPoints
from msdgs_train.supports.gaussians import GaussiansConfig, GaussiansSupport
from msdgs_train.supports.registry import register_support
from msdgs_train.systems.base import Moment, Target, ViewLoss
from msdgs_train.systems.gaussian_splatting import GaussianSplatting
from msdgs_train.systems.registry import register_system


# layer
@dataclass(frozen=True)
class FourierConfig(LayerConfig):
    """Sizes and learning rates of a Fourier layer."""

    kind: ClassVar[str] = "fourier"
    frequencies: int = 4
    """Sines and cosines of time: 1 to so many periods over the time range."""
    lr_init: float = 2e-3
    """Learning rate until all times take part."""
    lr_final: float = 2e-5
    """Learning rate at the last step, to which it decays exponentially."""

    def build(self, bounds: SceneBounds, heads: Heads, num_points: int | None) -> "FourierLayer":
        return FourierLayer(self, bounds, heads)

    def check(self, field: str, moves_nodes: bool) -> None:
        check_size(f"{field}.frequencies", self.frequencies)


class FourierLayer(DeformationLayer):
    """All deltas are an affine function of position whose coefficients are a Fourier series of time."""

    kind = "fourier"
    angular: Tensor
    first_time: Tensor

    def __init__(self, config: FourierConfig, bounds: SceneBounds, outputs: Heads) -> None:
        super().__init__()
        self.config, self.outputs = config, outputs
        first, last = bounds.time_range
        frequencies = torch.arange(1, config.frequencies + 1)
        self.register_buffer("angular", 2 * math.pi * frequencies / ((last - first) or 1.0))  # [F] radians per time
        self.register_buffer("first_time", torch.tensor(first))
        columns = sum(outputs.sizes)
        self.matrices = nn.Parameter(torch.zeros(2 * config.frequencies, 3, columns))  # zeros: moves nothing at first
        self.offsets = nn.Parameter(torch.zeros(2 * config.frequencies, columns))

    def forward(self, means: Tensor, t: Tensor) -> LayerStep:
        phases = self.angular * (t - self.first_time)
        series = torch.cat([phases.sin(), phases.cos()])  # [2 F]
        matrix = torch.einsum("f,fic->ic", series, self.matrices)
        return LayerStep.of_columns(torch.addmm(series @ self.offsets, means, matrix), self.outputs)

    def parameter_groups(self) -> list[ParamGroup]:
        lr = LearningRate(self.config.lr_init, self.config.lr_final, holds=True)
        return [ParamGroup("series", list(self.parameters()), lr, is_clipped=True)]

    def operations(self) -> int:
        return 2 * 3 * self.offsets.shape[1]


register_layer(FourierConfig)


# support
@dataclass(frozen=True)
class ConfinedConfig(GaussiansConfig):
    """Settings of motion in a ball around the origin."""

    kind: ClassVar[str] = "confined"
    radius: float = 1.0
    """Radius of the ball outside of which nothing moves, in scene units."""

    def build(self) -> "ConfinedSupport":
        return ConfinedSupport(self)

    def check(self, field: str) -> None:
        if not self.radius > 0:
            raise InvalidInput(f"{field}.radius", "above 0", self.radius)


class ConfinedSupport(GaussiansSupport):
    """Gaussians in the ball follow the layers, others stay where they are."""

    kind = "confined"

    def follow(self, gaussians: CanonicalPoints, motions: Deltas) -> Deltas:
        assert isinstance(self.config, ConfinedConfig)
        inside = gaussians.means.square().sum(dim=1, keepdim=True) < self.config.radius**2
        means, scales, quats = (torch.where(inside, delta, 0.0) for delta in motions[:3])
        return motions._replace(means=means, scales=scales, quats=quats)


register_support(ConfinedConfig)


# system
@dataclass(frozen=True)
class SparseConfig(SystemConfig):
    """Settings of sparse motion."""

    motion_weight: float = 0.01
    """Weight of the mean displacement of Gaussians, per scene unit."""

    def __post_init__(self) -> None:
        self.require_weights("motion_weight")


class SparseMotion(GaussianSplatting):
    """Gaussian splatting that prefers to leave Gaussians where they are."""

    def loss(self, frame: Frame, target: Target, background: Tensor, moment: Moment) -> ViewLoss:
        view = super().loss(frame, target, background, moment)
        if not self.schedule.deforms(moment.step):
            return view
        assert isinstance(self.config.own, SparseConfig)
        displacement = self.model.pose(frame.t).means - self.model.gaussians.means
        return view._replace(loss=view.loss + self.config.own.motion_weight * displacement.abs().mean())


register_system(
    "sparse-fourier",
    "two Fourier layers and sparse motion",
    TrainConfig().updated(
        model=ModelConfig(sh_degree=2, layers=(FourierConfig(), FourierConfig(frequencies=8))), own=SparseConfig()
    ),
    build=SparseMotion,
)

# export
try:
    from msdgs_export.layers import LAYERS, LayerInputs
    from msdgs_export.layers.base import FieldLayerExport, zero
    from msdgs_export.layers.graph import GraphBuilder, to_numpy
    from msdgs_export.supports import SUPPORTS, SupportInputs
    from msdgs_export.supports.gaussians import GaussiansExport
except ImportError:  # training needs no onnx
    pass
else:

    class FourierExport(FieldLayerExport):
        """`FourierLayer` as nodes of an ONNX graph."""

        def outputs(self, graph: GraphBuilder, inputs: LayerInputs, rows: np.ndarray) -> str:
            layer, name = inputs.layer, inputs.name
            assert isinstance(layer, FourierLayer)
            series = self.series(graph, inputs, layer)
            matrices = to_numpy(layer.matrices)[:, :, rows].reshape(len(layer.matrices), -1)
            flat = graph.node("MatMul", [series, graph.constant(f"{name}.matrices", matrices)], f"{name}.flat")
            shape = graph.constant(f"{name}.shape", np.array([3, len(rows)]))
            matrix = graph.node("Reshape", [flat, shape], f"{name}.matrix")
            offsets = graph.constant(f"{name}.offsets", to_numpy(layer.offsets)[:, rows])
            offset = graph.node("MatMul", [series, offsets], f"{name}.offset")
            return graph.node("Gemm", [inputs.means, matrix, offset], f"{name}.outputs")

        def series(self, graph: GraphBuilder, inputs: LayerInputs, layer: FourierLayer) -> str:
            """[1, 2 F]."""
            name = inputs.name
            first = graph.constant(f"{name}.first_time", to_numpy(layer.first_time))
            angular = graph.constant(f"{name}.angular", to_numpy(layer.angular)[None])
            elapsed = graph.node("Sub", [inputs.time, first], f"{name}.elapsed")
            phases = graph.node("Mul", [elapsed, angular], f"{name}.phases")
            waves = [graph.node(kind, [phases], f"{name}.{kind}") for kind in ("Sin", "Cos")]
            return graph.node("Concat", waves, f"{name}.series", axis=1)

        def inert_heads(self, layer: DeformationLayer) -> frozenset[str]:
            assert isinstance(layer, FourierLayer)
            parts = (layer.matrices, layer.offsets)
            return frozenset(n for n, c in HEAD_COLUMNS.items() if not any(part[..., c].any() for part in parts))

        def without_heads(self, layer: DeformationLayer, names: frozenset[str]) -> DeformationLayer:
            layer = copy.deepcopy(layer)
            assert isinstance(layer, FourierLayer)
            for name in names:
                zero(layer.matrices[..., HEAD_COLUMNS[name]], layer.offsets[..., HEAD_COLUMNS[name]])
            return layer

    LAYERS[FourierConfig.kind] = FourierExport()

    class ConfinedExport(GaussiansExport):
        """`ConfinedSupport` as nodes of an ONNX graph."""

        def deltas(self, graph: GraphBuilder, inputs: SupportInputs) -> dict[str, str]:
            assert isinstance(inputs.support.config, ConfinedConfig)
            limit = graph.constant("confined.limit", np.array(inputs.support.config.radius**2, np.float32))
            ones = graph.constant("confined.ones", np.ones((3, 1), np.float32))
            zero = graph.constant("confined.zero", np.zeros(1, np.float32))
            squares = graph.node("Mul", [inputs.means, inputs.means], "confined.squares")
            sums = graph.node("MatMul", [squares, ones], "confined.sums")
            inside = graph.node("Less", [sums, limit], "confined.inside")
            parts = super().deltas(graph, inputs)
            for name in ("means", "scales", "quats"):
                if name in parts:
                    parts[name] = graph.node("Where", [inside, parts[name], zero], f"confined.{name}")
            return parts

    SUPPORTS[ConfinedConfig.kind] = ConfinedExport()
