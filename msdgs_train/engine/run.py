"""A training run in its folder: steps, evaluations, checkpoints, metrics and renderings."""

import contextlib
import fcntl
import json
import math
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import IO, Literal, NamedTuple

from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.writing import WriteFailed, write_text, writing
from msdgs_train.datasets import SceneData, load_scene
from msdgs_train.datasets.identity import identity
from msdgs_train.engine.clock import MAX_EVALUATION_SHARE, Clock
from msdgs_train.engine.config import TrainConfig, check_resumable
from msdgs_train.engine.meters import TrainingDiverged
from msdgs_train.engine.metrics_log import (
    MetricsLog,
    best_evaluations,
    draw_curve,
    read_metrics,
    write_side_by_side,
)
from msdgs_train.engine.observer import Observer
from msdgs_train.engine.run_record import (
    BEST,
    CHECKPOINT,
    CONFIG,
    FINAL_METRICS,
    LOCK,
    MODEL,
    Best,
    RunRecord,
    read_record,
    remove_temporaries,
    require_no_run,
    require_same_dataset,
    stored_config,
    write_config,
    write_record,
)
from msdgs_train.engine.schedule import Schedule, require_same_phase
from msdgs_train.engine.tensorboard_events import require_tensorboard
from msdgs_train.engine.trainer import StepResult, Trainer
from msdgs_train.evaluation.metrics import ImageMetrics, mean_metrics
from msdgs_train.rendering.rasterize import require_device

EVAL_SPLITS = ("test", "val")
SELECTION_SPLITS = ("val", "test")  # the first of these that the dataset has selects the best model
RENDERS_PER_EVAL = 4
MAX_ROLLBACKS = 3
TRIAL_STEPS = 4  # of a trainer that is thrown away, across the schedule
PAUSE_SECONDS = 0.05  # between two calls of `Observer.is_paused`

Status = Literal["finished", "interrupted"]


class RunResult(NamedTuple):
    """How a run has ended. An interrupted one can be resumed."""

    status: Status
    step: int  # of the schedule
    metrics: dict[str, ImageMetrics]  # by held-out split; empty if interrupted
    gaussians: int
    seconds: float  # of training, resumed parts and evaluations included, without the time to compile kernels
    best: Best | None  # the model in `best.pt`; None if nothing has been evaluated


@dataclass
class RunState:
    """A run that is ready to train, from its first step or from a checkpoint."""

    folder: Path
    trainer: Trainer
    log: MetricsLog
    record: RunRecord
    seconds: float  # trained before
    lock: IO[bytes]  # held while this process trains


def fit(
    config: TrainConfig,
    data: Path,
    run: Path,
    *,
    resume: bool = False,
    observer: Observer | None = None,
    tensorboard: bool = False,
) -> RunResult:
    """Train on the images in `data`; all results go to the folder `run`.

    With `tensorboard`, metrics and held-out renderings are also written to `run/tensorboard` as events.

    Raises `InvalidInput` if `run` holds another run and `resume` is false, or if the dataset differs, or a setting that
    a resumed run may not change; `ExtraMissing` if tensorboard isn't installed; and `WriteFailed`, after which the last
    checkpoint is whole.
    """
    try:
        state = prepare(config, data, run, resume=resume, tensorboard=tensorboard)
        with contextlib.closing(state.log), state.lock:
            return Run(state, observer or Observer()).execute()
    except WriteFailed as error:
        if not (run / CONFIG).exists():
            raise
        where = "from its last checkpoint" if (run / CHECKPOINT).exists() else "from its start"
        raise WriteFailed(error.filename, error, f"Then --resume continues the run {where}") from error


