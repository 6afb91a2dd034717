"""The result of an assessment of stability, and the plans that it allows."""

import math
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import torch

from msdgs_export.plans.registry import PLANS, plan_of
from msdgs_serve.scene.errors import MsdgsError
from msdgs_serve.scene.quaternion import MIN_NORM
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.gaussians.modulation import MAX_LOG_FACTOR
from msdgs_train.gaussians.scale_space import LOG_SCALE_LIMIT

AT_LIMIT = 1 - 1e-6
"""Fraction of a limit from which a value counts as being at it."""


class PlanUnsafe(MsdgsError):
    """A plan would show round-off that the model itself doesn't have."""


@dataclass(frozen=True)
class Float32Gap:
    """Errors of poses and frames in float32 against float64."""

    median: float  # of the largest relative error of each Gaussian, `msdgs_export.measure.poses`
    near_worst: float  # the 99.9th percentile
    worst: float
    pixels: float  # largest distance of a projected mean
    psnr: float  # dB, worst frame
    worst_pixel: float  # in that frame, [0, 1]
    psnr_without_worst: float  # dB, the same frame with the worst 0.1 % taken from float64
    overflowed: int  # Gaussians with a pose that is NaN or infinite, or without a rotation


@dataclass(frozen=True)
class WorstGaussians:
    """The 0.1 % of the Gaussians with the largest error in float32, at the worst time."""

    t: float
    ids: list[int]  # the worst first
    center: list[float]  # [3] mean of their float64 means, in the world
    spread: float  # their mean distance from it, as a fraction of the scene's half diagonal
    outside_bounds: int
    moved: float  # median distance from their canonical means, as a fraction of the half diagonal
    pixels: float  # largest distance of a projected mean
    drawn_psnr: float  # dB between the float64 frames with and without them: how visible they are


@dataclass(frozen=True)
class Samples:
    """One row per sampled Gaussian and time."""

    amplification: np.ndarray = field(default_factory=lambda: np.ones(0))  # [S]
    distance: np.ndarray = field(default_factory=lambda: np.ones(0))  # [S] of float32 from float64 means, scene units
    predicted: np.ndarray = field(default_factory=lambda: np.ones(0))  # [S] distance predicted by the amplification
    after: np.ndarray = field(default_factory=lambda: np.ones((0, 0)))  # [K, S] growth after each layer


@dataclass(frozen=True)
class StabilityReport:
    """The result of `assess`. The defaults are those of a model in which nothing moves."""

    gaussians: int
    times: int
    min_psnr: float  # dB
    limits: dict[str, int]  # by limit of the model: the Gaussians that are clamped to it
    broken: list[str]  # why no plan at all can show this model
    layers: list[str] = field(default_factory=list)
    median_amplification: float = 1.0
    worst_amplification: float = 1.0
    layer_growth: list[list[float]] = field(default_factory=list)  # per layer: median, 99.9 % and max of ‖J_k … J_1‖
    predicted_psnr: float = 100.0  # dB, worst frame, means displaced as the amplification predicts
    float32: Float32Gap | None = None
    worst: WorstGaussians | None = None
    unstable: list[str] = field(default_factory=list)  # why layers can't be run in float32
    samples: Samples = field(default_factory=Samples, repr=False)

    @property
    def stable(self) -> bool:
        """Whether plans that run the layers may be used."""
        return not (self.broken or self.unstable)

    @property
    def verdict(self) -> str:
        """The result in words, with a remedy."""
        if self.broken:
            return "can't be shown: " + "; ".join(self.broken)
        if self.unstable:
            return f"unstable in float32: {'; '.join(self.unstable)}. Use {_remedy()}"
        if not self.layers or not self.gaussians:
            return "stable: nothing moves"
        return "stable: float32 agrees with float64, any plan may be used"

    def refusal(self, plan: str) -> str | None:
        """Why `plan` must not be used for this model, with the remedy; None if it may."""
        if self.broken:
            return "; ".join(self.broken)
        if self.unstable and not plan_of(plan).fitted:
            problem = "; ".join(self.unstable)
            return f"the plan `{plan}` computes the layers in float32, and {problem}; use {_remedy()}"
        return None

    def require(self, plan: str) -> None:
        """Raise `PlanUnsafe` if `plan` must not be used."""
        if problem := self.refusal(plan):
            raise PlanUnsafe(problem)

    def to_plain(self) -> dict[str, Any]:
        """Plain values for JSON, without the samples; infinities become None."""
        plain = {k: v for k, v in asdict(self).items() if k != "samples"}
        return {"stable": self.stable, "verdict": self.verdict, **_without_infinities(plain)}


@torch.no_grad()
def limits_met(model: DynamicGaussians, scales: list[np.ndarray]) -> dict[str, int]:
    """Numbers of Gaussians that are clamped by each limit of the model, without zeros. `scales` are posed ones, [M, 3]
    per time."""
    g = model.gaussians
    with np.errstate(divide="ignore", invalid="ignore"):
        posed = [(np.abs(np.log(s)) >= LOG_SCALE_LIMIT * AT_LIMIT).any(axis=1).sum() for s in scales]
    found = {
        f"canonical scales at e^±{LOG_SCALE_LIMIT:g}": (g.log_scales.abs() >= LOG_SCALE_LIMIT).any(dim=1).sum(),
        f"scales at e^±{LOG_SCALE_LIMIT:g}, most at one time": max(posed, default=0),
        "quaternions without a direction": (torch.linalg.vector_norm(g.raw_quats, dim=1) < MIN_NORM).sum(),
    }
    for name, factors in model.modulation(g.embeddings).items() if model.modulation is not None else ():
        bounded = factors.log().abs() >= MAX_LOG_FACTOR * AT_LIMIT
        found[f"modulation of {name} at e^±{MAX_LOG_FACTOR:g}"] = bounded.any(dim=1).sum()
    return {limit: int(count) for limit, count in found.items() if count}


def _remedy() -> str:
    fitted = " or ".join(f"`{plan.usage}`" for plan in PLANS.values() if plan.fitted)
    return f"a plan that is fitted to float64 poses: {fitted}"


def _without_infinities(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _without_infinities(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_without_infinities(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
