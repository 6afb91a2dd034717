"""HexPlane-Slim (Cao and Johnson 2023): density and color features as products of planes over two axes each.

Features at (x, y, z, t) are products xy · zt, xz · yt and yz · xt of bilinearly interpolated planes. Density is a
scaled sum of 3 × 24 of them; a matrix and an MLP make a color of 3 × 48 others.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from operator import itemgetter
from typing import Annotated, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.datasets import SceneData
from msdgs_train.datasets.rays import Rays
from msdgs_train.layers.arrays import to_device
from msdgs_train.layers.parameters import ParamGroup, constant
from msdgs_train.settings import optional
from msdgs_train.volumes.config import VolumeConfig
from msdgs_train.volumes.field import Change, RayField, encoded
from msdgs_train.volumes.samples import Marched, Samples
from msdgs_train.volumes.space import Box, in_occupied, occupied_cells

AXES = ((0, 1, 2), (0, 2, 1), (1, 2, 0))  # two of a plane in space, and that of its plane over time
DENSITY_CHANNELS, COLOR_CHANNELS, COLOR_FEATURES, WIDTH, FREQUENCIES = 24, 48, 27, 128, 2
INIT_SCALE = 0.1  # standard deviation of the planes' first values
DENSITY_SHIFT, DISTANCE_SCALE = -10.0, 25.0
NOMINAL_HALF_SIZE = 1.5  # of the box of D-NeRF's scenes
STEP = 0.5  # between samples, in vertices
LEAST_ALPHA = 1e-3  # of a vertex that isn't empty
LEARNED_ALPHA = 1 - 0.5 ** (1 / DISTANCE_SCALE)  # of a vertex whose samples hide half of what is behind them
TIME_WEIGHT = 2.0  # of total variation along time
DECAY = 0.1  # of all rates and of the weight of total variation, over the run
GROWS_AT, MASKED_AT = (0.12, 0.24, 0.36), (0.16, 0.32, 0.4)


@dataclass(frozen=True)
class HexPlaneConfig(VolumeConfig):
    """Sizes and rates of HexPlane-Slim; those of its D-NeRF settings."""

    voxels: int = 200**3
    """Vertices of the grid in space in its last size."""
    first_voxels: int = 64**3
    """Vertices of the grid in space in its first size; it grows three times."""
    times: int = 24
    """Vertices along time in the last size; its authors advise 0.24 times the number of training images."""
    first_times: int = 16
    """Vertices along time in the first size; half of those in the last are advised."""
    box_half_size: Annotated[float | None, optional("LENGTH")] = None
    """Half the side of the cube around the origin that is modeled, in scene units. If not given: 1.5 in D-NeRF's
    scenes; in others what holds the sparse points, or what cameras look at."""
    grid_lr: float = 0.02
    """Learning rate of planes; decays to a tenth, as the other."""
    network_lr: float = 1e-3
    """Learning rate of matrices and the MLP."""
    tv_weight: float = 1e-4
    """Weight of the total variation of planes, which decays as rates do."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require(("first_voxels",), "a whole number in [64, 1e9]", lambda v: type(v) is int and 64 <= v <= 10**9)
        self.require_counts("times", "first_times", least=2)
        self.require_positive("grid_lr", "network_lr")
        self.require_positive_or_none("box_half_size")
        self.require_weights("tv_weight")

    def box_of(self, scene: SceneData) -> Box:
        half_size = self.box_half_size
        if half_size is None:
            half_size = NOMINAL_HALF_SIZE if scene.has_nominal_size else scene.scene_half_size
        return Box(torch.full((3,), -half_size), torch.full((3,), half_size))

    def build(self, box: Box) -> "HexPlane":
        return HexPlane(self, box)

    def resolutions(self) -> list[tuple[int, int]]:
        """Vertices along an axis of space and along time in each size; spaced evenly in their logarithms."""
        voxels = _spaced(self.first_voxels, self.voxels)
        return [
            (int(n ** (1 / 3) + 1e-3), round(t))
            for n, t in zip(voxels, _spaced(self.first_times, self.times), strict=True)
        ]


def _spaced(first: float, last: float) -> list[float]:
    return [first * (last / first) ** (k / len(GROWS_AT)) for k in range(len(GROWS_AT) + 1)]


