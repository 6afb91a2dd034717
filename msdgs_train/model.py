"""The whole model: canonical Gaussians, their deformation in time, and the modulation of its scaling."""

from dataclasses import dataclass, fields
from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor, nn

from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.quaternion import MIN_NORM
from msdgs_serve.scene.spherical_harmonics import sh_coefficients
from msdgs_train.deformation import MultiStepDeformation
from msdgs_train.gaussians import CanonicalGaussians
from msdgs_train.layers import MLPLayer
from msdgs_train.modulation import ScaleModulation
from msdgs_train.plane_layer import PlaneLayer

LOG_SCALE_LIMIT = 20.0
"""Scales stay within e^-20 and e^20: where a layer flings a Gaussian away its scale may vanish or overflow, and 0 · inf
is NaN."""

LayerKind = Literal["mlp", "plane"]
LEAST = {
    "width": 1,
    "depth": 1,
    "time_width": 1,
    "time_features": 1,
    "plane_channels": 1,
    "plane_space_nodes": 2,
    "plane_time_nodes": 2,
    "plane_width": 1,
}
"""The smallest sizes that make sense; the others may be 0."""


@dataclass(frozen=True)
class ModelConfig:
    """Sizes of a model. The defaults are the paper's, with K = 2 layers; K = 0 is a static scene."""

    sh_degree: int = 3
    layers: tuple[LayerKind, ...] = ("mlp", "mlp")
    """The kind of each of the K layers, in order; kinds may be mixed."""
    width: int = 256
    depth: int = 4
    xyz_frequencies: int = 10
    time_frequencies: int = 6
    time_width: int = 256
    time_features: int = 30
    plane_channels: int = 16
    """This and the following are sizes of layers of kind `plane`, those above of kind `mlp`."""
    plane_space_nodes: int = 32
    plane_time_nodes: int = 50
    plane_width: int = 32
    embedding_size: int = 32
    """0: no modulation."""
    delta_space: Literal["raw"] = "raw"
    """Where deltas are added: to log_scales and quaternions before exp and normalisation."""
    detach_means: bool = True
    """Photometric gradients through the positional encoding don't reach the canonical means, as in DeformGS."""

    def __post_init__(self) -> None:
        if not isinstance(self.layers, tuple | list):
            raise InvalidInput("model.layers", f"a list of kinds out of {list(get_args(LayerKind))}", self.layers)
        object.__setattr__(self, "layers", tuple(self.layers))
        unknown = [kind for kind in self.layers if kind not in get_args(LayerKind)]
        if unknown:
            raise InvalidInput("model.layers", f"kinds out of {list(get_args(LayerKind))}", unknown[0])
        for field in fields(self):
            value = getattr(self, field.name)
            if field.type is int and not (type(value) is int and value >= LEAST.get(field.name, 0)):
                raise InvalidInput(f"model.{field.name}", f"an integer of {LEAST.get(field.name, 0)} or more", value)
        if self.sh_degree > 3:
            raise InvalidInput("model.sh_degree", "0, 1, 2 or 3", self.sh_degree)
        if self.delta_space != "raw":
            raise InvalidInput("model.delta_space", '"raw"', self.delta_space)


class Domain(NamedTuple):
    """Where and when a model's scene takes place: what the grids of plane layers span. Stored with their weights."""

    half_extent: float = 1.0  # of a cube around the origin, scene units
    time_range: tuple[float, float] = (0.0, 1.0)


DEFAULT_DOMAIN = Domain()


class PosedGaussians(NamedTuple):
    """N Gaussians at one time, activated: what a rasterizer takes."""

    means: Tensor  # [N, 3] scene units
    quats: Tensor  # [N, 4] wxyz, unit
    scales: Tensor  # [N, 3] standard deviations, scene units
    opacities: Tensor  # [N] in (0, 1)
    sh: Tensor  # [N, (degree + 1)², 3]


