"""May a model's layers be computed in float32 when a frame is served? Measured in the image, foretold beforehand."""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import torch

from export.precision.amplification import Growth, growth
from export.precision.formats import FLOAT32, Format, in_format
from export.precision.frames import NEAR, ImageGap, View, image_gap
from export.precision.gap import PosedArrays, finite_rows, half_diagonal, largest_error, pose_arrays, pose_errors
from export.verify import times_to_verify
from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.errors import MsdgsError
from msdgs_train.checkpoint import SceneInfo
from msdgs_train.model import DynamicGaussians

MAX_ERROR = 50.0
"""dB. Errors above it are invisible: the export's own default."""

TIMES = 20
SAMPLED = 2_000
"""Gaussians whose amplification is followed at each time, others at each next one."""

FRAME_TIMES = 2
FRAME_CAMERAS = 2
"""Pictures are drawn at the times and from the cameras where float32 is furthest off."""

WORST_PART = 0.001
"""The Gaussians looked at one by one."""

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
    median: float  # of the largest relative error of each Gaussian, `export.precision.gap`
    near_worst: float  # the 99.9th percentile
    worst: float
    pixels: float  # largest distance of a projected mean
    psnr: float  # dB, worst frame
    worst_pixel: float  # in that frame, [0, 1]
    psnr_without_worst: float  # dB, the same frame with the worst 0.1 % taken from float64
    overflowed: int  # Gaussians with a pose that is NaN or infinite


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
    max_error: float  # dB
    median_amplification: float
    worst_amplification: float
    layer_growth: list[list[float]]  # for each layer median, 99.9th percentile and maximum of ‖J_k … J_1‖
    predicted_psnr: float  # dB, worst frame, means displaced by what amplification lets expect
    formats: list[FormatGap]
    worst: WorstGaussians | None
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
            return f"the plan `{plan}` computes the layers in float32 or less, and {'; '.join(self.unsteady)}. {REMEDY}"
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


def assess(
    model: DynamicGaussians,
    scene: SceneInfo,
    *,
    max_error: float = MAX_ERROR,
    times: int = TIMES,
    formats: Sequence[Format] = (FLOAT32,),
    on_time: Callable[[], object] = lambda: None,
) -> StabilityReport:
    """Compare the model in float32, and in `formats`, with itself in float64: poses at `times` times, pictures at the
    worst of them. `max_error`, in dB, is what counts as visible. The model isn't changed."""
    if not len(model.deformation) or not len(model.gaussians):
        on_time()
        return _at_rest(model, scene, max_error, times)
    return _Assessment(model, scene, max_error, formats).run(times, on_time)


