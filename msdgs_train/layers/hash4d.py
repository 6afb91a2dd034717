"""One step of deformation read from hash grids over space and over two axes of space and time (Grid4D, Xu et al. 2024).

Features over x y t, y z t and x z t say how points move; features over x y z of the canonical scene say how much each
hidden unit counts at a point.
"""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.layers.arrays import to_device
from msdgs_train.layers.base import (
    PAPER_HEADS,
    DeformationLayer,
    Heads,
    LayerConfig,
    LayerStep,
    SceneBounds,
    check_size,
)
from msdgs_train.layers.hash_grid import HashGrid
from msdgs_train.layers.hash_kernels import Levels
from msdgs_train.layers.parameters import LearningRate, ParamGroup

AXES = (0, 1), (1, 2), (0, 2)
"""Axes of space of the three grids over time."""

TIME_MARGIN = 0.05
"""Of the side of the cube, before the first time and after the last."""

MOST = {"levels": 64, "canonical_levels": 64, "log2_rows": 24, "canonical_log2_rows": 24}
MOST |= {"channels": 16, "width": 4_096, "depth": 64}
"""Largest sizes, twice those of Grid4D or more; a damaged file can't ask for endless memory."""
MAX_NODES = 1 << 16
NODES = ("coarsest", "finest", "canonical_coarsest", "canonical_finest")
"""Settings of three numbers of nodes, those of a coarsest level before those of its finest."""

TURN = 4
"""Outputs before those of `Heads.sizes`: the quaternion by which points turn about the origin, minus the identity."""

MIN_SQUARED_NORM = 1e-12
"""Of that quaternion; shorter ones turn less."""


@dataclass(frozen=True)
class Hash4DConfig(LayerConfig):
    """Sizes, learning rates and regularizers of a hash layer; the defaults are Grid4D's for D-NeRF."""

    kind: ClassVar[str] = "hash4d"
    levels: int = 32
    """Resolutions of each of the three grids over time."""
    coarsest: tuple[int, ...] = (8, 8, 8)
    """Nodes of their coarsest level along both axes of space and along time."""
    finest: tuple[int, ...] = (32, 32, 16)
    """Nodes of their finest level."""
    log2_rows: int = 19
    """A level with more than 2 to the power of this nodes is hashed into so many rows."""
    canonical_levels: int = 16
    """Resolutions of the grid over space."""
    canonical_coarsest: tuple[int, ...] = (16, 16, 16)
    """Nodes of its coarsest level along each axis."""
    canonical_finest: tuple[int, ...] = (2048, 2048, 2048)
    """Nodes of its finest level."""
    canonical_log2_rows: int = 19
    """As `log2_rows`, of the grid over space."""
    channels: int = 2
    """Features of each level."""
    width: int = 256
    """Hidden units."""
    depth: int = 0
    """Hidden layers behind the product of both kinds of features."""
    initialization: str = "zero"
    """`zero`: zero deltas; `torch`: its default for the last Linear too, as in Grid4D."""
    reach: float = 1.6 / 1.3
    """Half the side of the grids' cube, as a multiple of the scene's half size. Points outside read zeros."""
    lr_init: float = 8e-4
    """Learning rate of the network until all times take part."""
    lr_final: float = 1.6e-6
    """Learning rate of the network at the last step, to which it decays exponentially."""
    grid_lr_init: float = 8e-3
    """Learning rate of the grids until all times take part."""
    grid_lr_final: float = 8e-5
    """Learning rate of the grids at the last step."""
    lr_until: float = 0.9
    """Fraction of the run after which both rates have reached their last values."""
    spatial_weight: float = 0.5
    """Weight of the squared change of a point's features over space, if it is displaced at random."""
    temporal_weight: float = 0.5
    """Weight of the squared change of its features over time, if it is displaced at random in space and time."""
    spatial_noise: float = 1e-2 / 3.2
    """Largest displacement along each axis for the first of these, in sides of the grids' cube."""
    temporal_noise: float = 1e-2 / 3.2
    """Largest displacement along each axis of space for the second."""
    time_noise: float = 1e-3 / 3.2
    """Largest displacement along time, of which the side of the cube holds 1.11 times the scene's."""
    displaced: float = 0.1
    """Fraction of the points that are displaced in a step."""

    def __post_init__(self) -> None:
        for name in NODES:
            object.__setattr__(self, name, tuple(getattr(self, name)))

    def build(self, bounds: SceneBounds, heads: Heads, num_points: int | None) -> "Hash4DLayer":
        return Hash4DLayer(self, bounds, heads)

    def check(self, field: str, moves_nodes: bool) -> None:
        for name, most in MOST.items():
            check_size(f"{field}.{name}", getattr(self, name), least=0 if name == "depth" else 1)
            if getattr(self, name) > most:
                raise InvalidInput(f"{field}.{name}", f"at most {most:,}", getattr(self, name))
        for name, least in zip(NODES, (2, self.coarsest, 2, self.canonical_coarsest), strict=True):
            nodes, leasts = getattr(self, name), least if isinstance(least, tuple) else (least,) * 3
            are_whole = len(nodes) == 3 and all(type(count) is int for count in nodes)
            if not (are_whole and all(a <= count <= MAX_NODES for a, count in zip(leasts, nodes, strict=True))):
                expected = f"three whole numbers from {', '.join(map(str, leasts))} to {MAX_NODES:,}"
                raise InvalidInput(f"{field}.{name}", expected, nodes)
        if self.initialization not in ("zero", "torch"):
            raise InvalidInput(f"{field}.initialization", "zero or torch", self.initialization)
        for name in ("spatial_noise", "temporal_noise", "time_noise", "displaced", "reach"):
            value, least = getattr(self, name), 0 if name.endswith("noise") else math.ulp(0)
            if not (type(value) in (int, float) and least <= value < math.inf):
                expected = "finite and 0 or above" if not least else "finite and above 0"
                raise InvalidInput(f"{field}.{name}", expected, value)


