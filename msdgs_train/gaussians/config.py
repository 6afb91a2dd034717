"""What a model is made of: layers, their sizes, and every switch of the method, checked when it is built."""

import math
from dataclasses import dataclass, fields
from typing import Any, Literal, get_args

from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.spherical_harmonics import sh_coefficients
from msdgs_train.layers.heads import Heads
from msdgs_train.supports.skinning_kernels import K_NEAREST

LayerKind = Literal["mlp", "plane", "bases"]
ModulationTarget = Literal["means", "scales", "quats"]
DeltaSpace = Literal["raw", "activated"]
LEAST = {
    "width": 1,
    "depth": 1,
    "time_width": 1,
    "time_features": 1,
    "plane_features_dim": 1,
    "plane_resolution": 2,
    "plane_time_resolution": 2,
    "plane_width": 1,
    "num_nodes": 1,
    "num_knots": 1,
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
    plane_features_dim: int = 16
    """This and the following are sizes of layers of kind `plane`, those above of kind `mlp`."""
    plane_resolution: int = 32
    plane_time_resolution: int = 50
    plane_width: int = 32
    multires: tuple[int, ...] = (1,)
    """Grids a layer, with so many times `plane_resolution`; their features are put side by side. 4DGS has 1 2."""
    num_nodes: int = 256
    """Motions of a layer of kind `bases`, each of which many Gaussians follow. Such a layer is the first."""
    num_knots: int = 36
    """Of their splines, over the time range of the scene."""
    affine: bool = True
    """They stretch what follows them; else they are rigid."""
    weights: bool = True
    """Each layer predicts how much its step counts (equation 8); without, all steps count in full."""
    embedding_dim: int = 32
    """Numbers a Gaussian that the modulation reads; 0: no modulation."""
    modulation_targets: tuple[ModulationTarget, ...] = ("scales",)
    """Which summed deltas the modulation multiplies, one or more of means, scales and quats."""
    delta_space: DeltaSpace = "raw"
    """Where deltas of scales are added: `raw`, to their logarithms; `activated`, to the scales, as in DeformGS."""
    opacity_head: bool = False
    """Layers also change opacities, before the sigmoid. Such a model can't be exported yet."""
    sh_head: bool = False
    """Layers also change colors, as SH coefficients. Such a model can't be exported yet."""
    detach_deform_input: bool = True
    """Photometric gradients through the layers' input don't reach the canonical means, as in DeformGS."""
    eps2d: float = 0.3
    """Added to the diagonal of projected covariances, px², so that nothing is missed between pixels: 0.3 in the field.
    With less what is small is sharper; other programs, which add 0.3, then draw the model softer."""

    def __post_init__(self) -> None:
        self._check_list("layers", get_args(LayerKind))
        self._check_list("modulation_targets", get_args(ModulationTarget))
        self._check_list("multires", None)
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
        if not self.modulation_targets or len(set(self.modulation_targets)) < len(self.modulation_targets):
            raise InvalidInput(
                "model.modulate", "one target or more, each once; embedding_dim 0: none", self.modulation_targets
            )
        if not self.multires:
            raise InvalidInput("model.multires", "one grid or more", self.multires)
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
        """Motion bases that each Gaussian may follow."""
        return min(K_NEAREST, self.num_nodes) if "bases" in self.layers else 0

    @property
    def heads(self) -> Heads:
        """What each layer predicts besides the deltas that all have."""
        return Heads(self.weights, self.opacity_head, sh_coefficients(self.sh_degree) if self.sh_head else 0)
