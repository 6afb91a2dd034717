"""Gradients of each image of a batch, and their mean."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from msdgs_train.datasets import Frame
from msdgs_train.layers.parameters import ParamGroup
from msdgs_train.systems.base import ViewLoss
from msdgs_train.systems.targets import Target


class ViewGradients(NamedTuple):
    """One image of a batch, or a batch of rays, after its backward pass."""

    frame: Frame | None  # None: rays of several
    view: ViewLoss
    loss: Tensor
    squared_error: Tensor  # mean over channels and the pixels that count
    gradients: dict[int, Tensor]  # by id of the parameter; those that the loss depends on


def differentiate(groups: Sequence[ParamGroup], frame: Frame | None, view: ViewLoss, target: Target) -> ViewGradients:
    """The gradients of the parameters that the loss depends on."""
    parameters = [p for group in groups for p in group.params]
    found = torch.autograd.grad(view.loss, parameters, allow_unused=True)
    gradients = {id(p): gradient for p, gradient in zip(parameters, found, strict=True) if gradient is not None}
    return ViewGradients(frame, view, view.loss.detach(), target.squared_error(view.rgb), gradients)


def average_gradients(groups: Sequence[ParamGroup], views: Sequence[ViewGradients]) -> None:
    """Set `grad` to the mean over the images that depend on each parameter, added up in their order, so that the same
    seed gives the same bits."""
    for parameter in (p for group in groups for p in group.params):
        known = [view.gradients[id(parameter)] for view in views if id(parameter) in view.gradients]
        mean = known[0] if len(known) == 1 else sum(known[1:], known[0]) / len(known) if known else None
        parameter.grad = None if mean is None else mean.contiguous()  # fused Adam takes any gradient for a dense one
