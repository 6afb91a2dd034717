"""The parts of a model that pruning keeps, and the smaller model that they make."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from msdgs_export.bake import Baked, bake, limits_left_out
from msdgs_export.layers import GAINS, export_of
from msdgs_export.measure.poses import posed
from msdgs_export.spatial_order import morton_order
from msdgs_export.supports import support_export_of
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.scene.spherical_harmonics import sh_coefficients
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.gaussians.model_file import SceneInfo
from msdgs_train.layers.arrays import to_array
from msdgs_train.layers.base import DeformationLayer
from msdgs_train.layers.chain import MultiStepDeformation


@dataclass(frozen=True)
class NetworkMask:
    """The parts of a deformation that are kept."""

    layers: tuple[int, ...]  # indices of the model's layers
    heads: frozenset[str]  # of those that can be removed
    modulated: bool


@dataclass(frozen=True, eq=False)
class PruningMask:
    """The parts of a model that are kept."""

    network: NetworkMask
    kept: np.ndarray  # [N] bool
    moves: np.ndarray  # [N] bool, only Gaussians that are kept
    sh_degree: int

    @property
    def ids(self) -> np.ndarray:
        """The model's ids of the kept Gaussians: moving ones, then static ones."""
        return np.concatenate([np.flatnonzero(self.moves), np.flatnonzero(self.kept & ~self.moves)])

    def without(self, **changes: Any) -> "PruningMask":
        """The mask with changes; Gaussians that aren't kept don't move."""
        changed = replace(self, **changes)
        return replace(changed, moves=changed.moves & changed.kept)


@dataclass(frozen=True, eq=False)
class PrunedModel:
    """A smaller model of the Gaussians that move, and those that don't."""

    moving: DynamicGaussians
    static: Gaussians  # float32, activated
    ids: np.ndarray  # [M + S] int64, the model's id of each: moving ones, then static ones
    network: NetworkMask  # of those that move
    left_out: tuple[dict[str, Any], ...] = ()


def full_mask(model: DynamicGaussians) -> PruningMask:
    """The mask that keeps everything."""
    count = len(model.gaussians)
    layers = tuple(range(len(model.deformation)))
    network = NetworkMask(layers, _removable_heads(model), model.modulation is not None)
    moves = np.full(count, len(model.deformation) > 0)
    return PruningMask(network, np.ones(count, bool), moves, model.config.sh_degree)


def in_spatial_order(model: DynamicGaussians) -> DynamicGaussians:
    """The same Gaussians along a Z-order curve; without gradients."""
    order = torch.from_numpy(morton_order(to_array(model.gaussians.means)))
    return _model(model, full_mask(model).network, order, model.config.sh_degree)


def with_network(model: DynamicGaussians, network: NetworkMask) -> DynamicGaussians:
    """All Gaussians with the kept parts of the deformation; parameters are shared with `model`."""
    return _model(model, network, slice(None), model.config.sh_degree)


def pruned(
    model: DynamicGaussians, mask: PruningMask, mean_poses: Gaussians, left_out: list[dict[str, Any]]
) -> PrunedModel:
    """The model that a mask keeps; `mean_poses` are the poses that each of the N Gaussians has if it is static."""
    network = mask.network if mask.moves.any() else replace(mask.network, layers=())
    static = np.flatnonzero(mask.kept & ~mask.moves)
    moving = _model(model, network, torch.from_numpy(mask.moves), mask.sh_degree)
    return PrunedModel(moving, rows(mean_poses, static, mask.sh_degree), mask.ids, network, tuple(left_out))


def unpruned(model: DynamicGaussians) -> PrunedModel:
    """A model of which nothing is pruned."""
    every = np.arange(len(model.gaussians))
    canonical = posed(model, 0.0, deform=False)
    return PrunedModel(model, rows(canonical, every[:0], model.config.sh_degree), every, full_mask(model).network)


