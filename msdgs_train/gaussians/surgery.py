"""Adding, removing and resetting rows of the Gaussians' parameters together with Adam's moments.

Density control changes the number of Gaussians during a run. Each row of a parameter has a row of first and second
moments, which stays with it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from msdgs_train.gaussians.canonical import CanonicalGaussians

MOMENTS = frozenset({"exp_avg", "exp_avg_sq"})
"""Entries of Adam's state with a row per row of a parameter."""


@dataclass(frozen=True)
class RowSurgery:
    """Changes Gaussians and the state of their optimizer at once; parameter groups are found by attribute name."""

    gaussians: CanonicalGaussians
    optimizer: torch.optim.Optimizer

    def learning_rate(self, name: str) -> float:
        """The current rate of an attribute."""
        return next(group["lr"] for group in self.optimizer.param_groups if group["name"] == name)

    def replace_rows(self, kept: Tensor, added: Mapping[str, Tensor]) -> None:
        """Keep the rows `kept`, [M] indices, of every parameter, and append the rows `added`.

        The moments of kept rows stay as they are; those of added rows start at zero.
        """
        for name, old in list(self.gaussians.named_parameters()):
            rows = added[name]
            new = nn.Parameter(torch.cat([old.detach()[kept], rows]), old.requires_grad)
            self._replace(name, new, lambda moment, rows=rows: torch.cat([moment[kept], torch.zeros_like(rows)]))

    def reset_moments(self, rows: Tensor) -> None:
        """Set the moments of some rows, [M] indices, of every parameter to zero."""
        for parameter in self.gaussians.parameters():
            state = self.optimizer.state.get(parameter, {})  # empty before the first gradient
            for moment in MOMENTS & state.keys():
                state[moment][rows] = 0

    def replace_values(self, name: str, values: Tensor) -> None:
        """Set one parameter to `values`, of the same shape, and its moments to zero."""
        new = nn.Parameter(values, getattr(self.gaussians, name).requires_grad)
        self._replace(name, new, torch.zeros_like)

    def _replace(self, name: str, new: nn.Parameter, on_moments: Callable[[Tensor], Tensor]) -> None:
        old = getattr(self.gaussians, name)
        setattr(self.gaussians, name, new)
        if not new.requires_grad:
            return
        group = next(group for group in self.optimizer.param_groups if group["name"] == name)
        group["params"] = [new]
        state = self.optimizer.state.pop(old, None)
        if state is not None:
            for moment in MOMENTS:
                state[moment] = on_moments(state[moment])
            self.optimizer.state[new] = state
