"""The basis of pruning: the visibility of each Gaussian, its motion in pixels, and frames to compare."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property, partial, reduce

import numpy as np
import torch

from msdgs_export.bake import changing_outputs
from msdgs_export.measure.frames import compare, render
from msdgs_export.measure.poses import Pose, operations, posed
from msdgs_export.measure.views import View
from msdgs_export.progress import Track, no_progress
from msdgs_export.pruning.mask import NetworkMask, PruningMask, full_mask, rows, with_network
from msdgs_serve.rasterizer import GSPLAT, RasterizerOptions
from msdgs_serve.scene.baked import APPEARANCE
from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.gaussians import FloatArray, Gaussians
from msdgs_serve.scene.quaternion import MIN_NORM, to_matrix
from msdgs_serve.scene.spherical_harmonics import SH_C0
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.layers.chain import MultiStepDeformation
from msdgs_train.rendering.rasterize import rasterize

MEMORY, POSE_BYTES = 2e9, 40
"""Bytes of cached poses of smaller networks, and bytes of a Gaussian at one time."""

SAMPLED_GAUSSIANS, SAMPLED_TIMES = 1000, 5
"""Samples of the quick estimate of a network part's contribution."""


class Poses:
    """All Gaussians at the selection times, posed on first use, and their mean poses."""

    def __init__(self, model: DynamicGaussians, times: Sequence[float], pose: Pose) -> None:
        self.times, self._model, self._pose = times, model, pose
        self._at: dict[float, Gaussians] = {}

    def at(self, t: float) -> Gaussians:
        """The Gaussians at one of the times."""
        if t not in self._at:
            g = Gaussians(*(array.astype(np.float32, copy=False) for array in vars(self._pose(t)).values()))
            shared, changing = next(iter(self._at.values()), g), changing_outputs(self._model)
            self._at[t] = replace(g, **{name: getattr(shared, name) for name in APPEARANCE if name not in changing})
        return self._at[t]

    @cached_property
    def static(self) -> Gaussians:
        """Their mean poses."""
        return mean_pose([self.at(t) for t in self.times])