class HexPlane(RayField):
    """Planes of space, [1, C, V, U], and over time, [1, C, W, T], of density and color."""

    least_weight: ClassVar[float] = 1e-4
    grids: ClassVar[tuple[str, ...]] = ("density_space", "density_time", "color_space", "color_time", "cells")
    cells: Tensor | None  # [X, Y, Z] bool, where something may be

    def __init__(self, config: HexPlaneConfig, box: Box) -> None:
        super().__init__(box)
        self.config = config
        (n, times), *_ = config.resolutions()
        self.register_buffer("cells", None)
        self.density_space, self.density_time = _planes(DENSITY_CHANNELS, n, n), _planes(DENSITY_CHANNELS, n, times)
        self.color_space, self.color_time = _planes(COLOR_CHANNELS, n, n), _planes(COLOR_CHANNELS, n, times)
        self.density_scales = nn.ParameterList(torch.ones(DENSITY_CHANNELS, 1) for _ in AXES)
        self.color_matrix = nn.Linear(3 * COLOR_CHANNELS, COLOR_FEATURES, bias=False)
        inputs = (COLOR_FEATURES + 3) * (1 + 2 * FREQUENCIES)
        self.color_mlp = nn.Sequential(
            nn.Linear(inputs, WIDTH), nn.ReLU(), nn.Linear(WIDTH, WIDTH), nn.ReLU(), nn.Linear(WIDTH, 3)
        )
        nn.init.zeros_(self.color_mlp[-1].bias)  # type: ignore[arg-type]

    @property
    def resolution(self) -> int:
        """Vertices along each axis of space."""
        return self.density_space[0].shape[2]

    @property
    def size(self) -> int:
        return self.resolution**3

    def check(self) -> None:
        n = self.resolution
        for name, plane in self.named_parameters():
            if "_space" in name and plane.shape[2:] != (n, n):
                raise InvalidInput(name, f"a plane of {n} × {n} vertices", tuple(plane.shape))
            if "_time" in name and plane.shape[2] != n:
                raise InvalidInput(name, f"a plane of {n} rows", tuple(plane.shape))
        if n < 2 or (self.cells is not None and self.cells.dim() != 3):
            raise InvalidInput("cells", "a grid of 3 axes, and planes of 2 vertices or more", n)

    def samples(self, rays: Rays, generator: torch.Generator | None) -> Samples:
        distances = self._distances(rays.origins.device)
        if generator is not None:  # all rays alike
            shift = to_device(torch.rand(len(distances), generator=generator), distances.device)
            near, far = self.config.depths
            distances = distances + shift * ((far - near) / len(distances))
        directions = functional.normalize(rays.directions, dim=1)
        points = rays.origins[:, None] + directions[:, None] * distances[:, None]
        samples = Samples.of(points, functional.pad(distances.diff(), (0, 1)), self.box.contains(points))
        if self.cells is None:
            return samples
        return samples.at(torch.nonzero(in_occupied(self.cells, self.box.normalized(samples.points)))[:, 0])

    def _distances(self, device: torch.device) -> Tensor:
        count = int(3**0.5 * self.resolution / STEP)
        return torch.linspace(*self.config.depths, count, device=device)

    def optical_depths(self, samples: Samples, rays: Rays) -> tuple[Tensor, Tensor]:
        points, times = self._places(samples, rays)
        products = _products(self.density_space, self.density_time, points, times)
        density = torch.zeros_like(times)
        for scales, product in zip(self.density_scales, products, strict=True):
            density = density + (scales * product).sum(dim=0)
        depths = functional.softplus(density + DENSITY_SHIFT) * samples.lengths * DISTANCE_SCALE
        return depths, depths.new_empty(len(depths), 0)

    def colors(self, samples: Samples, rays: Rays, features: Tensor) -> Tensor:
        products = torch.cat(list(_products(self.color_space, self.color_time, *self._places(samples, rays))))
        features = self.color_matrix(products.T)
        views = functional.normalize(rays.directions, dim=1)[samples.rays]
        inputs = [encoded(features, FREQUENCIES), encoded(views, FREQUENCIES)]
        return torch.sigmoid(self.color_mlp(torch.cat(inputs, dim=1)))

    def _places(self, samples: Samples, rays: Rays) -> tuple[Tensor, Tensor]:
        """Points, [M, 3], and times, [M], in [-1, 1]."""
        return self.box.normalized(samples.points), 2 * rays.times[samples.rays] - 1

    def regularizers(self, marched: Marched, target: Tensor, progress: float) -> Tensor:
        space, time = [*self.density_space, *self.color_space], [*self.density_time, *self.color_time]
        total = sum(_total_variation(plane, 1.0) for plane in space)
        total = total + sum(_total_variation(plane, TIME_WEIGHT) for plane in time)
        return self.config.tv_weight * DECAY**progress * total

    def parameter_groups(self, progress: float) -> list[ParamGroup]:
        grids = [*self.density_space, *self.density_time, *self.color_space, *self.color_time]
        network = [*self.density_scales, *self.color_matrix.parameters(), *self.color_mlp.parameters()]
        factor = DECAY**progress
        return [
            ParamGroup("planes", grids, constant(factor * self.config.grid_lr)),
            ParamGroup("network", network, constant(factor * self.config.network_lr)),
        ]

    def changes(self) -> list[Change]:
        grown = [
            (at, partial(self.grow, *size)) for at, size in zip(GROWS_AT, self.config.resolutions()[1:], strict=True)
        ]
        return sorted([*grown, *((at, self.mask_if_learned) for at in MASKED_AT)], key=itemgetter(0))

    @torch.no_grad()
    def grow(self, resolution: int, times: int) -> None:
        """Interpolate all planes to another size."""
        for planes in (self.density_space, self.color_space):
            _resize(planes, (resolution, resolution))
        for planes in (self.density_time, self.color_time):
            _resize(planes, (resolution, times))

    def mask_if_learned(self) -> None:
        """Find the cells where something is, unless nothing is opaque: after few steps, as runs of given minutes take
        before the first mask, all cells would be empty, and stay so."""
        if self._alphas().max() >= LEARNED_ALPHA:
            self.mask()

    @torch.no_grad()
    def mask(self) -> None:
        """Find the cells where something is at any time. Cells that were empty before stay so."""
        cells = occupied_cells(self._alphas(), LEAST_ALPHA)
        if self.cells is not None:
            cells &= functional.interpolate(self.cells[None, None].float(), cells.shape)[0, 0] > 0
        self.cells = cells

    @torch.no_grad()
    def _alphas(self) -> Tensor:
        """Largest opacities over time at the vertices, [X, Y, Z]; features are linear in time between vertices."""
        step = STEP * (self.corners[1] - self.corners[0]).mean() / (self.resolution - 1)
        return torch.stack([-torch.expm1(-step * self._densest(x)) for x in range(self.resolution)])

    def _densest(self, x: int) -> Tensor:
        """Largest density over time, [Y, Z], at vertices of one x."""
        scaled = [
            scale[..., None] * plane[0] for scale, plane in zip(self.density_scales, self.density_space, strict=True)
        ]
        (xy, xz, yz), (zt, yt, xt) = scaled, (plane[0] for plane in self.density_time)
        density = torch.einsum("cy,czt->yzt", xy[..., x], zt) + torch.einsum("cz,cyt->yzt", xz[..., x], yt)
        density = density + torch.einsum("czy,ct->yzt", yz, xt[:, x])
        return functional.softplus(density.amax(dim=2) + DENSITY_SHIFT)


