"""TiNeuVox (Fang et al. 2022): one grid of features, looked up where a network says that points are at a time.

Each point is deformed by an MLP of its position and of a feature of time; features of the grid there, at strides of 1,
2 and 4 vertices, become density and color by small networks.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.datasets import SceneData
from msdgs_train.datasets.rays import Rays, rays_of
from msdgs_train.layers.parameters import ParamGroup, constant
from msdgs_train.volumes.config import VolumeConfig
from msdgs_train.volumes.field import Change, RayField, encoded
from msdgs_train.volumes.samples import Marched, Samples
from msdgs_train.volumes.space import Box

POSITION, VIEW, TIME, FEATURE = 10, 4, 8, 2  # frequencies
STRIDES = (1, 2, 4)  # of the grid, in vertices
STEP = 0.5  # between samples, in voxels
BOX_SCALE = 1.05
DECAY = 0.1  # of all rates, over the run
GROWS_AT = (0.1, 0.2, 0.3)  # doubled; rates start again
LEAST = 1e-6  # of what is left of the background, in its entropy


@dataclass(frozen=True)
class TiNeuVoxConfig(VolumeConfig):
    """Sizes and rates of TiNeuVox; those of its small model."""

    channels: int = 4
    """Features of a vertex."""
    width: int = 64
    """Hidden units of all networks."""
    first_alpha: float = 1e-2
    """Opacity of a sample before the first step."""
    grid_lr: float = 8e-2
    """Learning rate of the grid; decays to a tenth over the run, as the others, and starts again where it grows."""
    deformation_lr: float = 6e-4
    """Learning rate of the deformation."""
    network_lr: float = 8e-4
    """Learning rate of the other networks."""
    entropy_weight: float = 1e-3
    """Weight of the entropy of what is left of the background, so that rays hit something or nothing."""
    color_weight: float = 1e-2
    """Weight of the squared error of each sample's own color."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_counts("channels")
        self.require_counts("width", least=2)
        self.require_positive("grid_lr", "deformation_lr", "network_lr")
        self.require_weights("entropy_weight", "color_weight")
        self.require(("first_alpha",), "in (0, 1)", lambda v: 0 < v < 1)

    def box_of(self, scene: SceneData) -> Box:
        """Around all training rays from near to far, and a twentieth larger."""
        ends, (near, far) = [], self.depths
        for frame in scene.splits["train"]:
            rays = rays_of(frame.camera, frame.t)
            views = functional.normalize(rays.directions, dim=1)
            points = torch.cat([rays.origins + near * views, rays.origins + far * views])
            ends.append(torch.stack(points.aminmax(dim=0)))
        low, high = torch.stack(ends)[:, 0].amin(dim=0), torch.stack(ends)[:, 1].amax(dim=0)
        margin = (BOX_SCALE - 1) / 2 * (high - low)
        return Box(low - margin, high + margin)

    def build(self, box: Box) -> "TiNeuVox":
        return TiNeuVox(self, box)


