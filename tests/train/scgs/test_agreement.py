"""Nodes, network and losses beside SC-GS's own modules: vectors of `tests.support.scgs_reference`."""

import numpy as np
import pytest
import torch
from torch import Tensor

from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.supports.scgs import SCGSSupport
from msdgs_train.systems.scgs.losses import (
    acceleration_loss,
    elastic_loss,
    near_time,
    rigidity_loss,
    sampled_times,
    trajectories,
)
from tests.support import scgs_reference as reference
from tests.support.scgs_models import scgs_model
from tests.support.tolerances import assert_close

GENERATOR = torch.Generator()


@pytest.fixture(scope="module")
def stored() -> dict[str, np.ndarray]:
    with np.load(reference.VECTORS) as vectors:
        return dict(vectors)


def posed(model: DynamicGaussians, t: float) -> dict[str, Tensor]:
    found = model.pose(t)
    return {"means": found.means, "quats": found.quats, "scales": found.scales}


@pytest.mark.parametrize("index", range(len(reference.TIMES)))
def test_poses_are_those_of_scgs(stored: dict[str, np.ndarray], index: int):
    model = scgs_model()
    for name, values in posed(model, reference.TIMES[index]).items():
        assert_close(values.detach(), stored[f"posed{index}.{name}"], "scgs.pose")


def losses(model: DynamicGaussians, t: float, draws: np.ndarray) -> Tensor:
    support, chain = model.support, model.deformation
    assert isinstance(support, SCGSSupport)
    with reference.drawn(draws):
        times = [sampled_times(near_time(t, 0.02, GENERATOR), 0.02, 8, GENERATOR)]
        times.append(near_time(t, 0.06, GENERATOR) + 0.06 * torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64))
        times.append(sampled_times(float(torch.rand(())), 0.05, 2, GENERATOR))
    elastic, acceleration, rigidity = (trajectories(chain, support.nodes, each) for each in times)
    weights, ids = (v[:, 1:] for v in support.weights(support.nodes, support.node_hypers, 3))
    values = (
        elastic_loss(elastic, weights, ids),
        acceleration_loss(acceleration),
        rigidity_loss(rigidity, GENERATOR),
    )
    return torch.stack(values)


def test_five_steps_are_those_of_scgs(stored: dict[str, np.ndarray]):
    model, targets = scgs_model().double(), reference.seeded_gaussians()
    rates = {"layers.0.network": reference.NETWORK_LR, "support.nodes": reference.NETWORK_LR}
    rates["hyper_coords"] = reference.HYPER_LR
    trained = {group.name: group for group in model.motion_groups()}
    assert trained.keys() == rates.keys()
    assert all(group.lr.init == rates[name] for name, group in trained.items() if name != "layers.0.network")
    groups = [{"params": group.params, "lr": rates[name]} for name, group in trained.items()]
    optimizer = torch.optim.Adam(groups, eps=reference.EPSILON)
    weights = torch.tensor([reference.ELASTIC, reference.ACCELERATION, reference.RIGIDITY], dtype=torch.float64)
    for step, (t, draws) in enumerate(zip(reference.FITTED_TIMES, reference.seeded_draws(), strict=True)):
        found = losses(model, t, draws)
        assert_close(found.detach(), stored["losses"][step], "scgs.losses.relative")
        (reference.fitted_error(posed(model, t), targets) + weights @ found).backward()
        optimizer.step()
        optimizer.zero_grad()
    for name, values in posed(model, reference.TIMES[1]).items():
        assert_close(values.detach(), stored[f"fitted.{name}"], "scgs.fitted")
    for name in ("node_hypers", "log_radii", "node_logits"):
        assert_close(getattr(model.support, name).detach(), stored[f"fitted.{name}"], "scgs.fitted")
    assert_close(model.gaussians.attributes["hyper_coords"].detach(), stored["fitted.hyper_coords"], "scgs.fitted")
