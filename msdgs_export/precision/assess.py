"""Whether a model's layers may be computed in float32 when a frame is served.

It is measured in frames, and predicted from the amplification of errors by the layers.
"""

import copy
import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from msdgs_export.measure.amplification import Growth, growth
from msdgs_export.measure.frames import NEAR, FrameDifference, PoseRenderer, compare
from msdgs_export.measure.poses import half_diagonal, largest_error, pose_errors, posed, usable_rows
from msdgs_export.measure.times import times_to_verify
from msdgs_export.precision.report import Float32Gap, Samples, StabilityReport, WorstGaussians, limits_met
from msdgs_export.progress import Track, no_progress
from msdgs_export.target import MIN_PSNR
from msdgs_serve.scene.camera import Camera
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.gaussians.model_file import SceneInfo

TIMES = 20
SAMPLED = 2_000
"""Gaussians per time whose amplification is computed; others at each next time."""

FRAME_TIMES, FRAME_CAMERAS = 2, 2
"""Frames are rendered at the times and from the cameras with the largest errors of float32."""

WORST_FRACTION = 0.001
"""Fraction of the Gaussians, those with the largest errors, that is reported separately."""

NEAR_WORST = 1 - WORST_FRACTION

_Frames = list[tuple[Camera, np.ndarray]]


class _TimeSample(NamedTuple):
    """Some of the Gaussians at one time."""

    t: float
    ids: np.ndarray
    growth: Growth
    exact: Gaussians  # float64
    single_means: np.ndarray
    errors: np.ndarray  # [M] the largest of each Gaussian


class _FrameGap(NamedTuple):
    """The worst frame in float32 at one time."""

    difference: FrameDifference
    without_worst: float  # dB
    pixels: float
    overflowed: int


def assess(
    model: DynamicGaussians,
    scene: SceneInfo,
    *,
    min_psnr: float = MIN_PSNR,
    times: int = TIMES,
    track: Track = no_progress,
) -> StabilityReport:
    """Compare the model in float32 with itself in float64: poses at `times` times, frames at the worst of them. Errors
    under `min_psnr`, in dB, count as visible. The model isn't changed."""
    if not len(model.deformation) or not len(model.gaussians):
        broken = _hidden(PoseRenderer(scene), model) if len(model.gaussians) else []
        return StabilityReport(len(model.gaussians), times, min_psnr, limits_met(model, []), broken)
    with np.errstate(over="ignore", invalid="ignore"):  # overflow is part of the report
        return _Assessment(model, scene, min_psnr).run(times, track)


class _Assessment:
    def __init__(self, model: DynamicGaussians, scene: SceneInfo, min_psnr: float) -> None:
        self.model, self.scene, self.min_psnr = model, scene, min_psnr
        self.size, self.count = half_diagonal(scene.bounds), len(model.gaussians)
        self.single, self.double = copy.deepcopy(model).float(), copy.deepcopy(model).double()
        self.mean_factors = _mean_factors(self.double)
        self.renderer = PoseRenderer(scene, model.rasterizer)

    def run(self, times: int, track: Track) -> StabilityReport:
        found, on_time = [], track("stability of the layers", times)
        stride = max(1, math.ceil(self.count / SAMPLED))
        for i, t in enumerate(times_to_verify(*self.scene.time_range, times)):
            found.append(self._sample(t, np.arange(i % stride, self.count, stride)))
            on_time()
        samples = _joined(found)
        by_error = sorted(found, key=lambda m: np.quantile(m.errors, NEAR_WORST, method="higher"))
        on_step = track("poses and frames in float32 and float64", 0)
        frames = [self._frames(sample, samples, on_step) for sample in by_error[::-1][:FRAME_TIMES]]
        gap = _float32_gap(found, [frame_gap for frame_gap, _, _ in frames])
        predicted = min(prediction for _, prediction, _ in frames)
        overflowed = sum(int((~usable_rows(sample.exact)).sum()) for sample in found)
        broken = [f"{overflowed:,} poses are NaN or infinite even in float64"] if overflowed else []
        return StabilityReport(
            gaussians=self.count,
            layers=[layer.kind for layer in self.model.config.layers],
            times=times,
            min_psnr=self.min_psnr,
            median_amplification=float(np.median(samples.amplification)),
            worst_amplification=float(samples.amplification.max()),
            layer_growth=[[_quantile(a, q) for q in (0.5, NEAR_WORST, 1.0)] for a in samples.after],
            predicted_psnr=predicted,
            float32=gap,
            worst=frames[0][2],
            limits=limits_met(self.double, [sample.exact.scales for sample in found]),
            broken=broken + _hidden(self.renderer, self.double),
            unstable=self._unstable(gap, predicted),
            samples=samples,
        )

    def _sample(self, t: float, ids: np.ndarray) -> _TimeSample:
        exact, single = posed(self.double, t, ids), posed(self.single, t, ids)
        errors = largest_error(pose_errors(single, exact, self.size))
        found = growth(self.double, self.single, torch.from_numpy(ids), float(np.float32(t)))
        found = found._replace(predicted=found.predicted * self.mean_factors[ids])
        return _TimeSample(t, ids, found, exact, single.means, errors)

    def _unstable(self, gap: Float32Gap, predicted: float) -> list[str]:
        if gap.overflowed:
            return [f"{gap.overflowed:,} Gaussians overflow in float32"]
        if gap.psnr < self.min_psnr:
            return [f"float32 round-off is visible: {gap.psnr:.1f} dB in the worst frame, under {self.min_psnr:g}"]
        if predicted < self.min_psnr:
            found = f"{gap.psnr:.1f} dB at the times tried, but {predicted:.1f} dB predicted from the amplification"
            return [f"float32 round-off may be visible: {found}, under {self.min_psnr:g}"]
        return []

    def _frames(
        self, sample: _TimeSample, joined: Samples, on_step: Callable[[], object]
    ) -> tuple[_FrameGap, float, WorstGaussians]:
        """Frames at one time: the gap of float32, PSNR of the predicted displacement, the worst Gaussians."""
        exact, draw = posed(self.double, sample.t, on_block=on_step), self.renderer.draw
        single = posed(self.single, sample.t, on_block=on_step)
        gaps = [np.square(self.renderer.pixel_gaps(single, exact, c)).sum() for c in self.renderer.cameras]
        cameras = [self.renderer.cameras[i] for i in np.argsort(gaps, kind="stable")[::-1][:FRAME_CAMERAS]]
        frames = [(camera, draw(exact, camera)) for camera in cameras]
        on_step()
        frame_gap = self._frame_gap(single, exact, frames)
        on_step()
        displaced = replace(exact, means=_displaced(exact.means, sample, joined))
        predicted = min(compare(draw(displaced, camera), frame).psnr for camera, frame in frames)
        return frame_gap, predicted, self._worst(sample.t, single, exact, frames)

    def _frame_gap(self, got: Gaussians, exact: Gaussians, frames: _Frames) -> _FrameGap:
        without_worst = Gaussians(*(array.copy() for array in vars(got).values()))
        worst = _worst_ids(got, exact, self.size)
        for name, array in vars(without_worst).items():
            array[worst] = getattr(exact, name)[worst]
        draw = self.renderer.draw
        pairs = [(compare(draw(got, c), frame), compare(draw(without_worst, c), frame).psnr) for c, frame in frames]
        gap, without = min(pairs, key=lambda pair: pair[0].psnr)
        pixels = max(float(self.renderer.pixel_gaps(got, exact, c).max(initial=0)) for c, _ in frames)
        return _FrameGap(gap, without, pixels, int((~usable_rows(got)).sum()))

    def _worst(self, t: float, got: Gaussians, exact: Gaussians, frames: _Frames) -> WorstGaussians:
        ids = _worst_ids(got, exact, self.size)
        means = np.nan_to_num(exact.means[ids])
        center = means.mean(axis=0)
        low, high = np.array(self.scene.bounds)
        canonical = self.double.gaussians.means.detach().numpy()[ids]
        others = np.ones(self.count, bool)
        others[ids] = False
        return WorstGaussians(
            t=t,
            ids=ids.tolist(),
            center=self.scene.placement.to_world(center).tolist(),
            spread=float(np.linalg.norm(means - center, axis=1).mean()) / self.size,
            outside_bounds=int(((means < low) | (means > high)).any(axis=1).sum()),
            moved=float(np.median(np.linalg.norm(means - canonical, axis=1))) / self.size,
            pixels=max(float(self.renderer.pixel_gaps(got, exact, c)[ids].max(initial=0)) for c, _ in frames),
            drawn_psnr=min(compare(self.renderer.draw(exact, c, keep=others), frame).psnr for c, frame in frames),
        )


