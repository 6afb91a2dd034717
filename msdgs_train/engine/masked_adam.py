"""Adam that leaves entries without a gradient alone, as grids need of which a step sees a part."""

import math
from typing import Any

import torch
from torch import Tensor


class MaskedAdam(torch.optim.Adam):
    """Adam; in groups with `skips_zero`, entries whose gradient is 0 keep their value and their moments."""

    @torch.no_grad()
    def step(self, closure: Any = None) -> Any:
        for group in self.param_groups:
            for parameter in group["params"] if group.get("skips_zero") else ():
                if parameter.grad is not None:
                    gradient, broken = parameter.grad.view(-1), getattr(self, "found_inf", None)
                    gradient = gradient if broken is None else gradient.masked_fill(broken.bool(), 0.0)
                    self._step_where_seen(group, parameter, gradient)
                    parameter.grad = None
        return super().step(closure)

    def _step_where_seen(self, group: dict[str, Any], parameter: Tensor, gradient: Tensor) -> None:
        state = self.state[parameter]
        if not state:
            state["step"] = torch.zeros((), device=parameter.device)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
        state["step"] += 1
        step, (beta1, beta2) = float(state["step"]), group["betas"]
        places = torch.nonzero(gradient)[:, 0]
        seen = gradient[places]
        first, second = state["exp_avg"].view(-1), state["exp_avg_sq"].view(-1)
        first[places] = beta1 * first[places] + (1 - beta1) * seen
        second[places] = beta2 * second[places] + (1 - beta2) * seen.square()
        size = group["lr"] * math.sqrt(1 - beta2**step) / (1 - beta1**step)
        change = size * first[places] / (second[places].sqrt() + group["eps"])
        parameter.view(-1).index_add_(0, places, change, alpha=-1)