def _planes(channels: int, rows: int, columns: int) -> nn.ParameterList:
    return nn.ParameterList(INIT_SCALE * torch.randn(1, channels, rows, columns) for _ in AXES)


def _resize(planes: nn.ParameterList, size: tuple[int, int]) -> None:
    for i, plane in enumerate(planes):
        planes[i] = nn.Parameter(functional.interpolate(plane, size, mode="bilinear", align_corners=True))


def _products(space: nn.ParameterList, time: nn.ParameterList, points: Tensor, times: Tensor) -> Iterator[Tensor]:
    """Features, [C, M], of each plane in space times its plane over time, at points, [M, 3], and times, [M]."""
    for (u, v, w), in_space, over_time in zip(AXES, space, time, strict=True):
        places = torch.stack([points[:, u], points[:, v]], dim=1), torch.stack([times, points[:, w]], dim=1)
        at, then = (
            functional.grid_sample(plane, place[None, :, None], align_corners=True)[0, :, :, 0]
            for plane, place in zip((in_space, over_time), places, strict=True)
        )
        yield at * then


def _total_variation(plane: Tensor, across: float) -> Tensor:
    """Twice the mean squared differences of neighbors along the first axis of a plane, and along its second axis times
    `across`."""
    return 2 * (plane.diff(dim=2).square().mean() + across * plane.diff(dim=3).square().mean())
