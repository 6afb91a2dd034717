"""Settings of a model: its support, its layers and the switches of the method, checked when built."""

import dataclasses
import math
from dataclasses import dataclass, fields
from typing import Any, get_args

from msdgs_serve.rasterizer import GSPLAT
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.spherical_harmonics import sh_coefficients
from msdgs_train.gaussians.attribute import Attribute
from msdgs_train.gaussians.modulation import EMBEDDINGS, ModulationTarget, embeddings_attribute
from msdgs_train.gaussians.raw_quaternions import QuatSpace
from msdgs_train.gaussians.scale_space import ScaleSpace
from msdgs_train.layers.base import Heads, LayerConfig
from msdgs_train.layers.mlp import MLPConfig
from msdgs_train.layers.parameters import LearningRate
from msdgs_train.layers.parts import from_plain, to_plain
from msdgs_train.layers.registry import LAYERS
from msdgs_train.supports.base import SupportConfig
from msdgs_train.supports.gaussians import GaussiansConfig
from msdgs_train.supports.registry import SUPPORTS


@dataclass(frozen=True)
class ModelConfig:
    """Settings of a model. The defaults are the paper's, with K = 2 layers; K = 0 is a static scene."""

    sh_degree: int = 3
    """Degree of the spherical harmonics, 0 to 3."""
    support: SupportConfig = GaussiansConfig()
    """The points that layers move, with settings: gaussians, or control nodes (nodes:num_nodes=512)."""
    layers: tuple[LayerConfig, ...] = (MLPConfig(), MLPConfig())
    """The K layers in order, each a kind with settings of its own (mlp:width=96,depth=2); kinds may be mixed."""
    weights: bool = True
    """Each layer predicts a step weight (equation 8); without, all step weights are 1."""
    embedding_dim: int = 32
    """Numbers per Gaussian that the modulation reads; 0: no modulation."""
    modulation_targets: tuple[ModulationTarget, ...] = ("scales",)
    """The summed deltas that the modulation multiplies, one or more of means, scales and quats."""
    modulation_lr_init: float = 8e-4
    """Learning rate of the modulation network and its embeddings."""
    modulation_lr_final: float = 1.6e-6
    """Learning rate of the modulation at the last step, to which it decays exponentially."""
    scale_space: ScaleSpace = "log"
    """`log`: deltas are added to logarithms of scales; `linear`: to the scales, as in DeformGS."""
    quat_space: QuatSpace = "unit"
    """`unit`: quaternions are scaled to unit length after their deltas; `raw`: they aren't, as in DeformGS, and shear
    their Gaussians."""
    opacity_head: bool = False
    """Layers also change opacities, before the sigmoid. Only plans that run layers can hold such a model."""
    sh_head: bool = False
    """Layers also change colors, as SH coefficients. Only plans that run layers can hold such a model."""
    eps2d: float = 0.3
    """Dilation of projected covariances, px²; 0.3 in 3D Gaussian Splatting. A smaller one sharpens small structures;
    other renderers, which add 0.3, then draw the model blurrier."""
    near_plane: float = GSPLAT.near_plane
    """Gaussians nearer to a camera aren't drawn, scene units; 0.2 in INRIA's rasterizer."""
    alpha_max: float = GSPLAT.alpha_max
    """Largest alpha of a Gaussian in a pixel; 0.99 in INRIA's rasterizer. On CUDA gsplat's, 0.999, is fixed."""

    def __post_init__(self) -> None:
        for name in ("layers", "modulation_targets"):
            if not isinstance(getattr(self, name), tuple | list):
                raise InvalidInput(f"model.{name}", "a list", getattr(self, name))
            object.__setattr__(self, name, tuple(getattr(self, name)))
        for field in fields(self):
            value = getattr(self, field.name)
            if field.type is int and not (type(value) is int and value >= 0):
                raise InvalidInput(f"model.{field.name}", "an integer of 0 or more", value)
            if field.type is bool and type(value) is not bool:
                raise InvalidInput(f"model.{field.name}", "true or false", value)
        if type(self.eps2d) not in (int, float) or not 0 <= self.eps2d < math.inf:
            raise InvalidInput("model.eps2d", "finite and 0 or above", self.eps2d)
        if self.sh_degree > 3:
            raise InvalidInput("model.sh_degree", "0, 1, 2 or 3", self.sh_degree)
        targets, known = self.modulation_targets, get_args(ModulationTarget)
        if not targets or len(set(targets)) < len(targets) or not set(targets) <= set(known):
            expected = f"one or more of {list(known)}, each once; embedding_dim 0: no modulation"
            raise InvalidInput("model.modulation_targets", expected, targets)
        if not isinstance(self.support, SupportConfig):
            raise InvalidInput("model.support", f"one of {', '.join(SUPPORTS)}", self.support)
        _check_rates("model", self)
        _check_rates("model.support", self.support)
        self.support.check("model.support")
        for index, layer in enumerate(self.layers):
            if not isinstance(layer, LayerConfig):
                raise InvalidInput(f"model.layers.{index}", f"one of {', '.join(LAYERS)}", layer)
            _check_rates(f"model.layers.{index}", layer)
            layer.check(f"model.layers.{index}", self.support.moves_nodes)
            if self.support.extra_heads and not layer.has_extra_heads:
                heads = f"{', '.join(self.support.extra_heads)} for --support {self.support.kind}"
                raise InvalidInput(f"model.layers.{index}", f"of a kind that predicts {heads}", layer.kind)
        for name, most in (("near_plane", math.inf), ("alpha_max", 1.0)):
            value = getattr(self, name)
            if type(value) not in (int, float) or not 0 < value < most:
                raise InvalidInput(f"model.{name}", f"in (0, {most:g})", value)
        if self.quat_space not in get_args(QuatSpace):
            raise InvalidInput("model.quat_space", f"one of {list(get_args(QuatSpace))}", self.quat_space)
        if self.quat_space == "raw" and self.support.moves_nodes:
            raise InvalidInput("model.quat_space", "unit with nodes, which rotate Gaussians", self.quat_space)
        if self.scale_space not in get_args(ScaleSpace):
            raise InvalidInput("model.scale_space", f"one of {list(get_args(ScaleSpace))}", self.scale_space)
        if self.layers and self.scale_space not in self.support.scale_spaces:
            allowed = f"{' or '.join(self.support.scale_spaces)} with --support {self.support.kind}"
            raise InvalidInput("model.scale_space", allowed, self.scale_space)
        if self.layers and self.support.moves_nodes:
            for name in ("opacity_head", "sh_head"):
                if getattr(self, name):
                    raise InvalidInput(f"model.{name}", "off with nodes, which move Gaussians only", True)

    @property
    def heads(self) -> Heads:
        """Outputs of each layer besides deltas of means, scales and quaternions."""
        sh = sh_coefficients(self.sh_degree) if self.sh_head else 0
        return Heads(self.weights, self.opacity_head, sh, tuple(self.support.extra_heads.items()))

    @property
    def modulation_lr(self) -> LearningRate:
        """Learning rate of the modulation network and its embeddings."""
        return LearningRate(self.modulation_lr_init, self.modulation_lr_final)

    def attributes(self) -> dict[str, Attribute]:
        """Attributes of modulation and support, stored per Gaussian."""
        own = {EMBEDDINGS: embeddings_attribute(self.embedding_dim, self.modulation_lr)} if self.embedding_dim else {}
        return own | (self.support.attributes() if self.layers else {})

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        values["support"] = to_plain(self.support)
        values["layers"] = [to_plain(layer) for layer in self.layers]
        return values | {"modulation_targets": list(self.modulation_targets)}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> "ModelConfig":
        """The inverse of `to_dict`; parts may also be text (`mlp:width=96`). Raises `InvalidInput` naming a setting
        that is unknown or out of range."""
        unknown = sorted(set(values) - {field.name for field in dataclasses.fields(cls)})
        if unknown:
            raise InvalidInput("model", f"made of {', '.join(f.name for f in fields(cls))}", f"`{unknown[0]}`")
        values = dict(values)
        if "support" in values:
            values["support"] = from_plain("model.support", values["support"], SUPPORTS)
        if "layers" in values:
            if not isinstance(values["layers"], list | tuple):
                raise InvalidInput("model.layers", "a list", values["layers"])
            layers = (from_plain(f"model.layers.{i}", layer, LAYERS) for i, layer in enumerate(values["layers"]))
            values["layers"] = tuple(layers)
        return cls(**values)


def _check_rates(field: str, settings: Any) -> None:
    """Raise `InvalidInput` unless learning rates are finite and above 0, and weights finite and 0 or above."""
    for name in (item.name for item in fields(settings)):
        value = getattr(settings, name)
        is_number = type(value) in (int, float)
        if "lr_" in name and not (is_number and 0 < value < math.inf):
            raise InvalidInput(f"{field}.{name}", "a finite learning rate above 0", value)
        if name.endswith("_weight") and not (is_number and 0 <= value < math.inf):
            raise InvalidInput(f"{field}.{name}", "finite and 0 or above", value)
