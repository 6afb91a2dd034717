"""The result of an assessment of stability, and what follows from it for the plans of an export."""

import math
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from export.plans.registry import PLANS, plan_of
from msdgs_serve.scene.errors import MsdgsError

NO_VALUES = np.ones(0)


class PlanUnsafe(MsdgsError):
    """A plan would show round-off that the model itself doesn't have."""


@dataclass(frozen=True)
class FormatGap:
    """What one number format does to poses and frames, against float64."""

    name: str
    meaning: str
    median: float  # of the largest relative error of each Gaussian, `export.measure.poses`
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
    center: list[float]  # [3] mean of their float64 means, scene units
    spread: float  # their mean distance from it, as a fraction of the scene's half diagonal
    outside_bounds: int
    moved: float  # median distance from their canonical means, as a fraction of the half diagonal
    pixels: float  # largest distance of a projected mean
    drawn_psnr: float  # dB, the float64 frame with against without them: how much of them is visible at all


@dataclass(frozen=True)
class Samples:
    """One row per sampled Gaussian and time."""

    amplification: np.ndarray = field(default_factory=NO_VALUES.copy)  # [S]
    distance: np.ndarray = field(default_factory=NO_VALUES.copy)  # [S] float32 mean to float64 mean, scene units
    predicted: np.ndarray = field(default_factory=NO_VALUES.copy)  # [S] the distance predicted by the amplification
    after: np.ndarray = field(default_factory=lambda: np.ones((0, 0)))  # [K, S] growth after each layer


@dataclass(frozen=True)
class StabilityReport:
    """What `assess` found. `stable` says whether plans that run the layers may be used. The defaults are those of a
    model in which nothing moves."""

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
    formats: list[FormatGap] = field(default_factory=list)
    worst: WorstGaussians | None = None
    unstable: list[str] = field(default_factory=list)  # why layers can't be run in float32
    samples: Samples = field(default_factory=Samples, repr=False)

    @property
    def stable(self) -> bool:
        return not (self.broken or self.unstable)

    @property
    def verdict(self) -> str:
        """One sentence, or several, on what to do."""
        if self.broken:
            return "can't be shown: " + "; ".join(self.broken)
        if self.unstable:
            return f"unstable in float32: {'; '.join(self.unstable)}. Use {_remedy()}"
        if not self.layers or not self.gaussians:
            return "stable: nothing moves"
        return "stable: float32 shows what float64 shows, any plan may be used"

    def refusal(self, plan: str) -> str | None:
        """Why `plan` must not be used for this model, with the remedy; None if it may."""
        if self.broken:
            return "; ".join(self.broken)
        if self.unstable and not plan_of(plan).fitted:
            problem = "; ".join(self.unstable)
            return f"the plan `{plan}` computes the layers in float32 or less, and {problem}; use {_remedy()}"
        return None

    def require(self, plan: str) -> None:
        """Raise `PlanUnsafe` if `plan` must not be used."""
        problem = self.refusal(plan)
        if problem:
            raise PlanUnsafe(problem)

    def to_plain(self) -> dict[str, Any]:
        """Plain values for JSON, without the samples; infinities become None."""
        plain = {k: v for k, v in asdict(self).items() if k != "samples"}
        return {"stable": self.stable, "verdict": self.verdict, **_without_infinities(plain)}


def _remedy() -> str:
    fitted = " or ".join(f"`{plan.name}`" for plan in PLANS.values() if plan.fitted)
    return f"a plan that is fitted to float64 poses: {fitted}"


def _without_infinities(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _without_infinities(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_without_infinities(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
