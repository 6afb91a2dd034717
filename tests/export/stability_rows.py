"""Rows of the stability suite: a constructed case, the measured error, its bound, and whether the bound holds.

A case either keeps its bound, or is refused with a message that names the reason. Anything else fails: an exceeded
bound, an exception of another package, a refusal without the reason, NaN.
"""

import math
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
import torch

from msdgs_export.measure.frames import PoseRenderer, compare, in_frame, project
from msdgs_export.measure.poses import in_float64
from msdgs_serve.scene import Gaussians
from msdgs_serve.scene.errors import MsdgsError
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.gaussians.model_file import SceneInfo
from tests.support.models import SCENE, random_model
from tests.support.tolerances import tolerance

HOLDS, REFUSED, FAILS = "holds", "refused", "fails"


Change = Callable[[DynamicGaussians], object]


class Row(NamedTuple):
    """One line of the table."""

    case: str
    quantity: str
    error: str
    bound: str
    verdict: str


def measured(case: str, quantity: str, error: float, bound: str) -> Row:
    """Whether an error is within the row `bound` of the tolerances; a value in dB must not be lower."""
    limit = tolerance(bound)
    decibels = bound.endswith("_db")
    held = math.isfinite(error) and (error >= limit if decibels else error <= limit)
    shown = (f"{error:.1f} dB", f"≥ {limit:g} dB") if decibels else (f"{error:.1e}", f"≤ {limit:.1g}")
    return Row(case, quantity, *shown, HOLDS if held else FAILS)


def refused(case: str, action: Callable[[], object], *reasons: str, quantity: str = "") -> Row:
    """Whether `action` is refused with one of the package's own errors, whose message has all `reasons` in it."""
    verdict = f"{FAILS}: was accepted"
    try:
        action()
    except MsdgsError as error:
        message = " ".join(str(error).split())
        named = all(reason in message for reason in reasons)
        verdict = f"{REFUSED}: {shortened(message)}" if named else f"{FAILS}: {message}"
    except Exception as error:  # an unexpected success is a failed row
        verdict = f"{FAILS}: {type(error).__name__} {error}"
    return Row(case, quantity, "–", "a refusal", verdict)


def shortened(message: str, length: int = 110) -> str:
    """The message without the folder of a file, shortened."""
    message = " ".join(word.rsplit("/", 1)[-1] if word.startswith("/") else word for word in message.split())
    return message if len(message) <= length else message[:length].rsplit(" ", 1)[0] + " …"


def changed(change: Change = lambda model: None, count: int = 100, **config: Any) -> DynamicGaussians:
    """Return a random model after a change."""
    model = random_model(count, **{"sh_degree": 0, **config})
    with torch.no_grad():
        change(model)
    return model


def worst_frame(
    model: DynamicGaussians, pose: Callable[[float], Gaussians], times: Iterable[float],
    scene: SceneInfo = SCENE, cameras: int | None = None,
) -> tuple[int, float]:  # fmt: skip
    """Return the most Gaussians in a frame and the worst PSNR against the model in float64, of poses at some times seen
    by the first cameras of the scene, or by all."""
    view, exact_pose = PoseRenderer(scene), in_float64(model)
    seen, worst = 0, math.inf
    for t in times:
        got, exact = pose(t), exact_pose(t)
        for camera in view.cameras[:cameras]:
            seen = max(seen, int(in_frame(*project(exact.means, camera), camera).sum()))
            worst = min(worst, compare(view.draw(got, camera), view.draw(exact, camera)).psnr)
    return seen, worst


def relative(got: np.ndarray, want: np.ndarray) -> float:
    """Largest error relative to each element; infinite where shapes differ or one is NaN."""
    got, want = np.asarray(got, np.float64), np.asarray(want, np.float64)
    if got.shape != want.shape:
        return math.inf
    errors = np.abs(got - want) / np.maximum(np.abs(want), 1e-300)
    return float(np.where(np.isfinite(errors), errors, math.inf).max(initial=0))