class _Assessment:
    def __init__(self, model: DynamicGaussians, scene: SceneInfo, max_error: float, formats: Sequence[Format]) -> None:
        self.scene, self.max_error = scene, max_error
        self.size = half_diagonal(scene.bounds)
        self.count = len(model.gaussians)
        self.formats = (FLOAT32, *(f for f in formats if f is not FLOAT32))
        self.models = {f.name: in_format(model, f) for f in self.formats}
        self.single = self.models[FLOAT32.name]
        self.double = in_format(model, Format("float64", torch.float64, torch.float64, "nowhere", "the reference"))
        self.view = View(scene)

    def run(self, times: int, on_time: Callable[[], object]) -> StabilityReport:
        moments, parts, errors = times_to_verify(*self.scene.time_range, times), [], {f.name: [] for f in self.formats}
        stride = max(1, math.ceil(self.count / SAMPLED))
        broken = 0
        for i, t in enumerate(moments):
            ids = np.arange(i % stride, self.count, stride)
            exact = pose_arrays(self.double, t, ids)
            broken += int((~finite_rows(exact)).sum())
            parts.append((self._growth(t, ids), exact["means"], pose_arrays(self.single, t, ids)["means"]))
            for name, model in self.models.items():
                errors[name].append(largest_error(pose_errors(pose_arrays(model, t, ids), exact, self.size)))
            on_time()
        return self._report(times, moments, parts, errors, broken)

    def _growth(self, t: float, ids: np.ndarray) -> Growth:
        means = self.double.gaussians.means.detach()[torch.from_numpy(ids)]
        return growth(self.double.deformation, self.single.deformation, means, float(np.float32(t)))

    def _report(
        self,
        times: int,
        moments: list[float],
        parts: list[tuple[Growth, np.ndarray, np.ndarray]],
        errors: dict[str, list[np.ndarray]],
        broken: int,
    ) -> StabilityReport:
        samples = _joined(parts)
        by_time = [np.quantile(e, 1 - WORST_PART, method="higher") for e in errors[FLOAT32.name]]
        chosen = [moments[i] for i in np.argsort(by_time, kind="stable")[::-1][:FRAME_TIMES]]
        frames = [self._moment(t, samples) for t in dict.fromkeys(chosen)]
        gaps = [self._format_gap(f, errors[f.name], [m[f.name] for m, _, _ in frames]) for f in self.formats]
        predicted = min(prediction for _, prediction, _ in frames)
        problems = [f"{broken:,} poses are NaN or infinite even in float64"] if broken else []
        if self.view.hidden_by_near_plane(self.double.gaussians.means.detach().numpy()):
            problems.append(_hidden())
        return StabilityReport(
            gaussians=self.count,
            layers=[layer.kind for layer in self.double.deformation.layers],  # type: ignore[misc]
            times=times,
            max_error=self.max_error,
            median_amplification=float(np.median(samples.amplification)),
            worst_amplification=float(samples.amplification.max()),
            layer_growth=[
                [float(np.quantile(a, q, method="higher")) for q in (0.5, 1 - WORST_PART, 1.0)] for a in samples.after
            ],
            predicted_psnr=predicted,
            formats=gaps,
            worst=frames[0][2],
            broken=problems,
            unsteady=self._unsteady(gaps[0], predicted),
            samples=samples,
        )

    def _unsteady(self, gap: FormatGap, predicted: float) -> list[str]:
        if gap.overflowed:
            return [f"{gap.overflowed:,} Gaussians overflow in float32"]
        if gap.psnr < self.max_error:
            return [
                f"their float32 round-off is visible: {gap.psnr:.1f} dB in the worst frame, under {self.max_error:g}"
            ]
        if predicted < self.max_error:
            seen = (
                f"none was at the times tried ({gap.psnr:.1f} dB), but its amplification lets expect {predicted:.1f} dB"
            )
            return [f"their float32 round-off may be visible: {seen}, under {self.max_error:g}"]
        return []

    def _moment(self, t: float, samples: Samples) -> tuple[dict[str, "_FrameGap"], float, WorstGaussians]:
        """Pictures of one time: gaps by format, dB of the predicted displacement, the worst Gaussians of float32."""
        exact = pose_arrays(self.double, t)
        posed = {name: pose_arrays(model, t) for name, model in self.models.items()}
        cameras = self._cameras(posed[FLOAT32.name], exact)
        pictures = [(camera, self.view.draw(exact, camera)) for camera in cameras]
        gaps = {name: self._frame_gap(pose, exact, pictures) for name, pose in posed.items()}
        displaced = exact | {"means": self._displaced(exact["means"], t, samples)}
        predicted = min(image_gap(self.view.draw(displaced, c), picture).psnr for c, picture in pictures)
        return gaps, predicted, self._worst(t, posed[FLOAT32.name], exact, pictures)

    def _cameras(self, posed: PosedArrays, exact: PosedArrays) -> list[Camera]:
        """Those from which the pose is furthest off, in pixels."""
        gaps = [np.square(self.view.pixel_gaps(posed, exact, camera)).sum() for camera in self.view.cameras]
        return [self.view.cameras[i] for i in np.argsort(gaps, kind="stable")[::-1][:FRAME_CAMERAS]]

    def _displaced(self, means: np.ndarray, t: float, samples: Samples) -> np.ndarray:
        """Means moved by the predicted distance into directions drawn by lot; those not sampled take one of another."""
        stride = max(1, math.ceil(self.count / SAMPLED))
        ids = np.arange(0, self.count, stride)
        rng = np.random.default_rng(0)
        distances = rng.choice(samples.predicted, len(means))
        distances[ids] = self._growth(t, ids).predicted
        directions = rng.normal(size=means.shape)
        return means + distances[:, None] * directions / np.linalg.norm(directions, axis=1, keepdims=True)

    def _frame_gap(
        self, posed: PosedArrays, exact: PosedArrays, pictures: list[tuple[Camera, np.ndarray]]
    ) -> "_FrameGap":
        worst = _worst_ids(posed, exact, self.size)
        healed = {name: array.copy() for name, array in posed.items()}
        for name, array in healed.items():
            array[worst] = exact[name][worst]
        frames = [
            (image_gap(self.view.draw(posed, c), p), image_gap(self.view.draw(healed, c), p).psnr) for c, p in pictures
        ]
        gap, without = min(frames, key=lambda frame: frame[0].psnr)
        pixels = max(float(self.view.pixel_gaps(posed, exact, c).max(initial=0)) for c, _ in pictures)
        return _FrameGap(gap, without, pixels, int((~finite_rows(posed)).sum()))

    def _worst(
        self, t: float, posed: PosedArrays, exact: PosedArrays, pictures: list[tuple[Camera, np.ndarray]]
    ) -> WorstGaussians:
        ids = _worst_ids(posed, exact, self.size)
        means = np.nan_to_num(exact["means"][ids])
        center = means.mean(axis=0)
        low, high = np.array(self.scene.bounds)
        canonical = self.double.gaussians.means.detach().numpy()[ids]
        others = np.ones(self.count, bool)
        others[ids] = False
        return WorstGaussians(
            t=t,
            ids=ids.tolist(),
            center=center.tolist(),
            spread=float(np.linalg.norm(means - center, axis=1).mean()) / self.size,
            outside_bounds=int(((means < low) | (means > high)).any(axis=1).sum()),
            moved=float(np.median(np.linalg.norm(means - canonical, axis=1))) / self.size,
            pixels=max(float(self.view.pixel_gaps(posed, exact, c)[ids].max(initial=0)) for c, _ in pictures),
            drawn_psnr=min(image_gap(self.view.draw(exact, c, keep=others), p).psnr for c, p in pictures),
        )

    def _format_gap(self, number_format: Format, errors: list[np.ndarray], moments: list["_FrameGap"]) -> FormatGap:
        every = np.concatenate(errors)
        worst = min(moments, key=lambda moment: moment.image.psnr)
        median, near_worst, largest = (
            float(np.quantile(every, q, method="higher")) for q in (0.5, 1 - WORST_PART, 1.0)
        )
        return FormatGap(
            name=number_format.name,
            meaning=number_format.meaning,
            median=median,
            near_worst=near_worst,
            worst=largest,
            pixels=max(moment.pixels for moment in moments),
            psnr=worst.image.psnr,
            worst_pixel=worst.image.worst_pixel,
            psnr_without_worst=worst.without_worst,
            overflowed=max(max(moment.overflowed for moment in moments), max(int(np.isinf(e).sum()) for e in errors)),
        )


