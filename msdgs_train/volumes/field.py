"""The interface of a volume: density and color at points of space and time, and how it changes during a run."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import ClassVar

import torch
from torch import Tensor, nn

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.datasets.rays import Rays
from msdgs_train.layers.parameters import ParamGroup
from msdgs_train.volumes.samples import Marched, Samples
from msdgs_train.volumes.space import Box

Change = tuple[float, Callable[[], None]]
"""A fraction of the run, and what happens there."""


class RayField(nn.Module, ABC):
    """A volume that rays are marched through; its grids grow during a run."""

    least_depth: ClassVar[float] = 0.0
    """Samples of this optical depth or less are left out."""
    least_weight: ClassVar[float]
    """Samples of this weight or less add no color."""
    stop: ClassVar[float] = 0.0
    """Nothing is seen behind samples that leave less than this."""
    grids: ClassVar[tuple[str, ...]]
    """Beginnings of the names of tensors whose size changes."""
    corners: Tensor  # [2, 3]

    def __init__(self, box: Box) -> None:
        super().__init__()
        self.register_buffer("corners", torch.stack(box))

    @property
    def box(self) -> Box:
        """Where it is, in scene units."""
        return Box(*self.corners)

    @property
    @abstractmethod
    def size(self) -> int:
        """Number of vertices of its grids in space."""

    @abstractmethod
    def samples(self, rays: Rays, generator: torch.Generator | None) -> Samples:
        """Where rays are sampled; shifted at random with a generator."""

    @abstractmethod
    def optical_depths(self, samples: Samples, rays: Rays) -> tuple[Tensor, Tensor]:
        """Optical depths of samples, [M], and features that `colors` needs, [M, F]."""

    @abstractmethod
    def colors(self, samples: Samples, rays: Rays, features: Tensor) -> Tensor:
        """Colors of samples, [M, 3] in [0, 1], as seen along their rays."""

    @abstractmethod
    def regularizers(self, marched: Marched, target: Tensor, progress: float) -> Tensor:
        """The weighted sum of what is added to the mean squared error; `target` has the colors of the rays, [R, 3], and
        `progress` is in [0, 1]."""

    @abstractmethod
    def parameter_groups(self, progress: float) -> list[ParamGroup]:
        """All parameters with their rates at this fraction of the run."""

    @abstractmethod
    def changes(self) -> list[Change]:
        """What happens during a run, in order. The optimizer starts again where parameters are replaced."""

    def hits(self, rays: Rays) -> Tensor:
        """Whether rays meet the box, [R] bool."""
        enters, leaves = self.box.spans(rays.origins, rays.directions)
        return leaves > enters

    def load_grown(self, state: Mapping[str, Tensor], *, assign: bool = False) -> None:
        """Load tensors, of which those of grids may have another size; with `assign` they become the volume's own.

        Raises `InvalidInput` naming one that doesn't belong to this volume.
        """
        for name, tensor in state.items():
            if not name.startswith(self.grids):
                continue
            *path, leaf = name.split(".")
            try:
                owner = self.get_submodule(".".join(path))
                own = getattr(owner, leaf)
            except AttributeError:
                raise InvalidInput(name, "absent", tuple(tensor.shape)) from None
            if own is not None and (own.dim(), own.shape[:2]) != (tensor.dim(), tensor.shape[:2]):
                raise InvalidInput(name, f"a grid of {own.shape[1]} channels", tuple(tensor.shape))
            grown = torch.empty_like(tensor, device=self.corners.device)
            setattr(owner, leaf, nn.Parameter(grown) if isinstance(own, nn.Parameter) else grown)
        try:
            self.load_state_dict(state, assign=assign)
        except RuntimeError as error:
            raise InvalidInput("state", "the tensors of this volume", str(error).splitlines()[-1].strip()) from None
        self.check()

    @abstractmethod
    def check(self) -> None:
        """Raise `InvalidInput` unless the sizes of its tensors belong together."""


def encoded(values: Tensor, frequencies: int) -> Tensor:
    """Values, [M, C], with their sines and cosines at frequencies 1, 2, 4, …: [M, C (1 + 2 F)]."""
    angles = (values[..., None] * 2.0 ** torch.arange(frequencies, device=values.device)).flatten(-2)
    return torch.cat([values, angles.sin(), angles.cos()], dim=-1)
