"""Groups of parameters: what they are called, who trains them, and how their learning rate falls."""

from typing import Literal, NamedTuple

from torch import nn

Role = Literal["static", "motion", "binding"]
"""Canonical attributes; deformation; and which node a Gaussian follows, which only complete samples train."""


class LearningRate(NamedTuple):
    """Exponential decay from `init` to `final`."""

    init: float
    final: float
    holds: bool = False  # at `init` until all times take part

    def at(self, step: float, num_steps: int, full_window_step: int) -> float:
        """The rate of one step of a run."""
        held = full_window_step if self.holds else 0
        return exponential(self.init, self.final, max(step - held, 0), num_steps - held)


def constant(rate: float) -> LearningRate:
    """A rate that stays."""
    return LearningRate(rate, rate)


def exponential(init: float, final: float, step: float, steps: float) -> float:
    """From `init` at step 0 to `final` at `steps`, along a straight line in the logarithm; `final` ever after."""
    return init * (final / init) ** (min(step / steps, 1.0) if steps > 0 else 0.0)


class ParamGroup(NamedTuple):
    """Parameters with one learning rate."""

    name: str  # unique in a model
    params: list[nn.Parameter]
    lr: LearningRate
    role: Role
    is_clipped: bool = False  # whether their gradients are clipped, all clipped groups of a model together