def prepare(config: TrainConfig, data: Path, folder: Path, *, resume: bool, tensorboard: bool) -> RunState:
    """Load the dataset, build the model or load its checkpoint, and write the first files of the folder."""
    require_device(config.run.device)
    if tensorboard:
        require_tensorboard()
    if resume:
        stored_config(folder)
    else:
        require_no_run(folder)
    with contextlib.ExitStack() as on_error:
        lock = on_error.enter_context(_locked(folder)) if resume else None
        stored, earlier = (stored_config(folder), read_record(folder)) if resume else (None, None)
        if stored:
            check_resumable(stored, config)
        d = config.data
        scene = load_scene(data, d.size, d.llffhold, d.time_from, d.masks)
        dataset = identity(scene)
        if earlier:
            require_same_dataset(folder, earlier, data, dataset)
        scene = scene.normalized()
        if earlier:
            scene = scene.in_frame(earlier.scene_to_world)
        trainer = Trainer(config, scene)
        continues = resume and (folder / CHECKPOINT).exists()
        seconds = trainer.load_checkpoint(folder / CHECKPOINT) if continues else 0.0
        if stored:
            if stored.run.steps != config.run.steps:
                if config.run.steps < trainer.step_count:
                    expected = f"{trainer.step_count} or more, as so many steps are done"
                    raise InvalidInput("config.steps", expected, config.run.steps)
                before, milestones = Schedule.from_config(stored), trainer.system.milestones
                require_same_phase(before, trainer.schedule, trainer.reached, milestones)
            if trainer.step_count >= config.run.steps and stored.run.minutes != config.run.minutes:
                raise InvalidInput("config.minutes", "unchanged, as the run is finished", config.run.minutes)
        if lock is None:
            lock = on_error.enter_context(_locked(folder))
            require_no_run(folder)  # another process may have trained there until now
        remove_temporaries(folder)
        write_config(folder, config)
        best = _best_so_far(folder, earlier, scene) if earlier else None
        record = RunRecord(data.absolute(), best, dataset, scene.scene_to_world)
        write_record(folder, record)
        is_finished = trainer.step_count >= config.run.steps  # its last model is evaluated again
        log = MetricsLog(
            folder, keep_until=trainer.step_count, keep_evaluations=not is_finished, tensorboard=tensorboard
        )
        on_error.pop_all()
    return RunState(folder, trainer, log, record, seconds, lock)


def _locked(folder: Path) -> IO[bytes]:
    """A file that is locked until it is closed or the process ends; refused if another process trains in the folder,
    which is created if it doesn't exist."""
    with writing(folder, str(folder)):
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / LOCK).open("wb")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        raise InvalidInput("run", "a folder in which no other process trains", folder) from None
    return file


