"""The canonical Gaussians: their parameters before deformation and activation."""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple, Self

import numpy as np
import torch
from torch import Tensor, nn

from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.spherical_harmonics import SH_C0, sh_coefficients
from msdgs_train.gaussians.attribute import Attribute

INITIAL_OPACITY = 0.1
NEIGHBORS = 3
MIN_NEIGHBOR_DISTANCE = 1e-7  # scene units; coincident points still get a scale above 0
MAX_DRAWS = 16
"""Random points per Gaussian, of which those in view are kept."""
NO_ATTRIBUTES: Mapping[str, Attribute] = {}


class GaussianRows(NamedTuple):
    """Some rows of `CanonicalGaussians`."""

    means: Tensor
    log_scales: Tensor
    raw_quats: Tensor
    raw_opacities: Tensor
    sh_dc: Tensor
    sh_rest: Tensor
    attributes: dict[str, Tensor]


class CanonicalGaussians(nn.Module):
    """N Gaussians in storage space: logarithms of scales, logits of opacities, quaternions of any length."""

    means: nn.Parameter  # [N, 3] scene units
    log_scales: nn.Parameter  # [N, 3] natural logarithm of standard deviations
    raw_quats: nn.Parameter  # [N, 4] wxyz, not unit
    raw_opacities: nn.Parameter  # [N] logits
    sh_dc: nn.Parameter  # [N, 1, 3]
    sh_rest: nn.Parameter  # [N, (degree + 1)² - 1, 3]

    def __init__(
        self,
        means: Tensor,
        log_scales: Tensor,
        raw_quats: Tensor,
        raw_opacities: Tensor,
        sh_dc: Tensor,
        sh_rest: Tensor,
        **attributes: Tensor,
    ) -> None:
        """`attributes`: those of modulation and support, [N, …] each; integers aren't trained."""
        super().__init__()
        self.means = nn.Parameter(means)
        self.log_scales = nn.Parameter(log_scales)
        self.raw_quats = nn.Parameter(raw_quats)
        self.raw_opacities = nn.Parameter(raw_opacities)
        self.sh_dc = nn.Parameter(sh_dc)
        self.sh_rest = nn.Parameter(sh_rest)
        self._names = tuple(attributes)
        for name, values in attributes.items():
            self.register_parameter(name, nn.Parameter(values, requires_grad=values.is_floating_point()))

    def __len__(self) -> int:
        return len(self.means)

    @property
    def attributes(self) -> dict[str, Tensor]:
        """Attributes of modulation and support, by name."""
        return {name: self.get_parameter(name) for name in self._names}

    def rows(self, ids: Tensor | None = None) -> GaussianRows:
        """The Gaussians `ids`, int64 [M], or all; gradients flow through."""
        tensors = dict(self.named_parameters())
        if ids is not None:
            tensors = {name: parameter[ids] for name, parameter in tensors.items()}
        attributes = {name: tensors.pop(name) for name in self._names}
        return GaussianRows(**tensors, attributes=attributes)

    @classmethod
    def from_points(
        cls,
        points: Tensor,
        colors: Tensor,
        sh_degree: int,
        generator: torch.Generator,
        attributes: Mapping[str, Attribute] = NO_ATTRIBUTES,
    ) -> Self:
        """One isotropic Gaussian per point, [N, 3], of colors in [0, 1], [N, 3], and opacity 0.1; its scale is the mean
        distance to its neighbors."""
        n = len(points)
        log_scales = neighbor_distances(points).clamp_min(MIN_NEIGHBOR_DISTANCE).log()
        return cls(
            means=points,
            log_scales=log_scales[:, None].repeat(1, 3),
            raw_quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
            raw_opacities=torch.full((n,), math.log(INITIAL_OPACITY / (1 - INITIAL_OPACITY))),
            sh_dc=((colors - 0.5) / SH_C0)[:, None],
            sh_rest=torch.zeros(n, sh_coefficients(sh_degree) - 1, 3),
            **{name: attribute.init(n, attribute.columns, generator) for name, attribute in attributes.items()},
        )

    @classmethod
    def random_in_cube(
        cls,
        count: int,
        scene_half_size: float,
        sh_degree: int,
        seed: int,
        attributes: Mapping[str, Attribute] = NO_ATTRIBUTES,
        in_view: Callable[[np.ndarray], np.ndarray] | None = None,
        gray: float | None = None,
    ) -> Self:
        """`count` Gaussians of random colors, or of one `gray` in [0, 1], uniform in the cube of this half size around
        the origin.

        With `in_view`, [N, 3] → [N] bool, only where it is true, unless it hardly ever is.
        """
        generator = torch.Generator().manual_seed(seed)
        points = 2 * torch.rand(count * (1 if in_view is None else MAX_DRAWS), 3, generator=generator) - 1
        points = points * scene_half_size
        if in_view is not None:
            points = _first_in_view(points, count, in_view)
        colors = torch.rand(count, 3, generator=generator) if gray is None else torch.full((count, 3), gray)
        return cls.from_points(points, colors, sh_degree, generator, attributes)

    @classmethod
    def from_sparse_points(
        cls,
        points: np.ndarray,
        colors: np.ndarray | None,
        max_count: int,
        sh_degree: int,
        seed: int,
        attributes: Mapping[str, Attribute] = NO_ATTRIBUTES,
    ) -> Self:
        """At most `max_count` of the points, [M, 3], that came with a dataset; of random colors without `colors`,
        [M, 3] in [0, 1]."""
        generator = torch.Generator().manual_seed(seed)
        chosen = torch.randperm(len(points), generator=generator)[:max_count]
        random = torch.rand(len(chosen), 3, generator=generator)
        known = random if colors is None else torch.from_numpy(colors).float()[chosen]
        means = torch.from_numpy(points).float()[chosen]
        return cls.from_points(means, known, sh_degree, generator, attributes)


def _first_in_view(points: Tensor, count: int, in_view: Callable[[np.ndarray], np.ndarray]) -> Tensor:
    """The first `count` that are in view, looked for in parts; the first of all if there are fewer."""
    found = points[:0]
    for part in points.split(count):
        found = torch.cat([found, part[torch.from_numpy(in_view(part.numpy()))]])
        if len(found) >= count:
            return found[:count]
    return points[:count]


def neighbor_distances(points: Tensor) -> Tensor:
    """[N] mean distance of each point, [N, 3], to its three nearest neighbors; 1 if there is no other point.

    Raises `InvalidInput` if a coordinate is not finite.
    """
    n = len(points)
    broken = int((~torch.isfinite(points)).any(dim=1).sum())
    if broken:
        raise InvalidInput("points", "finite", f"{broken} of {n} with NaN or infinity")
    if n < 2:
        return torch.ones(n)
    from scipy.spatial import KDTree  # not needed to load a model, so not in the export extra

    positions = points.detach().cpu().numpy()
    distances, _ = KDTree(positions).query(positions, k=min(NEIGHBORS, n - 1) + 1)
    return torch.from_numpy(distances[:, 1:].mean(axis=1)).to(points)  # the first is the point itself
