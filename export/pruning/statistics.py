"""What trimming decides by: how much of each Gaussian is seen, how far it moves in pixels, and frames to compare."""

from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np
import torch

from export.measure.rendered_error import as_gaussians, shown
from export.measure.views import View
from export.pruning.mask import Cut, Network, rows, whole, with_network
from msdgs_serve.rasterizer import GSPLAT, RasterizerOptions
from msdgs_serve.scene.gaussians import FloatArray, Gaussians
from msdgs_serve.scene.quaternion import MIN_NORM, to_matrix
from msdgs_serve.scene.spherical_harmonics import SH_C0
from msdgs_train.evaluation.metrics import psnr_from_mse
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.layers.chain import operations
from msdgs_train.rendering.rasterize import rasterize

MEMORY, POSE_BYTES = 2e9, 40
"""Bytes of poses that are kept of smaller networks, for trimming to other errors, and of one Gaussian at one time."""

SAMPLED_GAUSSIANS, SAMPLED_TIMES = 1000, 5
"""For the quick look at what a part of the network does."""


class Poses:
    """All Gaussians at the deciding times, posed when they are first asked for, and as they would best stand still."""

    def __init__(self, model: DynamicGaussians, times: Sequence[float]) -> None:
        self.times, self._model = times, model
        self._at: dict[float, Gaussians] = {}

    @torch.no_grad()
    def at(self, t: float) -> Gaussians:
        """The Gaussians at one of the times."""
        if t not in self._at:
            g = as_gaussians(self._model.pose(t))
            shared = next(iter(self._at.values()), g)
            self._at[t] = Gaussians(g.means, g.quats, g.scales, shared.opacities, shared.sh)
        return self._at[t]

    @cached_property
    def still(self) -> Gaussians:
        """Where they are on average."""
        return standing_still([self.at(t) for t in self.times])


