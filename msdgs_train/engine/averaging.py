"""The mean of a model over its last steps, each of which fits a few images a little at the cost of the others."""

import copy
from typing import Any

import torch

from msdgs_train.gaussians.model import DynamicGaussians


class WeightAverage:
    """All steps weigh the same until there are `steps`; from then on it is exponential, and about a third of the weight
    is older than `steps`."""

    def __init__(self, steps: int) -> None:
        self.model: DynamicGaussians | None = None  # None: of no step
        self._most, self._count = steps, 0

    @torch.no_grad()
    def add(self, model: DynamicGaussians) -> None:
        """A step more; all must have the same Gaussians, in the same order."""
        self._count = min(self._count + 1, self._most)
        if self.model is None:
            self.model = copy.deepcopy(model)
            return
        for mean, last in zip(self.model.parameters(), model.parameters(), strict=True):
            if last.requires_grad:
                mean.lerp_(last, 1 / self._count)

    def reset(self) -> None:
        """All steps up to now."""
        self.model, self._count = None, 0

    def state(self) -> dict[str, Any] | None:
        """What `load_state` takes; None of no step."""
        return None if self.model is None else {"model": self.model.state_dict(), "count": self._count}

    def load_state(self, state: dict[str, Any] | None, model: DynamicGaussians) -> None:
        """Go on from there; `model` is of the last step."""
        self.reset()
        if state is not None:
            self.model, self._count = copy.deepcopy(model), state["count"]
            self.model.load_state_dict(state["model"])
