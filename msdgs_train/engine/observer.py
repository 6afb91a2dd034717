"""The callbacks of a run: what happens is reported to them, and they may pause or stop it."""

from msdgs_train.engine.trainer import StepResult, Trainer
from msdgs_train.evaluation.metrics import ImageMetrics


class Observer:
    """Callbacks that do nothing; subclasses override those that they need. Called between steps, from one thread."""

    def on_train_start(self, trainer: Trainer) -> None:
        """Before the first step, of a resumed run too."""

    def step(self, result: StepResult, seconds: float) -> None:
        """After every step; `seconds` of training so far."""

    def evaluation(self, step: int, split: str, metrics: ImageMetrics) -> None:
        """After a split has been evaluated."""

    def rolled_back(self, reason: str, step: int, lr_factor: float) -> None:
        """Training has diverged and returned to `step`; learning rates are those of the settings times `lr_factor`."""

    def should_stop(self) -> bool:
        """Asked after every step; if true, the run saves a checkpoint and returns."""
        return False

    def is_paused(self) -> bool:
        """Asked after every step; while true, the run waits and asks again."""
        return False


class Observers(Observer):
    """Several observers, called in order; each may pause or stop the run."""

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
