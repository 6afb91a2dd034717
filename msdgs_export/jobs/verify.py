"""Verification: poses of a written scene file are compared with the model's at many times."""

import copy
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from msdgs_export.measure.poses import half_diagonal, largest_error, pose_errors, posed
from msdgs_export.measure.times import times_to_verify
from msdgs_export.plans.base import BASELINE
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.scene.baked import APPEARANCE
from msdgs_serve.scene.errors import MsdgsError
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_train.gaussians.model import DynamicGaussians

TOLERANCE = 1e-4
TIMES = 50
DIFFERENCE_TIMES = 3
GAUSSIANS_PER_TIME = 2_500
"""In larger scenes every n-th Gaussian is compared, with another start at each time; each is compared at least once."""

UNSTABLE = 0.25
"""A Gaussian is unstable if the model in float32 differs from float64 by more than this fraction of the tolerance: a
chain of layers multiplies round-off. No file in float32 can be held to the tolerance there."""


class VerificationFailed(MsdgsError):
    """A written scene file differs from its model."""


def verify(
    session: DeformationSession,
    model: DynamicGaussians,
    *,
    times: int = TIMES,
    tolerance: float = TOLERANCE,
    on_time: Callable[[], object] = lambda: None,
) -> dict[str, Any]:
    """The largest errors against the model in float64 and float32, as `measured_error` stores them.

    Only the plan `network` is held to `tolerance`; others are measured. The file may hold more Gaussians than the
    model, static ones after all others, which aren't compared. Errors of means are relative to the scene's half
    diagonal or, further out, to the largest coordinate; those of scales to the Gaussian's largest scale; those of
    quaternions are absolute, or of covariances with `quat_space` raw. Raises `VerificationFailed` if one is above
    `tolerance` for a stable Gaussian. Unstable Gaussians are evaluated in rendered frames, before a file is written.
    """
    stated = session.scene.metadata
    if stated.plan != BASELINE:
        tolerance = math.inf
    double, count, size = copy.deepcopy(model).double(), len(model.gaussians), half_diagonal(stated.bounds)
    stride = max(1, min(times, math.ceil(count / GAUSSIANS_PER_TIME)))
    distances, unstable, unstable_worst = [], np.zeros(count, bool), 0.0
    outputs, by_shape = session.scene.posed_outputs, model.config.quat_space == "raw"
    worst: dict[str, dict[str, float]] = {p: dict.fromkeys(outputs, 0.0) for p in ("float64", "float32")}
    _check_opacities_and_sh(session, double, min(tolerance, TOLERANCE))  # constants under every plan
    for i, t in enumerate(times_to_verify(*stated.time_range, times)):
        ids = np.arange(i % stride, count, stride)
        poses = {"float64": posed(double, t, ids), "float32": posed(model, t, ids)}
        got = _posed_by_file(session, t, ids)
        _give_sign_of(poses["float64"].quats, got.quats)
        distances.append(_distances(got, poses["float64"]))
        own = largest_error(pose_errors(poses["float32"], poses["float64"], size, outputs, by_shape=by_shape))
        stable = own <= UNSTABLE * tolerance
        unstable[ids[~stable]] = True
        for precision, reference in poses.items():
            for name, errors in pose_errors(got, reference, size, outputs, by_shape=by_shape).items():
                unstable_worst = max(unstable_worst, float(errors[~stable].max(initial=0)))
                error = float(errors[stable].max(initial=0))
                worst[precision][name] = max(worst[precision][name], error)
                if not error <= tolerance:
                    problem = f"`{name}` at t = {t} differs by {error:.3g} from the model in {precision}"
                    raise VerificationFailed(f"{problem}, allowed is {tolerance:g}")
        on_time()
    return {
        **_displacements(np.concatenate(distances, axis=1), stated.scene_to_world.scale),
        **worst["float64"],
        "against": "model in float64",
        "against_float32": worst["float32"],
        "unstable": {"count": int(unstable.sum()), "error": unstable_worst},
        "times": times,
    }


def differences(got: DeformationSession, expected: DeformationSession) -> dict[str, float]:
    """The largest errors of all Gaussians of a file against another of the same scene, at a few times, by output."""
    outputs = expected.scene.posed_outputs
    worst: dict[str, float] = dict.fromkeys(outputs, 0.0)
    bounds = expected.scene.metadata.bounds
    for t in times_to_verify(*expected.scene.metadata.time_range, DIFFERENCE_TIMES):
        pose, reference = got.gaussians(t), expected.gaussians(t)
        _give_sign_of(reference.quats, pose.quats)
        for name, errors in pose_errors(pose, reference, half_diagonal(bounds), outputs).items():
            worst[name] = max(worst[name], float(errors.max(initial=0)))
    return worst


def _displacements(distances: np.ndarray, unit: float) -> dict[str, Any]:
    """Entries of `measured_error` from all `_distances`; `unit`: world units per scene unit."""
    position, angle, displacement = np.fmax.reduce(distances, axis=1, initial=0).tolist()
    return {
        "position": unit * position,
        "displacement": unit * displacement,
        "rotation_degrees": float(np.degrees(angle)),
    }


def _distances(got: Gaussians, expected: Gaussians) -> np.ndarray:
    """[3, M] distances of means in scene units; angles in radians; the largest of the displacements of means, scales
    and ends of rotated axes."""
    scales = expected.scales.astype(np.float64)
    positions = np.linalg.norm(got.means - expected.means, axis=1)
    chords = np.linalg.norm(got.quats - expected.quats, axis=1)
    axes = 2 * (scales.max(axis=1) - scales.min(axis=1)) * chords
    sizes = np.abs(got.scales - scales).max(axis=1)
    angles = 4 * np.arcsin(np.clip(chords / 2, 0, 1))
    return np.stack([positions, angles, np.max([positions, axes, sizes], axis=0, initial=0)])


def _give_sign_of(quats: np.ndarray, changed: np.ndarray) -> None:
    """Flip the signs of quaternions to those nearer to `quats`: q and −q are one rotation."""
    changed *= np.where((quats * changed).sum(axis=1, keepdims=True) < 0, -1, 1).astype(changed.dtype)


def _posed_by_file(session: DeformationSession, t: float, ids: np.ndarray) -> Gaussians:
    scene = session.scene
    moving = ids[ids < scene.moving_count]
    static = ids[ids >= scene.moving_count] - scene.moving_count
    parts = zip(scene.posed_outputs, session.pose(t, moving), scene.static, strict=True)
    posed = {name: np.concatenate([now, constant[static]]) for name, now, constant in parts}
    return Gaussians(**posed, **{name: getattr(scene, name)[ids] for name in APPEARANCE if name not in posed})


def _check_opacities_and_sh(session: DeformationSession, model: DynamicGaussians, tolerance: float) -> None:
    expected = posed(model, session.scene.metadata.time_range[0], deform=False)
    for name in (name for name in APPEARANCE if name not in session.scene.changing):
        reference = getattr(expected, name)
        got = getattr(session.scene, name)[: len(reference)]
        if not np.allclose(got, reference, rtol=tolerance, atol=tolerance):
            worst = float(np.abs(got.astype(np.float64) - reference).max(initial=0))
            allowed = f"and --tolerance allows {tolerance:g}, also relative to the value"
            raise VerificationFailed(f"`{name}` differs by up to {worst:.1e} from the model's, {allowed}")
