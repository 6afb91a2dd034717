"""Settings of volumes."""

from abc import abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING

from msdgs_train.settings import SystemConfig

if TYPE_CHECKING:
    from msdgs_train.datasets import SceneData
    from msdgs_train.volumes.field import RayField
    from msdgs_train.volumes.space import Box


@dataclass(frozen=True)
class VolumeConfig(SystemConfig):
    """What all volumes share."""

    rays: int = 4096
    """Rays of a batch, from all images alike; --batch-size batches are rendered in parallel per step."""
    near: float = 2.0
    """Where rays begin, in scene units; cameras are about 4 from what they show."""
    far: float = 6.0
    """Where rays end."""
    voxels: int = 100**3
    """Vertices of the grid in its last size, about."""

    def __post_init__(self) -> None:
        self.require_counts("rays")
        self.require(("voxels",), "a whole number in [64, 1e9]", lambda v: type(v) is int and 64 <= v <= 10**9)
        self.require_positive("near", "far")
        self.require(("far",), "above near", lambda far: far > self.near)

    @abstractmethod
    def box_of(self, scene: "SceneData") -> "Box":
        """The box around a scene."""

    @abstractmethod
    def build(self, box: "Box") -> "RayField":
        """A new volume in its first size."""
