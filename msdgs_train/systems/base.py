"""The interface of a system: a model, how it is rendered, and hooks before and after each step."""

from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from msdgs_serve.scene import Camera
from msdgs_train.datasets import Frame
from msdgs_train.datasets.rays import Rays
from msdgs_train.layers.parameters import ParamGroup
from msdgs_train.systems.targets import Target


class Moment(NamedTuple):
    """A step of the schedule, and the random numbers of one of its images."""

    step: int  # counted from 0
    generator: torch.Generator  # of this image alone, so that any number of threads and resumed runs draw the same


class ViewLoss(NamedTuple):
    """One rendered training image, or a batch of rays, and its loss."""

    loss: Tensor  # scalar
    rgb: Tensor  # [H, W, 3] or [R, 3]
    screen: Any = None  # results of the backward pass for `after_step`
    shows_all: bool = False  # nothing of the scene is outside the image


class System(Protocol):
    """The part of training that depends on the kind of model; an `ImageSystem` or a `RaySystem`."""

    @property
    def model(self) -> nn.Module:
        """The trained module."""
        ...

    @property
    def size(self) -> int:
        """Number of Gaussians, or of the corresponding elements."""
        ...

    def parameter_groups(self) -> list[ParamGroup]:
        """All current trainable parameters, with learning rates."""
        ...

    def milestones(self, num_steps: int) -> list[int]:
        """Steps, counted from 0, at which something happens once in a run of so many, besides the beginning of motion:
        a run that is resumed with other `--steps` may not miss or repeat it."""
        ...

    def before_step(self, optimizer: torch.optim.Optimizer, steps: range) -> None:
        """Called before an optimizer step. `steps` of the schedule, counted from 0, have been reached since the last
        one: one, or if the schedule follows the clock, several or none."""
        ...

    def after_step(self, optimizer: torch.optim.Optimizer, steps: range, views: list[tuple[Frame, ViewLoss]]) -> None:
        """Density control and averaging after these steps of the schedule, counted from 1, of one optimizer step; no
        views if its loss wasn't finite, or of rays."""
        ...

    def render(self, camera: Camera, t: float, background: Tensor, step: int) -> Tensor:
        """Render the model that is evaluated and saved, [H, W, 3], over `background`, [3], after `step` steps."""
        ...

    def generators(self) -> list[torch.Generator]:
        """All random generators, which checkpoints store."""
        ...

    def state(self) -> dict[str, Any]:
        """The state besides optimizer and generators for a bit-exact continuation; tensors and plain values."""
        ...

    def load_state(self, state: dict[str, Any], step: int) -> None:
        """Continue from a state after `step` steps."""
        ...

    def save(self, path: Path, step: int) -> None:
        """Write the model that is evaluated, atomically."""
        ...


class ImageSystem(System, Protocol):
    """A system that renders an image at a time."""

    def loss(self, frame: Frame, target: Target, background: Tensor, moment: Moment) -> ViewLoss:
        """Render a frame over `background`, [3], and compare it with its image. Called from several threads at
        once."""
        ...


@runtime_checkable
class RaySystem(System, Protocol):
    """A system that renders rays of all images alike."""

    @property
    def rays_per_batch(self) -> int:
        """Rays of a batch; a step has as many batches as an `ImageSystem` has images."""
        ...

    def hits(self, rays: Rays) -> Tensor:
        """Which rays take part in training, [R] bool."""
        ...

    def ray_loss(self, rays: Rays, target: Target, background: Tensor, moment: Moment) -> ViewLoss:
        """Render rays over `background`, [3], and compare them with their pixels. Called from several threads at
        once."""
        ...
