"""Vectors of the published HexPlane and TiNeuVox, by their own code on a CPU.

    git clone https://github.com/Caoang327/HexPlane && git -C HexPlane checkout fc99b61
    python -m tests.support.volume_references hexplane HexPlane
    git clone https://github.com/hustvl/TiNeuVox && git -C TiNeuVox checkout d1f3adb
    python -m tests.support.volume_references tineuvox TiNeuVox

write `hexplane.npz` and `tineuvox.npz` in `tests/train/volumes`. Each has the colors of `RAYS` random rays after 0 and
after `STEPS` optimizer steps of the repository's own loop on them, with a growth of its grids in between, and its
tensors after that; large ones as their first and last `KEPT` values. First tensors, rays and colors are those of
`seeded` and `scene_of_rays`. Packages that aren't needed are empty here, and CUDA kernels are their formulas.
"""

import argparse
import dataclasses
import importlib
import math
import sys
import tempfile
from collections.abc import Iterator
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import torch

from tests.agreement.fields import write

VECTORS = Path(__file__).parents[1] / "train" / "volumes"
RAYS, STEPS, GROWN_AFTER, KEPT = 48, 5, 2, 150
HEX_SIZES = ((12, 4), (15, 6))  # vertices along space and time, before and after
VOXELS = 9**3  # of TiNeuVox, after its growth

HEX_NAMES = {
    **{f"density_space.{i}": f"density_plane.{i}" for i in range(3)},
    **{f"density_time.{i}": f"density_line_time.{i}" for i in range(3)},
    **{f"color_space.{i}": f"app_plane.{i}" for i in range(3)},
    **{f"color_time.{i}": f"app_line_time.{i}" for i in range(3)},
    **{f"density_scales.{i}": f"density_basis_mat.{i}" for i in range(3)},
    "color_matrix.weight": "app_basis_mat.weight",
    **{f"color_mlp.{i}.{part}": f"app_regressor.mlp.{i}.{part}" for i in (0, 2, 4) for part in ("weight", "bias")},
}
TINEUVOX_NAMES = {"grid": "feature"} | {
    f"{own}.{part}": f"{theirs}.{part}"
    for own, theirs in (
        ("time_net.0", "timenet.0"), ("time_net.2", "timenet.2"), ("deformation.0", "deformation_net._time.0"),
        ("deformation.2", "deformation_net._time.1"), ("deformation.4", "deformation_net._time_out"),
        ("feature_net", "featurenet.0"), ("density_net", "densitynet"), ("color_net", "rgbnet.feature_linears"),
        ("view_net.0", "rgbnet.views_linears.0"), ("view_net.2", "rgbnet.views_linears.2"),
    )
    for part in ("weight", "bias")
}  # fmt: skip
"""Names of tensors: this project's, theirs."""


def seeded(shapes: dict[str, tuple[int, ...]]) -> dict[str, torch.Tensor]:
    """Random tensors by name: grids and biases of size 1, matrices scaled by their inputs; densities such that some
    parts are empty and some rays end."""
    numbers = np.random.default_rng(65)
    sizes = {"density_space": 0.7, "density_time": 0.7, "density_net": -4.0}
    state = {}
    for name, shape in sorted(shapes.items()):
        scale = sizes.get(name.split(".")[0], 1.0) / (math.sqrt(shape[1]) if len(shape) == 2 else 1.0)
        state[name] = torch.from_numpy(scale * numbers.standard_normal(shape)).to(torch.get_default_dtype())
    return state


class SceneOfRays(SimpleNamespace):
    """Rays from 4 units away, and colors."""

    origins: torch.Tensor  # [R, 3]
    directions: torch.Tensor  # [R, 3] not of unit length
    times: torch.Tensor  # [R] in [0, 1]
    rgb: torch.Tensor  # [R, 3]


def scene_of_rays() -> SceneOfRays:
    """Those that the references were made with, of torch's default type."""
    numbers = np.random.default_rng(1)
    positions = numbers.standard_normal((RAYS, 3))
    positions *= 4 / np.linalg.norm(positions, axis=1, keepdims=True)
    inward = -positions + numbers.uniform(-0.8, 0.8, (RAYS, 3))
    lengths = numbers.uniform(1.0, 1.15, (RAYS, 1)) / np.linalg.norm(inward, axis=1, keepdims=True)
    values = positions, inward * lengths, numbers.uniform(size=RAYS), numbers.uniform(size=(RAYS, 3))
    names = "origins", "directions", "times", "rgb"
    return SceneOfRays(
        **{n: torch.from_numpy(v).to(torch.get_default_dtype()) for n, v in zip(names, values, strict=True)}
    )