class TiNeuVox(RayField):
    """A grid of features, [1, C, X, Y, Z], and networks of deformation, density and color."""

    least_depth: ClassVar[float] = -math.log1p(-1e-4)  # an opacity of 1e-4
    least_weight: ClassVar[float] = 1e-4
    stop: ClassVar[float] = 1e-3
    grids: ClassVar[tuple[str, ...]] = ("grid",)
    voxel_size: Tensor  # [] scene units

    def __init__(self, config: TiNeuVoxConfig, box: Box) -> None:
        super().__init__(box)
        self.config = config
        width, features, position = config.width, config.channels * _encoded(FEATURE), 3 * _encoded(POSITION)
        self.register_buffer("voxel_size", torch.zeros(()))
        self.grid = nn.Parameter(torch.zeros(1, config.channels, *self._set_size(0)))
        self.time_net = nn.Sequential(nn.Linear(_encoded(TIME), width), nn.ReLU(), nn.Linear(width, features))
        self.deformation = nn.Sequential(
            nn.Linear(position + features, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, 3)
        )
        self.feature_net = nn.Linear(len(STRIDES) * features + position + features, width)
        self.density_net = nn.Linear(width, 1)
        self.color_net = nn.Linear(width, width)
        views = width + 3 * _encoded(VIEW)
        self.view_net = nn.Sequential(nn.Linear(views, width // 2), nn.ReLU(), nn.Linear(width // 2, 3))

    @property
    def size(self) -> int:
        return self.grid[0, 0].numel()

    def _edge(self, voxels: int) -> Tensor:
        """Side of a voxel if the box has so many."""
        return ((self.corners[1] - self.corners[0]).prod() / voxels) ** (1 / 3)

    def _set_size(self, stage: int) -> list[int]:
        """Sets the size of voxels after it was doubled `stage` times; returns the shape of the grid."""
        self.voxel_size = self._edge(int(self.config.voxels / 2 ** (len(GROWS_AT) - stage)))
        return ((self.corners[1] - self.corners[0]) / self.voxel_size).long().tolist()

    def check(self) -> None:
        if not self.voxel_size >= self._edge(self.config.voxels) / 2:
            raise InvalidInput("voxel_size", "that of a stage", float(self.voxel_size))

    def samples(self, rays: Rays, generator: torch.Generator | None) -> Samples:
        edge, (near, far) = STEP * self.voxel_size, self.config.depths
        enters, leaves = (along.clamp(near, far) for along in self.box.spans(rays.origins, rays.directions))
        counts = ((leaves - enters) / edge).ceil().clamp(min=1)
        steps = torch.arange(int(counts.max()), device=counts.device)
        starts = rays.origins + rays.directions * enters[:, None]
        directions = functional.normalize(rays.directions, dim=1)
        points = starts[:, None] + directions[:, None] * (edge * steps)[:, None]
        inside = (steps < counts[:, None]) & self.box.contains(points)
        interval = STEP * self.voxel_size / self._edge(self.config.voxels)
        return Samples.of(points, interval.expand(len(steps)), inside)

    def optical_depths(self, samples: Samples, rays: Rays) -> tuple[Tensor, Tensor]:
        times = self.time_net(encoded(rays.times[:, None], TIME))[samples.rays]
        position = encoded(samples.points, POSITION)
        deformed = samples.points + self.deformation(torch.cat([position, times], dim=1))
        inputs = [encoded(self._features(deformed), FEATURE), position, times]
        features = functional.relu(self.feature_net(torch.cat(inputs, dim=1)))
        shift = math.log(1 / (1 - self.config.first_alpha) - 1)
        depths = functional.softplus(self.density_net(features)[:, 0] + shift) * samples.lengths
        return depths, features

    def _features(self, points: Tensor) -> Tensor:
        """Features of the grid at points, [M, 3], at all strides: [M, 3 C]. At its ends it is filled with zeros, to
        whole multiples of the largest stride, and the box is stretched over the whole."""
        padding = [part for n in reversed(self.grid.shape[2:]) for part in (0, -(n - 1) % STRIDES[-1])]
        grid = functional.pad(self.grid, padding)
        places = self.box.normalized(points).flip(1)[None, None, None]
        found = [
            functional.grid_sample(grid[:, :, ::stride, ::stride, ::stride], places, align_corners=True)[0, :, 0, 0]
            for stride in STRIDES
        ]
        return torch.cat(found).T

    def colors(self, samples: Samples, rays: Rays, features: Tensor) -> Tensor:
        views = encoded(functional.normalize(rays.directions, dim=1), VIEW)[samples.rays]
        return torch.sigmoid(self.view_net(torch.cat([self.color_net(features), views], dim=1)))

    def regularizers(self, marched: Marched, target: Tensor, progress: float) -> Tensor:
        left = marched.left.clamp(LEAST, 1 - LEAST)
        entropy = -(left * left.log() + (1 - left) * (1 - left).log()).mean()
        errors = (marched.colors - target[marched.rays]).square().sum(dim=1)
        colors = (errors * marched.weights.detach()).sum() / len(target)
        return self.config.entropy_weight * entropy + self.config.color_weight * colors

    def parameter_groups(self, progress: float) -> list[ParamGroup]:
        factor = DECAY ** (progress - max([0.0, *(at for at in GROWS_AT if at <= progress)]))
        others = [self.time_net, self.feature_net, self.density_net, self.color_net, self.view_net]
        networks = [parameter for module in others for parameter in module.parameters()]
        rates = self.config.grid_lr, self.config.deformation_lr, self.config.network_lr
        grid, deformation, network = (constant(factor * rate) for rate in rates)
        return [
            ParamGroup("grid", [self.grid], grid, skips_zero=True),
            ParamGroup("deformation", list(self.deformation.parameters()), deformation),
            ParamGroup("networks", networks, network),
        ]

    def changes(self) -> list[Change]:
        return [(at, partial(self.grow, stage)) for stage, at in enumerate(GROWS_AT, start=1)]

    @torch.no_grad()
    def grow(self, stage: int) -> None:
        """Interpolate the grid to the size after it was doubled `stage` times."""
        shape = self._set_size(stage)
        self.grid = nn.Parameter(functional.interpolate(self.grid, shape, mode="trilinear", align_corners=True))


def _encoded(frequencies: int) -> int:
    """Columns of an encoded value."""
    return 1 + 2 * frequencies
