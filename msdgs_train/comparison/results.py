"""Results of the runs of a comparison: metrics, sizes, training time and frame time."""

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch

from msdgs_serve.scene.metadata import SceneCamera
from msdgs_train.comparison.matrix import Run
from msdgs_train.comparison.runner import final_metrics, is_finished
from msdgs_train.engine.metrics_log import read_metrics
from msdgs_train.engine.run import EVAL_SPLITS
from msdgs_train.engine.run_record import MODEL
from msdgs_train.gaussians.stored import StoredModel, load_stored

TIMED_FRAMES = 8


class CurvePoint(NamedTuple):
    """PSNR on held-out images at one step of training."""

    step: int
    seconds: float
    psnr: float


@dataclass(frozen=True)
class Result:
    """One finished run; metrics are those of the last model, after the whole budget."""

    run: Run
    split: str
    psnr: float  # dB
    ssim: float
    deformation_parameters: int  # of a volume all
    modulation_parameters: int  # embeddings included
    gaussians: int
    seconds: float  # training time, evaluations included
    skipped: int
    frame_ms: float  # deforming and rendering one held-out view, median
    curve: list[CurvePoint]


def collect(runs: Sequence[Run]) -> list[Result]:
    """Collect the results of the finished runs; frames are timed one after the other."""
    return [_result(run) for run in runs if is_finished(run)]


def _result(run: Run) -> Result:
    metrics = final_metrics(run) or {}
    split = next(name for name in EVAL_SPLITS if name in metrics["splits"] and name in run.splits)
    lines = read_metrics(run.folder)
    loaded = load_stored(run.folder / MODEL)
    counts = loaded.parameter_counts
    return Result(
        run=run,
        split=split,
        psnr=metrics["splits"][split]["psnr"],
        ssim=metrics["splits"][split]["ssim"],
        deformation_parameters=counts.motion,
        modulation_parameters=counts.modulation,
        gaussians=metrics["gaussians"],
        seconds=metrics["seconds"],
        skipped=max((line["skipped"] for line in lines if line["kind"] == "train"), default=0),
        frame_ms=frame_milliseconds(loaded, run.config.run.threads),
        curve=_curve(lines, split),
    )


def frame_milliseconds(loaded: StoredModel, threads: int) -> float:
    """Return the median frame time over some of its cameras, after an untimed frame, with `threads` of torch."""
    torch.set_num_threads(threads)
    times = []
    for i, entry in enumerate([loaded.scene.cameras[0], *loaded.scene.cameras[:TIMED_FRAMES]]):
        camera = SceneCamera.from_plain(entry).camera
        start = time.perf_counter()
        loaded.render(camera, entry["t"])
        if i:
            times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times)


def _curve(lines: list[dict[str, Any]], split: str) -> list[CurvePoint]:
    train = [line for line in lines if line["kind"] == "train"]
    steps, seconds = ([line[key] for line in train] for key in ("step", "seconds"))
    return [
        CurvePoint(line["step"], float(np.interp(line["step"], steps, seconds)), line["psnr"])
        for line in lines
        if line["kind"] == "eval" and line["split"] == split
    ]
