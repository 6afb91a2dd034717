"""What SC-GS's own modules compute, stored in `tests/train/scgs/vectors.npz`.

    python -m tests.support.scgs_reference CHECKOUT

writes the file from a checkout of github.com/yihua7/SC-GS, of which only `utils/time_utils.py` and
`utils/deform_utils.py` run, on the CPU and in float64; pytorch3d's nearest neighbors are replaced by a sort. The state
is drawn from seeds, so that the file holds results alone.
"""

import sys
import types
from collections import namedtuple
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tests.agreement.fields import write

VECTORS = Path(__file__).parents[1] / "train" / "scgs" / "vectors.npz"
NODES, GAUSSIANS, HYPER = 24, 40, 8
TIMES = (0.0, 0.3, 0.95)
STEPS, FITTED_TIMES = 5, (0.1, 0.4, 0.6, 0.8, 0.2)
ELASTIC, ACCELERATION, RIGIDITY = 1e-3, 1e-5, 1e-2
NETWORK_LR, HYPER_LR, EPSILON = 8e-4, 2.5e-3, 1e-15
WIDTH = 256
HEADS = {"gaussian_warp": 3, "gaussian_scaling": 3, "gaussian_rotation": 4, "local_rotation": 4}
SHAPES: dict[str, tuple[int, ...]] = {
    "network.timenet.0.weight": (WIDTH, 13), "network.timenet.0.bias": (WIDTH,),
    "network.timenet.2.weight": (30, WIDTH), "network.timenet.2.bias": (30,),
    "network.linear.0.weight": (WIDTH, 93), "network.linear.0.bias": (WIDTH,),
    **{f"network.linear.{i}.weight": (WIDTH, WIDTH + (93 if i == 5 else 0)) for i in range(1, 8)},
    **{f"network.linear.{i}.bias": (WIDTH,) for i in range(1, 8)},
    **{f"network.{head}.{kind}": (size, WIDTH)[: 2 if kind == "weight" else 1]
       for head, size in HEADS.items() for kind in ("weight", "bias")},
    "nodes": (NODES, 3 + HYPER), "_node_radius": (NODES,), "_node_weight": (NODES, 1),
}  # fmt: skip


def seeded_state() -> dict[str, Tensor]:
    """The state of a network and of nodes under SC-GS's names: float64, of values that float32 can hold."""
    state = {}
    for index, (name, shape) in enumerate(SHAPES.items()):
        values = np.random.default_rng([65, index]).normal(size=shape)
        is_matrix, is_head = name.endswith("weight") and len(shape) == 2, "gaussian_" in name or "local_" in name
        gain = 1.0 if not is_matrix or name == "_node_weight" else 1.4 / np.sqrt(shape[1])
        state[name] = torch.from_numpy(values * gain * (0.3 if is_head else 1.0) * (0.1 if "bias" in name else 1.0))
    state["nodes"][:, 3:] *= 0.1
    state["_node_radius"] = 0.3 * state["_node_radius"] - 0.7
    return {name: values.float().double() for name, values in state.items()}


def seeded_gaussians() -> dict[str, Tensor]:
    """Means, raw quaternions, logarithms of scales and hyper coordinates, and targets of the posed ones:
    float64, of values that float32 can hold."""
    draw = np.random.default_rng(66).normal
    sizes = {"means": 3, "raw_quats": 4, "log_scales": 3, "hyper_coords": HYPER}
    values = {name: torch.from_numpy(draw(size=(GAUSSIANS, columns))) for name, columns in sizes.items()}
    values["hyper_coords"] *= 0.1
    values["log_scales"] = 0.2 * values["log_scales"] + 2.5  # scales stay above 0
    targets = {name: torch.from_numpy(draw(size=(GAUSSIANS, size))) for name, size in
               (("of_means", 3), ("of_quats", 4), ("of_scales", 3))}  # fmt: skip
    return {name: value.float().double() for name, value in (values | targets).items()}


def seeded_draws() -> np.ndarray:
    """[STEPS, 13] uniform numbers that the losses of each step take one after the other."""
    return np.random.default_rng(67).uniform(size=(STEPS, 13))


@contextmanager
def drawn(values: np.ndarray) -> Iterator[None]:
    """Let `torch.rand` give these numbers in order."""
    original, queue = torch.rand, list(values)

    def rand(*shape: Any, **_: Any) -> Tensor:
        size = torch.Size(shape[0] if shape and not isinstance(shape[0], int) else shape)
        return torch.tensor([queue.pop(0) for _ in range(size.numel())], dtype=torch.float64).reshape(size)

    torch.rand = rand
    try:
        yield
    finally:
        torch.rand = original
    assert not queue, "numbers are left over"