def kept(tensor: torch.Tensor) -> np.ndarray:
    """The part of a tensor that is stored."""
    values = tensor.detach().numpy().ravel()
    return values if len(values) <= 2 * KEPT else np.concatenate([values[:KEPT], values[-KEPT:]])


def hexplane(checkout: Path) -> dict[str, np.ndarray]:
    """Vectors of HexPlane_Slim, from `Trainer.train`, in float64."""
    torch.set_default_dtype(torch.float64)
    _empty(
        "imageio", "kornia", "lpips", "pytorch_msssim", "cv2", "plyfile", "skimage", "skimage.measure", "scipy.signal"
    )
    _empty("tqdm", "tqdm.auto", tqdm=_Steps)
    sys.path.insert(0, str(checkout))
    slim = importlib.import_module("hexplane.model.HexPlane_Slim")
    trainer = importlib.import_module("hexplane.render.trainer")
    source = (checkout / "config" / "config.py").read_text().split("@dataclass\nclass Config:")[0]
    settings: dict[str, Any] = {"__name__": "settings"}
    sys.modules["settings"] = ModuleType("settings")
    exec(source, settings)
    (n, times), (grown, grown_times) = HEX_SIZES
    model_config = settings["Model_Config"](
        upsampling_type="unaligned", upsample_list=[GROWN_AFTER - 1], update_emptymask_list=[GROWN_AFTER],
        N_voxel_init=round(n**3 * 1.001), N_voxel_final=round(grown**3 * 1.001),
        time_grid_init=times, time_grid_final=grown_times,
    )  # fmt: skip
    optim = settings["Optim_Config"](n_iters=STEPS, lr_decay_step=25_000, batch_size=RAYS)
    cfg = SimpleNamespace(
        model=model_config, optim=optim, data=settings["Data_Config"](N_vis=0), systems=settings["System_Config"]()
    )
    box = torch.tensor([[-1.5] * 3, [1.5] * 3])
    model = slim.HexPlane_Slim(box, [n] * 3, "cpu", times, [2.0, 6.0], **dataclasses.asdict(model_config))
    whole = (
        model.updateEmptyMask
    )  # times at the vertices, where features are largest: this project's masks have no others
    model.updateEmptyMask = lambda size: whole(size, model.density_line_time[0].shape[3])
    _load(model, HEX_NAMES)
    scene = scene_of_rays()
    rays = torch.cat([scene.origins, torch.nn.functional.normalize(scene.directions, dim=1)], dim=1)
    samples = lambda size: int(np.linalg.norm([size] * 3) / 0.5)  # noqa: E731
    moments = 2 * scene.times[:, None] - 1
    result = {"rgb.0": model(rays, moments, N_samples=samples(n))[0]}
    dataset = _Dataset(rays, scene.rgb, moments)
    writer = SimpleNamespace(add_scalar=lambda *_, **__: None)
    torch.manual_seed(0)
    trainer.Trainer(model, cfg, [n] * 3, dataset, dataset, writer, "", "cpu").train()
    result["rgb.last"] = model(rays, moments, N_samples=samples(grown))[0]
    result["empty"] = (model.emptyMask.empty_volume == 0).float().mean()
    return _stored(result, model, HEX_NAMES)


