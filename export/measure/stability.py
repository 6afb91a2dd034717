"""May a model's layers be computed in float32 when a frame is served? Measured in the image, foretold beforehand."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch

from export.measure.amplification import Growth, growth
from export.measure.frames import NEAR, ImageGap, View, image_gap
from export.measure.gap import PosedArrays, half_diagonal, largest_error, pose_arrays, pose_errors, usable_rows
from export.measure.verify import times_to_verify
from export.precision.formats import FLOAT32, Format, in_format
from export.precision.limits import limits_met
from export.precision.report import FormatGap, Samples, StabilityReport, WorstGaussians
from msdgs_serve.scene.camera import Camera
from msdgs_train.gaussians.model import DynamicGaussians, carried
from msdgs_train.gaussians.model_file import SceneInfo

MIN_PSNR = 50.0
"""dB. Errors above it are invisible: the export's own default."""

TIMES = 20
SAMPLED = 2_000
"""Gaussians whose amplification is followed at each time, others at each next one."""

FRAME_TIMES = 2
FRAME_CAMERAS = 2
"""Images are drawn at the times and from the cameras where float32 is furthest off."""

WORST_PART = 0.001
"""The Gaussians looked at one by one."""

NEAR_WORST = 1 - WORST_PART


def assess(
    model: DynamicGaussians,
    scene: SceneInfo,
    *,
    min_psnr: float = MIN_PSNR,
    times: int = TIMES,
    formats: Sequence[Format] = (FLOAT32,),
    on_time: Callable[[], object] = lambda: None,
) -> StabilityReport:
    """Compare the model in float32, and in `formats`, with itself in float64: poses at `times` times, images at the
    worst of them. `min_psnr`, in dB, is what counts as visible. The model isn't changed."""
    if not len(model.deformation) or not len(model.gaussians):
        on_time()
        return _at_rest(model, scene, min_psnr, times)
    with np.errstate(over="ignore", invalid="ignore"):  # here they are findings
        return _Assessment(model, scene, min_psnr, formats).run(times, on_time)


class _Assessment:
    def __init__(self, model: DynamicGaussians, scene: SceneInfo, min_psnr: float, formats: Sequence[Format]) -> None:
        self.model, self.scene, self.min_psnr = model, scene, min_psnr
        self.size = half_diagonal(scene.bounds)
        self.count = len(model.gaussians)
        self.formats = (FLOAT32, *(f for f in formats if f is not FLOAT32))
        self.models = {f.name: in_format(model, f) for f in self.formats}
        self.single = self.models[FLOAT32.name]
        self.double = in_format(model, Format("float64", torch.float64, torch.float64, "nowhere", "the reference"))
        self.mean_factors = _mean_factors(self.double)
        self.view = View(scene, model.rasterizer)

    def run(self, times: int, on_time: Callable[[], object]) -> StabilityReport:
        moments = []
        stride = max(1, math.ceil(self.count / SAMPLED))
        for i, t in enumerate(times_to_verify(*self.scene.time_range, times)):
            moments.append(self._moment(t, np.arange(i % stride, self.count, stride)))
            on_time()
        samples = _joined(moments)
        by_error = sorted(moments, key=lambda m: np.quantile(m.errors[FLOAT32.name], NEAR_WORST, method="higher"))
        frames = [self._frames(moment, samples) for moment in by_error[::-1][:FRAME_TIMES]]
        gaps = [self._format_gap(f, moments, [gaps[f.name] for gaps, _, _ in frames]) for f in self.formats]
        predicted = min(prediction for _, prediction, _ in frames)
        return StabilityReport(
            gaussians=self.count,
            layers=list(self.model.config.layers),
            times=times,
            min_psnr=self.min_psnr,
            median_amplification=float(np.median(samples.amplification)),
            worst_amplification=float(samples.amplification.max()),
            layer_growth=[[_quantile(a, q) for q in (0.5, NEAR_WORST, 1.0)] for a in samples.after],
            predicted_psnr=predicted,
            formats=gaps,
            worst=frames[0][2],
            limits=limits_met(self.double, [m.exact["scales"] for m in moments]),
            broken=self._broken(moments),
            unsteady=self._unsteady(gaps[0], predicted),
            samples=samples,
        )

    def _moment(self, t: float, ids: np.ndarray) -> "_Moment":
        exact = pose_arrays(self.double, t, ids)
        poses = {name: pose_arrays(model, t, ids) for name, model in self.models.items()}
        errors = {name: largest_error(pose_errors(pose, exact, self.size)) for name, pose in poses.items()}
        with torch.no_grad():
            rows = self.double.gaussians.rows(torch.from_numpy(ids))
            followed = carried(rows)
        found = growth(self.double.deformation, self.single.deformation, rows.means, float(np.float32(t)), followed)
        found = found._replace(predicted=found.predicted * self.mean_factors[ids])
        return _Moment(t, ids, found, exact, poses[FLOAT32.name]["means"], errors)

    def _broken(self, moments: list["_Moment"]) -> list[str]:
        overflowed = sum(int((~usable_rows(moment.exact)).sum()) for moment in moments)
        problems = [f"{overflowed:,} poses are NaN or infinite even in float64"] if overflowed else []
        hidden = self.view.hidden_by_near_plane(self.double.gaussians.means.detach().numpy())
        return [*problems, _hidden()] if hidden else problems

    def _unsteady(self, gap: FormatGap, predicted: float) -> list[str]:
        if gap.overflowed:
            return [f"{gap.overflowed:,} Gaussians overflow in float32"]
        if gap.psnr < self.min_psnr:
            return [f"float32 round-off is visible: {gap.psnr:.1f} dB in the worst frame, under {self.min_psnr:g}"]
        if predicted < self.min_psnr:
            seen = (
                f"none was at the times tried ({gap.psnr:.1f} dB), but its amplification lets expect {predicted:.1f} dB"
            )
            return [f"float32 round-off may be visible: {seen}, under {self.min_psnr:g}"]
        return []

    def _frames(self, moment: "_Moment", samples: Samples) -> tuple[dict[str, "_FrameGap"], float, WorstGaussians]:
        """Images of one time: gaps by format, dB of the predicted displacement, the worst Gaussians of float32."""
        exact = pose_arrays(self.double, moment.t)
        posed = {name: pose_arrays(model, moment.t) for name, model in self.models.items()}
        cameras = self._cameras(posed[FLOAT32.name], exact)
        pictures = [(camera, self.view.draw(exact, camera)) for camera in cameras]
        gaps = {name: self._frame_gap(pose, exact, pictures) for name, pose in posed.items()}
        displaced = exact | {"means": _displaced(exact["means"], moment, samples)}
        predicted = min(image_gap(self.view.draw(displaced, c), picture).psnr for c, picture in pictures)
        return gaps, predicted, self._worst(moment.t, posed[FLOAT32.name], exact, pictures)

    def _cameras(self, posed: PosedArrays, exact: PosedArrays) -> list[Camera]:
        """Those from which the pose is furthest off, in pixels."""
        gaps = [np.square(self.view.pixel_gaps(posed, exact, camera)).sum() for camera in self.view.cameras]
        return [self.view.cameras[i] for i in np.argsort(gaps, kind="stable")[::-1][:FRAME_CAMERAS]]

    def _frame_gap(
        self, posed: PosedArrays, exact: PosedArrays, pictures: list[tuple[Camera, np.ndarray]]
    ) -> "_FrameGap":
        worst = _worst_ids(posed, exact, self.size)
        outliers_replaced = {name: array.copy() for name, array in posed.items()}
        for name, array in outliers_replaced.items():
            array[worst] = exact[name][worst]
        frames = [
            (image_gap(self.view.draw(posed, c), p), image_gap(self.view.draw(outliers_replaced, c), p).psnr)
            for c, p in pictures
        ]
        gap, without = min(frames, key=lambda frame: frame[0].psnr)
        pixels = max(float(self.view.pixel_gaps(posed, exact, c).max(initial=0)) for c, _ in pictures)
        return _FrameGap(gap, without, pixels, int((~usable_rows(posed)).sum()))

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

    def _format_gap(self, number_format: Format, moments: list["_Moment"], frames: list["_FrameGap"]) -> FormatGap:
        errors = np.concatenate([moment.errors[number_format.name] for moment in moments])
        worst = min(frames, key=lambda frame: frame.image.psnr)
        return FormatGap(
            name=number_format.name,
            meaning=number_format.meaning,
            median=_quantile(errors, 0.5),
            near_worst=_quantile(errors, NEAR_WORST),
            worst=float(errors.max()),
            pixels=max(frame.pixels for frame in frames),
            psnr=worst.image.psnr,
            worst_pixel=worst.image.worst_pixel,
            psnr_without_worst=worst.without_worst,
            overflowed=max(frame.overflowed for frame in frames),
        )


