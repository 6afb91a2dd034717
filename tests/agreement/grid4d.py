"""Outputs of Grid4D's own program (https://github.com/JiaweiXu8/Grid4D), stored in grid4d.npz.

    python -m tests.agreement.grid4d CHECKOUT

runs the network and five optimizer steps of a checkout on a CPU. Its CUDA kernels are compiled as C++, one thread after
another (needs g++); everything else is its Python code, with devices left out. Weights, points and times come from
seeds, so that the vectors are small.
"""

import ctypes
import json
import re
import subprocess
import sys
import tempfile
import types
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tests.agreement.fields import write

VECTORS = Path(__file__).with_suffix(".npz")
TIMES = (0.0, 0.37, 1.0)
RATES = {"position_lr_init": 1.6e-4, "position_lr_final": 1.6e-6, "network_lr_scale": 5.0, "grid_lr_scale": 50.0}
LAST_STEP = 10  # of the decay of rates
PERTURBED = {"spatial_perturb_range": 1e-2, "temporal_perturb_range": [1e-2, 1e-2, 1e-2, 1e-3]}
WEIGHT = 0.5  # of each regularizer


class Case(NamedTuple):
    """Sizes of a network, and the number of points at which it is evaluated."""

    grid: Mapping[str, Any]
    network: Mapping[str, Any]
    points: int
    steps: int = 0


CASES = {
    "published": Case({}, {"depth": 0, "width": 256}, 48),
    "small": Case(
        {
            "canonical_num_levels": 4,
            "canonical_base_resolution": 4,
            "canonical_desired_resolution": 30,
            "canonical_log2_hashmap_size": 9,
            "deform_num_levels": 3,
            "deform_base_resolution": [4, 5, 3],
            "deform_desired_resolution": [9, 12, 7],
            "deform_log2_hashmap_size": 8,
        },
        {"depth": 1, "width": 16},
        40,
        steps=5,
    ),
}


def seeded(name: str, shape: tuple[int, ...]) -> Tensor:
    """Numbers of a parameter: tables of ± 0.5, so that each level counts, and weights as large as torch's own."""
    generator = np.random.default_rng(sum(name.encode()) + shape[0])
    size = 0.5 if name.endswith("embeddings") else shape[-1] ** -0.5
    return torch.from_numpy(generator.uniform(-size, size, shape).astype(np.float32))


def stored_states(vectors: Mapping[str, np.ndarray], case: str) -> list[dict[str, Tensor]]:
    """The seeded checkpoint of a case, of the grids and of the network."""
    states = []
    for k, text in enumerate(vectors[f"{case}.shapes"]):
        prefix = f"{case}.{k}."
        state = {n.removeprefix(prefix): torch.from_numpy(vectors[n]) for n in vectors if n.startswith(prefix)}
        state |= {name: seeded(name, tuple(shape)) for name, shape in json.loads(str(text)).items()}
        states.append(state)
    return states


def points(count: int) -> Tensor:
    """[N, 3] mostly inside of the grids' cube of ± 1.6; some are outside, one is at a corner."""
    found = np.random.default_rng(7).uniform(-1.65, 1.65, (count, 3)).astype(np.float32)
    found[0], found[1] = 1.6, (-1.6, 0.3, 1.6)
    return torch.from_numpy(found)


def targets(count: int) -> Tensor:
    """[N, 10] means, rotations and scales that five steps approach."""
    return torch.from_numpy(np.random.default_rng(8).uniform(-0.5, 0.5, (count, 10)).astype(np.float32))


def loss(means: Tensor, quats: Tensor, scales: Tensor) -> Tensor:
    """The squared distance of deformed means, [N, 3], and deltas, [N, 4] and [N, 3], from `targets`."""
    return (torch.cat([means, quats, scales], dim=1) - targets(len(means))).square().mean()


SHIM = """
#include <cmath>
#include <cstdint>
#include <type_traits>
#define __global__
#define __device__
struct Place { uint32_t x, y; };
static thread_local Place blockIdx, blockDim{1, 1}, threadIdx{0, 0};
namespace at { struct Half {}; }
struct __half { __half(float) {} };
struct __half2 { __half x, y; };
static void atomicAdd(__half2*, __half2) {}
static void atomicAdd(float* place, float value) { *place += value; }
"""
ENTRIES = """
extern "C" void forward(const float* inputs, const float* table, const int* offsets, float* outputs, uint32_t B,
                        uint32_t L, const float* scales, const float* bases, bool slopes, float* dy_dx) {
    for (blockIdx.y = 0; blockIdx.y < L; blockIdx.y++)
        for (blockIdx.x = 0; blockIdx.x < B; blockIdx.x++)
            kernel_grid<float, 3, 2>(inputs, table, offsets, outputs, B, L, scales, bases, slopes, dy_dx);
}
extern "C" void backward(const float* grad, const float* inputs, const float* table, const int* offsets,
                         float* grad_table, uint32_t B, uint32_t L, const float* scales, const float* bases) {
    for (blockIdx.y = 0; blockIdx.y < L; blockIdx.y++)
        for (blockIdx.x = 0; blockIdx.x < B; blockIdx.x++)
            kernel_grid_backward<float, 3, 2, 2>(grad, inputs, table, offsets, grad_table, B, L, scales, bases);
}
"""


