"""How well the systems of a comparison can follow motion at all: their layers are taught where points of the synthetic
scene are, which is known, instead of images."""

import statistics
import sys
from pathlib import Path
from typing import Annotated

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch import Tensor

from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.comparison.matrix import Budget, System, read_systems
from msdgs_train.datasets.synthetic.motion import OBJECTS, world_positions
from msdgs_train.datasets.synthetic.trajectories import surface_points
from msdgs_train.engine.optimizer import learning_rates, make_optimizer, set_learning_rates
from msdgs_train.gaussians.canonical import CanonicalGaussians
from msdgs_train.gaussians.model import DynamicGaussians, SceneBounds

MOVING = OBJECTS[2:]
HALF_EXTENT = 1.3  # scene units
JUDGED_TIMES = 61


def main(
    systems: Annotated[tuple[str, ...], tyro.conf.Positional] = ("benchmarks/ablation.toml",),
    steps: int = 1_200,
    seeds: tuple[int, ...] = (0, 1, 2),
    points: int = 400,
) -> int:
    """Teach each system the motion of points, and tell how far from them it ends.

    python benchmarks/known_motion.py benchmarks/ablation.toml --steps 1200 --seeds 0 1 2

    The canonical means are the points at the middle of time; learning rates are those of the system's training, all of
    time takes part from the start. A step is one time and all points.

    Args:
        systems: Presets, or files as `msdgs-train compare` takes them.
        steps: Of the optimiser.
        seeds: Of the layers' weights and the order of the times.
        points: Of each of the objects that move.
    """
    console = Console(soft_wrap=True, highlight=False)
    try:
        known = read_systems(systems, Budget(steps))
    except InvalidInput as error:
        console.print(f"error: {error}", style="red", markup=False)
        return 1
    torch.set_num_threads(1)
    table = Table("system", *MOVING, "all", "± over seeds", box=None, title=f"1/1000 scene units, rms, {steps:,} steps")
    followed = [system for system in known if system.config.model.layers]
    for system in track(followed, "systems", console=Console(stderr=True)):
        errors = np.array([errors_of(system, seed, points) for seed in seeds])
        overall = np.sqrt((errors**2).mean(axis=1))
        spread = statistics.stdev(overall) if len(seeds) > 1 else 0.0
        table.add_row(system.name, *(f"{e:.1f}" for e in (*errors.mean(axis=0), overall.mean())), f"{spread:.1f}")
    console.print(table)
    return 0


def errors_of(system: System, seed: int, points: int) -> np.ndarray:
    """[objects] rms distance of a taught model's points to where they are, thousandths of a scene unit."""
    local = [surface_points(name, points, seed) for name in MOVING]
    model, config = _new_model(system, seed, _places(local, 0.5)), system.config
    optimizer = make_optimizer(model, config)
    random = np.random.default_rng(seed)
    for step in range(config.steps):
        set_learning_rates(optimizer, learning_rates(config, step))
        t = float(random.uniform())
        loss = (model.pose(t).means - _places(local, t)).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    squares = np.zeros(len(MOVING))
    with torch.no_grad():
        for t in np.linspace(0, 1, JUDGED_TIMES):
            off = (model.pose(float(t)).means - _places(local, float(t))).square().sum(dim=1)
            squares += off.reshape(len(MOVING), points).mean(dim=1).double().numpy() / JUDGED_TIMES
    return 1e3 * np.sqrt(squares)


def _new_model(system: System, seed: int, canonical: Tensor) -> DynamicGaussians:
    sizes, generator = system.config.model, torch.Generator().manual_seed(seed)
    rest = (sizes.sh_degree, sizes.embedding_dim, generator, sizes.motions)
    gaussians = CanonicalGaussians.from_points(canonical, torch.full_like(canonical, 0.5), *rest)
    gaussians.requires_grad_(requires_grad=False)
    if gaussians.embeddings is not None:
        gaussians.embeddings.requires_grad_()
    torch.manual_seed(seed)
    return DynamicGaussians(sizes, gaussians, SceneBounds(HALF_EXTENT))


def _places(local: list[np.ndarray], t: float) -> Tensor:
    """[objects · points, 3] of all objects at a time."""
    places = [world_positions(name, points, t) for name, points in zip(MOVING, local, strict=True)]
    return torch.from_numpy(np.concatenate(places)).float()


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
