"""A whole run in its folder: steps, evaluations, checkpoints, and what is left to look at."""

import json
import math
import time
from dataclasses import asdict
from pathlib import Path
from typing import Literal, NamedTuple

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.datasets import SceneData, load_scene
from msdgs_train.engine.config import TrainConfig, check_resumable
from msdgs_train.engine.metrics_log import MetricsLog, draw_curve, write_side_by_side
from msdgs_train.engine.run_record import Best, RunInvalid, RunRecord, read_record, write_record
from msdgs_train.engine.tensorboard_events import require_tensorboard
from msdgs_train.engine.trainer import StepResult, Trainer, TrainingDiverged
from msdgs_train.evaluation.metrics import ImageMetrics, mean_metrics

CONFIG = "config.json"
CHECKPOINT = "checkpoint.pt"
MODEL = "model.pt"
BEST = "best.pt"
FINAL_METRICS = "metrics.json"
EVAL_SPLITS = ("test", "val")
SELECTION_SPLITS = ("val", "test")  # the first that the dataset has decides which model is the best
RENDERS_PER_EVAL = 4
MAX_ROLLBACKS = 3
PAUSE_SECONDS = 0.05  # between questions whether to go on

Status = Literal["finished", "interrupted", "out of time"]


class RunResult(NamedTuple):
    """How a run has ended. It can be resumed unless it is `finished`."""

    status: Status
    step: int
    metrics: dict[str, ImageMetrics]  # of each held-out split; none when interrupted
    gaussians: int
    seconds: float  # of training in all, evaluations included
    best: Best | None  # what `best.pt` is; None while nothing has been evaluated


class Observer:
    """Hears of what a run does. This one does nothing; the command line shows a progress bar."""

    def on_train_start(self, trainer: Trainer) -> None:
        """Before the first step, and again where a rollback has made a new trainer."""

    def step(self, result: StepResult, seconds: float) -> None:
        """After every step."""

    def evaluation(self, step: int, split: str, metrics: ImageMetrics) -> None:
        """After a split has been evaluated."""

    def rolled_back(self, reason: str, step: int, lr_factor: float) -> None:
        """After training has diverged and gone back to `step`, with the settings' learning rates times a factor."""

    def should_stop(self) -> bool:
        """Asked after every step; the run then saves a checkpoint and returns."""
        return False

    def is_paused(self) -> bool:
        """Asked after every step, and while it is true again and again; the run goes on when it isn't."""
        return False


class Observers(Observer):
    """Several, told one after the other; each may pause or stop the run."""

    def __init__(self, *observers: Observer) -> None:
        self.observers = observers

    def on_train_start(self, trainer: Trainer) -> None:
        for observer in self.observers:
            observer.on_train_start(trainer)

    def step(self, result: StepResult, seconds: float) -> None:
        for observer in self.observers:
            observer.step(result, seconds)

    def evaluation(self, step: int, split: str, metrics: ImageMetrics) -> None:
        for observer in self.observers:
            observer.evaluation(step, split, metrics)

    def rolled_back(self, reason: str, step: int, lr_factor: float) -> None:
        for observer in self.observers:
            observer.rolled_back(reason, step, lr_factor)

    def should_stop(self) -> bool:
        return any(observer.should_stop() for observer in self.observers)

    def is_paused(self) -> bool:
        return any(observer.is_paused() for observer in self.observers)


def stored_config(run: Path) -> TrainConfig:
    """The settings that a run began with. Raises `InvalidInput` where there is no such run."""
    path = run / CONFIG
    if not path.exists() or not (run / CHECKPOINT).exists():
        raise InvalidInput("run", "the folder of a run with a checkpoint, to resume it", run)
    try:
        return TrainConfig.from_dict(json.loads(path.read_text()))
    except (InvalidInput, ValueError, AttributeError, TypeError) as error:
        raise RunInvalid(path, f"can't be resumed, train again in a new folder: {error}") from error


def fit(
    config: TrainConfig,
    data: Path,
    run: Path,
    *,
    resume: bool = False,
    observer: Observer | None = None,
    tensorboard: bool = False,
) -> RunResult:
    """Train on the images in `data` and leave everything in the folder `run`.

    With `tensorboard`, `run/tensorboard` gets the metrics as events, and held-out renderings at every evaluation.

    Raises `InvalidInput` where `run` holds another run and `resume` is false, or where a resumed run would change
    settings that have shaped it, and `ExtraMissing` where tensorboard isn't installed.
    """
    if tensorboard:
        require_tensorboard()
    if resume:
        check_resumable(stored_config(run), config)
    elif (run / CHECKPOINT).exists():
        raise InvalidInput("run", "a new folder, or a run to go on with (--resume)", f"{run}, which holds a run")
    scene = load_scene(data, config.data.size)
    run.mkdir(parents=True, exist_ok=True)
    trainer = Trainer(config, scene)
    seconds = trainer.load_checkpoint(run / CHECKPOINT) if resume else 0.0
    (run / CONFIG).write_text(json.dumps(config.to_dict(), indent=2) + "\n")
    best = _best_so_far(run, scene) if resume else None
    if best is None:
        (run / BEST).unlink(missing_ok=True)
    record = RunRecord(data.absolute(), best)
    write_record(run, record)
    going = _Run(config, scene, run, trainer, observer or Observer(), seconds, record, tensorboard)
    try:
        return going.execute()
    finally:
        going.log.close()


def _selection_split(scene: SceneData) -> str | None:
    return next((split for split in SELECTION_SPLITS if scene.splits.get(split)), None)


def _best_so_far(run: Path, scene: SceneData) -> Best | None:
    record = read_record(run)
    best = record.best if record else None
    return best if best and best.split == _selection_split(scene) and (run / BEST).exists() else None


