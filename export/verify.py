"""Is a written scene file the model it was made from? Both are posed at many times and compared."""

import copy
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from export.precision.gap import PosedArrays, half_diagonal, largest_error, pose_arrays, pose_errors
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.baked import MOVING_OUTPUTS
from msdgs_serve.scene.errors import MsdgsError
from msdgs_train.model import DynamicGaussians

TOLERANCE = 1e-4
TIMES = 50
GAUSSIANS_A_TIME = 5_000
"""Of a larger scene every n-th Gaussian is compared at a time, beginning with another at each next time."""

UNSTABLE = 0.25
"""A Gaussian is unstable where the model's own float32 is off from its float64 by more than this part of the
tolerance: a chain of layers multiplies round-off. No file in float32 can be held to the tolerance there."""

UNSTABLE_ALLOWED = 0.01
"""Part of the Gaussians that may be unstable."""


class VerificationFailed(MsdgsError):
    """A written scene file doesn't compute what its model does."""


def verify(
    session: DeformationSession,
    model: DynamicGaussians,
    *,
    times: int = TIMES,
    tolerance: float = TOLERANCE,
    on_time: Callable[[], object] = lambda: None,
) -> dict[str, Any]:
    """The largest errors against the model in float64 and float32, as `measured_error` stores them.

    The file may hold more Gaussians than the model, static ones after all others; they aren't compared.
    Errors of means are relative to the scene's half diagonal or, further out, to the largest coordinate; those
    of scales to the Gaussian's largest scale; those of quaternions are absolute. Raises `VerificationFailed` where one
    is above `tolerance` for a stable Gaussian, or too many Gaussians are unstable.
    """
    double = copy.deepcopy(model).double()
    count = len(model.gaussians)
    stride = max(1, math.ceil(count / GAUSSIANS_A_TIME))
    unstable, unstable_worst = np.zeros(count, bool), 0.0
    worst: dict[str, dict[str, float]] = {p: dict.fromkeys(MOVING_OUTPUTS, 0.0) for p in ("float64", "float32")}
    _check_opacities_and_sh(session, double, min(tolerance, TOLERANCE))  # stored as they are under every plan
    for i, t in enumerate(times_to_verify(*session.scene.metadata.time_range, times)):
        ids = np.arange(i % stride, count, stride)
        got = _posed_by_file(session, t, ids)
        posed = {"float64": pose_arrays(double, t, ids), "float32": pose_arrays(model, t, ids)}
        size = half_diagonal(session.scene.metadata.bounds)
        own = largest_error(pose_errors(posed["float32"], posed["float64"], size))
        stable = own <= UNSTABLE * tolerance
        unstable[ids[~stable]] = True
        for precision, reference in posed.items():
            for name, errors in pose_errors(got, reference, size).items():
                unstable_worst = max(unstable_worst, float(errors[~stable].max(initial=0)))
                error = float(errors[stable].max(initial=0))
                worst[precision][name] = max(worst[precision][name], error)
                if not error <= tolerance:
                    problem = f"`{name}` at t = {t} is off by {error:.3g} from the model in {precision}"
                    raise VerificationFailed(f"{problem}, allowed is {tolerance:g}")
        on_time()
    if unstable.sum() > UNSTABLE_ALLOWED * count:
        raise VerificationFailed(
            f"{unstable.sum():,} of {count:,} Gaussians are unstable: the model's own float32 is off from its float64 "
            f"by more than {UNSTABLE * tolerance:g}, a quarter of the tolerance"
        )
    return {
        **worst["float64"],
        "against": "model in float64",
        "against_float32": worst["float32"],
        "unstable": {"count": int(unstable.sum()), "error": unstable_worst},
        "times": times,
    }


def times_to_verify(t0: float, t1: float, count: int) -> list[float]:
    """`count` float32 times in [t0, t1]: both ends, and between them ones that fall on no grid of frames."""
    golden = (math.sqrt(5) - 1) / 2
    inner = sorted((i * golden) % 1 for i in range(1, count - 1))
    times = [t0 + (t1 - t0) * f for f in [0.0, *inner, 1.0]]
    # t0 and t1 themselves are kept: their float32 neighbours may lie outside the range
    return [t0, *(float(np.float32(t)) for t in times[1:-1]), t1]


def _posed_by_file(session: DeformationSession, t: float, ids: np.ndarray) -> PosedArrays:
    scene = session.scene
    moving = ids[ids < scene.moving_count]
    static = ids[ids >= scene.moving_count] - scene.moving_count
    statics = (scene.static_means[static], scene.static_quats[static], scene.static_scales[static])
    parts = zip(session.pose(t, moving), statics, strict=True)
    return dict(zip(MOVING_OUTPUTS, (np.concatenate(pair) for pair in parts), strict=True))


def _check_opacities_and_sh(session: DeformationSession, model: DynamicGaussians, tolerance: float) -> None:
    with torch.no_grad():
        expected = model.pose(session.scene.metadata.time_range[0], deform=False)
    for name in ("opacities", "sh"):
        reference = getattr(expected, name).numpy()
        got = getattr(session.scene, name)[: len(reference)]
        if not np.allclose(got, reference, rtol=tolerance, atol=tolerance):
            raise VerificationFailed(f"`{name}` differs from the model's")
