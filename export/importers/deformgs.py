"""Runs of Deformable-3D-Gaussians: one MLP that reads encoded position and time, deltas in activated space."""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from export.importers.errors import ImportFailed
from export.importers.state import State
from msdgs_serve.scene.spherical_harmonics import SH_DEGREES
from msdgs_train.gaussians import CanonicalGaussians
from msdgs_train.layers import MLPLayer
from msdgs_train.model import DynamicGaussians, ModelConfig

XYZ_FREQUENCIES = 10
MOST_LAYERS = 64
CHECKED_TIMES, CHECKED_GAUSSIANS = 9, 10_000
"""At which lengths of quaternions are looked at."""


def read_deformgs(
    run: Path, gaussians: CanonicalGaussians, iteration: int, settings: dict[str, Any]
) -> tuple[DynamicGaussians, list[str]]:
    """The model of an iteration, and notes. Raises `ImportFailed` for networks that are built otherwise."""
    file = run / "deform" / f"iteration_{iteration}" / "deform.pth"
    if not file.is_file():
        raise ImportFailed(run, f"has point_cloud/iteration_{iteration} but no deform/iteration_{iteration}/deform.pth")
    state = State(file)
    if settings.get("is_6dof") or "branch_w.weight" in state:
        raise ImportFailed(file, "was trained with --is_6dof, whose screw motions no layer of this project has")
    depth = sum(name.startswith("linear.") and name.endswith(".weight") for name in state.names())
    if not 2 <= depth <= MOST_LAYERS:
        raise ImportFailed(file, f"has {depth} hidden layers; from 2 to {MOST_LAYERS} can be read")
    width = len(state.read("linear.0.bias", None))
    by_network = "timenet.0.weight" in state
    time_width, time_features, frequencies = _time_sizes(state, by_network, width)
    config = ModelConfig(
        sh_degree=SH_DEGREES[1 + gaussians.sh_rest.shape[1]],
        layers=("mlp",),
        width=width,
        depth=depth,
        time_frequencies=frequencies,
        time_width=time_width,
        time_features=time_features,
        skip=depth // 2 + 1,
        weights=False,
        embedding_size=0,
        delta_space="activated",
    )
    model = DynamicGaussians(config, gaussians)
    layer = model.deformation.layers[0]
    assert isinstance(layer, MLPLayer)
    with torch.no_grad():
        _fill(layer, state, by_network)
    return model, [_quaternion_note(model)]


def _time_sizes(state: State, by_network: bool, width: int) -> tuple[int, int, int]:
    """Width and outputs of the small network of time, and frequencies of its input."""
    if by_network:
        hidden = state.read("timenet.0.weight", None, None)
        return len(hidden), len(state.read("timenet.2.bias", None)), (hidden.shape[1] - 1) // 2
    encoded = state.read("linear.0.weight", width, None).shape[1] - (3 + 6 * XYZ_FREQUENCIES)
    if encoded < 1 or encoded % 2 == 0:
        raise ImportFailed(state.file, f"`linear.0.weight` has {encoded} columns for an encoded time")
    return 2 * encoded, encoded, (encoded - 1) // 2


def _fill(layer: MLPLayer, state: State, by_network: bool) -> None:
    """Their tensors in the layer's places. Their encoding has sine and cosine of a frequency side by side."""
    order = _octave_order(3, XYZ_FREQUENCIES)
    times = _octave_order(1, (layer.time_hidden.in_features - 1) // 2)
    features = layer.input_features - layer.xyz_features
    inputs = torch.cat([order, layer.xyz_features + (torch.arange(features) if by_network else times)])
    if by_network:
        hidden, out = layer.time_hidden, layer.time_output
        _set(hidden, state.read("timenet.0.weight", *hidden.weight.shape)[:, times], state.read("timenet.0.bias", None))
        _set(out, state.read("timenet.2.weight", *out.weight.shape), state.read("timenet.2.bias", None))
    else:  # the encoded time itself: x = relu(x) − relu(−x)
        eye = torch.eye(features)
        _set(layer.time_hidden, torch.cat([eye, -eye]), torch.zeros(2 * features))
        _set(layer.time_output, torch.cat([eye, -eye], dim=1), torch.zeros(features))
    for i, linear in enumerate([layer.first, *layer.trunk]):
        assert isinstance(linear, nn.Linear)
        weight = state.read(f"linear.{i}.weight", *linear.weight.shape)
        if i in (0, layer.skip):
            weight = torch.cat([weight[:, inputs], weight[:, len(inputs) :]], dim=1)
        _set(linear, weight, state.read(f"linear.{i}.bias", len(linear.bias)))
    heads = [("gaussian_warp", 3), ("gaussian_scaling", 3), ("gaussian_rotation", 4)]
    _set(
        layer.heads,
        torch.cat([state.read(f"{name}.weight", size, layer.heads.in_features) for name, size in heads]),
        torch.cat([state.read(f"{name}.bias", size) for name, size in heads]),
    )


def _octave_order(dimensions: int, frequencies: int) -> Tensor:
    """Where in their encoding (x, sin x, cos x, sin 2x, cos 2x, …) the columns of ours (x, sines, cosines) are."""
    places = torch.arange(2 * frequencies * dimensions).reshape(frequencies, 2, dimensions).transpose(0, 1)
    return torch.cat([torch.arange(dimensions), dimensions + places.reshape(-1)])


def _set(linear: nn.Linear, weight: Tensor, bias: Tensor) -> None:
    linear.weight.copy_(weight)
    linear.bias.copy_(bias)


@torch.no_grad()
def _quaternion_note(model: DynamicGaussians) -> str:
    """How far covariances of unit quaternions are from theirs, which uses normalize(q) + Δq as it is."""
    layer, count = model.deformation.layers[0], len(model.gaussians)
    g = model.gaussians.rows(torch.arange(0, count, max(1, count // CHECKED_GAUSSIANS)))
    quats = g.raw_quats / torch.linalg.vector_norm(g.raw_quats, dim=1, keepdim=True)
    worst = torch.zeros(len(quats))
    for t in torch.linspace(0, 1, CHECKED_TIMES):
        lengths = torch.linalg.vector_norm(quats + layer(g.means, t).delta_quats, dim=1)
        worst = torch.maximum(worst, (lengths - 1).abs())
    share = float((worst > 0.01).double().mean())
    return (
        f"their renderer takes quaternions of any length, a scene file unit ones: lengths differ from 1 by up to "
        f"{float(worst.max()):.3g}, by more than 0.01 at {share:.1%} of the Gaussians; their shapes are drawn unbent"
    )