class PruningStatistics:
    """Frames of the whole model at the selection views, and the changes that a mask makes in them."""

    def __init__(
        self,
        model: DynamicGaussians,
        views: Sequence[View],
        background: Sequence[float],
        track: Track = no_progress,
        pose: Pose | None = None,
    ) -> None:
        """`pose` gives the poses of the whole model; by default torch does."""
        on_view = track("motion and visibility of the Gaussians", len(views))
        self._on_frame = track("frames of pruned models", 0)
        self.model, self.background = model, background
        self._views = views
        self._order = list(range(len(views)))
        self._kept: dict[NetworkMask, Poses] = {}
        self._motions: dict[NetworkMask, FloatArray] = {}
        network = full_mask(model).network
        self._whole = network, self._posed(network, pose)
        self._frames = list[FloatArray]()
        for view in views:
            self._frames.append(render(self._whole[1].at(view.t), view.camera, background, model.rasterizer))
            on_view()
        self.peaks, self.amounts = self._visibility()

    def poses(self, network: NetworkMask) -> Poses:
        """The poses of all Gaussians with this part of the network."""
        if network == self._whole[0]:
            return self._whole[1]
        if network not in self._kept:
            most = int(MEMORY / (POSE_BYTES * len(self._whole[1].times) * max(len(self.model.gaussians), 1)))
            while len(self._kept) >= max(most, 1):
                del self._kept[next(iter(self._kept))]
            self._kept[network] = self._posed(network)
        return self._kept[network]

    def operations(self, network: NetworkMask) -> float:
        """Approximate operations to pose all Gaussians at the selection times with this part of the network."""
        chain = MultiStepDeformation(list(self.model.deformation)[k] for k in network.layers)
        return (
            operations(self.model.support, chain, len(self.model.gaussians))
            * len(self.model.gaussians)
            * len(self._whole[1].times)
        )

    def worst_db(self, mask: PruningMask, min_db: float = -np.inf) -> float:
        """PSNR in dB of the worst selection frame, or of the first that is under `min_db`."""
        poses, worst = self.poses(mask.network), np.inf
        moving, static = np.flatnonzero(mask.moves), np.flatnonzero(mask.kept & ~mask.moves)
        standing = rows(poses.static if len(static) else self._whole[1].static, static, mask.sh_degree)
        for i in list(self._order):
            view = self._views[i]
            changing = rows(poses.at(view.t), moving, mask.sh_degree)
            pairs = zip(vars(changing).values(), vars(standing).values(), strict=True)
            drawn = Gaussians(*(np.concatenate(pair) for pair in pairs))
            try:
                frame = render(drawn, view.camera, self.background, self.model.rasterizer)
            except InvalidInput:  # poses that overflow in float32
                return -np.inf
            worst = min(worst, compare(frame, self._frames[i]).psnr)
            self._on_frame()
            if worst < min_db:
                self._order.remove(i)  # probably the worst one in the next call too
                self._order.insert(0, i)
                break
        return worst

    def motion(self, network: NetworkMask) -> FloatArray:
        """[N] largest displacement of the ends of a Gaussian's axes from its mean pose, pixels. A change of all of its
        opacity or color counts as one."""
        if network in self._motions:
            return self._motions[network]
        poses = self.poses(network)
        mean_axes, mean = half_axes(poses.static), poses.static
        furthest, changed = np.zeros((2, len(mean)), np.float32)
        for at in map(poses.at, poses.times):
            moved = np.linalg.norm(at.means - poses.static.means, axis=1)
            rotated = np.linalg.norm(half_axes(at) - mean_axes, axis=1).max(axis=1, initial=0)
            np.maximum(furthest, moved + rotated, out=furthest)
            if not changing_outputs(self.model):
                continue
            faded = np.abs(at.opacities - mean.opacities) / np.maximum(mean.opacities, GSPLAT.alpha_min)
            colored = np.abs(at.sh - mean.sh).sum(axis=1).max(axis=1, initial=0)
            np.maximum(changed, faded + colored, out=changed)
        self._motions[network] = furthest * self._pixels_per_unit(mean.means) + changed
        return self._motions[network]

    def change(self, network: NetworkMask, smaller: NetworkMask) -> float:
        """Mean displacement in pixels of a few Gaussians at a few times if part of a network is removed, weighted by
        their visibility."""
        poses = self.poses(network)
        count = len(self.model.gaussians)
        ids = np.arange(0, count, max(1, count // SAMPLED_GAUSSIANS))
        model, change = with_network(self.model, smaller), 0.0
        for t in poses.times[:: max(1, len(poses.times) // SAMPLED_TIMES)]:
            before = rows(poses.at(t), ids, self.model.config.sh_degree)
            after = posed(model, t, ids)
            moved = np.linalg.norm(after.means - before.means, axis=1)
            rotated = np.linalg.norm(half_axes(after) - half_axes(before), axis=1).max(axis=1, initial=0)
            pixels = (moved + rotated) * self._pixels_per_unit(before.means) * self.peaks[ids]
            change = max(change, float(pixels.sum() / max(self.peaks[ids].sum(), 1e-12)))
        return change

    def _pixels_per_unit(self, means: FloatArray) -> FloatArray:
        """[N] pixels per scene unit at each point, in the nearest camera."""
        cameras = {id(view.camera): view.camera for view in self._views}.values()
        return reduce(np.maximum, (pixels_per_unit(means, camera) for camera in cameras))

    def _posed(self, network: NetworkMask, pose: Pose | None = None) -> Poses:
        model = with_network(self.model, network)
        pose = pose or partial(posed, model, on_block=self._on_frame)
        return Poses(model, sorted({view.t for view in self._views}), pose)

    def _visibility(self) -> tuple[FloatArray, FloatArray]:
        """[N] the largest contribution of a Gaussian to a pixel at its center, in [0, 1], and the largest sum of its
        contributions to a view."""
        poses = self.poses(self._whole[0])
        peaks, amounts = np.zeros((2, len(poses.static)), np.float32)
        for view in self._views if len(peaks) else ():
            g = poses.at(view.t)
            weights = blending_weights(g, view, self.model.rasterizer)
            self._on_frame()
            # pixels covered by its two largest axes
            sizes = np.sort(g.scales, axis=1)[:, 1:] * pixels_per_unit(g.means, view.camera)[:, None]
            np.maximum(peaks, weights / (2 * np.pi * (sizes.prod(axis=1) + self.model.config.eps2d)), out=peaks)
            np.maximum(amounts, weights, out=amounts)
        return np.minimum(peaks, 1), amounts


def blending_weights(gaussians: Gaussians, view: View, options: RasterizerOptions) -> FloatArray:
    """[N] contribution of each Gaussian to a frame: its alpha times the transmittance before it, summed over pixels."""
    means, quats, scales, opacities = (
        torch.from_numpy(array) for array in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)
    )
    gray = torch.zeros(len(means), 1, 3, requires_grad=True)
    rgb, _, _ = rasterize(means, quats, scales, opacities, gray, view.camera, torch.zeros(3), options)
    (gradient,) = torch.autograd.grad(rgb[..., 0].sum(), gray)
    return (gradient[:, 0, 0] / SH_C0).numpy()


def pixels_per_unit(means: FloatArray, camera: Camera) -> FloatArray:
    """[N] pixels per scene unit at each point."""
    distances = np.linalg.norm(means - camera.position, axis=1)
    return (max(camera.fx, camera.fy) / np.maximum(distances, GSPLAT.near_plane)).astype(np.float32)


def half_axes(gaussians: Gaussians) -> FloatArray:
    """[N, 3, 3] whose columns are the half-axes of the Gaussians, scene units."""
    return to_matrix(gaussians.quats) * gaussians.scales[:, None, :]


def mean_pose(poses: list[Gaussians]) -> Gaussians:
    """Mean poses over time: of means, of logarithms of scales, of quaternions in one hemisphere, and if they change, of
    opacities, and of SH weighted by opacity."""
    first = poses[0]
    quats = np.zeros_like(first.quats)
    for pose in poses:
        same = np.where((pose.quats * first.quats).sum(axis=1, keepdims=True) < 0, -1, 1)
        quats += same * pose.quats
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    quats = np.where(norms < MIN_NORM, first.quats, quats / np.maximum(norms, MIN_NORM)).astype(np.float32)
    means = np.asarray(np.mean([pose.means for pose in poses], axis=0, dtype=np.float64), np.float32)
    log_scales = np.mean([np.log(pose.scales) for pose in poses], axis=0, dtype=np.float64)
    opacities, sh = first.opacities, first.sh
    if any(pose.opacities is not opacities or pose.sh is not sh for pose in poses):
        total = np.sum([pose.opacities for pose in poses], axis=0, dtype=np.float64)
        weighted = sum(pose.opacities[:, None, None] * pose.sh.astype(np.float64) for pose in poses)
        opacities = np.asarray(total / len(poses), np.float32)
        sh = np.asarray(weighted / np.maximum(total, 1e-30)[:, None, None], np.float32)
    return Gaussians(means, quats, np.exp(log_scales).astype(np.float32), opacities, sh)
