"""Adam that leaves entries without a gradient alone, as grids need of which a step sees a part."""

import math
from typing import Any

import torch
from torch import Tensor

from msdgs_train.layers import arrays


class MaskedAdam(torch.optim.Adam):
    """Adam; in groups with `skips_zero`, entries whose gradient is 0 keep their value and their moments."""

    @torch.no_grad()
    def step(self, closure: Any = None) -> Any:
        for group in self.param_groups:
            for parameter in group["params"] if group.get("skips_zero") else ():
                if parameter.grad is not None:
                    self._step_where_seen(group, parameter, parameter.grad)
                    parameter.grad = None
        return super().step(closure)

    def _step_where_seen(self, group: dict[str, Any], parameter: Tensor, gradient: Tensor) -> None:
        state = self.state[parameter]
        if not state:
            state["step"] = torch.zeros((), device=parameter.device)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
        if arrays.has_kernels(parameter):
            _update_places(group, parameter, gradient, state)
        else:
            _update_all(group, parameter, gradient, state, getattr(self, "found_inf", None))


def _update_places(group: dict[str, Any], parameter: Tensor, gradient: Tensor, state: dict[str, Tensor]) -> None:
    """Read and write the entries that have a gradient alone."""
    state["step"] += 1
    step, (beta1, beta2) = float(state["step"]), group["betas"]
    places = torch.nonzero(gradient.view(-1))[:, 0]
    seen = gradient.view(-1)[places]
    first, second = state["exp_avg"].view(-1), state["exp_avg_sq"].view(-1)
    first[places] = beta1 * first[places] + (1 - beta1) * seen
    second[places] = beta2 * second[places] + (1 - beta2) * seen.square()
    size = group["lr"] * math.sqrt(1 - beta2**step) / (1 - beta1**step)
    change = size * first[places] / (second[places].sqrt() + group["eps"])
    parameter.view(-1).index_add_(0, places, change, alpha=-1)


def _update_all(
    group: dict[str, Any], parameter: Tensor, gradient: Tensor, state: dict[str, Tensor], broken: Tensor | None
) -> None:
    """As `_update_places`, without waiting for a device; nothing changes if `broken`, a scalar, is 1."""
    seen = gradient != 0
    if broken is not None:
        seen &= broken == 0
    state["step"] += 1 if broken is None else 1 - broken
    step, (beta1, beta2) = state["step"].double(), group["betas"]
    first, second = state["exp_avg"], state["exp_avg_sq"]
    first.copy_(torch.where(seen, beta1 * first + (1 - beta1) * gradient, first))
    second.copy_(torch.where(seen, beta2 * second + (1 - beta2) * gradient.square(), second))
    size = group["lr"] * (1 - beta2**step).sqrt() / (1 - beta1**step)
    parameter.sub_(torch.where(seen, size * first / (second.sqrt() + group["eps"]), 0.0))
