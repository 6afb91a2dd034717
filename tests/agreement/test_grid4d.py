"""The hash layer beside Grid4D's own program at the commit that grid4d.npz names."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console
from scipy.spatial.transform import Rotation
from torch import Tensor

from msdgs_export.importers.detect import detect_format
from msdgs_export.importers.runs.grid4d import Grid4DImporter
from msdgs_export.importers.runs.model import write_model
from msdgs_train.gaussians.model_file import load_model
from msdgs_train.layers.hash4d import Hash4DLayer
from tests.agreement import grid4d
from tests.agreement.grid4d import CASES, LAST_STEP, TIMES, WEIGHT, loss, points, stored_states
from tests.support.foreign_runs import write_grid4d
from tests.support.tolerances import assert_close, tolerance


@pytest.fixture(scope="module")
def vectors() -> dict[str, np.ndarray]:
    with np.load(grid4d.VECTORS) as stored:
        return dict(stored)


@pytest.fixture
def layer(request: pytest.FixtureRequest, vectors: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Hash4DLayer:
    """The layer of an imported run of a case."""
    monkeypatch.setattr("msdgs_export.importers.runs.state.read_guarded", lambda read, file: read(file))
    monkeypatch.setattr(Grid4DImporter, "fidelity", lambda *_: None)  # of frames, which take most of the time
    run = write_grid4d(tmp_path / "run", stored_states(vectors, request.param))
    assert detect_format(run) == "grid4d"
    write_model(run, "grid4d", tmp_path / "model.pt", Console(quiet=True))
    found = load_model(tmp_path / "model.pt").model.deformation.layers[0]
    assert isinstance(found, Hash4DLayer)
    return found


def outputs(layer: Hash4DLayer, count: int) -> np.ndarray:
    """[T, N, 10] means and deltas of rotations and scales."""
    where, rows = points(count), []
    for t in TIMES:
        with torch.no_grad():
            step = layer(where, torch.tensor(t))
        rows.append(torch.cat([where + step.delta_means, step.delta_quats, step.delta_scales], dim=1))
    return torch.stack(rows).numpy()


def moved(theirs: np.ndarray) -> np.ndarray:
    """Their outputs, [T, N, 14], a quaternion, a shift, and deltas, as `outputs`."""
    turns = Rotation.from_quat(theirs[..., [1, 2, 3, 0]].reshape(-1, 4))
    where = np.tile(points(theirs.shape[1]).numpy(), (len(theirs), 1))
    means = turns.apply(where).reshape(*theirs.shape[:2], 3) + theirs[..., 4:7]
    return np.concatenate([means, theirs[..., 7:]], axis=2)


@pytest.mark.parametrize(("layer", "case"), [(name, name) for name in CASES], indirect=["layer"])
def test_the_network_gives_what_theirs_gives(layer: Hash4DLayer, case: str, vectors: dict[str, np.ndarray]):
    assert_close(outputs(layer, CASES[case].points), moved(vectors[f"{case}.outputs"]), "agreement.forward")
    if case == "published":
        assert sum(p.numel() for p in layer.parameters()) == 13_224_948


def changes(layer: Hash4DLayer, before: dict[str, Tensor]) -> Tensor:
    """Norms of the changes of all parameters in the order of theirs."""
    found = {name: p.detach() - before[name] for name, p in layer.named_parameters()}
    heads = [found["heads.weight"], found["heads.bias"]]
    for part in ("hidden.0", "from_temporal", "from_canonical"):
        heads = [found[f"{part}.weight"], found[f"{part}.bias"], *heads]
    tables = [found["canonical.table"], *(found[f"temporal.{k}.table"] for k in range(3))]
    *rest, weight, bias = heads
    rows = (slice(0, 7), slice(10, 14), slice(7, 10))  # of turns and shifts, rotations and scales
    parts = [each for part in rows for each in (weight[part], bias[part])]
    return torch.stack([each.double().norm() for each in (*tables, *rest, *parts)])


@pytest.mark.parametrize("layer", ["small"], indirect=True)
def test_five_optimizer_steps_are_theirs(layer: Hash4DLayer, vectors: dict[str, np.ndarray]):
    case, groups = CASES["small"], layer.parameter_groups()
    before = {name: p.detach().clone() for name, p in layer.named_parameters()}
    layer.requires_grad_(True)
    optimizer = torch.optim.Adam([{"params": g.params, "lr": 0.0} for g in groups], eps=1e-15)
    where, losses = points(case.points), []
    assert {layer.config.spatial_weight, layer.config.temporal_weight} == {WEIGHT}
    for k in range(case.steps):
        for group, settings in zip(groups, optimizer.param_groups, strict=True):
            settings["lr"] = group.lr._replace(until=1.0).at(k, LAST_STEP, 0)
        t = torch.tensor(TIMES[k % len(TIMES)])
        step = layer(where, t)
        total = loss(where + step.delta_means, step.delta_quats, step.delta_scales)
        total = total + sum(layer.regularizers(where, t, torch.Generator().manual_seed(k)).values())
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        losses.append(float(total.detach()))
    assert_close(losses, vectors["small.losses"], "agreement.training")
    assert_close(outputs(layer, case.points), moved(vectors["small.trained"]), "agreement.training")
    ratios = changes(layer, before).numpy() / vectors["small.changes"]
    assert np.abs(ratios - 1).max() <= tolerance("agreement.training")
