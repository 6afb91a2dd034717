"""Poses of a model, and errors of poses by Gaussian."""

import copy
import math
from collections.abc import Callable, Sequence

import numpy as np
import torch

from msdgs_serve.scene.baked import MOVING_OUTPUTS
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.scene.quaternion import to_matrix
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.layers.chain import MultiStepDeformation
from msdgs_train.supports.base import Support

Pose = Callable[[float], Gaussians]

BLOCK = 1 << 14
"""Gaussians that are posed at once; in float64 it takes some seconds for a model of the paper's size."""

SMALLEST_VISIBLE = 1e-3
"""Scales below this fraction of the scene's half diagonal are less than a pixel; errors are relative to at least it."""

UNIT_TOLERANCE = 1e-3
"""Allowed difference of the norm of a quaternion from 1, as in `Gaussians.validate`."""


@torch.no_grad()
def posed(
    model: DynamicGaussians,
    t: float,
    ids: np.ndarray | None = None,
    *,
    deform: bool = True,
    on_block: Callable[[], object] = lambda: None,
) -> Gaussians:
    """The Gaussians `ids`, int64 [M], or all, at time `t`, in the model's precision; canonical ones if not `deform`.

    The time is rounded to float32, as a scene file takes it. `on_block` is called after every `BLOCK` Gaussians.
    """
    rows = torch.arange(len(model.gaussians)) if ids is None else torch.from_numpy(ids)
    blocks = []
    for block in rows.split(BLOCK):
        blocks.append(model.pose(float(np.float32(t)), ids=block, deform=deform))
        on_block()
    return Gaussians(*(torch.cat(parts).numpy() for parts in zip(*blocks, strict=True)))


def in_float64(model: DynamicGaussians, on_block: Callable[[], object] = lambda: None) -> Pose:
    """The Gaussians of a model as a function of time, computed in float64."""
    double = copy.deepcopy(model).double()
    return lambda t: posed(double, t, on_block=on_block)


def operations(support: Support, chain: MultiStepDeformation, count: int) -> float:
    """Approximate operations per Gaussian and pose, of `count` Gaussians that share the chain's points."""
    points = count if support.num_points is None else support.num_points
    return support.operations() + chain.operations() * points / max(count, 1)


def half_diagonal(bounds: object) -> float:
    """Half the diagonal of a box given by two corners, [2, 3]; above 0."""
    low, high = np.array(bounds)
    return max(float(np.linalg.norm(high - low)) / 2, 1e-30)


def pose_errors(
    got: Gaussians,
    expected: Gaussians,
    scene_size: float,
    outputs: Sequence[str] = MOVING_OUTPUTS,
    *,
    by_shape: bool = False,
) -> dict[str, np.ndarray]:
    """[M] the largest error of each Gaussian, by output; infinite if `got` is NaN or infinite.

    Means: relative to the scene's half diagonal or, further out, to the largest coordinate. Quaternions: absolute.
    Scales: relative to the Gaussian's largest scale, or to `SMALLEST_VISIBLE` of the scene. Opacities and SH: absolute.

    With `by_shape`, errors of covariances, relative to the largest variance, stand for those of quaternions: axes of
    equal length have no direction, if those are found from the shape (`unit_form`).
    """
    sizes = {
        "means": np.maximum(np.abs(expected.means).max(axis=1), scene_size),
        **dict.fromkeys(("quats", "opacities", "sh"), 1.0),
        "scales": np.maximum(expected.scales.max(axis=1), SMALLEST_VISIBLE * scene_size),
    }
    with np.errstate(invalid="ignore", over="ignore"):
        differences = {n: np.abs(getattr(got, n).astype(np.float64) - getattr(expected, n)) for n in outputs}
        largest = {name: values.max(axis=tuple(range(1, values.ndim))) for name, values in differences.items()}
        errors = {name: values / sizes[name] for name, values in largest.items()}
        if by_shape:
            off = np.abs(_covariances(got) - _covariances(expected)).max(axis=(1, 2))
            errors["quats"] = off / np.square(sizes["scales"])
    return {name: np.where(np.isfinite(values), values, math.inf) for name, values in errors.items()}


def _covariances(gaussians: Gaussians) -> np.ndarray:
    """[M, 3, 3] float64."""
    halves = to_matrix(gaussians.quats.astype(np.float64)) * gaussians.scales.astype(np.float64)[:, None]
    return halves @ halves.transpose(0, 2, 1)


def largest_error(errors: dict[str, np.ndarray]) -> np.ndarray:
    """[M] the largest error of each Gaussian over all outputs."""
    return np.max([*errors.values()], axis=0)


def usable_rows(posed: Gaussians) -> np.ndarray:
    """[M] whether a Gaussian can be drawn: all values are finite and its quaternion hasn't overflowed."""
    finite = np.all([np.isfinite(array.reshape(len(array), -1)).all(axis=1) for array in vars(posed).values()], axis=0)
    norms = np.linalg.norm(np.where(finite[:, None], posed.quats, 1), axis=1)
    return finite & (np.abs(norms - 1) < UNIT_TOLERANCE)
