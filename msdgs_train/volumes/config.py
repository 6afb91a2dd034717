"""Settings of volumes."""

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Self

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.settings import SystemConfig, optional
from msdgs_train.volumes.extent import depth_range

if TYPE_CHECKING:
    from msdgs_train.datasets import SceneData
    from msdgs_train.volumes.field import RayField
    from msdgs_train.volumes.space import Box


@dataclass(frozen=True)
class VolumeConfig(SystemConfig):
    """What all volumes share."""

    rays: int = 4096
    """Rays of a batch, from all images alike; --batch-size batches are rendered in parallel per step."""
    near: Annotated[float | None, optional("LENGTH")] = None
    """Where rays begin, in scene units, in which cameras are about 4 from what they show. If not given: 2 in D-NeRF's
    scenes; in others before the nearest sparse points, or before the ball that holds the scene."""
    far: Annotated[float | None, optional("LENGTH")] = None
    """Where rays end. If not given: 6 in D-NeRF's scenes; in others behind the points or the ball."""
    voxels: int = 100**3
    """Vertices of the grid in its last size, about."""

    def __post_init__(self) -> None:
        self.require_counts("rays")
        self.require(("voxels",), "a whole number in [64, 1e9]", lambda v: type(v) is int and 64 <= v <= 10**9)
        self.require_positive_or_none("near", "far")
        self.require(("far",), "above near", lambda far: far is None or self.near is None or far > self.near)

    def sized(self, scene: "SceneData") -> Self:
        """These settings with lengths of the scene for those that aren't given."""
        own_near, own_far = depth_range(scene)
        near, far = own_near if self.near is None else self.near, own_far if self.far is None else self.far
        if near >= far and self.near is not None:
            raise InvalidInput("config.near", f"below {far:.4g}, where the scene ends; or give --far too", near)
        if near >= far:
            raise InvalidInput("config.far", f"above {near:.4g}, where the scene begins; or give --near too", far)
        return replace(self, near=near, far=far)

    @property
    def depths(self) -> tuple[float, float]:
        """Near and far, which `sized` has set. Raises `InvalidInput` if one isn't."""
        if self.near is None or self.far is None:
            raise InvalidInput("near" if self.near is None else "far", "a number", None)
        return self.near, self.far

    @abstractmethod
    def box_of(self, scene: "SceneData") -> "Box":
        """The box around a scene, of settings that are `sized`."""

    @abstractmethod
    def build(self, box: "Box") -> "RayField":
        """A new volume in its first size."""