def _float32_gap(samples: list[_TimeSample], frames: list[_FrameGap]) -> Float32Gap:
    errors = np.concatenate([sample.errors for sample in samples])
    worst = min(frames, key=lambda frame: frame.difference.psnr)
    return Float32Gap(
        median=_quantile(errors, 0.5),
        near_worst=_quantile(errors, NEAR_WORST),
        worst=float(errors.max()),
        pixels=max(frame.pixels for frame in frames),
        psnr=worst.difference.psnr,
        worst_pixel=worst.difference.worst_pixel,
        psnr_without_worst=worst.without_worst,
        overflowed=max(frame.overflowed for frame in frames),
    )


@torch.no_grad()
def _mean_factors(model: DynamicGaussians) -> np.ndarray:
    """[N] largest modulation factor of each mean's displacement; 1 if means aren't modulated."""
    factors = None if model.modulation is None else model.modulation(model.gaussians.embeddings).get("means")
    return np.ones(len(model.gaussians)) if factors is None else factors.amax(dim=1).numpy()


def _hidden(renderer: PoseRenderer, model: DynamicGaussians) -> list[str]:
    if not renderer.hidden_by_near_plane(model.gaussians.means.detach().numpy()):
        return []
    near = f"everything in front of the cameras is within {NEAR} scene units, nearer than the near plane"
    return [f"{near}; scale the scene up before training"]


def _worst_ids(got: Gaussians, exact: Gaussians, size: float) -> np.ndarray:
    """Ids of the Gaussians with the largest errors, at least one, the worst first."""
    errors = largest_error(pose_errors(got, exact, size))
    return np.argsort(errors, kind="stable")[::-1][: math.ceil(WORST_FRACTION * len(errors))]


def _joined(samples: list[_TimeSample]) -> Samples:
    distances = [np.linalg.norm(sample.single_means - sample.exact.means, axis=1) for sample in samples]
    return Samples(
        amplification=np.concatenate([sample.growth.amplification for sample in samples]),
        distance=np.concatenate([np.where(np.isfinite(d), d, math.inf) for d in distances]),
        predicted=np.concatenate([sample.growth.predicted for sample in samples]),
        after=np.concatenate([sample.growth.after for sample in samples], axis=1),
    )


def _displaced(means: np.ndarray, sample: _TimeSample, joined: Samples) -> np.ndarray:
    """Means moved by the predicted distance in random directions; Gaussians not sampled take that of another."""
    rng = np.random.default_rng(0)
    distances = rng.choice(joined.predicted, len(means))
    distances[sample.ids] = sample.growth.predicted
    directions = rng.normal(size=means.shape)
    return means + distances[:, None] * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _quantile(values: np.ndarray, part: float) -> float:
    return float(np.quantile(values, part, method="higher"))
