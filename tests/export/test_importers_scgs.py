"""Import of runs of SC-GS, compared with what its own modules compute."""

from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console

from msdgs_export.bake import bake
from msdgs_export.importers.detect import detect_format
from msdgs_export.importers.errors import ImportFailed
from msdgs_export.importers.runs.model import write_model
from msdgs_export.trajectories.poses import ExactPoses
from msdgs_train.gaussians.model_file import load_model
from tests.support import scgs_reference as reference
from tests.support.models import SCENE, export_scene
from tests.support.scgs_models import scgs_model, write_scgs
from tests.support.tolerances import assert_close, tolerance

QUIET = Console(quiet=True)


@pytest.fixture(autouse=True)
def _networks_are_read_in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("msdgs_export.importers.runs.state.read_guarded", lambda read, file: read(file))


def test_a_run_is_imported_and_exported(tmp_path: Path):
    run = write_scgs(tmp_path / "run")
    assert detect_format(run) == "scgs"
    assert write_model(run, "scgs", tmp_path / "model.pt", QUIET) == []
    model = load_model(tmp_path / "model.pt").model
    with np.load(reference.VECTORS) as stored:
        for index, t in enumerate(reference.TIMES):
            posed = model.pose(t)._asdict()
            for name in ("means", "quats", "scales"):
                assert_close(posed[name].detach(), stored[f"posed{index}.{name}"], "scgs.pose")
    exported = export_scene(tmp_path / "model.pt", tmp_path / "scene.onnx", times=4)
    assert exported.measured_error["means"] <= tolerance("export.relative")


def test_plans_that_are_fitted_see_the_poses_of_the_model():
    model = scgs_model()
    exact = ExactPoses(bake(model, SCENE, "0" * 64)).at(0.6)
    with torch.no_grad():
        posed = model.double().pose(0.6)
    expected = torch.cat([posed.means, posed.scales, posed.quats], dim=1)
    assert_close(exact, expected, "scgs.exact")


def test_a_run_without_local_frames_moves_by_translations(tmp_path: Path):
    run = write_scgs(tmp_path / "run")
    network = run / "deform" / "iteration_80000" / "deform.pth"
    state = {name: v for name, v in torch.load(network).items() if "local_rotation" not in name}
    torch.save(state, network)
    write_model(run, "scgs", tmp_path / "model.pt", QUIET)
    model = load_model(tmp_path / "model.pt").model
    t = torch.tensor(0.3)
    weights, ids = model.support.weights(model.gaussians.means, model.gaussians.attributes["hyper_coords"])  # pyright: ignore
    translations = model.deformation(model.support.points(model.gaussians.means), t).means
    expected = model.gaussians.means + (weights[..., None] * translations[ids]).sum(dim=1)
    assert_close(model.pose(0.3).means.detach(), expected.detach(), "scgs.pose")


@pytest.mark.parametrize(
    "switches",
    ["pred_color=True", "use_hash=True", "gs_with_motion_mask=True", "d_rot_as_res=False", "max_d_scale=2.0"],
)
def test_other_models_are_refused_by_their_switch(tmp_path: Path, switches: str):
    run = write_scgs(tmp_path / "run", f", {switches}")
    with pytest.raises(ImportFailed, match=f"was trained with {switches.split('=')[0]}"):
        write_model(run, "scgs", tmp_path / "model.pt", QUIET)


def test_gaussians_without_hyper_coordinates_are_refused(tmp_path: Path):
    run = write_scgs(tmp_path / "run")
    cloud = run / "point_cloud" / "iteration_80000" / "point_cloud.ply"
    cloud.write_bytes(cloud.read_bytes().replace(b"fea_7", b"fxa_7"))
    with pytest.raises(ImportFailed, match="has 7 of `fea_…`; its nodes have 8"):
        write_model(run, "scgs", tmp_path / "model.pt", QUIET)