def tineuvox(checkout: Path) -> dict[str, np.ndarray]:
    """Vectors of TiNeuVox's small model, from `scene_rep_reconstruction`, in float64."""
    torch.set_default_dtype(torch.float64)
    torch.Tensor.float = torch.Tensor.double  # type: ignore[method-assign]  # of its grid and its optimizer
    _empty("imageio", "mmcv", "pytorch_msssim", "cv2", "lpips", "tkinter", "scipy.signal")
    _empty("tqdm", tqdm=_Steps, trange=lambda *bounds: _Steps(range(*bounds)))
    _empty("torch_scatter", segment_coo=lambda src, index, out, reduce: out.index_add(0, index, src))
    kernels = {"render_utils_cuda": _RayKernels, "adam_upd_cuda": _AdamKernels}
    cpp_extension = importlib.import_module("torch.utils.cpp_extension")
    cpp_extension.load = lambda name, **_: kernels.get(name)  # type: ignore[attr-defined]
    sys.path.insert(0, str(checkout))
    run: Any = importlib.import_module("run")
    lib: Any = importlib.import_module("lib.tineuvox")
    settings: dict[str, Any] = {}
    exec((checkout / "configs" / "nerf-small" / "default.py").read_text(), settings)
    cfg_model, cfg_train = _Settings(settings["model_and_render"]), _Settings(settings["train_config"])
    cfg_model.update(num_voxels=VOXELS, num_voxels_base=VOXELS, world_bound_scale=1.0)
    cfg_train.update(N_iters=STEPS, N_rand=RAYS, pg_scale=[GROWN_AFTER + 1], ray_sampler="flatten")
    models, scene = [], scene_of_rays()

    initialized = lib.TiNeuVox.__init__

    def seed(model: Any, **arguments: Any) -> None:
        initialized(model, **arguments)
        model.feature = torch.nn.Parameter(model.feature.double())
        _load(model, TINEUVOX_NAMES)
        models.append(model)

    lib.TiNeuVox.__init__, views = seed, scene.directions / scene.directions.norm(dim=1, keepdim=True)
    inputs = scene.origins, scene.directions, views, scene.times[:, None]
    march = {"near": 2.0, "far": 6.0, "bg": 1, "stepsize": cfg_model.stepsize}
    gathered = scene.rgb, scene.times[:, None], scene.origins, scene.directions, views, None
    lib.get_training_rays_flatten = lambda **_: gathered
    lib.batch_indices_generator = lambda *_: iter([torch.arange(RAYS)] * STEPS)
    data = dict.fromkeys(("HW", "Ks", "i_val", "i_test", "render_poses", "render_times"), np.zeros(1))
    data |= {"near": 2.0, "far": 6.0, "i_train": [0], "poses": np.zeros(1), "times": [0.0]}
    data |= {"irregular_shape": True, "images": [torch.zeros(1)]}
    low, high = torch.tensor([-1.7, -1.5, -1.4]), torch.tensor([1.5, 1.6, 1.3])
    first = {}
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "small").mkdir()
        dataset = _Settings(dataset_type="dnerf", load2gpu_on_the_fly=False, ndc=False, white_bkgd=True)
        cfg = SimpleNamespace(data=dataset, basedir=folder, expname="small")
        arguments = SimpleNamespace(step_to_half=19_000, i_print=10**9, fre_test=10**9)
        optimizer = run.utils.create_optimizer_or_freeze_model

        def started(model: Any, *rest: Any, **named: Any) -> Any:
            if not first:
                first["rgb.0"] = model(*inputs, **march)["rgb_marched"]
            return optimizer(model, *rest, **named)

        run.utils.create_optimizer_or_freeze_model = started
        run.scene_rep_reconstruction(arguments, cfg, cfg_model, cfg_train, low, high, data)
    (model,) = models
    last = model(*inputs, **march)
    result = first | {"rgb.last": last["rgb_marched"], "box": torch.stack([low, high])}
    return _stored(result, model, TINEUVOX_NAMES)


class _Settings(dict):
    """Settings by attribute."""

    def __getattr__(self, name: str) -> Any:
        if name not in self:
            raise AttributeError(name)
        return self[name]


class _RayKernels:
    """render_utils_kernel.cu as formulas, in loops over rays."""

    @staticmethod
    def sample_pts_on_rays(
        origins: torch.Tensor, directions: torch.Tensor, low: torch.Tensor, high: torch.Tensor, near: float, far: float,
        edge: torch.Tensor,
    ) -> tuple[torch.Tensor | None, ...]:  # fmt: skip
        points, rays, steps = [], [], []
        for ray, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
            slope = torch.where(direction == 0, 1e-6, direction)
            one, other = (high - origin) / slope, (low - origin) / slope
            enters = torch.minimum(one, other).max().clamp(near, far)
            leaves = torch.maximum(one, other).min().clamp(near, far)
            for step in range(max(math.ceil((leaves - enters) / edge), 1)):
                points.append(origin + direction * enters + direction / direction.norm() * edge * step)
                rays.append(ray)
                steps.append(step)
        found = torch.stack(points)
        outside = ((found < low) | (found > high)).any(dim=1)
        return found, outside, torch.tensor(rays), torch.tensor(steps), None, None, None

    @staticmethod
    def alpha2weight(alpha: torch.Tensor, rays: torch.Tensor, count: int) -> tuple[torch.Tensor, ...]:
        weights, before, left = torch.zeros_like(alpha), torch.ones_like(alpha), torch.ones(count)
        ends = torch.zeros(count, dtype=torch.int64)
        starts = torch.searchsorted(rays, torch.arange(count))
        for ray in range(count):
            i, stop, seen = int(starts[ray]), int((rays <= ray).sum()), 1.0
            while i < stop:
                before[i], weights[i] = seen, seen * alpha[i]
                seen, i = seen * (1 - float(alpha[i])), i + 1
                if seen < 1e-3:
                    break
            left[ray], ends[ray] = seen, i
        return weights, before, left, starts, ends

    @staticmethod
    def alpha2weight_backward(
        alpha: torch.Tensor, weights: torch.Tensor, before: torch.Tensor, left: torch.Tensor, starts: torch.Tensor,
        ends: torch.Tensor, count: int, of_weights: torch.Tensor, of_left: torch.Tensor,
    ) -> torch.Tensor:  # fmt: skip
        gradient = torch.zeros_like(alpha)
        for ray in range(count):
            behind = of_left[ray] * left[ray]
            for i in reversed(range(int(starts[ray]), int(ends[ray]))):
                gradient[i] = of_weights[i] * before[i] - behind / (1 - alpha[i] + 1e-10)
                behind = behind + of_weights[i] * weights[i]
        return gradient