class DynamicGaussians(nn.Module):
    """Gaussians that move: `pose(t)` gives them at any time."""

    def __init__(self, config: ModelConfig, gaussians: CanonicalGaussians, domain: Domain = DEFAULT_DOMAIN) -> None:
        super().__init__()
        _check_shapes(config, gaussians)
        self.config = config
        self.gaussians = gaussians
        self.deformation = MultiStepDeformation(_new_layer(kind, config, domain) for kind in config.layers)
        self.modulation = ScaleModulation(config.embedding_size) if config.embedding_size else None

    def plane_layers(self) -> list[PlaneLayer]:
        """Those of the layers that are grids."""
        return [layer for layer in self.deformation.layers if isinstance(layer, PlaneLayer)]

    def pose(
        self,
        t: float | Tensor,
        steps: int | None = None,
        deform: bool = True,
        sh_degree: int | None = None,
        ids: Tensor | None = None,
    ) -> PosedGaussians:
        """The Gaussians at time `t`.

        `steps` stops after that many layers, `deform=False` gives the canonical Gaussians without running any,
        `sh_degree` leaves out the SH bands above it, and `ids`, int64 [M], poses only these Gaussians.
        """
        g = self.gaussians if ids is None else self.gaussians.rows(ids)
        means, log_scales, quats = g.means, g.log_scales, unit_quats(g.raw_quats)
        if deform and len(self.deformation) and steps != 0:
            time = torch.as_tensor(t, dtype=means.dtype, device=means.device)
            deltas = self.deformation(means.detach() if self.config.detach_means else means, time, steps)
            means = means + deltas.means
            delta_log_scales = deltas.log_scales
            if self.modulation is not None:
                delta_log_scales = self.modulation(g.embeddings) * delta_log_scales  # equation 12
            log_scales = log_scales + delta_log_scales
            quats = unit_quats(quats + deltas.quats)
        degree = self.config.sh_degree if sh_degree is None else sh_degree
        sh = torch.cat([g.sh_dc, g.sh_rest[:, : sh_coefficients(degree) - 1]], dim=1)
        scales = log_scales.clamp(-LOG_SCALE_LIMIT, LOG_SCALE_LIMIT).exp()
        return PosedGaussians(means, quats, scales, g.raw_opacities.sigmoid(), sh)


def _new_layer(kind: LayerKind, config: ModelConfig, domain: Domain) -> MLPLayer | PlaneLayer:
    if kind == "mlp":
        return MLPLayer(
            config.width,
            config.depth,
            config.xyz_frequencies,
            config.time_frequencies,
            config.time_width,
            config.time_features,
        )
    return PlaneLayer(
        config.plane_channels,
        config.plane_space_nodes,
        config.plane_time_nodes,
        config.plane_width,
        *domain,
    )


def unit_quats(raw_quats: Tensor) -> Tensor:
    """Quaternions, [N, 4], scaled to unit length; those of norm under 1e-8 have no direction and become identity."""
    norms = torch.linalg.vector_norm(raw_quats, dim=1, keepdim=True)
    identity = raw_quats.new_tensor([1.0, 0.0, 0.0, 0.0])
    return torch.where(norms < MIN_NORM, identity, raw_quats / norms.clamp_min(MIN_NORM))


def _check_shapes(config: ModelConfig, gaussians: CanonicalGaussians) -> None:
    n = len(gaussians)
    expected: dict[str, tuple[int, ...] | None] = {
        "means": (n, 3),
        "log_scales": (n, 3),
        "raw_quats": (n, 4),
        "raw_opacities": (n,),
        "sh_dc": (n, 1, 3),
        "sh_rest": (n, sh_coefficients(config.sh_degree) - 1, 3),
        "embeddings": (n, config.embedding_size) if config.embedding_size else None,
    }
    for name, shape in expected.items():
        tensor = getattr(gaussians, name)
        got = None if tensor is None else tuple(tensor.shape)
        if got != shape:
            raise InvalidInput(f"gaussians.{name}", "absent" if shape is None else f"of shape {shape}", got)