class Run:
    """Takes the steps of a prepared run, and evaluates and saves at the intervals that its settings name."""

    def __init__(self, state: RunState, observer: Observer) -> None:
        self.folder, self.trainer, self.log, self.record = state.folder, state.trainer, state.log, state.record
        self.config, self.observer = state.trainer.config, observer
        self.splits = [split for split in EVAL_SPLITS if state.trainer.scene.splits.get(split)]
        self.selection_split = _selection_split(state.trainer.scene)
        self._now = time.process_time if self.config.run.time == "cpu" else time.perf_counter
        self.started = self._now() - state.seconds
        self.deforming_cost = 1.0  # in steps without deformation
        self.clock, self.advance = self._new_clock(), 1
        self.evaluation_seconds = MAX_EVALUATION_SHARE * state.seconds

    def execute(self) -> RunResult:
        """Train until the last step or an interruption, then evaluate and save."""
        self.observer.on_train_start(self.trainer)
        if self.clock and self.trainer.step_count < self.config.run.steps:
            self._prepare_clock()
        status = self._train()
        if not (status == "interrupted" and self.trainer.is_skipping and (self.folder / CHECKPOINT).exists()):
            self._save()
        metrics = {}
        if status != "interrupted":
            metrics = {split: self._evaluate(split, renders=None) for split in self.splits}
        self.log.flush()
        draw_curve(self.folder)
        if metrics:
            self._write_final_metrics(metrics)
        size = self.trainer.system.size
        return RunResult(status, self.trainer.step_count, metrics, size, self._seconds(), self.record.best)

    def _prepare_clock(self) -> None:
        """Compile kernels, which takes a minute on a new machine, and measure what motion costs, by a few steps of
        another trainer. Their time doesn't count as training time."""
        before, trial = self._now(), Trainer(self.config, self.trainer.scene)
        for _ in range(TRIAL_STEPS):
            if not self.observer.should_stop():
                trial.step(max(self.config.run.steps // TRIAL_STEPS, 1))
        for split in self.splits[:1]:
            next(trial.evaluate(split))
        if self._counts_static_steps() and not self.observer.should_stop():
            deform_start = self.trainer.schedule.deform_start_step
            self.deforming_cost = self._seconds_of_rehearsal(trial, deform_start) / self._seconds_of_rehearsal(trial, 0)
            self.clock = self._new_clock()
        self.started += self._now() - before

    def _counts_static_steps(self) -> bool:
        """Whether steps without deformation are left, in a loop in which they are a fraction of the steps."""
        schedule, start = self.trainer.schedule, self.trainer.schedule.deform_start_step
        return not schedule.grows_window and schedule.deforms(start) and self.trainer.step_count < start

    def _seconds_of_rehearsal(self, trial: Trainer, step: int) -> float:
        taken = []
        for _ in range(TRIAL_STEPS):
            before = self._now()
            trial.rehearse(step)
            taken.append(self._now() - before)
        return max(min(taken), 1e-9)

    def _train(self) -> Status:
        steps = self.config.run.steps
        while self.trainer.step_count < steps:
            before = self._now()
            try:
                result = self.trainer.step(self.advance)
            except TrainingDiverged as error:
                self._roll_back(error)
                continue
            taken = self._now() - before
            self._after_step(result)
            if self.clock:
                images = self.trainer.images_per_step
                self.advance = self.clock.advance(result.step, taken, images, self._seconds())
            if result.step < steps and self._is_stopped():
                return "interrupted"
        return "finished"

    def _roll_back(self, error: TrainingDiverged) -> None:
        """Return to the last checkpoint, or to the start, with lower learning rates."""
        if self.trainer.rollbacks >= MAX_ROLLBACKS:
            raise TrainingDiverged(
                f"{error}, after {MAX_ROLLBACKS} returns to a checkpoint with half the learning rates each; "
                "start a new run with lower ones"
            ) from error
        self.trainer.roll_back(self.folder / CHECKPOINT)
        self.clock, self.advance = self._new_clock(), 1
        self.log.rewind(self.trainer.step_count)
        self._save()
        self.observer.rolled_back(str(error), self.trainer.step_count, self.trainer.lr_factor)

    def _new_clock(self) -> Clock | None:
        run, splits = self.config.run, self.trainer.scene.splits
        held_out = sum(len(splits[split]) for split in self.splits)
        if not run.minutes:
            return None
        static = self.trainer.schedule.deform_start_step
        return Clock(run.steps, 60 * run.minutes, held_out, self.trainer.step_count, static, self.deforming_cost)

    def _is_stopped(self) -> bool:
        """Wait while paused, which doesn't count as training time; whether the run is to stop."""
        since = self._now()
        while self.observer.is_paused() and not self.observer.should_stop():
            time.sleep(PAUSE_SECONDS)
        self.started += self._now() - since
        return self.observer.should_stop()

    def _after_step(self, result: StepResult) -> None:
        every, is_last = self.config.logging, result.step == self.config.run.steps
        if is_last or _is_due(self.trainer.reached, every.log_every):
            self.log.train(result, self._seconds())
        self.observer.step(result, self._seconds())
        if is_last:
            return
        if _is_due(self.trainer.reached, every.eval_every) and self.splits and self._has_time_to_evaluate():
            before = self._now()
            for split in self.splits:
                self._evaluate(split, renders=RENDERS_PER_EVAL)
            draw_curve(self.folder)
            self.evaluation_seconds += self._now() - before
        if _is_due(self.trainer.reached, every.checkpoint_every) and not self.trainer.is_skipping:
            self._save()

    def _has_time_to_evaluate(self) -> bool:
        return self.clock is None or self.clock.allows_evaluation(self._seconds(), self.evaluation_seconds)

    def _evaluate(self, split: str, *, renders: int | None) -> ImageMetrics:
        """The mean metrics of a split; `renders` renderings, or all, are written beside their images."""
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
            self.record = replace(self.record, best=candidate)
            write_record(self.folder, self.record)

    def _save(self) -> None:
        self.log.flush()  # a run that is resumed from this checkpoint doesn't log earlier steps again
        self.trainer.save_checkpoint(self.folder / CHECKPOINT, self._seconds())
        self.trainer.system.save(self.folder / MODEL, self.trainer.step_count)

    def _write_final_metrics(self, splits: dict[str, ImageMetrics]) -> None:
        metrics = {
            "step": self.trainer.step_count,
            "optimizer_steps": self.trainer.optimizer_steps,
            "seconds": round(self._seconds(), 1),
            "gaussians": self.trainer.system.size,
            "splits": {split: metrics._asdict() for split, metrics in splits.items()},
            "best_evaluations": best_evaluations(read_metrics(self.folder)),
            "best": self.record.best and {"file": BEST, **asdict(self.record.best)},
        }
        write_text(self.folder / FINAL_METRICS, json.dumps(metrics, indent=2) + "\n")

    def _seconds(self) -> float:
        return self._now() - self.started


def _selection_split(scene: SceneData) -> str | None:
    return next((split for split in SELECTION_SPLITS if scene.splits.get(split)), None)


def _best_so_far(folder: Path, record: RunRecord, scene: SceneData) -> Best | None:
    best = record.best
    return best if best and best.split == _selection_split(scene) and (folder / BEST).exists() else None


def _is_due(steps: range, every: int) -> bool:
    """Whether one of the steps is a multiple of `every`."""
    return every > 0 and (steps.stop - 1) // every > (steps.start - 1) // every
