"""The whole model: canonical Gaussians, a support, its chain of layers, and the modulation of their deltas."""

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from msdgs_serve.rasterizer import GSPLAT, RasterizerOptions
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.spherical_harmonics import SH_C0, sh_coefficients
from msdgs_train.gaussians.canonical import CanonicalGaussians, GaussianRows
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.gaussians.modulation import EMBEDDINGS, Modulation
from msdgs_train.gaussians.raw_quaternions import unit_form
from msdgs_train.gaussians.scale_space import activated_scales, add_to_scales
from msdgs_train.layers.base import SceneBounds
from msdgs_train.layers.chain import MultiStepDeformation
from msdgs_train.layers.parameters import ParamGroup
from msdgs_train.layers.quaternions import unit_or_identity
from msdgs_train.supports.base import CanonicalPoints


class PosedGaussians(NamedTuple):
    """N activated Gaussians at one time, as a rasterizer takes them."""

    means: Tensor  # [N, 3] scene units
    quats: Tensor  # [N, 4] wxyz, unit; in training with `quat_space` raw of any length, as `rasterize` draws it
    scales: Tensor  # [N, 3] standard deviations, scene units
    opacities: Tensor  # [N] in (0, 1)
    sh: Tensor  # [N, (degree + 1)², 3]


class DynamicGaussians(nn.Module):
    """Gaussians with a deformation; `pose(t)` gives them at any time."""

    def __init__(self, config: ModelConfig, gaussians: CanonicalGaussians, bounds: SceneBounds = SceneBounds()) -> None:
        super().__init__()
        _check_shapes(config, gaussians)
        self.config = config
        self.gaussians = gaussians
        self.support = config.support.build()
        points = self.support.num_points
        self.deformation = MultiStepDeformation(layer.build(bounds, config.heads, points) for layer in config.layers)
        size = config.embedding_dim
        self.modulation = Modulation(size, targets=config.modulation_targets) if size else None

    @property
    def rasterizer(self) -> RasterizerOptions:
        """Constants of the rasterizer for this model."""
        c = self.config
        return GSPLAT._replace(eps2d=c.eps2d, near_plane=c.near_plane, alpha_max=c.alpha_max)

    def pose(
        self,
        t: float | Tensor,
        num_layers: int | None = None,
        deform: bool = True,
        sh_degree: int | None = None,
        ids: Tensor | None = None,
        motions: Any = None,
        points: CanonicalPoints | None = None,
    ) -> PosedGaussians:
        """The Gaussians at time `t`.

        `num_layers` stops after that many layers, `deform=False` gives the canonical Gaussians without running any,
        `sh_degree` omits the SH bands above it, `ids`, int64 [M], poses only these Gaussians; `motions` of the support
        at `t` and `points`, what it reads of the Gaussians, are given if they are known.
        """
        g = self.gaussians.rows(ids)
        rest = sh_coefficients(self.config.sh_degree if sh_degree is None else sh_degree) - 1
        sh_dc, sh_rest = g.sh_dc, g.sh_rest if rest == g.sh_rest.shape[1] else g.sh_rest[:, :rest]
        points, raw_opacities = points or canonical_points(g), g.raw_opacities
        means, quats = points.means, points.quats
        if not (deform and len(self.deformation) and num_layers != 0):
            sh = torch.cat([sh_dc, sh_rest], dim=1)
            return PosedGaussians(means, quats, activated_scales(g.log_scales), raw_opacities.sigmoid(), sh)
        if motions is None:
            time = torch.as_tensor(t, dtype=means.dtype, device=means.device)
            motions = self.support.motions(self.deformation, means, time, num_layers)
        deltas = self.support.follow(points, motions)
        if self.modulation is not None:  # equation 12, applied to the sums over all layers
            factors = self.modulation(g.attributes[EMBEDDINGS])
            deltas = deltas._replace(**{name: f * getattr(deltas, name) for name, f in factors.items()})
        if deltas.opacities is not None:
            raw_opacities = raw_opacities + deltas.opacities
        if deltas.gains is not None:
            sh_dc, sh_rest = shaded(sh_dc, sh_rest, deltas.gains[:, None])
        sh = torch.cat([sh_dc, sh_rest], dim=1)
        if deltas.sh is not None:
            sh = sh + deltas.sh[:, : sh.shape[1]]
        quats = quats + deltas.quats
        scales = add_to_scales(self.config.scale_space, g.log_scales, deltas.scales)
        if self.config.quat_space == "unit":
            quats = unit_or_identity(quats)
        elif not torch.is_grad_enabled():
            quats, scales = unit_form(quats, scales)
        return PosedGaussians(means + deltas.means, quats, scales, raw_opacities.sigmoid(), sh)

    def motion_groups(self) -> list[ParamGroup]:
        """The parameter groups of layers, support and modulation, and of attributes of modulation and support."""
        groups = [
            group._replace(name=f"layers.{index}.{group.name}")
            for index, layer in enumerate(self.deformation)
            for group in layer.parameter_groups()
            if group.params
        ]
        groups += [group._replace(name=f"support.{group.name}") for group in self.support.parameter_groups()]
        if self.modulation is not None:
            params = list(self.modulation.parameters())
            groups.append(ParamGroup("modulation", params, self.config.modulation_lr))
        for name, attribute in self.config.attributes().items():
            parameter = self.gaussians.get_parameter(name)
            if parameter.requires_grad:
                groups.append(ParamGroup(name, [parameter], attribute.lr))
        return groups


def canonical_points(rows: GaussianRows) -> CanonicalPoints:
    """What a support reads of these Gaussians."""
    return CanonicalPoints(rows.means, unit_or_identity(rows.raw_quats), rows.attributes, rows.raw_quats)


def shaded(sh_dc: Tensor, sh_rest: Tensor, gains: Tensor) -> tuple[Tensor, Tensor]:
    """SH of colors that are multiplied by 1 + gains, [N, 1, 3]: a color is 0.5 plus the sum of its bands."""
    return torch.addcmul(sh_dc, gains, sh_dc + 0.5 / SH_C0), torch.addcmul(sh_rest, gains, sh_rest)


def _check_shapes(config: ModelConfig, gaussians: CanonicalGaussians) -> None:
    n = len(gaussians)
    expected = {
        "means": (n, 3),
        "log_scales": (n, 3),
        "raw_quats": (n, 4),
        "raw_opacities": (n,),
        "sh_dc": (n, 1, 3),
        "sh_rest": (n, sh_coefficients(config.sh_degree) - 1, 3),
    }
    expected |= {name: (n, attribute.columns) for name, attribute in config.attributes().items()}
    found = {name: tuple(parameter.shape) for name, parameter in gaussians.named_parameters()}
    for name in expected | found:
        if expected.get(name) != found.get(name):
            shape = expected.get(name)
            wanted = "absent" if shape is None else f"of shape {shape}"
            raise InvalidInput(f"gaussians.{name}", wanted, found.get(name))
