"""The interface of a system: a model, how it is rendered, and what it does before and after each step."""

from pathlib import Path
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor, nn

from msdgs_serve.scene import Camera
from msdgs_train.engine.curriculum import TrainingSample
from msdgs_train.layers.parameters import ParamGroup


class ViewLoss(NamedTuple):
    """One rendered training image and its loss."""

    loss: Tensor  # scalar
    rgb: Tensor  # [H, W, 3]
    clamped_scales: int = 0  # Gaussians a scale of which was clamped
    screen: Any = None  # what `after_step` wants to know of the backward pass


class System(Protocol):
    """All that differs between kinds of models while they are trained."""

    @property
    def model(self) -> nn.Module:
        """What is trained."""
        ...

    @property
    def size(self) -> int:
        """Gaussians, or what else there may be more and fewer of."""
        ...

    def parameter_groups(self) -> list[ParamGroup]:
        """All trainable parameters as they are now, with learning rates and roles."""
        ...

    def before_step(self, optimizer: torch.optim.Optimizer, step: int) -> None:
        """Do what is due before this step, counted from 0."""
        ...

    def loss(self, sample: TrainingSample, target: Tensor, background: Tensor, step: int) -> ViewLoss:
        """Render a sample and compare it with its image, [H, W, 3]; called from several threads at once."""
        ...

    def new_frame_rows(self, times: list[float]) -> list[tuple[nn.Parameter, Tensor]]:
        """Parameters and masks of rows that take larger steps where newly admitted frames are at `times`."""
        ...

    def after_step(
        self, optimizer: torch.optim.Optimizer, step: int, views: list[tuple[TrainingSample, ViewLoss]]
    ) -> None:
        """Density control and averaging after this step, counted from 1; no views if its loss wasn't finite."""
        ...

    def render(self, camera: Camera, t: float, background: Tensor, step: int) -> Tensor:
        """[H, W, 3] of the model as it is evaluated and saved."""
        ...

    def generators(self) -> list[torch.Generator]:
        """All of its randomness."""
        ...

    def state(self) -> dict[str, Any]:
        """All that a bit-exact continuation needs besides optimizer and generators; tensors and plain values."""
        ...

    def load_state(self, state: dict[str, Any], step: int) -> None:
        """Continue from a state after `step` steps."""
        ...

    def save(self, path: Path, step: int) -> None:
        """Write the model as it is evaluated, atomically."""
        ...
