"""A model and a run of SC-GS with the seeded state of `scgs_reference`."""

from pathlib import Path

import numpy as np
import torch

from msdgs_export.importers.runs.scgs import fill_model, network_config
from msdgs_export.importers.runs.state import State
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.config import ModelConfig
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.supports.scgs import SCGSConfig
from tests.support import scgs_reference as reference
from tests.support.splat_files import inria_columns, ply_bytes, some_gaussians


class _State(State):
    """The seeded state, without a file."""

    def __init__(self) -> None:
        self.file = Path("deform.pth")
        self._values = {name: values.float() for name, values in reference.seeded_state().items()}


def scgs_model() -> DynamicGaussians:
    """The seeded network, nodes and Gaussians."""
    state, seeded = _State(), reference.seeded_gaussians()
    config = ModelConfig(
        sh_degree=0,
        support=SCGSConfig(reference.NODES, hyper_dim=reference.HYPER),
        layers=(network_config(state.part("network.")),),
        weights=False,
        embedding_dim=0,
        scale_space="linear",
    )
    stored = {n: seeded[n].float() for n in ("means", "log_scales", "raw_quats", "hyper_coords")}
    colors = torch.linspace(-1, 1, 3 * reference.GAUSSIANS).reshape(-1, 1, 3)
    rest = torch.zeros(reference.GAUSSIANS, 0, 3)
    gaussians = CanonicalGaussians(
        raw_opacities=torch.linspace(-2, 2, reference.GAUSSIANS), sh_dc=colors, sh_rest=rest, **stored
    )
    model = DynamicGaussians(config, gaussians)
    fill_model(model, state)
    return model


def write_scgs(folder: Path, switches: str = "") -> Path:
    """Write a run folder as SC-GS does."""
    cloud = folder / "point_cloud" / "iteration_80000" / "point_cloud.ply"
    network = folder / "deform" / "iteration_80000" / "deform.pth"
    cloud.parent.mkdir(parents=True)
    network.parent.mkdir(parents=True)
    seeded, columns = reference.seeded_gaussians(), inria_columns(some_gaussians(reference.GAUSSIANS, 3))
    values = {"rot_": seeded["raw_quats"], "fea_": seeded["hyper_coords"], "scale_": seeded["log_scales"]}
    for prefix, rows in values.items():
        columns |= {f"{prefix}{i}": column.astype(np.float32) for i, column in enumerate(rows.T.numpy())}
    columns |= {name: column.astype(np.float32) for name, column in zip("xyz", seeded["means"].T.numpy(), strict=True)}
    cloud.write_bytes(ply_bytes(columns))
    nodes = {f"gs_{name}": torch.zeros(reference.NODES, 3) for name in ("_xyz", "_scaling")}
    state = {name: values.float() for name, values in reference.seeded_state().items()}
    torch.save({"inited": torch.tensor(True), **state, **nodes}, network)
    (folder / "cfg_args").write_text(f"Namespace(sh_degree=3, K=3, hyper_dim=8, is_blender=True{switches})")
    return folder
