"""What is left of a model after trimming, and the smaller model that this makes."""

import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from export.measure.rendered_error import as_gaussians
from msdgs_serve.scene.gaussians import Gaussians
from msdgs_serve.scene.spherical_harmonics import sh_coefficients
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.layers.chain import MultiStepDeformation
from msdgs_train.layers.mlp import MLPLayer
from msdgs_train.layers.plane import PlaneLayer

HEADS = ("means", "scales", "quats")
"""What the heads of a layer change, in the order of their columns."""

_COLUMNS = {"means": slice(0, 3), "scales": slice(3, 6), "quats": slice(6, 10)}


@dataclass(frozen=True)
class Network:
    """The parts of a deformation that are left."""

    layers: tuple[int, ...]  # indices of the model's
    heads: frozenset[str]  # out of `HEADS`, of layers that have heads
    modulated: bool


@dataclass(frozen=True, eq=False)
class Cut:
    """What is left of a model."""

    network: Network
    kept: np.ndarray  # [N] bool
    moves: np.ndarray  # [N] bool, only Gaussians that are kept
    sh_degree: int

    @property
    def ids(self) -> np.ndarray:
        """The model's ids of what is left: moving Gaussians, then still ones."""
        return np.concatenate([np.flatnonzero(self.moves), np.flatnonzero(self.kept & ~self.moves)])

    def without(self, **changes: Any) -> "Cut":
        """Another cut; Gaussians that aren't kept don't move."""
        changed = replace(self, **changes)
        return replace(changed, moves=changed.moves & changed.kept)


@dataclass(frozen=True, eq=False)
class TrimmedModel:
    """A smaller model of Gaussians that move, beside ones that don't."""

    moving: DynamicGaussians
    still: Gaussians  # float32, activated
    ids: np.ndarray  # [M + S] int64, the model's id of each: moving ones, then still ones
    left_out: tuple[dict[str, Any], ...] = ()


def whole(model: DynamicGaussians) -> Cut:
    """The cut that leaves everything in."""
    count = len(model.gaussians)
    heads = HEADS if any(kind != "bases" for kind in model.config.layers) else ()
    network = Network(tuple(range(len(model.deformation))), frozenset(heads), model.modulation is not None)
    moves = np.full(count, len(model.deformation) > 0)
    return Cut(network, np.ones(count, bool), moves, model.config.sh_degree)


def with_network(model: DynamicGaussians, network: Network) -> DynamicGaussians:
    """All Gaussians with what is left of the deformation; parameters are shared with `model`."""
    return _model(model, network, slice(None), model.config.sh_degree)


def trimmed(model: DynamicGaussians, cut: Cut, still_poses: Gaussians, left_out: list[dict[str, Any]]) -> TrimmedModel:
    """The model that a cut leaves; `still_poses` says of all N Gaussians how each would stand still."""
    network = cut.network if cut.moves.any() else replace(cut.network, layers=())
    still = np.flatnonzero(cut.kept & ~cut.moves)
    moving = _model(model, network, torch.from_numpy(cut.moves), cut.sh_degree)
    return TrimmedModel(moving, rows(still_poses, still, cut.sh_degree), cut.ids, tuple(left_out))


def untrimmed(model: DynamicGaussians) -> TrimmedModel:
    """All of a model."""
    every = np.arange(len(model.gaussians))
    with torch.no_grad():
        canonical = as_gaussians(model.pose(0.0, deform=False))
    return TrimmedModel(model, rows(canonical, every[:0], model.config.sh_degree), every)


def with_sh_degree(trimmed: TrimmedModel, sh_degree: int) -> TrimmedModel:
    """The same Gaussians with the SH bands up to `sh_degree` alone."""
    before = trimmed.moving.config.sh_degree
    network = whole(trimmed.moving).network
    still = rows(trimmed.still, np.arange(len(trimmed.still)), sh_degree)
    entry = {"rule": "sh_degree", "what": "SH bands, as asked for", "count": before - sh_degree, "of": before}
    moving = _model(trimmed.moving, network, slice(None), sh_degree)
    return TrimmedModel(moving, still, trimmed.ids, (*trimmed.left_out, entry))


def rows(gaussians: Gaussians, ids: np.ndarray, sh_degree: int) -> Gaussians:
    """Some Gaussians, with the SH bands up to `sh_degree`."""
    g, coefficients = gaussians, sh_coefficients(sh_degree)
    return Gaussians(g.means[ids], g.quats[ids], g.scales[ids], g.opacities[ids], g.sh[ids, :coefficients])


def _model(model: DynamicGaussians, network: Network, which: slice | torch.Tensor, sh_degree: int) -> DynamicGaussians:
    tensors = {name: parameter.detach()[which] for name, parameter in model.gaussians.named_parameters()}
    tensors["sh_rest"] = tensors["sh_rest"][:, : sh_coefficients(sh_degree) - 1]
    if not network.modulated:
        tensors.pop("embeddings", None)
    if not any(model.config.layers[k] == "bases" for k in network.layers):
        tensors.pop("skinning_logits", None)
        tensors.pop("node_ids", None)
    layers = [model.deformation.layers[k] for k in network.layers]
    config = replace(
        model.config,
        layers=tuple(model.config.layers[k] for k in network.layers),
        sh_degree=sh_degree,
        embedding_dim=model.config.embedding_dim if network.modulated else 0,
    )
    with torch.random.fork_rng(devices=[]):  # new layers draw random weights, which are not kept
        smaller = DynamicGaussians(config, CanonicalGaussians(**tensors))
    smaller.deformation = MultiStepDeformation(_without_heads(layer, network.heads) for layer in layers)
    smaller.modulation = model.modulation if network.modulated else None
    return smaller.requires_grad_(requires_grad=False)


def _without_heads(layer: torch.nn.Module, heads: frozenset[str]) -> torch.nn.Module:
    """The layer with zeros in place of the heads that are left out; a plan stores no column that is all zeros."""
    missing = [name for name in HEADS if name not in heads]
    if not missing:
        return layer
    layer = copy.deepcopy(layer)
    with torch.no_grad():
        for name in missing:
            if isinstance(layer, MLPLayer):
                layer.heads.weight[_COLUMNS[name]] = 0
                layer.heads.bias[_COLUMNS[name]] = 0
            elif isinstance(layer, PlaneLayer):
                for parameter in layer.heads[HEADS.index(name)].parameters():
                    parameter.zero_()
    return layer
