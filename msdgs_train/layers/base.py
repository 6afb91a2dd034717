"""What a deformation layer is: one step of a chain that moves points, Gaussians or control nodes (paper, equation 7).

A new kind is one file: a frozen dataclass that derives from `LayerConfig`, a module that derives from
`DeformationLayer`, and a line that registers the first in `layers.registry`.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, NamedTuple

from msdgs_serve.scene.errors import InvalidInput

if TYPE_CHECKING:
    from msdgs_train.layers.deformation import DeformationLayer

HEAD_COLUMNS = {"means": slice(0, 3), "scales": slice(3, 6), "quats": slice(6, 10)}
"""Columns of a layer's deltas, in the order of `Heads.sizes`; that of the step weight, if any, is the last one."""


class Heads(NamedTuple):
    """What a layer predicts besides deltas of means, scales and quaternions."""

    weight: bool = True  # without it every step counts in full, w = 1
    opacity: bool = False
    sh: int = 0  # coefficients (degree + 1)² a channel; 0: none

    @property
    def sizes(self) -> tuple[int, ...]:
        """Columns of: means, scales, quats, opacity, sh, weight before its sigmoid. 0 for what isn't there."""
        return (3, 3, 4, int(self.opacity), 3 * self.sh, int(self.weight))


PAPER_HEADS = Heads()


class SceneBounds(NamedTuple):
    """Where and when a model's scene takes place: what grids span. Stored with the weights."""

    scene_half_size: float = 1.0  # of a cube around the origin, scene units
    time_range: tuple[float, float] = (0.0, 1.0)


@dataclass(frozen=True)
class LayerConfig:
    """Sizes and learning rates of one layer; each layer of a model has its own."""

    kind: ClassVar[str]
    """The name of this kind of layer in configurations and files."""

    def build(self, bounds: SceneBounds, heads: Heads, num_points: int | None) -> "DeformationLayer":
        """A new layer that moves nothing yet; `num_points` is that of the control nodes, None for Gaussians."""
        raise NotImplementedError

    def check(self, field: str, moves_nodes: bool) -> None:
        """Raise `InvalidInput` naming `field.SETTING` if a size is out of range, or the layer can't move such points,
        control nodes or Gaussians."""

    def check_stored(self, num_tensors: int) -> None:
        """Raise `InvalidInput` where a model file of `num_tensors` tensors can't hold this layer.

        A file's configuration is read before its tensors; one that asks for a million matrices must not make them.
        """


def check_size(field: str, value: object, least: int = 1) -> None:
    """Raise `InvalidInput` unless `value` is an integer of `least` or more."""
    if type(value) is not int or value < least:
        raise InvalidInput(field, f"an integer of {least} or more", value)
