"""Verification: poses of a written scene file are compared with the model's at many times."""

import copy
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from export.measure.poses import half_diagonal, largest_error, pose_errors, posed
from export.plans.base import BASELINE
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.baked import MOVING_OUTPUTS
from msdgs_serve.scene.errors import MsdgsError
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_train.gaussians.model import DynamicGaussians

TOLERANCE = 1e-4
TIMES = 50
GAUSSIANS_PER_TIME = 5_000
"""In a larger scene every n-th Gaussian is compared, starting with another one at each time."""

UNSTABLE = 0.25
"""A Gaussian is unstable if the model in float32 differs from float64 by more than this fraction of the tolerance: a
chain of layers multiplies round-off. No file in float32 can be held to the tolerance there."""


MIN_BOUND_PIXELS = 0.01
"""Pixels that float32 and 16-bit poses may add to an error bound."""

MAX_VIOLATIONS = 1e-3
"""Fraction of the poses that may exceed the error bound of their plan; Gaussians that move too fast don't count."""


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

    Only the plan `network` is held to `tolerance`. Others are measured, and fitted ones are held to their error bound,
    at times between those that they were fitted to. The file may hold more Gaussians than the model, static ones after
    all others; they aren't compared. Errors of means are relative to the scene's half
    diagonal or, further out, to the largest coordinate; those of scales to the Gaussian's largest scale; those of
    quaternions are absolute. Raises `VerificationFailed` if one is above `tolerance` for a stable Gaussian, or an
    error bound is exceeded. Unstable Gaussians are evaluated in rendered frames, before a file is written.
    """
    stated = session.scene.metadata
    if stated.plan != BASELINE:
        tolerance = math.inf
    displacements = _Displacements(stated.measured_error.get("fitted"))
    double = copy.deepcopy(model).double()
    count = len(model.gaussians)
    stride = max(1, math.ceil(count / GAUSSIANS_PER_TIME))
    unstable, unstable_worst = np.zeros(count, bool), 0.0
    worst: dict[str, dict[str, float]] = {p: dict.fromkeys(MOVING_OUTPUTS, 0.0) for p in ("float64", "float32")}
    _check_opacities_and_sh(session, double, min(tolerance, TOLERANCE))  # constants under every plan
    for i, t in enumerate(times_to_verify(*session.scene.metadata.time_range, times)):
        ids = np.arange(i % stride, count, stride)
        poses = {"float64": posed(double, t, ids), "float32": posed(model, t, ids)}
        got = _posed_by_file(session, t, ids)
        _give_sign_of(poses["float64"].quats, got.quats)
        displacements.add(got, poses["float64"])
        size = half_diagonal(session.scene.metadata.bounds)
        own = largest_error(pose_errors(poses["float32"], poses["float64"], size))
        stable = own <= UNSTABLE * tolerance
        unstable[ids[~stable]] = True
        for precision, reference in poses.items():
            for name, errors in pose_errors(got, reference, size).items():
                unstable_worst = max(unstable_worst, float(errors[~stable].max(initial=0)))
                error = float(errors[stable].max(initial=0))
                worst[precision][name] = max(worst[precision][name], error)
                if not error <= tolerance:
                    problem = f"`{name}` at t = {t} is off by {error:.3g} from the model in {precision}"
                    raise VerificationFailed(f"{problem}, allowed is {tolerance:g}")
        on_time()
    return {
        **displacements.to_plain(),
        **worst["float64"],
        "against": "model in float64",
        "against_float32": worst["float32"],
        "unstable": {"count": int(unstable.sum()), "error": unstable_worst},
        "times": times,
    }


class _Displacements:
    """The largest distances between two computations of poses, in units of the scene."""

    def __init__(self, bound: dict[str, Any] | None) -> None:
        self._bound = bound
        self._position = self._displacement = self._degrees = 0.0
        self._compared = self._broken = 0

    def add(self, got: Gaussians, expected: Gaussians) -> None:
        """Compare Gaussians at one time."""
        positions, turns, displacements = _distances(got, expected)
        self._position = max(self._position, float(positions.max(initial=0)))
        self._displacement = max(self._displacement, float(displacements.max(initial=0)))
        self._degrees = max(self._degrees, float(np.degrees(turns.max(initial=0))))
        if self._bound is not None:
            allowed = 2 * self._bound["error"] + MIN_BOUND_PIXELS * self._bound["pixel"]
            self._compared += len(displacements)
            self._broken += int(np.count_nonzero(~(displacements <= allowed)))

    def _too_fast(self) -> float:
        """Poses of Gaussians without an error bound."""
        return 0.0 if self._bound is None else self._bound["too_fast_part"] * self._compared

    def to_plain(self) -> dict[str, Any]:
        """Entries of `measured_error`. Raises `VerificationFailed` if the error bound is exceeded."""
        fitted = {} if self._bound is None else {"fitted": self._bound}
        if self._bound is not None and self._broken > MAX_VIOLATIONS * self._compared + self._too_fast():
            raise VerificationFailed(
                f"{self._broken:,} of {self._compared:,} poses exceed twice the plan's error bound of "
                f"{self._bound['error']:.3g} scene units"
            )
        return {
            "position": self._position,
            "displacement": self._displacement,
            "rotation_degrees": self._degrees,
            **fitted,
        }


def _distances(got: Gaussians, expected: Gaussians) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """[M] of means in scene units; angles in radians; and the largest of means, scales and ends of turned axes."""
    scales = expected.scales.astype(np.float64)
    positions = np.linalg.norm(got.means - expected.means, axis=1)
    chords = np.linalg.norm(got.quats - expected.quats, axis=1)
    axes = 2 * (scales.max(axis=1) - scales.min(axis=1)) * chords
    sizes = np.abs(got.scales - scales).max(axis=1)
    turns = 4 * np.arcsin(np.clip(chords / 2, 0, 1))
    return positions, turns, np.max([positions, axes, sizes], axis=0, initial=0)


def _give_sign_of(quats: np.ndarray, changed: np.ndarray) -> None:
    """Flip the signs of quaternions to those nearer to `quats`: q and −q are one rotation."""
    changed *= np.where((quats * changed).sum(axis=1, keepdims=True) < 0, -1, 1).astype(changed.dtype)


def times_to_verify(t0: float, t1: float, count: int) -> list[float]:
    """`count` float32 times in [t0, t1]: both ends, and irregular times between them."""
    golden = (math.sqrt(5) - 1) / 2
    inner = sorted((i * golden) % 1 for i in range(1, count - 1))
    times = [t0 + (t1 - t0) * f for f in [0.0, *inner, 1.0]]
    # t0 and t1 themselves are kept: their float32 neighbours may lie outside the range
    return [t0, *(float(np.float32(t)) for t in times[1:-1]), t1]


def _posed_by_file(session: DeformationSession, t: float, ids: np.ndarray) -> Gaussians:
    scene = session.scene
    moving = ids[ids < scene.moving_count]
    static = ids[ids >= scene.moving_count] - scene.moving_count
    statics = (scene.static_means[static], scene.static_quats[static], scene.static_scales[static])
    parts = zip(session.pose(t, moving), statics, strict=True)
    means, quats, scales = (np.concatenate(pair) for pair in parts)
    return Gaussians(means, quats, scales, scene.opacities[ids], scene.sh[ids])


def _check_opacities_and_sh(session: DeformationSession, model: DynamicGaussians, tolerance: float) -> None:
    expected = posed(model, session.scene.metadata.time_range[0], deform=False)
    for name in ("opacities", "sh"):
        reference = getattr(expected, name)
        got = getattr(session.scene, name)[: len(reference)]
        if not np.allclose(got, reference, rtol=tolerance, atol=tolerance):
            raise VerificationFailed(f"`{name}` differs from the model's")