class _Run:
    def __init__(
        self,
        config: TrainConfig,
        scene: SceneData,
        folder: Path,
        trainer: Trainer,
        observer: Observer,
        seconds: float,
        record: RunRecord,
        tensorboard: bool,
    ) -> None:
        self.config = config
        self.scene = scene
        self.folder = folder
        self.trainer = trainer
        self.observer = observer
        self.record = record
        self.splits = [split for split in EVAL_SPLITS if scene.splits.get(split)]
        self.selection_split = _selection_split(scene)
        self.tensorboard = tensorboard
        self.log = self._open_log()
        self.started = time.perf_counter() - seconds

    def execute(self) -> RunResult:
        status: Status = "finished"
        self.observer.on_train_start(self.trainer)
        while self.trainer.step_count < self.config.run.steps and status == "finished":
            try:
                result = self.trainer.step()
            except TrainingDiverged as error:
                self._roll_back(error)
                continue
            self._after_step(result)
            if result.step < self.config.run.steps:
                status = self._reason_to_stop()
        metrics = {}
        if status != "interrupted":
            metrics = {split: self._evaluate(split, renders=None) for split in self.splits}
        self._save()
        draw_curve(self.folder)
        if metrics:
            self._write_final_metrics(metrics)
        count = self.trainer.system.size
        return RunResult(status, self.trainer.step_count, metrics, count, self._seconds(), self.record.best)

    def _open_log(self) -> MetricsLog:
        return MetricsLog(self.folder, keep_until=self.trainer.step_count, tensorboard=self.tensorboard)

    def _roll_back(self, error: TrainingDiverged) -> None:
        """Go on from the last checkpoint, or anew where there is none yet, with lower learning rates."""
        diverged = self.trainer
        if diverged.rollbacks >= MAX_ROLLBACKS:
            raise TrainingDiverged(
                f"{error}, after {MAX_ROLLBACKS} returns to a checkpoint with half the learning rates each; "
                "begin a new run with lower ones"
            ) from error
        self.trainer = Trainer(self.config, self.scene)
        if (self.folder / CHECKPOINT).exists():
            self.trainer.load_checkpoint(self.folder / CHECKPOINT)
        self.trainer.retry_after(diverged)
        self.log.close()
        self.log = self._open_log()
        self._save()
        self.observer.on_train_start(self.trainer)
        self.observer.rolled_back(str(error), self.trainer.step_count, self.trainer.lr_factor)

    def _reason_to_stop(self) -> Status:
        self._wait_while_paused()
        if self.observer.should_stop():
            return "interrupted"
        budget = self.config.run.max_minutes
        return "out of time" if budget is not None and self._seconds() >= 60 * budget else "finished"

    def _wait_while_paused(self) -> None:
        """Time that doesn't count as training."""
        since = time.perf_counter()
        while self.observer.is_paused() and not self.observer.should_stop():
            time.sleep(PAUSE_SECONDS)
        self.started += time.perf_counter() - since

    def _after_step(self, result: StepResult) -> None:
        if result.step % self.config.logging.log_every == 0 or result.step == self.config.run.steps:
            self.log.train(result, self._seconds())
        self.observer.step(result, self._seconds())
        if result.step < self.config.run.steps:
            if _is_due(result.step, self.config.logging.eval_every) and self.splits:
                for split in self.splits:
                    self._evaluate(split, renders=RENDERS_PER_EVAL)
                draw_curve(self.folder)
            if _is_due(result.step, self.config.logging.checkpoint_every) and not self.trainer.is_skipping:
                self._save()

    def _evaluate(self, split: str, *, renders: int | None) -> ImageMetrics:
        """The mean quality of a split; the first `renders` frames, or all, are written beside their images."""
        frames = []
        for index, evaluated in enumerate(self.trainer.evaluate(split)):
            frames.append(evaluated.metrics)
            if renders is None or index < renders:
                write_side_by_side(self.folder, split, evaluated)
            if index < RENDERS_PER_EVAL:
                self.log.image(self.trainer.step_count, split, evaluated)
        mean = mean_metrics(frames)
        self.log.evaluation(self.trainer.step_count, split, mean)
        self.observer.evaluation(self.trainer.step_count, split, mean)
        if split == self.selection_split and math.isfinite(mean.psnr):
            self._keep_if_best(Best(split, self.trainer.step_count, mean.psnr))
        return mean

    def _keep_if_best(self, candidate: Best) -> None:
        best = self.record.best
        if best is None or candidate.psnr > best.psnr:
            self.trainer.system.save(self.folder / BEST, self.trainer.step_count)
            self.record = RunRecord(self.record.data, candidate)
            write_record(self.folder, self.record)

    def _save(self) -> None:
        self.log.flush()  # a run that goes on from this checkpoint doesn't log again what came before it
        self.trainer.save_checkpoint(self.folder / CHECKPOINT, self._seconds())
        self.trainer.system.save(self.folder / MODEL, self.trainer.step_count)

    def _write_final_metrics(self, splits: dict[str, ImageMetrics]) -> None:
        metrics = {
            "step": self.trainer.step_count,
            "seconds": round(self._seconds(), 1),
            "gaussians": self.trainer.system.size,
            "splits": {split: metrics._asdict() for split, metrics in splits.items()},
            "best": self.record.best and {"file": BEST, **asdict(self.record.best)},
        }
        (self.folder / FINAL_METRICS).write_text(json.dumps(metrics, indent=2) + "\n")

    def _seconds(self) -> float:
        return time.perf_counter() - self.started


def _is_due(step: int, every: int) -> bool:
    return every > 0 and step % every == 0
