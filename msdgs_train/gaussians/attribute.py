"""Numbers that a support or the modulation stores per Gaussian."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from msdgs_train.layers.parameters import LearningRate


class Attribute(NamedTuple):
    """Numbers stored per Gaussian besides mean, scales, rotation, opacity and color."""

    columns: int
    init: Callable[[int, int, torch.Generator], Tensor]  # of rows, columns and a generator; integers aren't trained
    lr: LearningRate
