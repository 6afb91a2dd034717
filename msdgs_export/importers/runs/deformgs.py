"""Runs of Deformable-3D-Gaussians: one MLP that reads encoded position and time, deltas in activated space."""

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from msdgs_export.importers.errors import ImportFailed
from msdgs_export.importers.runs.base import Loss, filled_model
from msdgs_export.importers.runs.fidelity import quaternion_fidelity
from msdgs_export.importers.runs.state import RunFolder, State
from msdgs_serve.scene.spherical_harmonics import SH_DEGREES
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.model import DynamicGaussians, ModelConfig
from msdgs_train.gaussians.model_file import SceneInfo
from msdgs_train.layers.mlp import MLPConfig, MLPLayer

XYZ_FREQUENCIES = 10
MIN_LAYERS, MAX_LAYERS = 3, 64
"""With two hidden layers, the heads would also read the input, which `MLPLayer` doesn't support."""

MAX_UNITS, MAX_FREQUENCIES = 4_096, 64
"""Sixteen times the usual width; frequencies above 2⁶⁴ are noise in float32."""

HEADS = {"gaussian_warp": 3, "gaussian_scaling": 3, "gaussian_rotation": 4}


class DeformGSImporter:
    """Importer of Deformable-3D-Gaussians."""

    networks = "deform/iteration_*/deform.pth"
    marker = ""
    white_background = False

    def read(self, run: RunFolder, gaussians: CanonicalGaussians) -> tuple[DynamicGaussians, list[str]]:
        """The model of a run; no notes."""
        state = run.state
        if run.settings.get("is_6dof") or "branch_w.weight" in state:
            raise ImportFailed(
                state.file, "was trained with --is_6dof, whose screw motions no layer of this project has"
            )
        config = ModelConfig(
            sh_degree=SH_DEGREES[1 + gaussians.sh_rest.shape[1]],
            layers=(network_config(state),),
            weights=False,
            embedding_dim=0,
            scale_space="linear",
        )
        return filled_model(config, gaussians, lambda model: fill_network(model, state, HEADS)), []

    def fidelity(self, model: DynamicGaussians, info: SceneInfo) -> Loss:
        """Its rasterizer doesn't normalize quaternions."""
        return quaternion_fidelity(model, info)


def network_config(state: State) -> MLPConfig:
    """The sizes of a network. Raises `ImportFailed` for those that no layer can have."""
    depth = sum(name.startswith("linear.") and name.endswith(".weight") for name in state.names())
    if not MIN_LAYERS <= depth <= MAX_LAYERS:
        raise ImportFailed(state.file, f"has {depth} hidden layers; from {MIN_LAYERS} to {MAX_LAYERS} can be read")
    width = len(state.read("linear.0.bias", None))
    time_width, time_features, frequencies = _time_sizes(state, width)
    if not all(1 <= size <= MAX_UNITS for size in (width, time_width, time_features)):
        found = f"{width:,} units a layer, and {time_width:,} and {time_features:,} for time"
        raise ImportFailed(state.file, f"has {found}; from 1 to {MAX_UNITS:,} can be read")
    if not 0 <= frequencies <= MAX_FREQUENCIES:
        raise ImportFailed(
            state.file, f"reads {frequencies:,} frequencies of time; up to {MAX_FREQUENCIES} can be read"
        )
    return MLPConfig(
        width=width,
        depth=depth,
        time_frequencies=frequencies,
        time_width=time_width,
        time_features=time_features,
        time_network="timenet.0.weight" in state,
        skip=depth // 2 + 1,
    )


def _time_sizes(state: State, width: int) -> tuple[int, int, int]:
    """Width and outputs of the small network of time, and frequencies of its input."""
    if "timenet.0.weight" in state:
        hidden = state.read("timenet.0.weight", None, None)
        return len(hidden), len(state.read("timenet.2.bias", None)), (hidden.shape[1] - 1) // 2
    encoded = state.read("linear.0.weight", width, None).shape[1] - (3 + 6 * XYZ_FREQUENCIES)
    if encoded < 1 or encoded % 2 == 0:
        raise ImportFailed(state.file, f"`linear.0.weight` has {encoded} columns for an encoded time")
    return 2 * encoded, encoded, (encoded - 1) // 2


@torch.no_grad()
def fill_network(model: DynamicGaussians, state: State, heads: Mapping[str, int]) -> None:
    """Set the layer's parameters; `heads` are names and sizes of the stored ones in the layer's order. The stored
    encoding has sine and cosine of a frequency side by side."""
    layer = model.deformation.layers[0]
    assert isinstance(layer, MLPLayer)
    order = _octave_order(3, XYZ_FREQUENCIES)
    times = _octave_order(1, (layer.time_hidden.in_features - 1) // 2)
    features = layer.input_features - layer.xyz_features
    if "timenet.0.weight" in state:
        inputs = torch.cat([order, layer.xyz_features + torch.arange(features)])
        state.fill(layer.time_hidden, "timenet.0")
        layer.time_hidden.weight.copy_(layer.time_hidden.weight[:, times])
        state.fill(layer.time_output, "timenet.2")
    else:
        inputs = torch.cat([order, layer.xyz_features + times])
    for i, linear in enumerate([layer.first, *layer.trunk]):
        assert isinstance(linear, nn.Linear)
        state.fill(linear, f"linear.{i}")
        if i in (0, layer.skip):
            linear.weight[:, : len(inputs)] = linear.weight[:, inputs]
    weights = [state.read(f"{name}.weight", size, layer.heads.in_features) for name, size in heads.items()]
    _set(layer.heads, torch.cat(weights), torch.cat([state.read(f"{n}.bias", size) for n, size in heads.items()]))


def _octave_order(dimensions: int, frequencies: int) -> Tensor:
    """Columns of the stored encoding (x, sin x, cos x, sin 2x, cos 2x, …) in the order of ours (x, sines, cosines)."""
    places = torch.arange(2 * frequencies * dimensions).reshape(frequencies, 2, dimensions).transpose(0, 1)
    return torch.cat([torch.arange(dimensions), dimensions + places.reshape(-1)])


def _set(linear: nn.Linear, weight: Tensor, bias: Tensor) -> None:
    linear.weight.copy_(weight)
    linear.bias.copy_(bias)
