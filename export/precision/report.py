"""What an assessment of stability found, and what follows from it for the plans of an export."""

import math
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from msdgs_serve.scene.errors import MsdgsError

CHAINED_PLANS = frozenset({"network", "prefix", "int8"})
"""Plans that run the layers when a frame is served, in float32 or less; others are fitted to float64 poses offline."""

REMEDY = "choose a plan that is fitted to float64 poses when it is written, `lowrank` or `keyframes`"


class PlanUnsafe(MsdgsError):
    """A plan would show round-off that the model itself doesn't have."""


@dataclass(frozen=True)
class FormatGap:
    """What one number format does to the pose and to the image, against float64."""

    name: str
    meaning: str
    median: float  # of the largest relative error of each Gaussian, `export.measure.gap`
    near_worst: float  # the 99.9th percentile
    worst: float
    pixels: float  # largest distance of a projected mean
    psnr: float  # dB, worst frame
    worst_pixel: float  # in that frame, [0, 1]
    psnr_without_worst: float  # dB, the same frame with the worst 0.1 % taken from float64
    overflowed: int  # Gaussians with a pose that is NaN or infinite, or without a rotation


@dataclass(frozen=True)
class WorstGaussians:
    """The 0.1 % that float32 gets most wrong, at the worst moment."""

    t: float
    ids: list[int]  # the worst first
    center: list[float]  # [3] mean of their float64 means, scene units
    spread: float  # their mean distance from it, as part of the scene's half diagonal
    outside_bounds: int
    moved: float  # median distance from their canonical means, as part of the half diagonal
    pixels: float  # largest distance of a projected mean
    drawn_psnr: float  # dB, the float64 frame with against without them: how much is seen of them at all


@dataclass(frozen=True)
class Samples:
    """One row a Gaussian and time looked at."""

    amplification: np.ndarray  # [S]
    distance: np.ndarray  # [S] of the float32 mean from the float64 one, scene units
    predicted: np.ndarray  # [S] what amplification lets expect of it
    after: np.ndarray  # [K, S] growth after each layer


@dataclass(frozen=True)
class StabilityReport:
    """What `assess` found. `steady` says whether plans that run the layers may be used."""

    gaussians: int
    layers: list[str]
    times: int
    min_psnr: float  # dB
    median_amplification: float
    worst_amplification: float
    layer_growth: list[list[float]]  # for each layer median, 99.9th percentile and maximum of ‖J_k … J_1‖
    predicted_psnr: float  # dB, worst frame, means displaced by what amplification lets expect
    formats: list[FormatGap]
    worst: WorstGaussians | None
    limits: dict[str, int]  # Gaussians that a bound of the model holds back, by what it is
    broken: list[str]  # why no plan at all can show this model
    unsteady: list[str]  # why float32 layers can't
    samples: Samples = field(repr=False)

    @property
    def steady(self) -> bool:
        return not (self.broken or self.unsteady)

    @property
    def verdict(self) -> str:
        """One sentence, or several, on what to do."""
        if self.broken:
            return "can't be shown: " + "; ".join(self.broken)
        if self.unsteady:
            return "unsteady in float32: " + "; ".join(self.unsteady) + f". {REMEDY[0].upper()}{REMEDY[1:]}"
        if not self.layers or not self.gaussians:
            return "steady: nothing moves"
        return "steady: float32 shows what float64 shows, any plan may be used"

    def refusal(self, plan: str) -> str | None:
        """Why `plan` must not be used for this model, with the remedy; None if it may."""
        if self.broken:
            return "; ".join(self.broken)
        if plan.split(":")[0] in CHAINED_PLANS and self.unsteady:
            return f"the plan `{plan}` computes the layers in float32 or less, and {'; '.join(self.unsteady)}; {REMEDY}"
        return None

    def require(self, plan: str) -> None:
        """Raise `PlanUnsafe` where `plan` must not be used."""
        problem = self.refusal(plan)
        if problem:
            raise PlanUnsafe(problem)

    def to_plain(self) -> dict[str, Any]:
        """Plain values for JSON, without the samples; infinities become None."""
        plain = {k: v for k, v in asdict(self).items() if k != "samples"}
        return {"steady": self.steady, "verdict": self.verdict, **_without_infinities(plain)}


def _without_infinities(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _without_infinities(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_without_infinities(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
