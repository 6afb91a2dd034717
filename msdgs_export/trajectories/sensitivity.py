"""How visible errors of poses are: squared errors of frames as quadratic forms of errors of poses.

A frame f moves by J e if a pose moves by e, and E[g gᵀ] = Jᵀ J for gradients g = Jᵀ s with random signs s (Hutchinson,
1990), so that some hundred backward passes, spread over all cameras and times, tell what all pixels see.
"""

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
import torch

from msdgs_export.trajectories.poses import MEANS, POSE, QUATS, SCALES
from msdgs_serve.rasterizer import as_trained
from msdgs_serve.scene.baked import BakedScene
from msdgs_serve.scene.camera import Camera
from msdgs_train.rendering.rasterize import rasterize

PASSES = 256
"""Backward passes, each of one camera at one time."""

MOST = 1e15
"""Larger gradients, of Gaussians at the limits of float32, are left out."""

CAMERA_STEP, TIME_STEP = 0.6180339887498949, 0.7548776662466927
"""Parts of all cameras and of the time range by which the next pass is further on: no two have a common period."""


def sensitivities(
    scene: BakedScene,
    samples: npt.NDArray[np.floating],
    cameras: Sequence[Camera],
    on_pass: Callable[[], object] = lambda: None,
) -> npt.NDArray[np.float32]:
    """[M, 10, 10] W of the moving Gaussians: an error e of a pose adds eᵀ W e to the mean squared error of a frame.

    `samples`, [M, T, 10], are their poses at T evenly spread times. Radial errors of quaternions don't count.
    """
    count, times = samples.shape[:2]
    options, background = as_trained(scene.metadata), torch.tensor(scene.metadata.background, dtype=torch.float32)
    static = (scene.static_means, scene.static_scales, scene.static_quats)
    opacities, sh = torch.from_numpy(scene.opacities), torch.from_numpy(scene.sh)
    generator = torch.Generator().manual_seed(0)
    sums = np.zeros((count, POSE, POSE), np.float32)
    for i in range(PASSES):
        camera = cameras[int(i * CAMERA_STEP % 1 * len(cameras))]
        poses = samples[:, round(i * TIME_STEP % 1 * (times - 1))]
        pairs = zip((MEANS, SCALES, QUATS), static, strict=True)
        means, scales, quats = (
            torch.from_numpy(np.concatenate([poses[:, part], still]).astype(np.float32)).requires_grad_()
            for part, still in pairs
        )
        rgb, _, _ = rasterize(means, quats, scales, opacities, sh, camera, background, options)
        signs = 2.0 * torch.randint(0, 2, rgb.shape, generator=generator) - 1
        grads = torch.autograd.grad((rgb * signs).sum(), (means, scales, quats))
        found = np.concatenate([grad[:count].numpy() for grad in grads], axis=1)
        radial = np.einsum("mc,mc->m", found[:, QUATS], poses[:, QUATS])
        found[:, QUATS] -= radial[:, None] * poses[:, QUATS]
        found[~(np.abs(found) < MOST).all(axis=1)] = 0
        sums += np.einsum("mc,md->mcd", found, found) / (PASSES * rgb.numel())
        on_pass()
    return sums


def square_roots(forms: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """[M, 10, 10] matrices A with A Aᵀ = W."""
    values, vectors = np.linalg.eigh(forms)
    return (vectors * np.sqrt(np.maximum(values, 0))[:, None]).astype(np.float32)
