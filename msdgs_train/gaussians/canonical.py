"""The canonical Gaussians: what training stores for each Gaussian, before any deformation or activation."""

import math
from typing import NamedTuple, Self

import numpy as np
import torch
from torch import Tensor, nn

from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.spherical_harmonics import SH_C0, sh_coefficients

INITIAL_OPACITY = 0.1
MIN_NEIGHBOUR_DISTANCE = 1e-7  # scene units; two points in one place still get a scale above 0


class StoredGaussians(NamedTuple):
    """The tensors of `CanonicalGaussians`, or some rows of them."""

    means: Tensor
    log_scales: Tensor
    raw_quats: Tensor
    raw_opacities: Tensor
    sh_dc: Tensor
    sh_rest: Tensor
    embeddings: Tensor | None
    skinning_logits: Tensor | None
    node_ids: Tensor | None


class CanonicalGaussians(nn.Module):
    """N Gaussians in storage space: logarithms of scales, logits of opacities, quaternions of any length."""

    means: nn.Parameter  # [N, 3] scene units
    log_scales: nn.Parameter  # [N, 3] natural logarithm of standard deviations
    raw_quats: nn.Parameter  # [N, 4] wxyz, not unit
    raw_opacities: nn.Parameter  # [N] logits
    sh_dc: nn.Parameter  # [N, 1, 3]
    sh_rest: nn.Parameter  # [N, (degree + 1)² - 1, 3]
    embeddings: nn.Parameter | None  # [N, embedding_dim]; None without scale modulation
    skinning_logits: nn.Parameter | None  # [N, F] of the weights of motions; None without such a layer
    node_ids: nn.Parameter | None  # [N, F] int64, which motions these are; not trained

    def __init__(
        self,
        means: Tensor,
        log_scales: Tensor,
        raw_quats: Tensor,
        raw_opacities: Tensor,
        sh_dc: Tensor,
        sh_rest: Tensor,
        embeddings: Tensor | None = None,
        skinning_logits: Tensor | None = None,
        node_ids: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.means = nn.Parameter(means)
        self.log_scales = nn.Parameter(log_scales)
        self.raw_quats = nn.Parameter(raw_quats)
        self.raw_opacities = nn.Parameter(raw_opacities)
        self.sh_dc = nn.Parameter(sh_dc)
        self.sh_rest = nn.Parameter(sh_rest)
        self.embeddings = None if embeddings is None else nn.Parameter(embeddings)
        self.skinning_logits = None if skinning_logits is None else nn.Parameter(skinning_logits)
        self.node_ids = None if node_ids is None else nn.Parameter(node_ids, requires_grad=False)

    def __len__(self) -> int:
        return len(self.means)

    def rows(self, ids: Tensor) -> StoredGaussians:
        """The Gaussians `ids`, int64 [M]; gradients flow through."""
        tensors = {name: parameter[ids] for name, parameter in self.named_parameters()}
        return StoredGaussians(**{"embeddings": None, "skinning_logits": None, "node_ids": None, **tensors})

    @classmethod
    def from_points(
        cls,
        points: Tensor,
        colors: Tensor,
        sh_degree: int,
        embedding_dim: int,
        generator: torch.Generator,
        motions: int = 0,
    ) -> Self:
        """One Gaussian a point, [N, 3], of colors in [0, 1], [N, 3]: round, opacity 0.1, as large as its neighbours
        are near. `embedding_dim` 0 means no modulation, `motions`, that each follows, 0 no shared ones."""
        n = len(points)
        log_scales = neighbour_distances(points).clamp_min(MIN_NEIGHBOUR_DISTANCE).log()
        embeddings = 0.1 * torch.randn(n, embedding_dim, generator=generator) if embedding_dim else None
        return cls(
            means=points,
            log_scales=log_scales[:, None].repeat(1, 3),
            raw_quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
            raw_opacities=torch.full((n,), math.log(INITIAL_OPACITY / (1 - INITIAL_OPACITY))),
            sh_dc=((colors - 0.5) / SH_C0)[:, None],
            sh_rest=torch.zeros(n, sh_coefficients(sh_degree) - 1, 3),
            embeddings=embeddings,
            skinning_logits=torch.zeros(n, motions) if motions else None,
            node_ids=torch.arange(motions).repeat(n, 1) if motions else None,
        )

    @classmethod
    def random_in_cube(
        cls, count: int, scene_half_size: float, sh_degree: int, embedding_dim: int, seed: int, motions: int = 0
    ) -> Self:
        """`count` Gaussians of random colors, uniform in the cube [-scene_half_size, scene_half_size]³."""
        generator = torch.Generator().manual_seed(seed)
        points = (2 * torch.rand(count, 3, generator=generator) - 1) * scene_half_size
        colors = torch.rand(count, 3, generator=generator)
        return cls.from_points(points, colors, sh_degree, embedding_dim, generator, motions)

    @classmethod
    def from_sparse_points(
        cls,
        points: np.ndarray,
        colors: np.ndarray | None,
        max_count: int,
        sh_degree: int,
        embedding_dim: int,
        seed: int,
        motions: int = 0,
    ) -> Self:
        """At most `max_count` of the points, [M, 3], that came with a dataset; of random colors where there are none,
        [M, 3] in [0, 1]."""
        generator = torch.Generator().manual_seed(seed)
        chosen = torch.randperm(len(points), generator=generator)[:max_count]
        random = torch.rand(len(chosen), 3, generator=generator)
        known = random if colors is None else torch.from_numpy(colors).float()[chosen]
        means = torch.from_numpy(points).float()[chosen]
        return cls.from_points(means, known, sh_degree, embedding_dim, generator, motions)


def neighbour_distances(points: Tensor, neighbours: int = 3) -> Tensor:
    """[N] mean distance of each point, [N, 3], to its nearest `neighbours`; 1 where there is no other point.

    Raises `InvalidInput` if a coordinate is not finite.
    """
    n = len(points)
    broken = int((~torch.isfinite(points)).any(dim=1).sum())
    if broken:
        raise InvalidInput("points", "finite", f"{broken} of {n} with NaN or infinity")
    if n < 2:
        return torch.ones(n)
    from scipy.spatial import KDTree  # not wanted to load a model, so not in the export extra

    positions = points.detach().cpu().numpy()
    distances, _ = KDTree(positions).query(positions, k=min(neighbours, n - 1) + 1)
    return torch.from_numpy(distances[:, 1:].mean(axis=1)).to(points)  # the first is the point itself