class _AdamKernels:
    """adam_upd_kernel.cu as formulas."""

    @staticmethod
    def adam_upd(
        value: torch.Tensor, gradient: torch.Tensor, first: torch.Tensor, second: torch.Tensor, step: int,
        beta1: float, beta2: float, rate: float, eps: float,
    ) -> None:  # fmt: skip
        size = rate * math.sqrt(1 - beta2**step) / (1 - beta1**step)
        first.copy_(beta1 * first + (1 - beta1) * gradient)
        second.copy_(beta2 * second + (1 - beta2) * gradient * gradient)
        value -= size * first / (second.sqrt() + eps)

    @staticmethod
    def masked_adam_upd(
        value: torch.Tensor, gradient: torch.Tensor, first: torch.Tensor, second: torch.Tensor, *rest: Any
    ) -> None:
        old = value.clone(), first.clone(), second.clone()
        _AdamKernels.adam_upd(value, gradient, first, second, *rest)
        for tensor, before in zip((value, first, second), old, strict=True):
            tensor.copy_(torch.where(gradient == 0, before, tensor))


class _Steps:
    """A progress bar that shows nothing."""

    def __init__(self, steps: range, **_: Any) -> None:
        self._steps = steps

    def __iter__(self) -> Iterator[int]:
        return iter(self._steps)

    def set_description(self, _: str) -> None: ...


class _Dataset:
    """All rays, in any order."""

    ndc_ray, white_bg, depth_data = False, True, False

    def __init__(self, rays: torch.Tensor, rgb: torch.Tensor, times: torch.Tensor) -> None:
        self.all_rays, self.all_rgbs, self.all_times, self.all_depths = rays, rgb, times, None

    def __len__(self) -> int:
        return len(self.all_rays)

    def __getitem__(self, index: torch.Tensor) -> dict[str, torch.Tensor]:
        return {"rays": self.all_rays[index], "rgbs": self.all_rgbs[index], "time": self.all_times[index]}


def _load(model: torch.nn.Module, names: dict[str, str]) -> None:
    own = {name: tuple(model.get_parameter(theirs).shape) for name, theirs in names.items()}
    for name, tensor in seeded(own).items():
        model.get_parameter(names[name]).data.copy_(tensor)


def _stored(result: dict[str, Any], model: torch.nn.Module, names: dict[str, str]) -> dict[str, np.ndarray]:
    tensors = {f"state.{name}": model.get_parameter(theirs) for name, theirs in names.items()}
    return {name: kept(tensor) for name, tensor in tensors.items()} | {
        name: value.detach().numpy() for name, value in result.items()
    }


def _empty(*names: str, **contents: Any) -> None:
    """Packages that are imported and not needed."""

    class Empty(ModuleType):
        def __getattr__(self, name: str) -> Any:
            return None

    for name in names:
        module = Empty(name)
        vars(module).update(contents, __path__=[], __spec__=ModuleSpec(name, None))
        sys.modules[name] = module


def main() -> None:
    """Write the vectors of one repository."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", choices=["hexplane", "tineuvox"])
    parser.add_argument("checkout", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    name, checkout = arguments.name, arguments.checkout.resolve()
    arrays = globals()[name](checkout)
    write(VECTORS / f"{name}.npz", checkout, f"tests.support.volume_references {name}", **arrays)


if __name__ == "__main__":
    main()