class _Moment(NamedTuple):
    """One time, at which some Gaussians were looked at."""

    t: float
    ids: np.ndarray
    growth: Growth
    exact: PosedArrays  # float64
    single_means: np.ndarray
    errors: dict[str, np.ndarray]  # the largest of each Gaussian, by format


class _FrameGap(NamedTuple):
    image: ImageGap
    without_worst: float
    pixels: float
    overflowed: int


@torch.no_grad()
def _mean_factors(model: DynamicGaussians) -> np.ndarray:
    """[N] what the modulation multiplies a Gaussian's whole displacement by, at most; 1 where it leaves means alone."""
    factors = None if model.modulation is None else model.modulation(model.gaussians.embeddings).means
    return np.ones(len(model.gaussians)) if factors is None else factors.amax(dim=1).numpy()


def _at_rest(model: DynamicGaussians, scene: SceneInfo, min_psnr: float, times: int) -> StabilityReport:
    """Of a model that has nothing to deform."""
    none = np.ones(0)
    hidden = len(model.gaussians) and View(scene).hidden_by_near_plane(model.gaussians.means.detach().numpy())
    return StabilityReport(
        gaussians=len(model.gaussians),
        layers=[],
        times=times,
        min_psnr=min_psnr,
        median_amplification=1.0,
        worst_amplification=1.0,
        layer_growth=[],
        predicted_psnr=100.0,
        formats=[],
        worst=None,
        limits=limits_met(model, []),
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


def _joined(moments: list[_Moment]) -> Samples:
    distances = [np.linalg.norm(moment.single_means - moment.exact["means"], axis=1) for moment in moments]
    return Samples(
        amplification=np.concatenate([moment.growth.amplification for moment in moments]),
        distance=np.concatenate([np.where(np.isfinite(d), d, math.inf) for d in distances]),
        predicted=np.concatenate([moment.growth.predicted for moment in moments]),
        after=np.concatenate([moment.growth.after for moment in moments], axis=1),
    )


def _displaced(means: np.ndarray, moment: _Moment, samples: Samples) -> np.ndarray:
    """Means moved by the predicted distance into directions drawn by lot; those not looked at take one of another."""
    rng = np.random.default_rng(0)
    distances = rng.choice(samples.predicted, len(means))
    distances[moment.ids] = moment.growth.predicted
    directions = rng.normal(size=means.shape)
    return means + distances[:, None] * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _quantile(values: np.ndarray, part: float) -> float:
    return float(np.quantile(values, part, method="higher"))