def compiled(checkout: Path, folder: Path) -> ctypes.CDLL:
    """Its kernels for three axes and two channels in float32, as functions that run one thread after another."""
    source = (checkout / "hashencoder" / "src" / "hashencoder.cu").read_text()
    first = source.index("template <uint32_t D>\n__device__ uint32_t fast_hash")
    last = re.search(r"template <[^>]*>\n__global__ void kernel_grid_second_backward_grad", source)
    assert last is not None
    file = folder / "kernels.cpp"
    file.write_text(SHIM + source[first : last.start()] + ENTRIES)
    library = folder / "kernels.so"
    subprocess.run(["g++", "-O2", "-w", "-ffp-contract=off", "-shared", "-fPIC", file, "-o", library], check=True)
    return ctypes.CDLL(str(library))


def stand_in(library: ctypes.CDLL) -> Any:
    """A module `hashencoder.backend` that calls these functions."""

    def address(tensor: Tensor) -> ctypes.c_void_p:
        assert tensor.is_contiguous()
        return ctypes.c_void_p(tensor.data_ptr())

    def forward(inputs, table, offsets, outputs, B, D, C, L, scales, bases, slopes, dy_dx) -> None:
        assert (D, C) == (3, 2)
        given = [address(tensor) for tensor in (inputs, table, offsets, outputs)]
        library.forward(*given, B, L, address(scales), address(bases), slopes, address(dy_dx))

    def backward(grad, inputs, table, offsets, into, B, D, C, L, scales, bases, slopes, *_) -> None:
        assert (D, C, slopes) == (3, 2, False)
        given = [address(tensor) for tensor in (grad, inputs, table, offsets, into)]
        library.backward(*given, B, L, address(scales), address(bases))

    module: Any = types.ModuleType("hashencoder.backend")
    module._backend = types.SimpleNamespace(hash_encode_forward=forward, hash_encode_backward=backward)
    return module


def without_devices() -> None:
    """Make torch leave out the device of what is asked for on "cuda"."""
    made = torch.tensor
    torch.tensor = lambda *args, device=None, **options: made(*args, **options)  # type: ignore[assignment]
    torch.nn.Module.cuda = lambda self, *_: self  # type: ignore[assignment]


def fill(model: Any) -> None:
    """Set the parameters of the grids and of the network."""
    for module in (model.grid4d, model.deform):
        parameters = dict(module.named_parameters())
        module.load_state_dict({n: seeded(n, tuple(p.shape)) for n, p in parameters.items()}, strict=False)


def parameters_of(model: Any) -> list[Tensor]:
    """Copies of all parameters."""
    return [p.detach().clone() for module in (model.grid4d, model.deform) for p in module.parameters()]


def recorded(make: Any, turned: Any, case: Case) -> dict[str, np.ndarray]:
    """Outputs at all times, then the losses of the steps, outputs after them, and norms of all changes."""
    model = make(dict(case.grid), dict(case.network), **PERTURBED)
    fill(model)
    before = parameters_of(model)
    xyz, found = points(case.points), dict[str, np.ndarray]()

    def outputs() -> np.ndarray:
        rows = []
        for t in TIMES:
            with torch.no_grad():
                step = model.step(xyz, torch.full((len(xyz), 1), t))
            rows.append(torch.cat([step["d_xyz"], step["d_rotation"], step["d_scaling"]], dim=1))
        return torch.stack(rows).numpy()

    found["outputs"] = outputs()
    for k, module in enumerate((model.grid4d, model.deform)):
        shapes = {name: list(parameter.shape) for name, parameter in module.named_parameters()}
        found["shapes"] = np.append(found.get("shapes", []), json.dumps(shapes))
        found |= {f"{k}.{name}": tensor.numpy() for name, tensor in module.named_buffers()}
    if case.steps:
        rates = RATES | {"position_lr_delay_mult": 0.01, "deform_lr_max_steps": LAST_STEP}
        model.train_setting(types.SimpleNamespace(**rates))
        losses = []
        for k in range(case.steps):
            torch.manual_seed(k)
            step = model.step(xyz, torch.full((len(xyz), 1), TIMES[k % len(TIMES)]))
            means = turned(step["d_xyz"][:, :4]) @ xyz[:, :, None] + step["d_xyz"][:, 4:, None]
            total = loss(means[:, :, 0], step["d_rotation"], step["d_scaling"])
            total = total + WEIGHT * step["reg_spatial"].mean() + WEIGHT * step["reg_temporal"].mean()
            total.backward()
            model.optimizer.step()
            model.optimizer.zero_grad()
            model.update_learning_rate(k + 1)
            losses.append(float(total.detach()))
        found |= {"losses": np.array(losses), "trained": outputs()}
        changes = [(a - b).double().norm() for a, b in zip(parameters_of(model), before, strict=True)]
        found["changes"] = torch.stack(changes).numpy()
    return found


def main(checkout: Path) -> None:
    """Write the vectors."""
    with tempfile.TemporaryDirectory() as folder:
        sys.path.insert(0, str(checkout))
        sys.modules["hashencoder.backend"] = stand_in(compiled(checkout, Path(folder)))
        sys.modules["cachetools"] = types.ModuleType("cachetools")
        sys.modules["cachetools"].cached = None  # type: ignore[attr-defined]
        sys.modules["scene"] = types.ModuleType("scene")  # without its loaders of datasets
        sys.modules["scene"].__path__ = [str(checkout / "scene")]
        without_devices()
        from scene.deform_model import DeformModel  # type: ignore[import-not-found]
        from utils.general_utils import quaternion_to_matrix  # type: ignore[import-not-found]

        found = dict[str, np.ndarray]()
        for name, case in CASES.items():
            values = recorded(DeformModel, quaternion_to_matrix, case)
            found |= {f"{name}.{key}": value for key, value in values.items()}
    write(VECTORS, checkout, "tests.agreement.grid4d", **found)


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
