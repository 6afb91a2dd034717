"""Deformation fields beside those of their own programs, at the commits that the vectors name."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from msdgs_export.importers.runs.base import RunImporter
from msdgs_export.importers.runs.deformgs import DeformGSImporter
from msdgs_export.importers.runs.fourdgs import FourDGSImporter
from msdgs_export.importers.runs.state import State
from msdgs_train.engine.optimizer import make_optimizer, set_learning_rates
from msdgs_train.engine.schedule import Schedule
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.layers.base import DeformationLayer
from msdgs_train.layers.mlp import MLPLayer
from msdgs_train.layers.plane import PlaneLayer
from msdgs_train.systems.registry import preset
from tests.agreement import deformgs, fourdgs
from tests.agreement.fields import LAST_STEP, outputs, seeded_state, trained
from tests.support.tolerances import assert_close, tolerance


def box(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """With the box of the planes, which isn't seeded."""
    half = torch.full((3,), fourdgs.BOX)
    return state | {"deformation_net.grid.aabb": torch.stack([half, -half])}


def with_their_rates(layer: DeformationLayer) -> None:
    if isinstance(layer, PlaneLayer):
        (init, final), (grid_init, grid_final) = fourdgs.RATES, fourdgs.GRID_RATES
        layer.config = replace(
            layer.config, lr_init=init, lr_final=final, grid_lr_init=grid_init, grid_lr_final=grid_final
        )
    else:
        assert isinstance(layer, MLPLayer)
        layer.config = replace(layer.config, lr_init=deformgs.RATES[0], lr_final=deformgs.RATES[1])


@pytest.mark.parametrize(
    ("program", "importer", "complete"),
    [(deformgs, DeformGSImporter(), dict), (fourdgs, FourDGSImporter(), box)],
    ids=["deformgs", "4dgs"],
)
def test_a_field_is_that_of_its_own_program(
    program: ModuleType,
    importer: RunImporter,
    complete: Callable[[Any], dict[str, Tensor]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Before training, and after five steps of the optimizer with its rates."""
    monkeypatch.setattr("msdgs_export.importers.runs.state.read_guarded", lambda read, file: read(file))
    with np.load(program.VECTORS) as stored:
        vectors = dict(stored)
    torch.save(complete(seeded_state(vectors)), tmp_path / "state.pth")
    run: Any = SimpleNamespace(state=State(tmp_path / "state.pth"), settings={})
    model, _ = importer.read(run, CanonicalGaussians.random_in_cube(2, 1.0, 3, 0))
    layer = model.deformation.layers[0]
    assert isinstance(layer, DeformationLayer)

    def field(means: Tensor, t: float) -> Tensor:
        step = layer(means, torch.tensor(t))
        return torch.cat([step.delta_means, step.delta_quats, step.delta_scales], dim=1)

    assert_close(outputs(field), vectors["before"], "agreement.forward")
    with_their_rates(layer)
    schedule = Schedule.from_config(preset("deformgs-faithful").updated(steps=LAST_STEP))
    groups = layer.parameter_groups()
    optimizer = make_optimizer(groups, schedule)
    losses = trained(field, lambda step: set_learning_rates(optimizer, groups, schedule, step, 1.0), optimizer)
    assert_close(losses, vectors["losses"], "agreement.training")
    assert_close(outputs(field), vectors["after"], "agreement.training")
    assert float(np.abs(vectors["after"] - vectors["before"]).max()) > 10 * tolerance("agreement.training")
