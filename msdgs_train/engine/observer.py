"""The callbacks of a run, which may also pause or stop it."""

from collections.abc import Callable

from msdgs_train.engine.trainer import StepResult, Trainer
from msdgs_train.evaluation.metrics import ImageMetrics


class Observer:
    """Callbacks that do nothing; subclasses override those that they need. Called between steps, from one thread."""

    def on_train_start(self, trainer: Trainer) -> None:
        """Called before the first step, also of a resumed run."""

    def step(self, result: StepResult, seconds: float) -> None:
        """Called after every step; `seconds` is the training time so far."""

    def evaluation(self, step: int, split: str, metrics: ImageMetrics) -> None:
        """Called after a split has been evaluated."""

    def rolled_back(self, reason: str, step: int, lr_factor: float) -> None:
        """Called when training has diverged and returned to `step`; learning rates are multiplied by `lr_factor`."""

    def should_stop(self) -> bool:
        """Called after every step; if true, the run saves a checkpoint and returns."""
        return False

    def is_paused(self) -> bool:
        """Called after every step; while true, the run waits and calls it again."""
        return False


class Observers(Observer):
    """Several observers, called in order; each may pause or stop the run."""

    def __init__(self, *observers: Observer) -> None:
        for name in ("on_train_start", "step", "evaluation", "rolled_back", "should_stop", "is_paused"):
            setattr(self, name, _call_all([getattr(observer, name) for observer in observers]))


def _call_all(callbacks: list[Callable[..., bool | None]]) -> Callable[..., bool]:
    """Combine callbacks into one, which returns true if any of them does; those that return nothing are all called."""
    return lambda *arguments: any(callback(*arguments) for callback in callbacks)
