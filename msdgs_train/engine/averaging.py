"""Exponential moving average of a model's weights, which reduces mini-batch noise."""

import copy
from typing import Any, Generic, TypeVar

import torch
from torch import nn

M = TypeVar("M", bound=nn.Module)


class WeightAverage(Generic[M]):
    """The mean of the first `steps` steps, an exponential moving average after that; about a third of its weight is
    older than `steps`."""

    def __init__(self, steps: int) -> None:
        self.model: M | None = None  # None before the first step
        self._most, self._count = steps, 0

    @torch.no_grad()
    def add(self, model: M, steps: int = 1) -> None:
        """Add a model that stands for so many steps; the Gaussians must be the same, in the same order."""
        if steps == 0:
            return
        self._count = min(self._count + steps, self._most)
        if self.model is None:
            self.model = copy.deepcopy(model)
            return
        fraction = min(steps / self._count, 1.0)
        for average, last in zip(self.model.parameters(), model.parameters(), strict=True):
            if last.requires_grad:
                average.lerp_(last, fraction)

    def reset(self) -> None:
        """Drop all steps up to now."""
        self.model, self._count = None, 0

    def state(self) -> dict[str, Any] | None:
        """The state for `load_state`; None before the first step."""
        return None if self.model is None else {"model": self.model.state_dict(), "count": self._count}

    def load_state(self, state: dict[str, Any] | None, model: M) -> None:
        """Continue from a state; `model` is that of the last step."""
        self.reset()
        if state is not None:
            self.model, self._count = copy.deepcopy(model), state["count"]
            self.model.load_state_dict(state["model"])
