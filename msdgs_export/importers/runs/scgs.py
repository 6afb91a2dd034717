"""Runs of SC-GS: the network of Deformable-3D-Gaussians at control nodes, which Gaussians follow."""

from typing import Any

import torch

from msdgs_export.importers.errors import ImportFailed
from msdgs_export.importers.runs.base import filled_model
from msdgs_export.importers.runs.deformgs import HEADS, fill_network, network_config
from msdgs_export.importers.runs.state import RunFolder, State
from msdgs_export.importers.splats.ply_columns import Columns
from msdgs_serve.scene.errors import InvalidInput
from msdgs_serve.scene.spherical_harmonics import SH_DEGREES
from msdgs_train.datasets.common.ply_file import PlyFile
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.model import DynamicGaussians, ModelConfig
from msdgs_train.gaussians.model_file import SceneInfo
from msdgs_train.supports.scgs import NodeRows, SCGSConfig, SCGSSupport

NETWORK = "network."
ALL_HEADS = {**HEADS, "local_rotation": 4}
NEAREST = 3
"""Nodes that a Gaussian follows, if cfg_args don't say."""

REFUSED = ("pred_opacity", "pred_color", "use_hash", "skinning", "gs_with_motion_mask", "d_rot_as_rotmat")
REFUSED += ("progressive_brand_time",)
"""Switches of cfg_args that give another model."""


class SCGSImporter:
    """Importer of SC-GS."""

    networks = "deform/iteration_*/deform.pth"
    marker = "_node_radius"
    white_background = False

    def read(self, run: RunFolder, gaussians: CanonicalGaussians) -> tuple[DynamicGaussians, list[str]]:
        """The model of a run; no notes."""
        state, settings = run.state, run.settings
        _refuse_others(state, settings)
        nodes = state.read("nodes", None, None)
        try:
            support = SCGSConfig(len(nodes), settings.get("K", NEAREST), nodes.shape[1] - 3)
            config = ModelConfig(
                sh_degree=SH_DEGREES[1 + gaussians.sh_rest.shape[1]],
                support=support,
                layers=(network_config(state.part(NETWORK)),),
                weights=False,
                embedding_dim=0,
                scale_space="linear",
            )
        except InvalidInput as error:
            raise ImportFailed(state.file, f"has sizes that can't be read: {error}") from error
        tensors = {name: parameter.detach() for name, parameter in gaussians.named_parameters()}
        hypers = _hyper_coords(run, support.hyper_dim)
        gaussians = CanonicalGaussians(**tensors | {"hyper_coords": hypers})
        return filled_model(config, gaussians, lambda model: fill_model(model, state)), []

    def fidelity(self, model: DynamicGaussians, info: SceneInfo) -> None:
        """Its renderer draws the same."""


def _refuse_others(state: State, settings: dict[str, Any]) -> None:
    switches = [name for name in REFUSED if settings.get(name)]
    switches += [] if settings.get("d_rot_as_res", True) else ["d_rot_as_res=False"]
    switches += ["max_d_scale"] if settings.get("max_d_scale", -1) > 0 else []
    if switches:
        raise ImportFailed(state.file, f"was trained with {switches[0]}, which no support of this project has")


def _hyper_coords(run: RunFolder, count: int) -> torch.Tensor:
    """[N, H] of the Gaussians, from the columns `fea_…` of the point cloud."""
    columns = Columns.of(run.cloud, PlyFile(run.cloud), "vertex")
    if columns.count("fea_") != count:
        raise ImportFailed(run.cloud, f"has {columns.count('fea_')} of `fea_…`; its nodes have {count}")
    values = torch.from_numpy(columns.stack("fea_", count)).float()
    if not torch.isfinite(values).all():
        raise ImportFailed(run.cloud, "`fea_…` hold NaN or infinity")
    return values


@torch.no_grad()
def fill_model(model: DynamicGaussians, state: State) -> None:
    """Set the layer's parameters, with no local rotations if the run was trained without, and the nodes."""
    support = model.support
    assert isinstance(support, SCGSSupport)
    m, h = support.node_hypers.shape
    network = state.part(NETWORK)
    if "local_rotation.weight" not in network:
        width = len(network.read("linear.0.bias", None))
        network = network.with_zeros({"local_rotation.weight": (4, width), "local_rotation.bias": (4,)})
    fill_network(model, network, ALL_HEADS)
    nodes, logits = state.read("nodes", m, 3 + h), state.read("_node_weight", m, 1)
    stored = NodeRows(nodes[:, :3], nodes[:, 3:], state.read("_node_radius", m), logits[:, 0])
    for name, values in stored._asdict().items():
        support.get_parameter(name).copy_(values)
    support.set_placed(True)
