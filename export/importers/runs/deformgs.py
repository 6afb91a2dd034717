"""Runs of Deformable-3D-Gaussians: one MLP that reads encoded position and time, deltas in activated space."""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from export.importers.errors import ImportFailed
from export.importers.runs.base import Fidelity
from export.importers.runs.fidelity import quaternion_fidelity
from export.importers.runs.state import State
from msdgs_serve.scene.spherical_harmonics import SH_DEGREES
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.model import DynamicGaussians, ModelConfig
from msdgs_train.gaussians.model_file import SceneInfo
from msdgs_train.layers.mlp import MLPConfig, MLPLayer

XYZ_FREQUENCIES = 10
MIN_LAYERS, MAX_LAYERS = 3, 64
"""With two, the heads would read the input once more; ours don't."""

MAX_UNITS, MAX_FREQUENCIES = 4_096, 64
"""Sixteen times the usual width; what is above 2⁶⁴ turns in unit time is noise in float32."""


class DeformGSImporter:
    """Of Deformable-3D-Gaussians."""

    white_background = False

    def detects(self, run: Path) -> bool:
        """Its networks are in files of their own."""
        return next(run.glob("deform/iteration_*/deform.pth"), None) is not None

    def read(
        self, run: Path, gaussians: CanonicalGaussians, iteration: int, settings: dict[str, Any]
    ) -> tuple[DynamicGaussians, list[str]]:
        """The model of an iteration, without notes."""
        return read_deformgs(run, gaussians, iteration, settings), []

    def fidelity(self, model: DynamicGaussians, info: SceneInfo) -> Fidelity:
        """Its rasterizer doesn't normalise quaternions."""
        return quaternion_fidelity(model, info)


def read_deformgs(
    run: Path, gaussians: CanonicalGaussians, iteration: int, settings: dict[str, Any]
) -> DynamicGaussians:
    """The model of an iteration. Raises `ImportFailed` for networks that are built otherwise."""
    file = run / "deform" / f"iteration_{iteration}" / "deform.pth"
    if not file.is_file():
        raise ImportFailed(run, f"has point_cloud/iteration_{iteration} but no deform/iteration_{iteration}/deform.pth")
    state = State(file)
    if settings.get("is_6dof") or "branch_w.weight" in state:
        raise ImportFailed(file, "was trained with --is_6dof, whose screw motions no layer of this project has")
    depth = sum(name.startswith("linear.") and name.endswith(".weight") for name in state.names())
    if not MIN_LAYERS <= depth <= MAX_LAYERS:
        raise ImportFailed(file, f"has {depth} hidden layers; from {MIN_LAYERS} to {MAX_LAYERS} can be read")
    width = len(state.read("linear.0.bias", None))
    by_network = "timenet.0.weight" in state
    time_width, time_features, frequencies = _time_sizes(state, by_network, width)
    if not all(1 <= size <= MAX_UNITS for size in (width, time_width, time_features)):
        found = f"{width:,} units a layer, and {time_width:,} and {time_features:,} for time"
        raise ImportFailed(file, f"has {found}; from 1 to {MAX_UNITS:,} can be read")
    if not 0 <= frequencies <= MAX_FREQUENCIES:
        raise ImportFailed(file, f"reads {frequencies:,} frequencies of time; up to {MAX_FREQUENCIES} can be read")
    config = ModelConfig(
        sh_degree=SH_DEGREES[1 + gaussians.sh_rest.shape[1]],
        layers=(
            MLPConfig(
                width=width,
                depth=depth,
                time_frequencies=frequencies,
                time_width=time_width,
                time_features=time_features,
                skip=depth // 2 + 1,
            ),
        ),
        weights=False,
        embedding_dim=0,
        scale_space="linear",
    )
    with torch.device("meta"):
        shapes_only = DynamicGaussians(config, gaussians)
    _fill(shapes_only, state, by_network)  # all tensors must fit before memory is taken for any
    model = DynamicGaussians(config, gaussians)
    _fill(model, state, by_network)
    return model


def _time_sizes(state: State, by_network: bool, width: int) -> tuple[int, int, int]:
    """Width and outputs of the small network of time, and frequencies of its input."""
    if by_network:
        hidden = state.read("timenet.0.weight", None, None)
        return len(hidden), len(state.read("timenet.2.bias", None)), (hidden.shape[1] - 1) // 2
    encoded = state.read("linear.0.weight", width, None).shape[1] - (3 + 6 * XYZ_FREQUENCIES)
    if encoded < 1 or encoded % 2 == 0:
        raise ImportFailed(state.file, f"`linear.0.weight` has {encoded} columns for an encoded time")
    return 2 * encoded, encoded, (encoded - 1) // 2


@torch.no_grad()
def _fill(model: DynamicGaussians, state: State, by_network: bool) -> None:
    """Their tensors in the layer's places. Their encoding has sine and cosine of a frequency side by side."""
    layer = model.deformation.layers[0]
    assert isinstance(layer, MLPLayer)
    order = _octave_order(3, XYZ_FREQUENCIES)
    times = _octave_order(1, (layer.time_hidden.in_features - 1) // 2)
    features = layer.input_features - layer.xyz_features
    inputs = torch.cat([order, layer.xyz_features + (torch.arange(features) if by_network else times)])
    if by_network:
        hidden, out = layer.time_hidden, layer.time_output
        weight, bias = (state.read(f"timenet.0.{kind}", *getattr(hidden, kind).shape) for kind in ("weight", "bias"))
        _set(hidden, weight[:, times], bias)
        _set(out, *(state.read(f"timenet.2.{kind}", *getattr(out, kind).shape) for kind in ("weight", "bias")))
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