def fitted_error(posed: dict[str, Tensor], gaussians: dict[str, Tensor]) -> Tensor:
    """Mean squared distance of posed Gaussians from their targets."""
    return sum(((posed[name] - gaussians[f"of_{name}"]) ** 2).mean() for name in posed)  # pyright: ignore


def _stub_modules() -> None:
    """Stand-ins for pytorch3d, and for a GPU."""
    found = namedtuple("found", ["dists", "idx", "knn"])

    def knn_points(p1: Tensor, p2: Tensor, _1: Any = None, _2: Any = None, K: int = 1, **_: Any) -> Any:
        squares = (p1[:, :, None] - p2[:, None]).square().sum(dim=-1)
        near = squares.sort(dim=-1, stable=True)
        return found(near.values[..., :K], near.indices[..., :K], None)

    modules = {name: types.ModuleType(name) for name in (
        "pytorch3d", "pytorch3d.ops", "pytorch3d.io", "pytorch3d.loss", "pytorch3d.loss.mesh_laplacian_smoothing")
    }  # fmt: skip
    modules["pytorch3d"].ops = modules["pytorch3d.ops"]  # pyright: ignore
    modules["pytorch3d.ops"].knn_points = knn_points  # pyright: ignore
    modules["pytorch3d.ops"].ball_query = None  # pyright: ignore
    modules["pytorch3d.io"].load_ply = None  # pyright: ignore
    modules["pytorch3d.loss.mesh_laplacian_smoothing"].cot_laplacian = None  # pyright: ignore
    sys.modules.update(modules)
    torch.Tensor.cuda = lambda self, *_, **__: self  # pyright: ignore
    torch.nn.Module.cuda = lambda self, *_, **__: self  # pyright: ignore
    to = torch.Tensor.to
    torch.Tensor.to = lambda self, *args, **names: self if args == ("cuda",) else to(self, *args, **names)  # pyright: ignore


def _posed(deform: Any, gaussians: dict[str, Tensor], t: float) -> dict[str, Tensor]:
    """As SC-GS's `render` combines them."""
    time = deform.expand_time(torch.tensor(t))
    feature, mask = gaussians["hyper_coords"], torch.ones(GAUSSIANS, 1)
    moved = deform(gaussians["means"], time, feature=feature, motion_mask=mask, is_training=False)
    return {
        "means": gaussians["means"] + moved["d_xyz"],
        "quats": torch.nn.functional.normalize(gaussians["raw_quats"] + moved["d_rotation"]),
        "scales": gaussians["log_scales"].exp() + moved["d_scaling"],
    }


def computed(control_node_warp: Callable[..., Any]) -> dict[str, np.ndarray]:
    """Poses at first, losses, and poses and parameters after five steps of Adam."""
    deform = control_node_warp(is_blender=True, node_num=NODES, K=3, local_frame=True, hyper_dim=HYPER)
    deform.double().load_state_dict(seeded_state())
    gaussians, results = seeded_gaussians(), {}
    gaussians["hyper_coords"].requires_grad_()
    for i, t in enumerate(TIMES):
        results |= {f"posed{i}.{name}": value for name, value in _posed(deform, gaussians, t).items()}
    groups = [{"params": group["params"], "lr": NETWORK_LR} for group in deform.trainable_parameters()]
    optimizer = torch.optim.Adam([*groups, {"params": [gaussians["hyper_coords"]], "lr": HYPER_LR}], eps=EPSILON)
    losses = []
    for t, draws in zip(FITTED_TIMES, seeded_draws(), strict=True):
        with drawn(draws):
            elastic = deform.elastic_loss(t=torch.tensor(t), delta_t=0.02)
            acceleration = deform.acc_loss(t=torch.tensor(t), delta_t=0.06)
            rigidity = deform.arap_loss()
        losses.append(torch.stack([elastic, acceleration, rigidity]))
        loss = fitted_error(_posed(deform, gaussians, t), gaussians)
        (loss + ELASTIC * elastic + ACCELERATION * acceleration + RIGIDITY * rigidity).backward()
        optimizer.step()
        optimizer.zero_grad()
    results |= {f"fitted.{name}": value for name, value in _posed(deform, gaussians, TIMES[1]).items()}
    results |= {
        "losses": torch.stack(losses), "fitted.node_hypers": deform.nodes[:, 3:],
        "fitted.log_radii": deform._node_radius, "fitted.node_logits": deform._node_weight[:, 0],
        "fitted.hyper_coords": gaussians["hyper_coords"],
    }  # fmt: skip
    return {name: value.detach().numpy() for name, value in results.items()}


def main(checkout: Path) -> None:
    _stub_modules()
    torch.set_default_dtype(torch.float64)
    sys.path.insert(0, str(checkout))
    from utils.time_utils import ControlNodeWarp  # pyright: ignore

    write(VECTORS, checkout, "tests.support.scgs_reference", **computed(ControlNodeWarp))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