def bake_pruned(pruned: PrunedModel, info: SceneInfo, checkpoint_sha256: str) -> Baked:
    """Bake the moving part of a pruned model, and add its static Gaussians."""
    baked = bake(pruned.moving, info, checkpoint_sha256)
    scene, static = baked.scene, pruned.static
    limits = limits_left_out(pruned.moving, len(pruned.moving.gaussians) + len(static))
    scene = replace(
        scene,
        metadata=replace(scene.metadata, left_out=(*limits, *pruned.left_out)),
        static_means=np.concatenate([scene.static_means, static.means]),
        static_quats=np.concatenate([scene.static_quats, static.quats]),
        static_scales=np.concatenate([scene.static_scales, static.scales]),
        opacities=np.concatenate([scene.opacities, static.opacities]),
        sh=np.concatenate([scene.sh, static.sh]),
    )
    return replace(baked, scene=scene.validate("the pruned scene"))


def with_sh_degree(pruned: PrunedModel, sh_degree: int) -> PrunedModel:
    """The same Gaussians with only the SH bands up to `sh_degree`."""
    before = pruned.moving.config.sh_degree
    network = full_mask(pruned.moving).network
    static = rows(pruned.static, np.arange(len(pruned.static)), sh_degree)
    entry = {
        "rule": "sh_degree",
        "what": "upper SH bands, within the error allowed",
        "count": before - sh_degree,
        "of": before,
    }
    moving = _model(pruned.moving, network, slice(None), sh_degree)
    return PrunedModel(moving, static, pruned.ids, pruned.network, (*pruned.left_out, entry))


def with_layers(pruned: PrunedModel, model: DynamicGaussians) -> PrunedModel:
    """The same Gaussians with all layers that `model` had before it was pruned."""
    network = replace(pruned.network, layers=full_mask(model).network.layers)
    ids = torch.from_numpy(pruned.ids[: len(pruned.moving.gaussians)])
    moving = _model(model, network, ids, pruned.moving.config.sh_degree)
    left_out = tuple(entry for entry in pruned.left_out if entry["rule"] != "layers")
    return replace(pruned, moving=moving, network=network, left_out=left_out)


def rows(gaussians: Gaussians, ids: np.ndarray, sh_degree: int) -> Gaussians:
    """Some Gaussians, with the SH bands up to `sh_degree`."""
    g, coefficients = gaussians, sh_coefficients(sh_degree)
    return Gaussians(g.means[ids], g.quats[ids], g.scales[ids], g.opacities[ids], g.sh[ids, :coefficients])


def _model(
    model: DynamicGaussians, network: NetworkMask, which: slice | torch.Tensor, sh_degree: int
) -> DynamicGaussians:
    tensors = {name: parameter.detach()[which] for name, parameter in model.gaussians.named_parameters()}
    tensors["sh_rest"] = tensors["sh_rest"][:, : sh_coefficients(sh_degree) - 1]
    config = replace(
        model.config,
        layers=tuple(model.config.layers[k] for k in network.layers),
        sh_degree=sh_degree,
        embedding_dim=model.config.embedding_dim if network.modulated else 0,
    )
    unread = model.config.attributes().keys() - config.attributes().keys()
    tensors = {name: values for name, values in tensors.items() if name not in unread}
    with torch.random.fork_rng(devices=[]):  # new layers draw random weights, which are replaced
        smaller = DynamicGaussians(config, CanonicalGaussians(**tensors))
    smaller.deformation = MultiStepDeformation(kept_layers(model, network))
    smaller.support = model.support
    smaller.modulation = model.modulation if network.modulated else None
    return smaller.requires_grad_(requires_grad=False)


def kept_layers(model: DynamicGaussians, network: NetworkMask) -> list[DeformationLayer]:
    """The layers of a mask, without the heads that it removes."""
    removed, layers = _removable_heads(model) - network.heads, list(model.deformation)
    return [_without_heads(layers[k], removed) for k in network.layers]


def _removable_heads(model: DynamicGaussians) -> frozenset[str]:
    """Heads that pruning may remove: on control nodes only gains, since a Gaussian's pose depends on all others."""
    known = frozenset[str]().union(*(export_of(layer).removable_heads for layer in model.deformation))
    known = known if any(layer.shades for layer in model.deformation) else known - {GAINS}
    return known if support_export_of(model.support).heads_are_removable else known & {GAINS}


def _without_heads(layer: DeformationLayer, removed: frozenset[str]) -> DeformationLayer:
    """The layer with zeros in place of the heads that are removed; a plan stores no column that is all zeros."""
    own = removed & export_of(layer).removable_heads
    return export_of(layer).without_heads(layer, own) if own else layer