@dataclass(frozen=True)
class _FrameGap:
    image: ImageGap
    without_worst: float
    pixels: float
    overflowed: int


def _at_rest(model: DynamicGaussians, scene: SceneInfo, max_error: float, times: int) -> StabilityReport:
    """Of a model that has nothing to deform."""
    none = np.ones(0)
    hidden = len(model.gaussians) and View(scene).hidden_by_near_plane(model.gaussians.means.detach().numpy())
    return StabilityReport(
        gaussians=len(model.gaussians),
        layers=[],
        times=times,
        max_error=max_error,
        median_amplification=1.0,
        worst_amplification=1.0,
        layer_growth=[],
        predicted_psnr=100.0,
        formats=[],
        worst=None,
        broken=[_hidden()] if hidden else [],
        unsteady=[],
        samples=Samples(none, none, none, np.ones((0, 0))),
    )


def _hidden() -> str:
    return (
        f"all that the cameras have in front of them is within {NEAR} scene units, nearer than the near plane; scale "
        "the scene up before training"
    )


def _worst_ids(posed: PosedArrays, exact: PosedArrays, size: float) -> np.ndarray:
    """The worst part of the Gaussians, at least one, the worst first."""
    errors = largest_error(pose_errors(posed, exact, size))
    return np.argsort(errors, kind="stable")[::-1][: math.ceil(WORST_PART * len(errors))]


def _joined(parts: list[tuple[Growth, np.ndarray, np.ndarray]]) -> Samples:
    growths = [growth for growth, _, _ in parts]
    distances = [np.linalg.norm(single - exact, axis=1) for _, exact, single in parts]
    return Samples(
        amplification=np.concatenate([g.amplification for g in growths]),
        distance=np.concatenate([np.where(np.isfinite(d), d, math.inf) for d in distances]),
        predicted=np.concatenate([g.predicted for g in growths]),
        after=np.concatenate([g.after for g in growths], axis=1),
    )


def _without_infinities(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _without_infinities(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_without_infinities(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
