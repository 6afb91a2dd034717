"""The whole model: canonical Gaussians, their deformation in time, and its modulation."""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from msdgs_serve.rasterizer import GSPLAT, RasterizerOptions
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.quaternion import MIN_NORM
from msdgs_serve.scene.spherical_harmonics import sh_coefficients
from msdgs_train.gaussians.canonical import CanonicalGaussians, StoredGaussians
from msdgs_train.gaussians.config import LayerKind, ModelConfig
from msdgs_train.gaussians.modulation import Factors, Modulation
from msdgs_train.layers.chain import Deltas, MultiStepDeformation
from msdgs_train.layers.mlp import MLPLayer
from msdgs_train.layers.plane import PlaneGrid, PlaneLayer
from msdgs_train.supports.nodes import BasisLayer, SkinningInputs

LOG_SCALE_LIMIT = 20.0
"""Scales stay within e^-20 and e^20: where a layer flings a Gaussian away its scale may vanish or overflow, and 0 · inf
is NaN."""

MIN_SCALE = math.exp(-LOG_SCALE_LIMIT)
"""Where deltas are added to scales themselves, a scale may come out negative; it becomes this, far below a pixel."""


class SceneBounds(NamedTuple):
    """Where and when a model's scene takes place: what the grids of plane layers span. Stored with their weights."""

    scene_half_size: float = 1.0  # of a cube around the origin, scene units
    time_range: tuple[float, float] = (0.0, 1.0)


DEFAULT_BOUNDS = SceneBounds()


class PosedGaussians(NamedTuple):
    """N Gaussians at one time, activated: what a rasterizer takes."""

    means: Tensor  # [N, 3] scene units
    quats: Tensor  # [N, 4] wxyz, unit
    scales: Tensor  # [N, 3] standard deviations, scene units
    opacities: Tensor  # [N] in (0, 1)
    sh: Tensor  # [N, (degree + 1)², 3]


class DynamicGaussians(nn.Module):
    """Gaussians that move: `pose(t)` gives them at any time."""

    def __init__(
        self, config: ModelConfig, gaussians: CanonicalGaussians, bounds: SceneBounds = DEFAULT_BOUNDS
    ) -> None:
        super().__init__()
        _check_shapes(config, gaussians)
        self.config = config
        self.gaussians = gaussians
        self.deformation = MultiStepDeformation(_new_layer(kind, config, bounds) for kind in config.layers)
        size = config.embedding_dim
        self.modulation = Modulation(size, targets=config.modulation_targets) if size else None

    def plane_grids(self) -> list[PlaneGrid]:
        """Those of all plane layers."""
        layers = [layer for layer in self.deformation.layers if isinstance(layer, PlaneLayer)]
        return [grid for layer in layers for grid in layer.plane_grids()]

    @property
    def rasterizer(self) -> RasterizerOptions:
        """The constants that it is drawn with."""
        return GSPLAT._replace(eps2d=self.config.eps2d)

    @property
    def bases(self) -> BasisLayer | None:
        """The layer of motion bases, if there is one."""
        return next((layer for layer in self.deformation.layers if isinstance(layer, BasisLayer)), None)

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
        degree = self.config.sh_degree if sh_degree is None else sh_degree
        sh = torch.cat([g.sh_dc, g.sh_rest[:, : sh_coefficients(degree) - 1]], dim=1)
        means, quats, raw_opacities = g.means, unit_quats(g.raw_quats), g.raw_opacities
        if not (deform and len(self.deformation) and steps != 0):
            return PosedGaussians(means, quats, activated_scales(g.log_scales), raw_opacities.sigmoid(), sh)
        time = torch.as_tensor(t, dtype=means.dtype, device=means.device)
        places = means.detach() if self.config.detach_deform_input else means
        deltas = self.deformation(places, time, steps, carried(g))
        deltas = self._modulated(deltas, g.embeddings)
        if deltas.opacities is not None:
            raw_opacities = raw_opacities + deltas.opacities
        if deltas.sh is not None:
            sh = sh + deltas.sh[:, : sh.shape[1]]
        return PosedGaussians(
            means + deltas.means,
            unit_quats(quats + deltas.quats),
            self._deformed_scales(g.log_scales, deltas.scales),
            raw_opacities.sigmoid(),
            sh,
        )

    def _modulated(self, deltas: Deltas, embeddings: Tensor | None) -> Deltas:
        """Equation 12, of the sums over all layers."""
        if self.modulation is None:
            return deltas
        factors: Factors = self.modulation(embeddings)
        return deltas._replace(**{name: f * getattr(deltas, name) for name, f in factors.present().items()})

    def _deformed_scales(self, log_scales: Tensor, deltas: Tensor) -> Tensor:
        if self.config.delta_space == "raw":
            return activated_scales(log_scales + deltas)
        return (activated_scales(log_scales) + deltas).clamp_min(MIN_SCALE)


def carried(gaussians: CanonicalGaussians | StoredGaussians) -> SkinningInputs | None:
    """Gaussians as a layer of kind `bases` wants them, None where there is none."""
    g, logits, ids = gaussians, gaussians.skinning_logits, gaussians.node_ids
    if logits is None or ids is None:
        return None
    weights = logits.T.contiguous().softmax(dim=0).T  # of 18,000 rows of 8: a seventh of the time that `dim=1` takes
    return SkinningInputs(g.means, unit_quats(g.raw_quats), weights, ids)


def activated_scales(log_scales: Tensor) -> Tensor:
    """Standard deviations of their logarithms, within e^±20."""
    return log_scales.clamp(-LOG_SCALE_LIMIT, LOG_SCALE_LIMIT).exp()


def _new_layer(kind: LayerKind, config: ModelConfig, bounds: SceneBounds) -> MLPLayer | PlaneLayer | BasisLayer:
    if kind == "bases":
        return BasisLayer(config.num_nodes, config.num_knots, bounds.time_range, config.affine)
    if kind == "mlp":
        return MLPLayer(
            config.width,
            config.depth,
            config.xyz_frequencies,
            config.time_frequencies,
            config.time_width,
            config.time_features,
            config.skip,
            config.heads,
        )
    return PlaneLayer(
        config.plane_features_dim,
        config.plane_resolution,
        config.plane_time_resolution,
        config.plane_width,
        *bounds,
        config.multires,
        config.heads,
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
        "embeddings": (n, config.embedding_dim) if config.embedding_dim else None,
        "skinning_logits": (n, config.motions) if config.motions else None,
        "node_ids": (n, config.motions) if config.motions else None,
    }
    for name, shape in expected.items():
        tensor = getattr(gaussians, name)
        got = None if tensor is None else tuple(tensor.shape)
        if got != shape:
            raise InvalidInput(f"gaussians.{name}", "absent" if shape is None else f"of shape {shape}", got)