class Evidence:
    """Frames of the whole model at the deciding views, and what a cut changes in them. All in float32."""

    def __init__(
        self,
        model: DynamicGaussians,
        views: Sequence[View],
        background: Sequence[float],
        on_time: Callable[[], object] = lambda: None,
    ) -> None:
        self.model, self.background = model, background
        self._views = views
        self._order = list(range(len(views)))
        self._kept: dict[Network, Poses] = {}
        network = whole(model).network
        self._whole = network, self._posed(network)
        for t in self._whole[1].times:
            self._whole[1].at(t)
            on_time()
        self._frames = [shown(self._whole[1].at(view.t), view.camera, background, model.rasterizer) for view in views]
        self.peaks, self.amounts = self._seen()

    def poses(self, network: Network) -> Poses:
        """All Gaussians as this part of the network moves them."""
        if network == self._whole[0]:
            return self._whole[1]
        if network not in self._kept:
            most = int(MEMORY / (POSE_BYTES * len(self._views) * max(len(self.model.gaussians), 1)))
            while len(self._kept) >= max(most, 1):
                del self._kept[next(iter(self._kept))]
            self._kept[network] = self._posed(network)
        return self._kept[network]

    def operations(self, network: Network) -> float:
        """About how many it takes to pose all Gaussians at the deciding times as this part of the network does."""
        layers = [self.model.deformation.layers[k] for k in network.layers]
        return operations(layers) * len(self.model.gaussians) * len(self._whole[1].times)

    def worst_db(self, cut: Cut, enough: float = -np.inf) -> float:
        """PSNR in dB of the worst deciding frame; where one is under `enough`, that of the first that is."""
        poses, worst = self.poses(cut.network), np.inf
        moving, still = np.flatnonzero(cut.moves), np.flatnonzero(cut.kept & ~cut.moves)
        colors = rows(self._whole[1].still, cut.ids, cut.sh_degree)
        standing = rows(poses.still if len(still) else self._whole[1].still, still, 0)
        constants = standing.means, standing.quats, standing.scales
        for i in list(self._order):
            view = self._views[i]
            at = poses.at(view.t)
            changing = at.means[moving], at.quats[moving], at.scales[moving]
            means, quats, scales = (np.concatenate(pair) for pair in zip(changing, constants, strict=True))
            drawn = Gaussians(means, quats, scales, colors.opacities, colors.sh)
            frame = shown(drawn, view.camera, self.background, self.model.rasterizer)
            db = psnr_from_mse(float(np.mean(np.square(frame - self._frames[i], dtype=np.float64))))
            worst = min(worst, db)
            if worst < enough:
                self._order.remove(i)  # most likely the one that decides next time too
                self._order.insert(0, i)
                break
        return worst

    def motion(self, network: Network) -> FloatArray:
        """[N] pixels by which the ends of a Gaussian's axes are at most off where it stands still: its position,
        rotation and scales, in the nearest camera."""
        poses = self.poses(network)
        still_axes = half_axes(poses.still)
        furthest = np.zeros(len(poses.still), np.float32)
        for at in map(poses.at, poses.times):
            moved = np.linalg.norm(at.means - poses.still.means, axis=1)
            turned = np.linalg.norm(half_axes(at) - still_axes, axis=1).max(axis=1, initial=0)
            np.maximum(furthest, moved + turned, out=furthest)
        return furthest * self.pixels_a_unit(poses.still.means)

    @torch.no_grad()
    def change(self, network: Network, smaller: Network) -> float:
        """Pixels by which a few Gaussians, at a few times, are elsewhere on average if part of a network is missing;
        faint ones count less."""
        poses = self.poses(network)
        count = len(self.model.gaussians)
        ids = np.arange(0, count, max(1, count // SAMPLED_GAUSSIANS))
        model, change = with_network(self.model, smaller), 0.0
        for t in poses.times[:: max(1, len(poses.times) // SAMPLED_TIMES)]:
            before = rows(poses.at(t), ids, self.model.config.sh_degree)
            after = as_gaussians(model.pose(t, ids=torch.from_numpy(ids)))
            moved = np.linalg.norm(after.means - before.means, axis=1)
            turned = np.linalg.norm(half_axes(after) - half_axes(before), axis=1).max(axis=1, initial=0)
            pixels = (moved + turned) * self.pixels_a_unit(before.means) * self.peaks[ids]
            change = max(change, float(pixels.sum() / max(self.peaks[ids].sum(), 1e-12)))
        return change

    def pixels_a_unit(self, means: FloatArray) -> FloatArray:
        """[N] pixels a scene unit where each point is, in the camera in which that is most."""
        most = np.zeros(len(means), np.float32)
        for camera in {id(view.camera): view.camera for view in self._views}.values():
            distances = np.linalg.norm(means - camera.position, axis=1)
            np.maximum(most, max(camera.fx, camera.fy) / np.maximum(distances, GSPLAT.near_plane), out=most)
        return most

    def _posed(self, network: Network) -> Poses:
        return Poses(with_network(self.model, network), sorted({view.t for view in self._views}))

    def _seen(self) -> tuple[FloatArray, FloatArray]:
        """[N] the most that a Gaussian covers of a pixel under its middle, and of how many pixels, over the views."""
        poses = self.poses(self._whole[0])
        peaks, amounts = np.zeros((2, len(poses.still)), np.float32)
        for view in self._views if len(peaks) else ():
            g = poses.at(view.t)
            weights = blending_weights(g, view, self.model.rasterizer)
            # pixels that a Gaussian of these two largest axes fills
            sizes = np.sort(g.scales, axis=1)[:, 1:] * self.pixels_a_unit(g.means)[:, None]
            np.maximum(peaks, weights / (2 * np.pi * (sizes.prod(axis=1) + self.model.config.eps2d)), out=peaks)
            np.maximum(amounts, weights, out=amounts)
        return np.minimum(peaks, 1), amounts


def blending_weights(gaussians: Gaussians, view: View, options: RasterizerOptions) -> FloatArray:
    """[N] how much each Gaussian adds to a frame: its alpha times what reaches it, summed over the pixels."""
    means, quats, scales, opacities = (
        torch.from_numpy(array) for array in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)
    )
    grey = torch.zeros(len(means), 1, 3, requires_grad=True)
    rgb, _, _ = rasterize(means, quats, scales, opacities, grey, view.camera, torch.zeros(3), options)
    (gradient,) = torch.autograd.grad(rgb[..., 0].sum(), grey)
    return (gradient[:, 0, 0] / SH_C0).numpy()


def half_axes(gaussians: Gaussians) -> FloatArray:
    """[N, 3, 3] whose columns are the half-axes of the Gaussians, scene units."""
    return to_matrix(gaussians.quats) * gaussians.scales[:, None, :]


def standing_still(poses: list[Gaussians]) -> Gaussians:
    """Each Gaussian where it is on average: means, logarithms of scales, quaternions of one hemisphere."""
    first = poses[0]
    quats = np.zeros_like(first.quats)
    for pose in poses:
        same = np.where((pose.quats * first.quats).sum(axis=1, keepdims=True) < 0, -1, 1)
        quats += same * pose.quats
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    quats = np.where(norms < MIN_NORM, first.quats, quats / np.maximum(norms, MIN_NORM)).astype(np.float32)
    means = np.asarray(np.mean([pose.means for pose in poses], axis=0, dtype=np.float64), np.float32)
    log_scales = np.mean([np.log(pose.scales) for pose in poses], axis=0, dtype=np.float64)
    return Gaussians(means, quats, np.exp(log_scales).astype(np.float32), first.opacities, first.sh)