class Hash4DLayer(DeformationLayer):
    """Features h of three grids over time, times a factor a of canonical features, give turns, shifts and deltas.

    h = relu(L₁ features), a = 2 σ(L₂ canonical features) − 1. Points turn about the origin and are then shifted. At the
    default sizes and without a weight it is the network of Grid4D, 13,224,948 parameters.
    """

    kind = "hash4d"
    half_sizes: Tensor
    first_time: Tensor
    duration: Tensor

    def __init__(
        self, config: Hash4DConfig = Hash4DConfig(), bounds: SceneBounds = SceneBounds(), outputs: Heads = PAPER_HEADS
    ) -> None:
        super().__init__()
        c, self.config, self.outputs = config, config, outputs
        levels = Levels.between(c.canonical_levels, c.canonical_coarsest, c.canonical_finest, 2**c.canonical_log2_rows)
        self.canonical = HashGrid(levels, c.channels)
        levels = Levels.between(c.levels, c.coarsest, c.finest, 2**c.log2_rows)
        self.temporal = nn.ModuleList(HashGrid(levels, c.channels) for _ in AXES)
        self.from_canonical = nn.Linear(c.canonical_levels * c.channels, c.width)
        self.from_temporal = nn.Linear(len(AXES) * c.levels * c.channels, c.width)
        self.hidden = nn.ModuleList(nn.Linear(c.width, c.width) for _ in range(c.depth))
        self.heads = nn.Linear(c.width, TURN + sum(outputs.sizes))
        if c.initialization == "zero":
            with torch.no_grad():  # the step weight keeps random parameters
                deltas = len(self.heads.bias) - outputs.weight
                self.heads.weight[:deltas] = 0
                self.heads.bias[:] = 0
        half, (first, last) = c.reach * bounds.scene_half_size, bounds.time_range
        self.register_buffer("half_sizes", torch.full((3,), half))  # of the grids' cube by axis, scene units
        self.register_buffer("first_time", torch.tensor(first))
        self.register_buffer("duration", torch.tensor((last - first) or 1.0))

    def forward(self, means: Tensor, t: Tensor) -> LayerStep:
        places = self.places(means, t)
        factors = 2 * self.from_canonical(self.canonical(places[:, :3])).sigmoid() - 1
        hidden = self.from_temporal(self.temporal_features(places)).relu() * factors
        for linear in self.hidden:
            hidden = linear(hidden).relu()
        turns, columns = self.heads(hidden).split([TURN, sum(self.outputs.sizes)], dim=1)
        step = LayerStep.of_columns(columns, self.outputs)
        return step._replace(delta_means=step.delta_means + displacements(turns, means))

    def places(self, means: Tensor, t: Tensor) -> Tensor:
        """[N, 4] positions of means, [N, 3], and of a time in the grids' cube, where they are in [0, 1]."""
        space = (means + self.half_sizes) / (2 * self.half_sizes)
        time = TIME_MARGIN + (1 - 2 * TIME_MARGIN) * (t - self.first_time) / self.duration
        return torch.cat([space, time.expand(len(means), 1)], dim=1)

    def temporal_features(self, places: Tensor) -> Tensor:
        """[N, 3 · L · C] features of the grids over x y t, y z t and x z t at places, [N, 4]."""
        pairs = zip(self.temporal, AXES, strict=True)
        columns = places.unbind(dim=1)
        read = [grid(torch.stack([columns[a], columns[b], columns[3]], dim=1)) for grid, (a, b) in pairs]
        return torch.cat(read, dim=1)

    def parameter_groups(self) -> list[ParamGroup]:
        c, tables = self.config, [grid.get_parameter("table") for grid in (self.canonical, *self.temporal)]
        linears = (self.from_canonical, self.from_temporal, *self.hidden, self.heads)
        network = [parameter for linear in linears for parameter in linear.parameters()]
        return [
            ParamGroup("grids", tables, LearningRate(c.grid_lr_init, c.grid_lr_final, True, c.lr_until), True),
            ParamGroup("network", network, LearningRate(c.lr_init, c.lr_final, True, c.lr_until), True),
        ]

    def regularizers(self, points: Tensor, t: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
        """Features should change little where points are displaced a little; some points, drawn for each."""
        c, places = self.config, self.places(points.detach(), t)
        time = (c.temporal_noise,) * 3 + (c.time_noise,)
        kinds = (
            ("spatial", c.spatial_weight, (c.spatial_noise,) * 3, self.canonical),
            ("temporal", c.temporal_weight, time, self.temporal_features),
        )
        terms = {}
        for name, weight, noise, features in kinds:
            if weight and len(places):
                count = max(1, int(c.displaced * len(places)))
                chosen = to_device(torch.randperm(len(places), generator=generator)[:count], places.device)
                moves = (2 * torch.rand(count, len(noise), generator=generator) - 1).to(places.dtype)
                moves = to_device(moves * torch.tensor(noise, dtype=places.dtype), places.device)
                before = places[chosen, : len(noise)]
                after = before + moves
                change = features(after) - features(before)
                terms[name] = weight * change.square().sum(dim=1).mean()
        return terms

    def operations(self) -> int:
        grids = (self.canonical, *self.temporal)
        return super().operations() + sum(grid.operations() for grid in grids if isinstance(grid, HashGrid))


def displacements(turns: Tensor, points: Tensor) -> Tensor:
    """[N, 3] R x − x of points x, [N, 3], that quaternions of any length, the identity plus [N, 4], turn."""
    w, axis = 1 + turns[:, :1], turns[:, 1:]
    cross = torch.linalg.cross(axis, points)
    squared = (w.square() + axis.square().sum(dim=1, keepdim=True)).clamp_min(MIN_SQUARED_NORM)
    return (2 / squared) * (w * cross + torch.linalg.cross(axis, cross))
