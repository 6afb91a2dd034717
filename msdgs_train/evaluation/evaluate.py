"""Evaluation of the last and the best model of a run on held-out images."""

import statistics
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from msdgs_train.datasets import DatasetInvalid, Frame, SceneData, composite, load_scene
from msdgs_train.datasets.identity import differences, identity
from msdgs_train.engine.run_record import BEST, MODEL, RECORD, Best, RunInvalid, read_config, read_record
from msdgs_train.evaluation.metrics import image_metrics, masked_psnr
from msdgs_train.evaluation.moving_region import moving_region
from msdgs_train.evaluation.perceptual import PerceptualMetrics, perceptual_metrics
from msdgs_train.gaussians.stored import StoredModel, load_stored
from msdgs_train.losses.photometric import filled

FILES = {"last": MODEL, "best": BEST}


class Scores(NamedTuple):
    """Metrics of one rendering; None for those that are unavailable."""

    psnr: float  # dB, data range 1
    ssim: float  # window 11, σ = 1.5
    lpips: float | None  # VGG-16, of images scaled to [−1, 1], its definition
    lpips_01: float | None  # of images in [0, 1], as the field's scripts
    flip: float | None  # mean ꟻLIP
    moving_psnr: float | None  # dB, over the pixels of the moving region; None if nothing moves


class EvaluatedModel(NamedTuple):
    """One model of a run and its scores."""

    name: str  # "last" or "best"
    loaded: StoredModel
    images: list[Scores]  # in the order of the split's frames

    @property
    def mean(self) -> Scores:
        """The mean over the images that have a score; None if none has."""
        columns = [[value for value in column if value is not None] for column in zip(*self.images, strict=True)]
        return Scores(*(statistics.fmean(column) if column else None for column in columns))  # type: ignore[arg-type]

    def render(self, frame: Frame) -> Tensor:
        """Render [H, W, 3] in [0, 1] with the camera and time of the frame."""
        return self.loaded.render(frame.camera, frame.t).clamp(0, 1)

    def image(self, frame: Frame) -> Tensor:
        """Read the image of the frame, [H, W, 3] in [0, 1], over the background that the model was trained with."""
        return torch.from_numpy(composite(frame.load_rgba(), self.loaded.scene.background))


class Evaluation(NamedTuple):
    """The results of a run's models on one split."""

    data: Path
    split: str
    frames: list[Frame]
    models: list[EvaluatedModel]  # last, and best if the run has one
    best: Best | None  # how the best one was selected
    region_source: str  # "images" or "model": the source of the moving region; "none" if it is unknown
    masks: list[np.ndarray]  # [H, W] bool per frame, the moving region; the same for all models
    unavailable: dict[str, str]  # scores that could not be computed, with the reason
    differing: list[str]  # in what the dataset isn't the one of the run


def evaluate_run(
    run: Path,
    data: Path | None = None,
    split: str = "test",
    progress: Callable[[int, int], None] | None = None,
    *,
    brief: bool = False,
) -> Evaluation:
    """Evaluate `model.pt` and, if there is one, `best.pt` of the run in folder `run` on a split; if `brief`, without
    `best.pt` and ꟻLIP.

    The other arguments are the options of `msdgs-train eval`; `progress` is called with (done, total) images.

    Raises `RunInvalid`, `CheckpointInvalid` and `DatasetInvalid`, which name the file that is missing or broken.
    """
    settings = read_config(run).data
    names = [name for name, file in FILES.items() if name == "last" or (not brief and (run / file).exists())]
    loaded = {name: load_stored(run / FILES[name]) for name in names}
    data = _data_folder(run, data)
    scene = load_scene(data, settings.size, settings.llffhold, settings.time_from, settings.masks)
    record = read_record(run)
    differing = differences(record.dataset, identity(scene)) if record else []
    scene = scene.in_frame(loaded["last"].scene.placement)
    frames = _frames(scene, data, split)
    region = moving_region(scene, split, list(loaded.values()))
    perceptual = perceptual_metrics(with_flip=not brief)
    models = [EvaluatedModel(name, model, []) for name, model in loaded.items()]
    masks = []
    for index, frame in enumerate(frames):
        masks.append(region.mask(frame))
        for place, evaluated in enumerate(models):
            rgb, target = evaluated.render(frame), evaluated.image(frame)
            evaluated.images.append(scores(rgb, target, masks[-1], perceptual, frame.load_mask()))
            if progress is not None:
                progress(index * len(models) + place + 1, len(frames) * len(models))
    best = record.best if record and "best" in loaded else None
    unavailable = dict(perceptual.unavailable)
    if region.source == "none":
        unavailable["moving_psnr"] = "cameras aren't fixed, and what moves in a volume is unknown"
    return Evaluation(data, split, frames, models, best, region.source, masks, unavailable, differing)


def scores(
    rgb: Tensor,
    target: Tensor,
    moving: np.ndarray,
    perceptual: PerceptualMetrics,
    counts: np.ndarray | None = None,
) -> Scores:
    """Score a rendering against its image, [H, W, 3] in [0, 1], by the pixels that count, [H, W] bool; None: all.

    `moving`, [H, W] bool, is the moving region. LPIPS and ꟻLIP are means over all pixels, with no error in those that
    don't count.
    """
    psnr, ssim = image_metrics(rgb, target, counts)
    if counts is not None:
        rgb, moving = filled(rgb, target, torch.from_numpy(counts)), moving & counts
    others = {name: metric(rgb, target) for name, metric in perceptual.metrics.items()}
    lpips, lpips_01, flip = (others.get(name) for name in ("lpips", "lpips_01", "flip"))
    return Scores(psnr, ssim, lpips, lpips_01, flip, masked_psnr(rgb, target, moving))


def _data_folder(run: Path, data: Path | None) -> Path:
    if data is not None:
        return data.absolute()
    record = read_record(run)
    if record is None:
        problem = f"no such file, so the dataset has to be given: msdgs-train eval {run} --data DATA"
        raise RunInvalid(run / RECORD, problem)
    if not record.data.is_dir():
        problem = f"does not exist; if it is elsewhere now: msdgs-train eval {run} --data DATA"
        raise DatasetInvalid(record.data, "folder", problem)
    return record.data


def _frames(scene: SceneData, data: Path, split: str) -> list[Frame]:
    if not scene.splits.get(split):
        others = [f"`{name}` with {len(frames)}" for name, frames in scene.splits.items() if frames]
        raise DatasetInvalid(data, split, f"has no images; there are {', '.join(others)}")
    return scene.splits[split]
