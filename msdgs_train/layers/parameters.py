"""Parameter groups: names and learning rates."""

from typing import NamedTuple

from torch import nn


class LearningRate(NamedTuple):
    """Exponential decay from `init` to `final`."""

    init: float
    final: float
    holds: bool = False  # whether it stays at `init` until all times take part
    until: float = 1.0  # fraction of the run at which it reaches `final`

    def at(self, step: float, num_steps: int, full_window_step: int) -> float:
        """The rate of one step of a run."""
        held = full_window_step if self.holds else 0
        return exponential(self.init, self.final, max(step - held, 0), self.until * num_steps - held)


def constant(rate: float) -> LearningRate:
    """A constant rate."""
    return LearningRate(rate, rate)


def exponential(init: float, final: float, step: float, steps: float) -> float:
    """Log-linear from `init` at step 0 to `final` at `steps`; `final` after that."""
    return init * (final / init) ** (min(step / steps, 1.0) if steps > 0 else 0.0)


class ParamGroup(NamedTuple):
    """Parameters with one learning rate."""

    name: str  # unique in a model
    params: list[nn.Parameter]
    lr: LearningRate
    is_clipped: bool = False  # whether their gradients are clipped, all clipped groups of a model together
    skips_zero: bool = False  # whether entries without a gradient keep their value and their moments
