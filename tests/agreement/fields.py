"""What the deformation fields of published programs and of this project are compared on."""

import json
import subprocess
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

TIMES = (0.0, 0.37, 1.0)
POINTS = 40
STEPS, LAST_STEP = 5, 10  # of the optimizer, and of the decay of its rates

Field = Callable[[Tensor, float], Tensor]
"""Deltas of means, quaternions and scales, [N, 10], of points, [N, 3], at a time."""


def seeded(name: str, shape: Sequence[int]) -> Tensor:
    """Numbers of a parameter: planes around their first values, and weights as large as torch's own."""
    generator = np.random.RandomState(sum(name.encode()) + shape[0])
    size = 0.5 if ".grids." in name else shape[-1] ** -0.5
    return torch.from_numpy(generator.uniform(-size, size, shape).astype(np.float32)) + (0.7 if size == 0.5 else 0.0)


def seeded_state(vectors: Mapping[str, np.ndarray]) -> dict[str, Tensor]:
    """The state of a network whose names and shapes are stored."""
    return {name: seeded(name, shape) for name, shape in json.loads(str(vectors["shapes"])).items()}


def points() -> Tensor:
    """[N, 3] in the cube of ± 1.3."""
    return torch.from_numpy(np.random.RandomState(7).uniform(-1.3, 1.3, (POINTS, 3)).astype(np.float32))


def loss(deltas: Tensor) -> Tensor:
    """The squared distance of deltas, [N, 10], from targets that five steps approach."""
    targets = np.random.RandomState(8).uniform(-0.5, 0.5, deltas.shape).astype(np.float32)
    return (deltas - torch.from_numpy(targets)).square().mean()


def outputs(field: Field) -> np.ndarray:
    """[T, N, 10] at all times."""
    with torch.no_grad():
        return torch.stack([field(points(), t) for t in TIMES]).numpy()


def trained(field: Field, step: Callable[[int], None], optimizer: torch.optim.Optimizer) -> np.ndarray:
    """The losses of five steps, [S]; `step` is called before each, counted from 0."""
    losses = []
    for i in range(STEPS):
        step(i)
        optimizer.zero_grad(set_to_none=True)
        value = loss(field(points(), TIMES[i % len(TIMES)]))
        value.backward()
        optimizer.step()
        losses.append(value.item())
    return np.array(losses)


def load_seeded(network: nn.Module, kept: Sequence[str] = ()) -> str:
    """Give a program's network the seeded state, but for the names `kept`; returns names and shapes as JSON."""
    shapes = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items() if name not in kept}
    network.load_state_dict({name: seeded(name, shape) for name, shape in shapes.items()}, strict=False)
    return json.dumps(shapes)


def write(file: Path, checkout: Path, module: str, **arrays: np.ndarray | str) -> None:
    """Store vectors with the commit of the checkout, and the command that made them."""
    commit = subprocess.check_output(["git", "-C", str(checkout), "rev-parse", "HEAD"], text=True).strip()
    np.savez_compressed(file, commit=commit, command=f"python -m {module} CHECKOUT", **arrays)  # type: ignore[arg-type]
