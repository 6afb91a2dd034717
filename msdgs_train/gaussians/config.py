"""What a model is made of: layers, their sizes, and every switch of the method, checked when it is built."""

import math
from dataclasses import dataclass, fields
from typing import Any, Literal, get_args

from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.spherical_harmonics import sh_coefficients
from msdgs_train.layers.heads import Heads
from msdgs_train.supports.skinning_kernels import FOLLOWED

LayerKind = Literal["mlp", "plane", "bases"]
ModulationTarget = Literal["means", "scales", "quats"]
DeltaSpace = Literal["raw", "activated"]
LEAST = {
    "width": 1,
    "depth": 1,
    "time_width": 1,
    "time_features": 1,
    "plane_channels": 1,
    "plane_space_nodes": 2,
    "plane_time_nodes": 2,
    "plane_width": 1,
    "basis_count": 1,
    "basis_knots": 1,
}
"""The smallest sizes that make sense; the others may be 0."""


@dataclass(frozen=True)
class ModelConfig:
    """Sizes and switches of a model. The defaults are the paper's, with K = 2 layers; K = 0 is a static scene."""

    sh_degree: int = 3
    layers: tuple[LayerKind, ...] = ("mlp", "mlp")
    """The kind of each of the K layers, in order; kinds may be mixed."""
    width: int = 256
    depth: int = 4
    xyz_frequencies: int = 10
    time_frequencies: int = 6
    time_width: int = 256
    time_features: int = 30
    skip: int = 0
    """An MLP layer reads its input once more after so many hidden layers, fewer than `depth`; 0: it doesn't."""
    plane_channels: int = 16
    """This and the following are sizes of layers of kind `plane`, those above of kind `mlp`."""
    plane_space_nodes: int = 32
    plane_time_nodes: int = 50
    plane_width: int = 32
    plane_scales: tuple[int, ...] = (1,)
    """Grids a layer, with so many times `plane_space_nodes`; their features are put side by side. 4DGS has 1 2."""
    basis_count: int = 256
    """Motions of a layer of kind `bases`, each of which many Gaussians follow. Such a layer is the first."""
    basis_knots: int = 36
    """Of their splines, over the time range of the scene."""
    basis_stretches: bool = True
    """They stretch what follows them; else they are rigid."""
    weights: bool = True
    """Each layer predicts how much its step counts (equation 8); without, all steps count in full."""
    embedding_size: int = 32
    """Numbers a Gaussian that the modulation reads; 0: no modulation."""
    modulate: tuple[ModulationTarget, ...] = ("scales",)
    """Which summed deltas the modulation multiplies, one or more of means, scales and quats."""
    delta_space: DeltaSpace = "raw"
    """Where deltas of scales are added: `raw`, to their logarithms; `activated`, to the scales, as in DeformGS."""
    opacity_head: bool = False
    """Layers also change opacities, before the sigmoid. Such a model can't be exported yet."""
    sh_head: bool = False
    """Layers also change colours, as SH coefficients. Such a model can't be exported yet."""
    detach_means: bool = True
    """Photometric gradients through the layers' input don't reach the canonical means, as in DeformGS."""
    eps2d: float = 0.3
    """Added to the diagonal of projected covariances, px², so that nothing is missed between pixels: 0.3 in the field.
    With less what is small is sharper; other programs, which add 0.3, then draw the model softer."""

    def __post_init__(self) -> None:
        self._check_list("layers", get_args(LayerKind))
        self._check_list("modulate", get_args(ModulationTarget))
        self._check_list("plane_scales", None)
        for field in fields(self):
            value = getattr(self, field.name)
            if field.type is int and not (type(value) is int and value >= LEAST.get(field.name, 0)):
                raise InvalidInput(f"model.{field.name}", f"an integer of {LEAST.get(field.name, 0)} or more", value)
            if field.type is bool and type(value) is not bool:
                raise InvalidInput(f"model.{field.name}", "true or false", value)
        if type(self.eps2d) not in (int, float) or not 0 <= self.eps2d < math.inf:
            raise InvalidInput("model.eps2d", "finite and 0 or above", self.eps2d)
        if self.sh_degree > 3:
            raise InvalidInput("model.sh_degree", "0, 1, 2 or 3", self.sh_degree)
        if not self.modulate or len(set(self.modulate)) < len(self.modulate):
            raise InvalidInput("model.modulate", "one target or more, each once; embedding_size 0: none", self.modulate)
        if not self.plane_scales:
            raise InvalidInput("model.plane_scales", "one grid or more", self.plane_scales)
        if self.skip >= self.depth:
            raise InvalidInput("model.skip", f"fewer than the {self.depth} hidden layers of `depth`", self.skip)
        if "bases" in self.layers[1:]:
            raise InvalidInput("model.layers", "with `bases`, which moves canonical Gaussians, first", self.layers)
        if self.delta_space not in get_args(DeltaSpace):
            raise InvalidInput("model.delta_space", f"one of {list(get_args(DeltaSpace))}", self.delta_space)
        if "bases" in self.layers and self.delta_space != "raw":
            raise InvalidInput("model.delta_space", "raw with `bases`, whose stretches are factors", self.delta_space)

    def _check_list(self, name: str, known: tuple[Any, ...] | None) -> None:
        """Make a list, as JSON has it, a tuple; refuse values that aren't known, or aren't whole numbers above 0."""
        expected = "whole numbers above 0" if known is None else f"values out of {list(known)}"
        values = getattr(self, name)
        if not isinstance(values, tuple | list):
            raise InvalidInput(f"model.{name}", f"a list of {expected}", values)
        object.__setattr__(self, name, tuple(values))
        for value in values:
            if not (type(value) is int and value > 0 if known is None else value in known):
                raise InvalidInput(f"model.{name}", expected, value)

    @property
    def motions(self) -> int:
        """Shared motions that each Gaussian may follow."""
        return min(FOLLOWED, self.basis_count) if "bases" in self.layers else 0

    @property
    def heads(self) -> Heads:
        """What each layer predicts besides the deltas that all have."""
        return Heads(self.weights, self.opacity_head, sh_coefficients(self.sh_degree) if self.sh_head else 0)
