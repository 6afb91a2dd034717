"""How well the systems of a comparison represent motion: their layers are trained on known trajectories of points of
the synthetic scene instead of images."""

import statistics
import sys
from typing import Annotated

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.progress import track
from torch import Tensor

from benchmarks.measuring import machine, report_console, table
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.comparison.matrix import Budget, read_systems
from msdgs_train.datasets.synthetic.motion import OBJECTS, world_positions
from msdgs_train.datasets.synthetic.trajectories import surface_points
from msdgs_train.engine.config import TrainConfig
from msdgs_train.engine.optimizer import make_optimizer, set_learning_rates
from msdgs_train.engine.schedule import Schedule
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.model import DynamicGaussians
from msdgs_train.gaussians.surgery import RowSurgery
from msdgs_train.layers.base import SceneBounds
from msdgs_train.supports.gaussians import GaussiansConfig
from msdgs_train.supports.nodes import NodesConfig
from msdgs_train.systems.registry import DEFAULT

MOVING = OBJECTS[2:]
SCENE_HALF_SIZE = 1.3  # scene units
EVALUATED_TIMES = 61


def main(
    systems: Annotated[tuple[str, ...], tyro.conf.Positional] = ("benchmarks/training/ablation.toml",),
    steps: int = 1_200,
    seeds: tuple[int, ...] = (0, 1, 2),
    points: int = 400,
    check: bool = False,
) -> int:
    """Train each system on the trajectories of points, and print its final distance from them.

    python -m benchmarks.training.known_motion benchmarks/training/ablation.toml --steps 1200 --seeds 0 1 2

    The canonical means are the points at the middle of the time range. Learning rates are those of the system's
    training, and all times are used from the start. A step is one time and all points.

    Args:
        systems: Presets, or files as `msdgs-train compare` takes them.
        steps: Optimizer steps.
        seeds: Seeds of the layers' weights and the order of the times.
        points: Points of each moving object.
        check: Test this benchmark: an untrained model stays in the middle, a trained one comes closer.
    """
    if check:
        return self_test()
    try:
        known = read_systems(systems, Budget(steps))
        for name, config in known.items():
            if not isinstance(config.model.support, GaussiansConfig | NodesConfig):
                expected = "systems whose nodes, if they have any, are placed when motion begins"
                raise InvalidInput("systems", expected, f"{name}, on the support {config.model.support.kind}")
    except InvalidInput as error:
        report_console().print(f"error: {error}", style="red", markup=False)
        return 1
    torch.set_num_threads(1)
    made = table(f"RMS in 1/1000 scene units, {steps:,} steps", "system", *MOVING, "all", "± over seeds")
    moving = [(name, config) for name, config in known.items() if config.model.layers]
    for name, config in track(moving, "systems", console=Console(stderr=True)):
        errors = np.array([errors_of(config, seed, points) for seed in seeds])
        overall = np.sqrt((errors**2).mean(axis=1))
        spread = statistics.stdev(overall) if len(seeds) > 1 else 0.0
        made.add_row(name, *(f"{e:.1f}" for e in (*errors.mean(axis=0), overall.mean())), f"{spread:.1f}")
    report_console().print(machine(), made)
    return 0


def errors_of(config: TrainConfig, seed: int, points: int) -> np.ndarray:
    """[objects] RMS distance of a trained model's points from their trajectories, thousandths of a scene unit."""
    local = [surface_points(name, points, seed) for name in MOVING]
    model = _new_model(config, seed, _places(local, 0.5))
    schedule, groups = Schedule.from_config(config), model.motion_groups()
    optimizer = make_optimizer(groups, schedule)
    model.support.on_deform_start(model.gaussians, RowSurgery(model.gaussians, optimizer))
    moved = model.support.points(model.gaussians.means)
    for layer in model.deformation:
        layer.on_deform_start(moved)
    random = np.random.default_rng(seed)
    for step in range(schedule.num_steps):
        set_learning_rates(optimizer, groups, schedule, step, factor=1.0)
        t = float(random.uniform())
        loss = (model.pose(t).means - _places(local, t)).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    squares = np.zeros(len(MOVING))
    with torch.no_grad():
        for t in np.linspace(0, 1, EVALUATED_TIMES):
            off = (model.pose(float(t)).means - _places(local, float(t))).square().sum(dim=1)
            squares += off.reshape(len(MOVING), points).mean(dim=1).double().numpy() / EVALUATED_TIMES
    return 1e3 * np.sqrt(squares)


def _new_model(config: TrainConfig, seed: int, canonical: Tensor) -> DynamicGaussians:
    sizes, generator = config.model, torch.Generator().manual_seed(seed)
    gray = torch.full_like(canonical, 0.5)
    gaussians = CanonicalGaussians.from_points(canonical, gray, sizes.sh_degree, generator, sizes.attributes())
    for name in ("means", "log_scales", "raw_quats", "raw_opacities", "sh_dc", "sh_rest"):
        gaussians.get_parameter(name).requires_grad = False
    torch.manual_seed(seed)
    return DynamicGaussians(sizes, gaussians, SceneBounds(SCENE_HALF_SIZE))


def _places(local: list[np.ndarray], t: float) -> Tensor:
    """[objects · points, 3] positions of the points of all objects at a time."""
    places = [world_positions(name, points, t) for name, points in zip(MOVING, local, strict=True)]
    return torch.from_numpy(np.concatenate(places)).float()


def self_test() -> int:
    """Errors before training are those of points at rest at the middle of the time range."""
    torch.set_num_threads(1)
    at_rest = []
    for name in MOVING:
        local = surface_points(name, 20, 0)
        middle = world_positions(name, local, 0.5)
        off = [world_positions(name, local, t) - middle for t in np.linspace(0, 1, EVALUATED_TIMES)]
        at_rest.append(1e3 * np.sqrt(np.mean(np.sum(np.square(off), axis=2))))
    for name in ("msdgs-small", DEFAULT):
        before, after = (read_systems([name], Budget(steps))[name] for steps in (1, 150))
        np.testing.assert_allclose(errors_of(before, 0, 20), at_rest, rtol=0.05)
        assert (errors_of(after, 0, 20) < 0.8 * np.array(at_rest)).all()
    return main(("msdgs-small",), steps=10, seeds=(0, 1), points=10)


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
