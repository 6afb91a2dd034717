"""Is a written scene file the model it was made from? Both are posed at many times and compared."""

import copy
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.baked import MOVING_OUTPUTS
from msdgs_serve.scene.errors import MsdgsError
from msdgs_serve.scene.gaussians import FloatArray
from msdgs_train.model import DynamicGaussians

TOLERANCE = 1e-4
TIMES = 50
GAUSSIANS_A_TIME = 5_000
"""Of a larger scene every n-th Gaussian is compared at a time, beginning with another at each next time."""

Errors = dict[str, float]


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
    """The largest errors against the model in float32 and in float64, as `measured_error` stores them.

    Errors of means are relative to the root mean square of the means, those of scales each to the scale itself, and
    those of unit quaternions are absolute. Raises `VerificationFailed` where one is above `tolerance`.
    """
    worst: dict[str, Errors] = {precision: dict.fromkeys(MOVING_OUTPUTS, 0.0) for precision in ("float32", "float64")}
    models = {"float32": model, "float64": copy.deepcopy(model).double()}
    stride = max(1, math.ceil(len(model.gaussians) / GAUSSIANS_A_TIME))
    _check_opacities_and_sh(session, models["float64"], tolerance)
    for i, t in enumerate(times_to_verify(*session.scene.metadata.time_range, times)):
        ids = np.arange(i % stride, len(model.gaussians), stride)
        got = _posed_by_file(session, t, ids)
        for precision, reference in models.items():
            for name, error in _errors(got, _posed_by_model(reference, t, ids)).items():
                worst[precision][name] = max(worst[precision][name], error)
                if not error <= tolerance:
                    own = _errors(_posed_by_model(model, t, ids), _posed_by_model(models["float64"], t, ids))[name]
                    raise VerificationFailed(
                        f"`{name}` at t = {t} is off by {error:.3g} from the model in {precision}, allowed is "
                        f"{tolerance:g}; the model's own float32 is off by {own:.3g} from its float64"
                    )
        on_time()
    return {**worst["float64"], "against": "model in float64", "against_float32": worst["float32"], "times": times}


def times_to_verify(t0: float, t1: float, count: int) -> list[float]:
    """`count` float32 times in [t0, t1]: both ends, and between them ones that fall on no grid of frames."""
    golden = (math.sqrt(5) - 1) / 2
    inner = sorted((i * golden) % 1 for i in range(1, count - 1))
    times = [t0 + (t1 - t0) * f for f in [0.0, *inner, 1.0]]
    # t0 and t1 themselves are kept: their float32 neighbours may lie outside the range
    return [t0, *(float(np.float32(t)) for t in times[1:-1]), t1]


def _posed_by_file(session: DeformationSession, t: float, ids: np.ndarray) -> dict[str, FloatArray]:
    scene = session.scene
    moving = ids[ids < scene.moving_count]
    static = ids[ids >= scene.moving_count] - scene.moving_count
    statics = (scene.static_means[static], scene.static_quats[static], scene.static_scales[static])
    parts = zip(session.pose(t, moving), statics, strict=True)
    return dict(zip(MOVING_OUTPUTS, (np.concatenate(pair) for pair in parts), strict=True))


def _posed_by_model(model: DynamicGaussians, t: float, ids: np.ndarray) -> dict[str, np.ndarray]:
    with torch.no_grad():
        posed = model.pose(float(np.float32(t)), ids=torch.from_numpy(ids))
    return {name: getattr(posed, name).numpy() for name in MOVING_OUTPUTS}


def _errors(got: dict[str, FloatArray], expected: dict[str, np.ndarray]) -> Errors:
    if not len(expected["means"]):
        return dict.fromkeys(expected, 0.0)
    size = {
        "means": np.sqrt(np.mean(expected["means"] ** 2)),
        "quats": 1.0,
        "scales": expected["scales"],
    }
    return {name: float(np.max(np.abs(got[name] - array) / size[name])) for name, array in expected.items()}


def _check_opacities_and_sh(session: DeformationSession, model: DynamicGaussians, tolerance: float) -> None:
    with torch.no_grad():
        expected = model.pose(session.scene.metadata.time_range[0], deform=False)
    for name in ("opacities", "sh"):
        got, reference = getattr(session.scene, name), getattr(expected, name).numpy()
        if not np.allclose(got, reference, rtol=tolerance, atol=tolerance):
            raise VerificationFailed(f"`{name}` differs from the model's")
